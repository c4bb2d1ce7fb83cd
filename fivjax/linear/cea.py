r"""Complex eigenvalue analysis of steady sliding: its modes, where it loses stability, and which parameter to change.

The linearised motion is the Jacobian of `contact` at the sliding state (`linearisation`), so friction that falls with
speed enters as it should. Its eigenvalues $λ$ have a frequency $|\mathrm{Im}\,λ|/2π$ and a growth rate
$\mathrm{Re}\,λ$.

What belongs to the same questions is at hand here too: `critical_friction`, `stability_limit`, `coalescence`,
`critical_slope` (from `critical`), `margin` and `chart` (from `stability`). Design by gradient is in `design`.
"""

from collections.abc import Iterator, Mapping

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import xarray as xr
from jaxtyping import Array, Complex, Float

from ..foundation import arguments
from ..foundation.compiling import compiled
from ..foundation.precision import in_double_precision, is_known, real, returning_numpy
from ..io.datasets import QUANTITIES, labelled
from ..model.scene import Scene, sliding_equilibrium, steady_sliding
from ..model.structure import Structure
from .critical import Coalescence as Coalescence
from .critical import Mechanism as Mechanism
from .critical import Outcome as Outcome
from .critical import StabilityLimit as StabilityLimit
from .critical import coalescence as coalescence
from .critical import critical_friction as critical_friction
from .critical import critical_slope as critical_slope
from .critical import friction_slope as friction_slope
from .critical import stability_limit as stability_limit
from .critical import with_own_gradient
from .linearisation import linear_sliding
from .routh_hurwitz import as_scene, check_direction, with_axes
from .routh_hurwitz import chart as chart
from .routh_hurwitz import margin as margin

# How often an interval of an axis is halved to tell two modes apart; beyond, they have met. Modes that are one and the
# same all along the axis would be halved everywhere, so the looks taken at one interval are counted too.
HALVINGS = 30
LOOKS = 4 * HALVINGS
# Few enough that LAPACK calls on two parts of a batch do not wait for each other (see `elimination`).
POINTS_AT_ONCE = 256


@returning_numpy
def linearisation(system: Structure | Scene, mu=None, *, direction: int = 1) -> Float[Array, "m m"]:
    """State matrix A of small motions about steady sliding, ż = A z: the Jacobian of `contact`, by autodiff.

    z holds the deviations of the displacements (m) without the normal coordinate, then their velocities (m/s);
    m = 2(n - 1).

    **Arguments:** `system`, a scene, or a structure with constant friction `mu`; `direction`, for a structure, +1 for a
    belt that moves along the tangential coordinate, -1 against it.

    **Raises:** `ValueError` for a scene that has no steady sliding, or where friction is missing or given twice.
    """
    return _matrix(_checked(system, mu, direction))


_matrix = compiled(lambda scene: linear_sliding(scene).matrix)


def _checked(system, mu, direction) -> Scene:
    if mu is not None:
        arguments.real_number("mu", mu, minimum=0)
    scene = as_scene(system, mu, direction)
    if isinstance(system, Scene):
        sliding_equilibrium(scene)
    return scene


@returning_numpy
def eigenvalues(system: Structure | Scene, mu=None, *, direction: int = 1) -> Complex[Array, "... m"]:
    """The 2(n - 1) eigenvalues of steady sliding, in 1/s, sorted by frequency.

    Order: by |Im λ|, then by Re λ, then Im λ; so the two of a conjugate pair are neighbours, the one with negative
    imaginary part first.

    **Arguments:** as in `linearisation`; for a structure `mu` may also be an array, whose shape then comes first in the
    result. Differentiable where the eigenvalues are distinct; near a coalescence the derivative grows without bound. In
    a process without double precision, differentiate `growth_rate` instead (JAX cannot carry complex double precision
    through its backward pass there).
    """
    if mu is not None and np.ndim(mu) > 0:
        arguments.instance("system", system, Structure, "a Structure where `mu` is an array")
        check_direction(direction)
        _check_frictions(mu)
        mu = real(mu)
        return _eigenvalues_over(system, mu.ravel(), direction).reshape(*mu.shape, -1)
    return _eigenvalues(_checked(system, mu, direction))


def _check_frictions(mu) -> None:
    if is_known(mu):
        values = arguments.numeric_array("mu", mu)
        bad = values[~(np.isfinite(values) & (values >= 0))]
        if bad.size:
            raise ValueError(f"Argument `mu` must be non-negative and finite, but holds {bad[0]:g}.")


@compiled
def _eigenvalues(scene):
    found = jnp.linalg.eigvals(linear_sliding(scene).matrix)
    return found[jnp.lexsort((found.imag, found.real, jnp.abs(found.imag)))]


@compiled
def _eigenvalues_over(structure, mu, direction):
    return jax.lax.map(lambda value: _eigenvalues(as_scene(structure, value, direction)), mu, batch_size=POINTS_AT_ONCE)


_growth_rate = compiled(with_own_gradient(lambda scene: jnp.max(jnp.linalg.eigvals(linear_sliding(scene).matrix).real)))


@returning_numpy
def growth_rate(system: Structure | Scene, mu=None, *, direction: int = 1) -> Float[Array, ""]:
    """The largest real part of the eigenvalues of steady sliding, in 1/s: positive where it is unstable.

    Arguments as in `linearisation`. Differentiable in everything (through the eigenvalues, so the derivative grows
    without bound towards a coalescence), in any process; see `margin` for a measure that is smooth there.
    """
    return _growth_rate(_checked(system, mu, direction))


@in_double_precision
def modes(system: Structure | Scene, *, direction: int = 1, **parameters) -> xr.Dataset:
    r"""The modes of steady sliding along one parameter, each followed along the axis.

        fj.cea.modes(fj.belt_oscillator(), mu=np.linspace(0, 0.5, 501))
        fj.cea.modes(scene, belt_speed=np.linspace(0.1, 3, 200))

    A mode is a conjugate pair of eigenvalues, or two real ones where it is overdamped. Modes are numbered by frequency
    at the start of the axis and followed by continuity: an interval in which an eigenvalue moves as far as to its
    neighbour is halved until none does. Modes that cross without coupling are told apart by their shapes. Where two
    modes truly meet (undamped coalescence) nothing tells which is which beyond; there the one of higher frequency goes
    on as the one that grows.

    **Arguments:** `system`; one axis by name, as in `chart`; single numbers replace the system's own value.

    **Returns:** a dataset over the axis and `mode` with `frequency` (Hz, damped), `growth_rate` (1/s), `damping_ratio`
    (-Re λ/|λ|), `eigenvalue` (that of the pair with positive imaginary part, or the larger of two real ones; 1/s),
    `partner` (the other one) and `shape` (complex displacements over `coordinate`, normal one included, the largest
    scaled to 1). NaN where there is no steady sliding. Along `mu`, and with constant friction, also the numbers of
    `stability_limit` and `coalescence`: `mu_crit`, `frequency_crit` (Hz) and `mu_coalescence` (undamped).
    """
    scene, axes = with_axes(system, direction, parameters, count=1)
    ((name, values),) = axes.items()
    at = _Sampler(scene, name)
    samples = at.many(values)
    followed = [samples[0]]
    for k in range(1, len(values)):
        before, now = followed[-1], samples[k]
        at.looks = LOOKS
        if before is not None and now is not None:
            now = now.taken(_matched(at, values[k - 1], before, values[k], now, HALVINGS))
        followed.append(now)
    dataset = _modes_dataset(scene, name, values, followed)
    if name == "mu" and scene.friction.constant:
        dataset = dataset.assign(_limits(scene))
    return labelled(dataset, scene, analysis="modes of steady sliding", direction=direction)


class _Modes(eqx.Module):
    """The modes at one point, in NumPy."""

    eigenvalue: np.ndarray  # (m,)
    partner: np.ndarray  # (m,)
    shape: np.ndarray  # (m, m), one row per mode
    left: np.ndarray  # (m, 2m), what projects a state onto the mode
    right: np.ndarray  # (m, 2m), the mode's state

    def taken(self, order) -> "_Modes":
        return jax.tree.map(lambda array: array[order], self)


class _Sampler:
    """The modes of a scene at values of one parameter."""

    def __init__(self, scene: Scene, name: str):
        self.scene, self.name = scene, name
        self.looks = LOOKS

    def many(self, values: np.ndarray) -> list[_Modes | None]:
        matrices, exist = map(np.asarray, _matrices(self.scene, self.name, real(values)))
        return [_modes_of(matrix) if exists else None for matrix, exists in zip(matrices, exist, strict=True)]

    def between(self, low: float, high: float) -> tuple[float, _Modes | None]:
        """The middle of an interval and the modes there; none once the looks are used up."""
        middle = 0.5 * (low + high)
        if self.looks <= 0 or not low < middle < high:
            return middle, None
        self.looks -= 1
        return middle, self.many(np.array([middle]))[0]


@compiled
def _matrices(scene, name, values):
    def at(value):
        point = scene.replace(**{name: value})
        matrix = linear_sliding(point).matrix
        _, normal_force = steady_sliding(point, point.load.final)
        # An unloaded structure presses with nothing, and its equilibrium need not exist: its linear motion does.
        exists = jnp.all(jnp.isfinite(matrix)) & ~(normal_force < 0)
        return matrix, exists

    return jax.lax.map(at, values, batch_size=POINTS_AT_ONCE)


def _modes_of(matrix: np.ndarray) -> _Modes:
    m = matrix.shape[0] // 2
    found, vectors = np.linalg.eig(matrix)
    upper = np.flatnonzero(np.imag(found) > 0)
    # Real eigenvalues make modes of two neighbours each; conjugate ones come in pairs already.
    single = np.flatnonzero(np.imag(found) == 0)
    single = single[np.argsort(-np.real(found[single]), kind="stable")]
    first = np.concatenate([single[0::2], upper])
    second = np.concatenate([single[1::2], [np.argmin(np.abs(found - found[i].conj())) for i in upper]]).astype(int)
    order = np.lexsort((np.real(found[first]), np.abs(np.imag(found[first]))))
    first, second = first[order], second[order]
    vectors = vectors / np.linalg.norm(vectors, axis=0)
    left = np.linalg.pinv(vectors)
    shape = vectors[:m, first].T
    largest = shape[np.arange(m), np.argmax(np.abs(shape), axis=1)]
    # A mode of a free coordinate at constant speed has displacements all the same; only an empty one would divide by 0.
    shape = shape / np.where(largest == 0, 1.0, largest)[:, None]
    return _Modes(
        eigenvalue=found[first].astype(complex),
        partner=found[second].astype(complex),
        shape=shape.astype(complex),
        left=left[first],
        right=vectors[:, first].T,
    )


def _assigned(cost: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rows and columns of the pairs that together cost least."""
    # Imported when wanted: it takes as long to load as much of the rest.
    from scipy.optimize import linear_sum_assignment

    return linear_sum_assignment(cost)


def _matched(at: _Sampler, x0: float, a: _Modes, x1: float, b: _Modes, halvings: int) -> np.ndarray:
    """For each mode of `a` the index of the same mode in `b`."""
    distance = np.abs(a.eigenvalue[:, None] - b.eigenvalue[None, :])
    rows, order = _assigned(distance)
    moved = distance[rows, order]
    others = np.where(np.arange(len(order))[None, :] == order[:, None], np.inf, distance)
    neighbours = np.minimum(others.min(axis=1, initial=np.inf), _gaps(a.eigenvalue))
    if np.all(moved <= 0.3 * neighbours):
        return order
    middle, half = at.between(x0, x1) if halvings else (x0, None)
    if half is not None:
        first = _matched(at, x0, a, middle, half, halvings - 1)
        second = _matched(at, middle, half, x1, b, halvings - 1)
        return second[first]
    return _met(a, b)


def _gaps(eigenvalues: np.ndarray) -> np.ndarray:
    between = np.abs(eigenvalues[:, None] - eigenvalues[None, :])
    return np.where(np.eye(len(eigenvalues), dtype=bool), np.inf, between).min(axis=1, initial=np.inf)


def _met(a: _Modes, b: _Modes) -> np.ndarray:
    """The same as `_matched` where two modes of `a` have come together at one point."""
    # Modes that merely cross keep their shapes: what projects onto one before finds one only afterwards.
    share = np.abs(a.left @ b.right.T)
    rows, order = _assigned(-share)
    rest = np.where(np.arange(len(order))[None, :] == order[:, None], 0.0, share)
    if np.all(share[rows, order] > 0.9) and np.all(rest.max(axis=1, initial=0.0) < 0.5):
        return order
    # They truly met: by frequency before and by growth rate after, or the other way round; the rest by distance.
    distance = np.abs(a.eigenvalue[:, None] - b.eigenvalue[None, :])
    _, order = _assigned(distance)
    close = np.flatnonzero(_gaps(a.eigenvalue) <= 10 * distance.max(axis=1))
    if len(close) > 1:
        order[close[_ranks(a.eigenvalue[close])]] = order[close][_ranks(b.eigenvalue[order[close]])]
    return order


def _ranks(eigenvalues: np.ndarray) -> np.ndarray:
    by_frequency = np.ptp(np.imag(eigenvalues)) > np.ptp(np.real(eigenvalues))
    return np.argsort(np.imag(eigenvalues) if by_frequency else np.real(eigenvalues), kind="stable")


def _limits(scene: Scene) -> dict:
    direction = 1 if scene.belt_speed > 0 else -1
    limit = stability_limit(scene.structure, direction=direction)
    meeting = coalescence(scene.structure, direction=direction)
    said = {"outcome": limit.outcome.value, "mechanism": limit.mechanism.value}
    return {
        "mu_crit": ((), limit.mu, {"long_name": "critical friction", "units": "1", **said}),
        "frequency_crit": ((), limit.frequency, {"long_name": "frequency at the critical friction", "units": "Hz"}),
        "mu_coalescence": (
            (),
            meeting.mu,
            {"long_name": "friction at the coalescence of the undamped modes", "units": "1"},
        ),
    }


def _modes_dataset(scene: Scene, name: str, values: np.ndarray, followed: list) -> xr.Dataset:
    structure = scene.structure
    n, m = structure.size, structure.size - 1
    keep = [i for i in range(n) if i != structure.normal]
    eigenvalue, partner = np.full((2, len(values), m), np.nan, complex)
    shape = np.full((len(values), m, n), np.nan, complex)
    for k, sample in enumerate(followed):
        if sample is not None:
            eigenvalue[k], partner[k] = sample.eigenvalue, sample.partner
            shape[k][:, keep] = sample.shape
            shape[k][:, structure.normal] = 0
    size = np.abs(eigenvalue)
    ratio = -np.real(eigenvalue) / np.where(size > 0, size, 1.0)
    variables = {
        "frequency": (np.imag(eigenvalue) / (2 * np.pi), "frequency", "Hz"),
        "growth_rate": (np.real(eigenvalue), "growth rate", "1/s"),
        "damping_ratio": (ratio, "damping ratio", "1"),
        "eigenvalue": (eigenvalue, "eigenvalue", "1/s"),
        "partner": (partner, "the mode's other eigenvalue", "1/s"),
    }
    dataset = xr.Dataset(
        {key: ((name, "mode"), v, {"long_name": long, "units": unit}) for key, (v, long, unit) in variables.items()},
        coords={
            name: values,
            "mode": np.arange(m),
            "coordinate": np.arange(n),
        },
    )
    dataset["shape"] = ((name, "mode", "coordinate"), shape, {"long_name": "mode shape", "units": "1"})
    dataset["mode"].attrs["long_name"] = "mode, by frequency at the start of the axis"
    dataset["coordinate"].attrs["long_name"] = "coordinate of the structure"
    return dataset


class Sensitivity(Mapping):
    r"""How μ_crit moves with each parameter: `result["k1"]` is dμ_crit/dk1, a float in SI units.

    - `mu_crit`: the critical friction itself.
    - `plain`, `normalised`: dictionaries by name; dμ_crit/dp, and (p/μ_crit) dμ_crit/dp, the percent that μ_crit moves
      per percent of p. NaN where there is no derivative.
    - `dataset`: all of it with units, for plots and files.
    """

    def __init__(self, dataset: xr.Dataset):
        self.dataset = dataset
        names = [str(name) for name in dataset["parameter"].values]
        self.mu_crit = float(dataset["mu_crit"])
        self.plain = dict(zip(names, dataset["sensitivity"].values.tolist(), strict=True))
        self.normalised = dict(zip(names, dataset["normalised"].values.tolist(), strict=True))

    def __getitem__(self, name: str) -> float:
        return self.plain[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self.plain)

    def __len__(self) -> int:
        return len(self.plain)

    def __repr__(self) -> str:
        rows = [f"  {name:<16}{self.plain[name]:>14.6g}{self.normalised[name]:>12.4f}" for name in self]
        return "\n".join([f"mu_crit = {self.mu_crit:.10g}", f"  {'parameter':<16}{'plain':>14}{'% per %':>12}", *rows])


@in_double_precision
def sensitivity(structure: Structure, *, direction: int = 1) -> Sensitivity:
    r"""dμ_crit/d(each physical parameter), by name, plain and in percent per percent.

    The parameters are those of the function that built the structure (seven for `belt_oscillator`). A structure given
    as matrices has its entries instead, `stiffness[0,1]` and so on, the two of a symmetric pair moved together.

    The derivative is implicit (see `critical_friction`). Of an undamped structure there is none with respect to
    damping: NaN.

    **Raises:** `ValueError` for a structure that is never or always unstable: there is nothing to differentiate.
    """
    limit = stability_limit(structure, direction=direction)
    if limit.outcome is not Outcome.FOUND:
        raise ValueError(
            f"There is no critical friction to differentiate: the structure is {limit.outcome.value}. Look at "
            f"`cea.stability_limit(structure).outcome` first."
        )
    values, _ = _named_parameters(structure)
    slopes, damping_slopes = _slopes(structure, direction)
    plain = {name: float(slopes[name]) for name in values}
    if limit.mechanism is Mechanism.COALESCENCE:
        for name, change in damping_slopes.items():
            if np.any(np.asarray(change) != 0):
                plain[name] = np.nan
    mu_crit = float(limit.mu)
    numbers = {name: float(value) for name, value in values.items()}
    units = [QUANTITIES[name][1] if name in QUANTITIES else _UNITS.get(name.split("[")[0], "?") for name in values]
    dataset = xr.Dataset(
        {
            "sensitivity": ("parameter", np.array(list(plain.values())), {"long_name": "d mu_crit / d parameter"}),
            "normalised": (
                "parameter",
                np.array([numbers[name] * slope / mu_crit for name, slope in plain.items()]),
                {"long_name": "percent of mu_crit per percent of the parameter", "units": "1"},
            ),
            "value": ("parameter", np.array(list(numbers.values())), {"long_name": "value of the parameter"}),
            "unit": ("parameter", units, {"long_name": "unit of the parameter"}),
            "mu_crit": ((), mu_crit, {"long_name": "critical friction", "units": "1"}),
        },
        coords={"parameter": list(plain)},
    )
    scene = as_scene(structure, mu_crit, direction)
    return Sensitivity(labelled(dataset, scene, analysis="sensitivity of mu_crit", mechanism=limit.mechanism.value))


@compiled
def _slopes(structure: Structure, direction):
    """dμ_crit/dp and dC/dp by name of parameter."""
    values, build = _named_parameters(structure)
    limit = jax.grad(lambda parameters: critical_friction(build(parameters), direction=direction))(values)
    return limit, jax.jacfwd(lambda parameters: build(parameters).damping)(values)


_UNITS = {"mass": "kg", "damping": "N s/m", "stiffness": "N/m"}


def _named_parameters(structure: Structure):
    if structure.builder is not None and structure.parameters:
        return dict(structure.parameters), lambda parameters: structure.replace(**parameters)
    rows, columns = np.triu_indices(structure.size)
    values = {
        f"{name}[{i},{j}]": getattr(structure, name)[i, j]
        for name in _UNITS
        for i, j in zip(rows, columns, strict=True)
    }

    def build(parameters):
        matrices = {}
        for name in _UNITS:
            entries = jnp.stack([parameters[f"{name}[{i},{j}]"] for i, j in zip(rows, columns, strict=True)])
            upper = jnp.zeros((structure.size, structure.size)).at[rows, columns].set(entries)
            matrices[name] = jnp.where(np.tri(structure.size, dtype=bool).T, upper, upper.T)
        return Structure(
            **matrices,
            load_direction=structure.load_direction,
            tangential=structure.tangential,
            normal=structure.normal,
        )

    return values, build
