r"""Stability of steady sliding without eigenvalues: the characteristic polynomial and Routh–Hurwitz.

Sliding keeps the rows of the structure but the normal one, the tangential row less $\sigma\mu$ times the normal row
(Eq. 3). The signs of the Hurwitz determinants of $p(s) = \det(s^2 M + s C + K)$ say whether it is stable. Eigenvalues
are not smooth where two of them meet; these determinants are polynomials in the matrices, smooth everywhere, and made
of nothing but sums and products. So a batch of them fuses into one loop over points, on any device, where general
eigenvalues go through LAPACK point by point (and are not to be had on every accelerator).

Time is measured in $1/ω_0$, $ω_0$ a mean of the structure's own frequencies, so that the coefficients are of order one.
"""

import jax
import jax.numpy as jnp
import numpy as np
import xarray as xr
from jaxtyping import Array, Complex, Float

from ..foundation import arguments
from ..foundation.compiling import compiled
from ..foundation.linear_solve import solve
from ..foundation.precision import in_double_precision, is_known, real, returning_numpy
from ..io.datasets import labelled
from ..model.friction import Coulomb
from ..model.load import ConstantLoad
from ..model.scene import Scene
from ..model.structure import Structure
from .linearisation import linear_sliding

# Up to here the determinant is expanded by hand (2ᵐ minors); beyond, matrix routines take over.
LARGEST_EXPANDED = 4
# The bialternate sum has N(N-1)/2 rows for N eigenvalues.
LARGEST_SIZE = 32
POINTS_AT_ONCE = 8192
# Where LAPACK is called: few enough that two parts of a batch do not wait for each other (see `elimination`).
POINTS_AT_ONCE_BY_LAPACK = 64
# Each iteration at least triples the precision of a double root; simple ones need some fifteen.
ITERATIONS = 60


def sliding_matrices(
    structure: Structure, mu: Float[Array, ""], direction: Float[Array, ""], slope_damping: Float[Array, ""]
) -> tuple[Float[Array, "m m"], Float[Array, "m m"], Float[Array, "m m"]]:
    """M, C and K of the sliding motion (Eq. 3), normal coordinate left out.

    `slope_damping` in N·s/m is what friction that varies with slip speed adds on the tangential diagonal of C: the
    normal force times dμ/dv, negative where friction falls.
    """
    t, n = structure.tangential, structure.normal
    keep = np.array([i for i in range(structure.size) if i != n])
    # A product with a constant rather than an update in place: in a batch it stays elementwise.
    row = jnp.asarray(np.arange(structure.size) == t, structure.mass.dtype)[:, None]

    def projected(matrix):
        return (matrix - row * (direction * mu * matrix[n]))[keep][:, keep]

    corner = np.outer(keep == t, keep == t).astype(np.float64)
    return (
        projected(structure.mass),
        projected(structure.damping) + slope_damping * corner,
        projected(structure.stiffness),
    )


def time_scale(structure: Structure) -> Float[Array, ""]:
    """ω₀ in rad/s: the root mean square of the uncoupled frequencies of the sliding coordinates, 1 if all are zero."""
    keep = np.array([i for i in range(structure.size) if i != structure.normal])
    squares = jnp.diagonal(structure.stiffness)[keep] / jnp.diagonal(structure.mass)[keep]
    mean = jax.lax.stop_gradient(jnp.mean(squares))
    return jnp.sqrt(jnp.where(mean > 0, mean, 1.0))


def determinant(rows) -> tuple[list, list[list]]:
    """Determinant and leading principal minors of a matrix of polynomials, by expansion along its rows.

    `rows[i][j]` is a list of coefficients, highest power first; all are scalars, or all arrays of one shape.
    """
    size = len(rows)
    minors = {(): [1.0]}
    leading = []
    for i in range(size):
        larger: dict[tuple[int, ...], list] = {}
        for columns, minor in minors.items():
            for j in range(size):
                if j not in columns:
                    sign = (-1) ** sum(column > j for column in columns)
                    key = tuple(sorted((*columns, j)))
                    larger[key] = _sum(larger.get(key, []), _product([sign * c for c in rows[i][j]], minor))
        minors = larger
        leading.append(minors[tuple(range(i + 1))])
    return leading[-1], leading


def _product(a, b) -> list:
    result = [0.0] * (len(a) + len(b) - 1)
    for i, x in enumerate(a):
        for j, y in enumerate(b):
            result[i + j] = result[i + j] + x * y
    return result


def _sum(a, b) -> list:
    width = max(len(a), len(b))
    a, b = [0.0] * (width - len(a)) + a, [0.0] * (width - len(b)) + b
    return [x + y for x, y in zip(a, b, strict=True)]


def characteristic_polynomial(mass, damping, stiffness, scale) -> list[Float[Array, ""]]:
    """Coefficients of det(s²M + sC + K) in units of `scale` (rad/s), highest power first, the first one 1.

    They are not finite where the sliding mass matrix is singular (Painlevé's paradox).
    """
    m = mass.shape[0]
    rows = [[[mass[i, j] * scale**2, damping[i, j] * scale, stiffness[i, j]] for j in range(m)] for i in range(m)]
    coefficients, _ = determinant(rows)
    return [c / coefficients[0] for c in coefficients]


def hurwitz_determinants(coefficients) -> list[Float[Array, ""]]:
    """The Routh–Hurwitz conditions of a polynomial with leading coefficient 1: its roots decay if all are positive.

    The Hurwitz determinants but the last; in place of that, its one new factor, the last coefficient.
    """
    degree = len(coefficients) - 1
    zero = jnp.zeros_like(coefficients[-1])

    def entry(i, j):
        k = 2 * (j + 1) - (i + 1)
        return [coefficients[k] if 0 <= k <= degree else zero]

    _, leading = determinant([[entry(i, j) for j in range(degree - 1)] for i in range(degree - 1)])
    return [*(minor[0] for minor in leading), coefficients[-1]]


@returning_numpy
def margin(structure: Structure, mu, *, direction: int = 1) -> Float[Array, ""]:
    r"""A smooth measure of stability of steady sliding: positive where it is stable, zero at the limit.

    The smallest of the Routh–Hurwitz determinants of the characteristic polynomial, in units of $ω_0$. At the first
    limit it is $\prod_{i<j} -(λ_i + λ_j)$ (a pair of eigenvalues crosses: flutter) or $\prod λ_i$ (a real one
    crosses: divergence), and smooth there and at a coalescence of modes. Above 4 sliding coordinates these two
    products are formed directly, as determinants of the bialternate sum of the state matrix with itself and of the
    state matrix, each relative to its value without friction; the sign is then a test up to the first limit and not
    beyond it. An undamped structure is on the limit at any friction: 0, or NaN above 4 sliding coordinates.

    Only sign and zeros have a meaning. Differentiable; works on any device; batches with `jax.vmap`.

    **Arguments:** `structure`; `mu`, the friction coefficient, without unit; `direction`, +1 for a belt that moves
    along the tangential coordinate, -1 against it.

    **Raises:** `ValueError` for a negative `mu`, or for more than 32 coordinates.
    """
    arguments.instance("structure", structure, Structure, "a Structure, such as belt_oscillator()")
    arguments.real_number("mu", mu, minimum=0)
    check_direction(direction)
    if structure.size > LARGEST_SIZE:
        raise ValueError(
            f"Argument `structure` must have at most {LARGEST_SIZE} coordinates here, but has {structure.size}. Use "
            f"`cea.growth_rate`, which has no such limit."
        )
    return _margin(structure, real(mu), real(direction))


@compiled
def _margin(structure, mu, direction):
    scale = time_scale(structure)
    mass, damping, stiffness = sliding_matrices(structure, mu, direction, jnp.zeros_like(mu))
    m = mass.shape[0]
    if m <= LARGEST_EXPANDED:
        coefficients = characteristic_polynomial(mass, damping, stiffness, scale)
        return jnp.min(jnp.stack(hurwitz_determinants(coefficients)))
    state = _state_matrix(mass, damping, stiffness, scale)
    without = _state_matrix(*sliding_matrices(structure, jnp.zeros_like(mu), direction, jnp.zeros_like(mu)), scale)
    return jnp.minimum(
        _relative_determinant(bialternate_sum(state), bialternate_sum(without)), _relative_determinant(state, without)
    )


def _state_matrix(mass, damping, stiffness, scale):
    m = mass.shape[0]
    lower = -solve(mass, jnp.concatenate([stiffness / scale**2, damping / scale], axis=1))
    return jnp.concatenate([jnp.eye(m, 2 * m, m, dtype=mass.dtype), lower])


def _relative_determinant(matrix, reference):
    # In logarithms: a determinant of hundreds of rows is rarely a number that fits.
    sign, size = jnp.linalg.slogdet(matrix)
    reference_sign, reference_size = jnp.linalg.slogdet(reference)
    return sign * reference_sign * jnp.exp(size - jax.lax.stop_gradient(reference_size))


def bialternate_sum(matrix: Float[Array, "n n"]) -> Float[Array, "k k"]:
    """The matrix whose eigenvalues are the sums λᵢ + λⱼ, i < j, of those of `matrix`: v ↦ Av + vAᵀ on skew v."""
    n = matrix.shape[0]
    p, q = (jnp.asarray(index) for index in np.triu_indices(n, 1))
    same = [[(a[:, None] == b[None, :]) for b in (p, q)] for a in (p, q)]
    a = [[matrix[i[:, None], j[None, :]] for j in (p, q)] for i in (p, q)]
    return (
        jnp.where(same[1][1], a[0][0], 0.0)
        - jnp.where(same[1][0], a[0][1], 0.0)
        + jnp.where(same[0][0], a[1][1], 0.0)
        - jnp.where(same[0][1], a[1][0], 0.0)
    )


def polynomial_roots(coefficients) -> Complex[Array, "n ..."]:
    """All roots of polynomials with leading coefficient 1 and coefficients of order one, by Ehrlich–Aberth iteration.

    `coefficients` is a list of real arrays of one shape, highest power first. Everything is elementwise over that shape
    and in real arithmetic, which is what makes a million polynomials quick. NaN where the iteration has not settled.
    """
    degree = len(coefficients) - 1
    coefficients = [jnp.broadcast_to(c, coefficients[-1].shape) for c in coefficients]
    # On the unit circle, and not symmetric about the real axis: from a symmetric start no pair of real roots is found.
    angles = 2 * np.pi * (np.arange(degree) + 0.35) / degree
    start = [
        (jnp.full_like(coefficients[-1], np.cos(angle)), jnp.full_like(coefficients[-1], np.sin(angle)))
        for angle in angles
    ]
    finite = jnp.isfinite(sum(coefficients))
    coefficients = [jnp.where(finite, c, 0.0) for c in coefficients]

    def unsettled(carry):
        iteration, _, change = carry
        return (iteration < ITERATIONS) & (jnp.max(change, initial=0.0) > 1e-26)

    def improved(carry):
        iteration, roots, _ = carry
        roots, change = _aberth(coefficients, roots)
        return iteration + 1, roots, change

    change = jnp.full_like(coefficients[-1], jnp.inf)
    _, roots, change = jax.lax.while_loop(unsettled, improved, (0, start, change))
    settled = finite & (change < 1e-8)
    return jnp.stack([jax.lax.complex(jnp.where(settled, x, jnp.nan), y) for x, y in roots])


def _aberth(coefficients, roots):
    reciprocals = {}
    for i in range(len(roots)):
        for j in range(i):
            reciprocals[i, j] = _reciprocal((roots[i][0] - roots[j][0], roots[i][1] - roots[j][1]))
    improved, change = [], 0.0
    for i, root in enumerate(roots):
        value, slope = (coefficients[0], 0.0), (0.0, 0.0)
        for coefficient in coefficients[1:]:
            slope = _times(slope, root)
            slope = (slope[0] + value[0], slope[1] + value[1])
            value = _times(value, root)
            value = (value[0] + coefficient, value[1])
        others = (0.0, 0.0)
        for j in range(len(roots)):
            if j != i:
                sign = 1.0 if j < i else -1.0
                reciprocal = reciprocals[max(i, j), min(i, j)]
                others = (others[0] + sign * reciprocal[0], others[1] + sign * reciprocal[1])
        deflated = _times(value, others)
        step = _times(value, _reciprocal((slope[0] - deflated[0], slope[1] - deflated[1])))
        usable = jnp.isfinite(step[0] + step[1])
        step = (jnp.where(usable, step[0], 0.0), jnp.where(usable, step[1], 0.0))
        improved.append((root[0] - step[0], root[1] - step[1]))
        size = 1.0 + root[0] ** 2 + root[1] ** 2
        change = jnp.maximum(change, (step[0] ** 2 + step[1] ** 2) / size)
    return improved, change


def _times(a, b):
    return a[0] * b[0] - a[1] * b[1], a[0] * b[1] + a[1] * b[0]


def _reciprocal(a):
    square = a[0] ** 2 + a[1] ** 2
    return a[0] / square, -a[1] / square


@in_double_precision
def chart(system: Structure | Scene, *, direction: int = 1, **parameters) -> xr.Dataset:
    r"""Growth rate of steady sliding over any two parameters, in one batch.

        c = fj.cea.chart(fj.belt_oscillator(), mu=np.linspace(0, 0.5, 1000), k1=np.linspace(80e3, 120e3, 1000))

    The roots of the characteristic polynomial are found for all points together (`polynomial_roots`); stability itself
    is judged by Routh–Hurwitz. Above 4 sliding coordinates both come from the eigenvalues of the Jacobian, point by
    point.

    **Arguments:**

    - `system`: a structure, or a scene where friction depends on speed.
    - `**parameters`: two axes, each one-dimensional and strictly increasing, by name: `mu` or a parameter of the
      structure; for a scene, anything in `scene.parameters`. Single numbers replace the system's own value.
    - `direction`: for a structure, +1 or -1: the way the belt moves.

    **Returns:** a dataset over the two axes with `growth_rate` (1/s, of the fastest growing mode), `frequency` of
    that mode (Hz), `margin` (the smallest Hurwitz determinant, positive where stable, without unit; up to 4 sliding
    coordinates) and, for a scene, `normal_force` of steady sliding (N). NaN where there is no steady sliding, or no
    unique one.

    **Raises:** `ValueError` for anything but two axes, unknown names, and values that the structure or scene refuses.
    """
    scene, axes = with_axes(system, direction, parameters, count=2)
    grid = np.meshgrid(*axes.values(), indexing="ij")
    shape = grid[0].shape
    columns = [values.ravel() for values in grid]
    points = columns[0].size
    expanded = scene.structure.size - 1 <= LARGEST_EXPANDED
    batch = min(POINTS_AT_ONCE if expanded else POINTS_AT_ONCE_BY_LAPACK, points)
    padding = -points % batch
    columns = [np.concatenate([c, np.repeat(c[-1:], padding)]).reshape(-1, batch) for c in columns]
    results = _chart(scene, tuple(axes), [real(c) for c in columns])
    growth_rate, frequency, smallest, normal_force = (np.asarray(r).ravel()[:points].reshape(shape) for r in results)
    variables = {
        "growth_rate": (growth_rate, "growth rate of the fastest growing mode", "1/s"),
        "frequency": (frequency, "frequency of the fastest growing mode", "Hz"),
        "margin": (smallest, "smallest Hurwitz determinant, positive where stable", "1"),
    }
    if not expanded:
        # A determinant with hundreds of rows at every point would take longer than all the rest.
        del variables["margin"]
    if isinstance(system, Scene):
        variables["normal_force"] = (normal_force, "normal force of steady sliding", "N")
    dataset = xr.Dataset(
        {name: (tuple(axes), v, {"long_name": long, "units": unit}) for name, (v, long, unit) in variables.items()},
        coords=axes,
    )
    return labelled(dataset, scene, analysis="stability chart", method="characteristic polynomial, Routh-Hurwitz")


@compiled
def _chart(scene, names, columns):
    def polynomial(*values):
        point = scene.replace(**dict(zip(names, values, strict=True)))
        normal_force, slope_damping, exists = _steady_state(point)
        mu = point.friction(jnp.abs(point.belt_speed))
        matrices = sliding_matrices(point.structure, mu, jnp.sign(point.belt_speed), slope_damping)
        scale = time_scale(point.structure)
        coefficients = characteristic_polynomial(*matrices, scale)
        ok = exists & (matrices[0][0, 0] > 0)
        smallest = jnp.min(jnp.stack(hurwitz_determinants(coefficients)))
        return [jnp.where(ok, c, jnp.nan) for c in coefficients], scale, jnp.where(ok, smallest, jnp.nan), normal_force

    def by_polynomial(chunk):
        coefficients, scale, smallest, normal_force = jax.vmap(polynomial)(*chunk)
        roots = polynomial_roots(coefficients)
        fastest = jnp.argmax(roots.real, axis=0)
        growth_rate = jnp.max(roots.real, axis=0) * scale
        frequency = jnp.abs(jnp.take_along_axis(roots.imag, fastest[None], axis=0)[0]) * scale / (2 * jnp.pi)
        return growth_rate, jnp.where(jnp.isnan(growth_rate), jnp.nan, frequency), smallest, normal_force

    def by_eigenvalues(*values):
        point = scene.replace(**dict(zip(names, values, strict=True)))
        normal_force, _, exists = _steady_state(point)
        matrix = linear_sliding(point).matrix
        ok = exists & jnp.all(jnp.isfinite(matrix))
        roots = jnp.linalg.eigvals(jnp.where(ok, matrix, jnp.eye(matrix.shape[0])))
        fastest = jnp.argmax(roots.real)
        results = roots.real[fastest], jnp.abs(roots.imag[fastest]) / (2 * jnp.pi), jnp.nan
        return *(jnp.where(ok, r, jnp.nan) for r in results), normal_force

    if scene.structure.size - 1 <= LARGEST_EXPANDED:
        return jax.lax.map(by_polynomial, tuple(columns))
    return jax.lax.map(lambda chunk: jax.vmap(by_eigenvalues)(*chunk), tuple(columns))


def _steady_state(scene: Scene):
    """Normal force (N), what the slope of friction adds to damping (N·s/m), and whether there is such a state."""
    structure = scene.structure
    speed = jnp.abs(scene.belt_speed)
    t, n = structure.tangential, structure.normal
    keep = [i for i in range(structure.size) if i != n]
    factor = jnp.sign(scene.belt_speed) * scene.friction(speed)
    # The sliding rows of [K, f], bordered by the normal row: by Cramer's rule N/F = -det[[K, f], [k_n, f_n]] / det K.
    table = jnp.concatenate([structure.stiffness, structure.load_direction[:, None]], axis=1)
    rows = [table[i] - (factor * table[n] if i == t else 0.0) for i in keep]
    columns = [*keep, structure.size]
    if len(keep) <= LARGEST_EXPANDED:
        stiffness = determinant([[[row[j]] for j in keep] for row in rows])[0][0]
        bordered = determinant([[[row[j]] for j in columns] for row in [*rows, table[n]]])[0][0]
    else:
        stiffness, bordered = 1.0, None
        reduced = jnp.stack(rows)[:, np.array(columns)]
        solved = solve(reduced[:, :-1], reduced[:, -1])
        bordered = table[n, -1] - table[n, np.array(keep)] @ solved
    normal_force = -bordered / stiffness * scene.load.final
    if scene.friction.constant:
        # The sliding motion is linear, about whatever state.
        slope_damping = jnp.zeros_like(speed)
        needed = jnp.where(jnp.isfinite(normal_force), normal_force, 0.0)
    else:
        slope_damping = normal_force * jax.grad(lambda v: scene.friction(v))(speed)
        needed = normal_force
    return normal_force, slope_damping, (needed >= 0) & (speed > 0)


def check_direction(direction) -> None:
    """Refuse anything but the two ways a belt can move."""
    if direction not in (1, -1):
        raise ValueError(f"Argument `direction` must be 1 or -1, but is {direction!r}.")


def as_scene(system: Structure | Scene, mu, direction: int) -> Scene:
    """The scene whose sliding state is asked for: a given one, or a structure under constant friction.

    A structure is not loaded: its linear motion with constant friction is the same under any load.
    """
    arguments.instance("system", system, (Structure, Scene), "a Structure or a Scene")
    check_direction(direction)
    if isinstance(system, Structure):
        if mu is None:
            raise ValueError("Argument `mu` must be given with a structure; a scene carries its own friction.")
        return Scene(system, Coulomb(mu), belt_speed=float(direction), load=ConstantLoad(0.0))
    if mu is not None:
        raise ValueError("Argument `mu` must not be given with a scene; use `scene.replace(mu=...)`.")
    if direction != 1:
        raise ValueError("Argument `direction` must not be given with a scene: the sign of its belt speed says it.")
    if is_known(system.belt_speed) and system.belt_speed == 0:
        raise ValueError("Argument `belt_speed` must not be zero: nothing slides steadily on a belt at rest.")
    return system


def with_axes(
    system: Structure | Scene, direction: int, parameters: dict, *, count: int
) -> tuple[Scene, dict[str, np.ndarray]]:
    """The scene with the single numbers put in, and the checked axes, as many as `count`."""
    arguments.instance("system", system, (Structure, Scene), "a Structure or a Scene")
    if isinstance(system, Structure):
        if "mu" not in parameters:
            raise ValueError("Argument `mu` must be given with a structure, as a number or an axis.")
        scene = as_scene(system, 0.0, direction)
        known = ["mu", *system.parameters]
    else:
        scene = as_scene(system, None, direction)
        known = sorted(scene.parameters)
    unknown = [name for name in parameters if name not in known]
    if unknown:
        raise ValueError(f"Unknown parameter `{unknown[0]}`; this system has: {', '.join(known)}.")
    axes = {name: arguments.axis(name, values) for name, values in parameters.items() if np.ndim(values) > 0}
    if len(axes) != count:
        wanted = "one axis, such as `mu=np.linspace(0, 0.5, 501)`" if count == 1 else "two axes"
        given = ", ".join(axes) or "none"
        raise ValueError(f"Give exactly {wanted}, as arrays; here the axes are: {given}.")
    scene = scene.replace(**{name: value for name, value in parameters.items() if name not in axes})
    # Every rule on a parameter is a bound, or an order between two, so the ends of the axes stand for all of them.
    for end in (0, -1):
        scene.replace(**{name: values[end] for name, values in axes.items()})
    return scene, axes
