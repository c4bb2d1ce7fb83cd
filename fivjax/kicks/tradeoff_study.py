"""The cost of accuracy: methods, steps and precisions measured on the user's scene."""

import dataclasses
import functools
import itertools
import json
import time
from collections.abc import Callable

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import xarray as xr

from ..cycles.own_coordinates import in_own_coordinates
from ..foundation import arguments
from ..foundation.precision import in_double_precision
from ..foundation.progress import following, stage, tick
from ..io.datasets import labelled
from ..linear.cea import eigenvalues
from ..maps.bistability import bistability_map
from ..model.friction import Coulomb, ExponentialDecay
from ..model.load import Pulse
from ..model.scene import Scene, refuse_painleve
from ..simulation.rows import states_at
from ..simulation.start import start_state
from ..simulation.trajectory import Trajectory, simulate
from ..steppers.base import MOST_ADVANCES, AbstractStepper
from ..steppers.event_exact import EventExact
from ..steppers.where_switched import WhereSwitched
from ..verdicts.verdict import Verdict
from .critical import critical_perturbation

# Accuracies of the state for which a method is recommended.
WANTED = (1e-1, 1e-2, 1e-3, 1e-6, 1e-9)
REPEATS = 3
# Points of a refined map on each axis: intervals of the coarsest grid times two to the power of the halvings, and one.
COARSEST = 8


def default_methods() -> dict[str, AbstractStepper]:
    """The methods that `tradeoff` compares unless told otherwise: where-switching by several solvers and steps, event-exact."""
    solvers = {"Heun": diffrax.Heun(), "Tsit5": diffrax.Tsit5(), "Dopri8": diffrax.Dopri8()}
    steps = {"Heun": (2e-5,), "Tsit5": (2e-4, 5e-5, 1e-5), "Dopri8": (2e-4,)}
    switched = {f"{name}, {dt:g} s": WhereSwitched(solvers[name], dt) for name in solvers for dt in steps[name]}
    return {**switched, "event-exact, order 8, 1e-8": EventExact(8, tolerance=1e-8), "event-exact": EventExact()}


@in_own_coordinates
@in_double_precision
def tradeoff(
    scene: Scene,
    *,
    methods: dict[str, AbstractStepper] | None = None,
    t1: float = 0.5,
    trajectories: int = 256,
    p: np.ndarray | None = None,
    precisions: tuple[str, ...] = ("float64", "float32"),
    boundary: bool = True,
    refine: int = 0,
    progress: bool | None = None,
) -> xr.Dataset:
    """The cost of each method on a scene, and its errors there.

    **Arguments:**

    - `scene`: the scene; its load must be a `Pulse` for `boundary`.
    - `methods`: steppers by their names in the table; unless given, `WhereSwitched` by three solvers, and `EventExact`.
    - `t1`: time after which states are compared, in s: long enough for several contact events.
    - `trajectories`: number of trajectories in the batch whose cost is measured.
    - `p`: kicks for which verdicts are compared, 24 around the critical one unless given.
    - `precisions`: "float64", "float32". Maps always compute in double precision, so `p_crit` and verdicts are only given for
      that.
    - `boundary`: whether to compare p_crit and verdicts, too, which takes most of the time.
    - `refine`: the most halvings for which refined maps are compared with the whole one, over belt speed (0.8 to 1.2
      times the scene's) and p (1 to 4), with `8 * 2**refine + 1` points each: what `bistability_map(..., refine=)` saves.

    **Returns:** a dataset over `stepper` and `precision`: `cost` (s per trajectory-cycle: one trajectory over one period of the
    least stable sliding mode, on this machine, without compilation, as `jax.vmap` of `simulate` takes it: `EventExact` in
    double precision by kernels, if there are some for the scene), `state_error` (of the worst coordinate, relative to the
    largest displacement or velocity), `p_crit_error` (NaN if by this method no kick within 0.05 of the critical one leads
    to vibration, or none does not), `wrong_verdicts` and `undecided` (shares of the kicks). The reference
    is `EventExact(order=20)` at a tenth of the tolerance. `part_cost` over `part` is the cost of parts of the work, relative to
    that of the event-exact end state alone. With `refine`, over `halvings`: `refined_seconds`, `refined_computed` (the share of
    the points that were computed) and `refined_wrong` (that of points with a wrong verdict). The attribute
    `recommendation` names, for each accuracy of the state, the cheapest method that reaches it.

    **Raises:** `TypeError` or `ValueError` for objects that are no methods, times and counts that are not positive, a `t1`
    shorter than a method's step, and a load without a pulse if `boundary` is true.

    **Example:**

        >>> methods = {"event-exact": fj.EventExact()}
        >>> trade = fj.tradeoff(  # doctest: +SLOW
        ...     scene, methods=methods, t1=0.2, trajectories=4, precisions=("float64",), boundary=False, progress=False
        ... )
    """
    methods = default_methods() if methods is None else methods
    trajectories, refine = _check(scene, methods, t1, trajectories, boundary, refine)
    precisions = _checked_precisions(precisions)
    frequency = _frequency(scene)
    rows = {(name, kind): method for (name, method), kind in itertools.product(methods.items(), precisions)}
    measures = ("cost", "state_error", "p_crit_error", "wrong_verdicts", "undecided")
    measured = {name: np.full((len(methods), len(precisions)), np.nan) for name in measures}

    with following("tradeoff", shown=progress, total=len(rows), unit=" methods"):
        exact = EventExact(order=20, tolerance=1e-16)
        stage("reference")
        reference = np.asarray(_end_state(scene, exact, t1))
        edge = _boundary(scene, exact, p, t1) if boundary else None
        for (name, kind), method in rows.items():
            stage(f"{name}, {kind}")
            place = list(methods).index(name), precisions.index(kind)
            end = functools.partial(_end_state, method=method, t1=t1, precision=kind)
            state = np.asarray(jax.jit(end)(scene), np.float64)
            measured["state_error"][place] = _state_error(state, reference, scene.structure.size)
            measured["cost"][place] = _cost(scene, end, trajectories) / (trajectories * t1 * frequency)
            if edge is not None and kind == "float64":
                for measure, value in edge(method).items():
                    measured[measure][place] = value
            tick()
        stage("parts")
        parts = _parts(scene, t1, trajectories)
        refined = refinement_trade(scene, refine) if refine else {}
    halvings = {"halvings": np.arange(refine + 1)} if refine else {}
    dataset = xr.Dataset(
        {
            **{name: (("stepper", "precision"), values) for name, values in measured.items()},
            "part_cost": ("part", np.array(list(parts.values()))),
            **{name: ("halvings", values) for name, values in refined.items()},
        },
        coords={"stepper": list(methods), "precision": list(precisions), "part": list(parts), **halvings},
    )
    dataset.attrs["recommendation"] = json.dumps({f"{wanted:g}": recommend(dataset, wanted) for wanted in WANTED})
    return labelled(
        dataset, scene, t1=t1, trajectories=trajectories, frequency=frequency, device=jax.devices()[0].device_kind
    )


def recommend(dataset: xr.Dataset, accuracy: float) -> str:
    """The cheapest method of a `tradeoff` that reaches an accuracy of the state; "" if none does."""
    arguments.real_number("accuracy", accuracy, above=0)
    good = dataset["cost"].where(dataset["state_error"] <= accuracy)
    if not bool(good.notnull().any()):
        return ""
    row, column = np.unravel_index(np.nanargmin(good.values), good.shape)
    method, precision = str(good["stepper"].values[row]), str(good["precision"].values[column])
    return method if precision == "float64" else f"{method}, {precision}"


def table(dataset: xr.Dataset) -> str:
    """A `tradeoff` as text."""
    lines = [
        f"{'method':28s} {'precision':9s} {'ns/cycle':>9s} {'state':>8s} {'p_crit':>8s} {'wrong':>6s} {'open':>6s}"
    ]
    for method, kind in itertools.product(dataset["stepper"].values, dataset["precision"].values):
        row = dataset.sel(stepper=method, precision=kind)

        def number(name, form, row=row):
            value = float(row[name])
            return "-" if np.isnan(value) else format(value, form) if np.isfinite(value) else "failed"

        lines.append(
            f"{method:28s} {kind:9s} {1e9 * float(row['cost']):9.0f} {number('state_error', '8.1e'):>8s} "
            f"{number('p_crit_error', '8.1e'):>8s} {number('wrong_verdicts', '6.1%'):>6s} {number('undecided', '6.1%'):>6s}"
        )
    lines += [
        f"{part:40s} {float(cost):6.2f}"
        for part, cost in zip(dataset["part"].values, dataset["part_cost"].values, strict=True)
    ]
    for count in dataset["halvings"].values if "halvings" in dataset.coords else ():
        of = dataset.sel(halvings=count)
        lines.append(
            f"map refined {count} times{float(of['refined_seconds']):23.1f} s, {float(of['refined_computed']):6.1%} "
            f"computed, {float(of['refined_wrong']):.2%} wrong"
        )
    for wanted, method in json.loads(dataset.attrs["recommendation"]).items():
        lines.append(f"for a state good to {wanted}: {method or 'none of these'}")
    return "\n".join(lines)


def _checked_precisions(precisions) -> tuple[str, ...]:
    names = tuple(dict.fromkeys(arguments.listed_names("precisions", precisions, "float64")))
    if not names:
        raise ValueError("Argument `precisions` must hold at least one of 'float64' and 'float32', but is empty.")
    for kind in names:
        arguments.one_of("precisions", kind, ("float64", "float32"))
    return names


def _check(scene, methods, t1, trajectories, boundary, refine) -> tuple[int, int]:
    """The numbers of trajectories and of refinements, if all is in order."""
    arguments.instance("scene", scene, Scene, "a Scene")
    arguments.known("scene", scene)
    if not isinstance(methods, dict) or not methods:
        raise TypeError("Argument `methods` must be a dict of steppers by name, such as {'exact': fj.EventExact()}.")
    arguments.real_number("t1", t1, above=0)
    for name, method in methods.items():
        arguments.instance(f"methods[{name!r}]", method, AbstractStepper, "a stepper, such as EventExact()")
        if not method.chooses_its_steps and method.dt > t1:
            raise ValueError(
                f"Argument `t1` must be at least as long as each method's step, but is {t1:g} s, and that of {name!r} is "
                f"{method.dt:g} s."
            )
    trajectories = arguments.whole_number("trajectories", trajectories, minimum=1)
    refuse_painleve(scene)
    arguments.truth("boundary", boundary)
    refine = arguments.whole_number("refine", refine, minimum=0)
    if boundary or refine:
        arguments.instance(
            "scene.load", scene.load, Pulse, "a Pulse, whose p is varied (or pass boundary=False and refine=0)"
        )
    if refine and np.ndim(scene.belt_speed):
        raise ValueError("Argument `refine` must be 0 for a scene whose contacts have belt speeds of their own.")
    return trajectories, refine


def _frequency(scene: Scene) -> float:
    """The frequency of the least stable sliding mode, in Hz; 1 if none vibrates."""
    values = eigenvalues(scene)
    vibrating = values[values.imag > 0]
    return float(vibrating[np.argmax(vibrating.real)].imag / (2 * np.pi)) if len(vibrating) else 1.0


def _single(tree):
    return jax.tree.map(lambda leaf: leaf.astype(np.float32), tree)


def _end_state(scene: Scene, method: AbstractStepper, t1: float, precision: str = "float64"):
    """As `simulate` computes it, in double precision; in single precision by its steps, for a traced scene: of a known one
    mechanics would be computed in double precision.
    """
    if precision == "float64":
        run = simulate(scene, t1, t1, method, derivatives="none", progress=False)
        return jnp.concatenate([run.displacement[-1], run.velocity[-1]])
    scene = _single(scene)
    y0, instants = _single((start_state(scene, None), jnp.array([0.0, t1])))
    return states_at(scene, method, y0, instants, MOST_ADVANCES + int(np.ceil(t1 / method.dt)))[0][-1]


def _state_error(state: np.ndarray, reference: np.ndarray, n: int) -> float:
    """The error of a state relative to the largest displacement and velocity; infinite for a run that failed."""
    scale = np.repeat([np.abs(reference[:n]).max(), np.abs(reference[n:]).max()], n)
    error = np.max(np.abs(state - reference) / scale)
    return float(error) if np.isfinite(error) else np.inf


def _cost(scene: Scene, result: Callable[[Scene], jax.Array | Trajectory], trajectories: int) -> float:
    """Wall time (s) for the results of scenes that differ a little in their kick, or are copies if there is no kick, in one
    batch.
    """
    kicked = isinstance(scene.load, Pulse)
    each = np.asarray(scene.load.p) * np.linspace(0.99, 1.01, trajectories) if kicked else np.ones(trajectories)

    def one(scene, own):
        return result(scene.replace(p=own) if kicked else jax.tree.map(lambda leaf: leaf * own, scene))

    run = jax.jit(jax.vmap(one, (None, 0)))
    return _timed(lambda: run(scene, each))


def _timed(function: Callable) -> float:
    """The shortest time (s) of a few calls, because other programs disturb some; the first call, which compiles, is left
    out.
    """
    jax.block_until_ready(function())
    walls = []
    for _ in range(REPEATS):
        begin = time.perf_counter()
        jax.block_until_ready(function())
        walls.append(time.perf_counter() - begin)
    return min(walls)


def _boundary(scene: Scene, exact: AbstractStepper, p, t1: float) -> Callable[[AbstractStepper], dict[str, float]]:
    """A function that gives a method's errors in p_crit and in the verdicts of a row of kicks; none if there is no p_crit."""
    # One value of some axis; each of several contacts may have its own belt speed, which is none.
    name = "force" if np.ndim(scene.belt_speed) else "belt_speed"
    now = {name: np.asarray(scene.parameters[name])[None]}
    found = critical_perturbation(scene, **now, p_step=0.05, tolerance=1e-7, progress=False)
    p_crit = float(found["p_crit"][0])
    if not np.isfinite(p_crit) and p is None:
        return lambda method: {}
    kicks = np.linspace(max(0.0, p_crit - 0.1), p_crit + 0.3, 24) if p is None else arguments.axis("p", p)
    right = _verdicts(scene, p=kicks, method=exact)["verdict"].values

    def measure(method: AbstractStepper) -> dict[str, float]:
        verdicts = _verdicts(scene, p=kicks, method=method)["verdict"].values
        wrong = (verdicts != right) & (verdicts >= 0) & (right >= 0)
        shares = {"wrong_verdicts": float(np.mean(wrong)), "undecided": float(np.mean(verdicts == Verdict.UNDECIDED))}
        if not np.isfinite(p_crit):
            return shares
        near = (max(0.0, p_crit - 0.05), p_crit + 0.05)
        # A weak cycle may take longer to draw a motion in; but with steps of one size that takes minutes.
        t_max = None if isinstance(method, EventExact) else 20 * t1
        own = critical_perturbation(
            scene, **now, p_range=near, p_step=0.01, tolerance=1e-5, method=method, t_max=t_max, progress=False
        )
        return {**shares, "p_crit_error": abs(float(own["p_crit"][0]) - p_crit)}

    return measure


def _verdicts(scene: Scene, **options):
    """A whole map: what an interrupted one lacks would count as wrong."""
    found = bistability_map(scene, **options, progress=False)
    if np.any(found["verdict"] == Verdict.NOT_RUN):
        raise KeyboardInterrupt
    return found


def _parts(scene: Scene, t1: float, trajectories: int) -> dict[str, float]:
    """The cost of parts of the work with the event-exact method, relative to that of the end state alone."""

    def cost(scene: Scene, rows: int = 1, energy: bool = False) -> float:
        def run(scene: Scene) -> Trajectory:
            return simulate(scene, t1, t1 / rows, energy=energy, derivatives="none", progress=False)

        return _cost(scene, run, trajectories)

    plain = cost(scene)
    found = {"end state alone": 1.0, "stored output, 1000 rows": cost(scene, rows=1000) / plain}
    found["energy ledger"] = cost(scene, energy=True) / plain
    if isinstance(scene.friction, Coulomb):
        # Practically constant, so that the motion is the same but is computed as with friction that varies.
        mu = scene.friction.mu
        falling = dataclasses.replace(scene, friction=ExponentialDecay(mu, mu, 1.0))
        found["friction that may depend on speed"] = cost(falling) / plain
    if isinstance(scene.load, Pulse):
        found["no contact events (no kick)"] = cost(scene.replace(p=1.0)) / plain
    return found


def refinement_trade(scene: Scene, halvings: int) -> dict[str, np.ndarray]:
    """Maps over kicks and belt speeds with 0 … `halvings` halvings, all with the same points.

    Of each: the time that it takes (s; the first, whole map is run twice, so that nothing is compiled in it), the share of the
    points computed, and that of points with another verdict than in the whole map.
    """
    seconds, computed, wrong = (np.zeros(halvings + 1) for _ in range(3))
    whole = None
    # The belt speeds of the map, in those of the scene, and its kicks.
    speeds, kicks = (0.8, 1.2), (1.0, 4.0)
    for count in (0, *range(halvings + 1)):
        size = COARSEST * 2 ** (halvings - count) + 1
        axes = {
            "belt_speed": np.sort(float(scene.belt_speed) * np.linspace(*speeds, size)),
            "p": np.linspace(*kicks, size),
        }
        begin = time.perf_counter()
        found = _verdicts(scene, **axes, refine=count, audit=0.0)
        seconds[count] = time.perf_counter() - begin
        computed[count] = float(np.mean(found["computed"])) if count else 1.0
        whole = found if whole is None else whole
        wrong[count] = float(np.mean(found["verdict"].values != whole["verdict"].values))
    return {"refined_seconds": seconds, "refined_computed": computed, "refined_wrong": wrong}
