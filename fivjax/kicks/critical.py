"""Critical kicks: the smallest that lead to a limit cycle, found by a scan and narrowed down in batches."""

import functools
import json
import math

import numpy as np
import xarray as xr

from ..cycles.own_coordinates import in_own_coordinates
from ..foundation import arguments
from ..foundation.precision import in_double_precision
from ..foundation.progress import reported, stage
from ..io.datasets import check_axis_names, labelled
from ..maps.axes import check_run, check_size, checked_axes, linear_limit
from ..maps.crossing import FirstCrossing, first_crossings, with_ends
from ..maps.datasets import time_limit
from ..maps.engine import RunOptions, run_to_verdict
from ..maps.executors import with_workers
from ..maps.groups import Limits
from ..maps.plan import TrajectoryList
from ..model.load import Pulse
from ..model.scene import Scene
from ..steppers.base import AbstractStepper
from ..steppers.description import describe_method
from ..steppers.event_exact import EventExact
from ..steppers.where_switched import WhereSwitched
from ..verdicts.verdict import Verdict
from .critical_derivatives import differentiable, with_derivatives

# The steps of a scan, unless given.
P_STEP = 0.01
# Names in the dataset of critical kicks, beside those of maps.
OF_RESULTS = (
    *("p_crit_low", "p_crit_high", "p_crit_error", "crossings", "only_crossing", "critical_energy", "kick_work"),
    *("d_p_crit", "parameter", "kind", "why_none", "newton_trajectories"),
)


@reported("critical kicks")
@in_own_coordinates
@in_double_precision
@with_workers
def critical_perturbation(
    scene: Scene,
    *,
    p_range: tuple[float, float] = (1.0, 5.0),
    p_step: float | None = None,
    tolerance: float = 1e-5,
    method: AbstractStepper | None = None,
    t_max: float | None = None,
    memory: float = 2e9,
    progress: bool | None = None,
    energy: bool = False,
    derivatives: bool = False,
    executor=None,
    **axis,
) -> xr.Dataset:
    """The smallest kick that leads to a limit cycle, over one or several parameters; all of them bracketed in one batch.

        fj.critical_perturbation(scene, mu=np.linspace(0.05, 0.228, 40))          # Fig. 10
        fj.critical_perturbation(scene, belt_speed=[0.5, 1, 1.5, 3, 5, 10, 100])  # Table 2

    The range of p is scanned in steps of `p_step`, then the first change from sliding to limit cycle is narrowed down. The
    boundary may have islands (sliding above a limit cycle); those narrower than the steps are missed.

    **Arguments:**

    - `scene`: a scene whose load is a `Pulse`.
    - `**axis`: values of any numeric parameters but p, by name.
    - `p_range`, `p_step`: the range of p, and the steps of the scan: 0.01 unless given, or the range if that is narrower.
    - `tolerance`: the width of the bracket at which narrowing stops.
    - `method`, `t_max`, `memory`, `progress`, `executor`: as in `bistability_map`.
    - `energy`: whether to add the energies of the critical kick.
    - `derivatives`: whether to compute p_crit to rounding, and its derivatives by every parameter.

    **Returns:** a dataset over the axes with

    - `p_crit_low`, `p_crit_high`: the largest kick proved to slide below the first change, and the smallest proved to end on
      a limit cycle above it, each by a trajectory of its own when the change was narrowed down;
    - `p_crit`: their middle. It is NaN if there is no change in the range, if undecided trajectories keep the two further
      apart than the tolerance, and if a trajectory that was run again contradicts the scan. If already the lower end of the
      range leads to a limit cycle, `p_crit` is that end, and `p_crit_low` is NaN;
    - `p_crit_error`: half the distance of the two; for methods with a fixed step plus the change of `p_crit` when the step is
      doubled;
    - `crossings`: the number of changes in the scan; `only_crossing`: whether there was at most one, and no undecided
      trajectory that might hide another.

    With `energy`, `critical_energy` is the energy of the vibration when the critical kick ends, in J. Little of it is work of
    the load (`kick_work`, which may be negative); most comes from the contact.

    With `derivatives`, p_crit is found to rounding by Newton's method if the motion passes a saddle cycle or just touches
    another contact mode, and is proved by trajectories at a relative distance of 1e-9 on both sides. Then there are also

    - `kind`: "manifold" if the critical kick lands on the stable manifold of a saddle cycle, "grazing" if its motion just
      touches sticking, lifting off or landing (with static friction above kinetic, such a touch may squeal), else "none";
    - `d_p_crit` over `parameter`, per unit of each; NaN if there is no derivative, and `why_none` says why in a sentence;
    - `newton_trajectories`: the number of trajectories that Newton's method took.

    **Raises:** `ValueError` as `bistability_map`, and for an axis named p; `TypeError` for a load without a pulse;
    `KeyboardInterrupt` where it is interrupted, because kicks that were not run would count as kicks that slide.

    **Example:**

        >>> found = fj.critical_perturbation(scene, belt_speed=[1.0, 3.0])  # doctest: +SLOW
        >>> found["p_crit"].values.round(6)
        array([1.107206, 1.190282])
    """
    method = EventExact() if method is None else method
    check_run(scene, method, t_max, memory)
    arguments.truth("energy", energy)
    arguments.truth("derivatives", derivatives)
    if derivatives and not isinstance(method, EventExact):
        raise ValueError(
            "Argument `derivatives` needs the method EventExact(), whose trajectories are exact through events."
        )
    arguments.instance("scene.load", scene.load, Pulse, "a Pulse, whose p is sought")
    if "p" in axis:
        raise ValueError("Argument `p` is what is sought; limit it with `p_range` instead.")
    if not axis:
        # Any scalar parameter serves as the axis.
        name = "belt_speed" if np.ndim(scene.belt_speed) == 0 else "force"
        axis = {name: np.asarray(scene.parameters[name])[None]}
    if not isinstance(p_range, tuple | list) or len(p_range) != 2:
        kind = TypeError if not isinstance(p_range, tuple | list) else ValueError
        raise kind(f"Argument `p_range` must be a pair of numbers, such as (1.0, 5.0), but is {p_range!r}.")
    low, high = p_range
    arguments.real_number("p_range[0]", low, minimum=0)
    arguments.real_number("p_range[1]", high, above=low)
    if p_step is None:
        p_step = min(P_STEP, float(high) - float(low))
    arguments.real_number("p_step", p_step, above=0, maximum=float(high) - float(low))
    arguments.real_number("tolerance", tolerance, above=0)
    scanned = round(min((high - low) / p_step, 1e15)) + 1
    check_size({**axis, "p": range(scanned)}, energy=bool(energy))
    axes = checked_axes(scene, axis)
    check_axis_names(axes, OF_RESULTS, "critical kicks")
    shape = tuple(len(values) for values in axes.values())
    columns = {
        name: values.ravel() for name, values in zip(axes, np.meshgrid(*axes.values(), indexing="ij"), strict=True)
    }

    known: dict = {}  # attractors of the rows, which are the same in the scan and in all later runs

    def run(values, method, label: str, limits: Limits | None = None):
        limits = Limits(t_max) if limits is None else limits
        options = RunOptions(label, memory, progress, executor, all_or_none=True)
        return run_to_verdict(scene, TrajectoryList(values), method, limits, options, attractors=known)

    scan = np.linspace(low, high, scanned)
    verdicts = _verdicts(run, method, columns, np.tile(scan, (math.prod(shape), 1)), "scan")
    seen = first_crossings(scan, verdicts)
    brackets, at_ends = _to_narrow(scan, verdicts, seen)
    # Newton's method mostly finds the kick from what one round leaves.
    few = derivatives and not isinstance(method, WhereSwitched)
    fine, contradicted = _narrowed(run, method, columns, brackets, at_ends, tolerance, 1 if few else None)
    stepping = np.zeros(math.prod(shape))
    if isinstance(method, WhereSwitched):
        # Errors are first order in the step, so halving it changes the result by as much as the remaining error.
        coarse_method = WhereSwitched(method.solver, 2 * method.dt)
        around = np.maximum(fine.brackets + p_step * np.array([-1.0, 1.0]), 0.0)
        unknown = np.full(around.shape, Verdict.UNDECIDED)
        coarse, _ = _narrowed(run, coarse_method, columns, around, unknown, tolerance)
        stepping = np.where(np.isnan(fine.low), 0.0, np.abs(coarse.middle - fine.middle))
    answers = {}
    if derivatives:
        stage("Newton's method and derivatives")

        def narrowed(rows: np.ndarray, found: FirstCrossing) -> FirstCrossing:
            chosen = {name: column[rows] for name, column in columns.items()}
            ends = np.tile([Verdict.SLIDING, Verdict.LIMIT_CYCLE], (len(rows), 1))
            finer, again = _narrowed(run, method, chosen, found.brackets[rows], ends, tolerance)
            contradicted[rows] |= again
            return finer

        verdicts_of = functools.partial(_verdicts, run, method)
        fine, answers = with_derivatives(scene, verdicts_of, columns, fine, narrowed if few else None)
    # If the lower end of the range already squeals, there is no kick that slides.
    width = np.where(np.isnan(fine.low), 0.0, fine.high - fine.low)
    dataset = xr.Dataset(
        {
            name: (tuple(axes), values.reshape(shape))
            for name, values in {
                "p_crit": fine.middle,
                "p_crit_low": fine.low,
                "p_crit_high": fine.high,
                "p_crit_error": np.where(np.isnan(fine.middle), np.nan, 0.5 * width + stepping),
                "crossings": seen.changes,
                "only_crossing": (seen.changes <= 1) & ~contradicted & ~_hidden(scan, verdicts, seen),
            }.items()
        },
        coords=axes,
    )
    if derivatives:
        slopes = answers.pop("d_p_crit")
        dataset["d_p_crit"] = ((*axes, "parameter"), slopes.reshape(*shape, -1))
        dataset = dataset.assign_coords(parameter=list(differentiable(scene)))
        dataset = dataset.assign({name: (tuple(axes), values.reshape(shape)) for name, values in answers.items()})
    if energy:
        for name, values in _energies_of_the_kick(run, method, scene, {**columns, "p": fine.middle}).items():
            dataset[name] = (tuple(axes), values.reshape(shape))
    dataset.attrs.update(linear_limit(scene, axes))
    dataset.attrs["range"] = json.dumps([float(low), float(high)])
    return labelled(
        dataset, scene, method=describe_method(method), **time_limit(t_max), tolerance=tolerance, p_step=p_step
    )


def _energies_of_the_kick(run, method, scene: Scene, columns: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """The energy of the vibration at the end of each kick, and the work of the kick, in J."""
    known = np.flatnonzero(np.isfinite(columns["p"]))
    start, duration = (np.asarray(columns.get(name, scene.parameters[name])) for name in ("start", "duration"))
    energies = {name: np.full(len(columns["p"]), np.nan) for name in ("critical_energy", "kick_work")}
    if len(known):
        outcome = run(
            values={name: column[known] for name, column in columns.items()},
            method=method,
            limits=Limits(float(np.max(start + duration)), energy=True),
            label="energy",
        )
        energies["critical_energy"][known] = outcome.energy["kick_energy"]
        energies["kick_work"][known] = outcome.energy["kick_work"]
    return energies


def _verdicts(run, method, columns: dict[str, np.ndarray], p: np.ndarray, label: str) -> np.ndarray:
    """Verdicts for each row of the columns at its own values of p (rows, kicks)."""
    values = {name: np.repeat(column, p.shape[1]) for name, column in columns.items()}
    found = run(values={**values, "p": p.ravel()}, method=method, label=label)
    return found.verdict.reshape(p.shape)


def _to_narrow(scan: np.ndarray, verdicts: np.ndarray, seen: FirstCrossing) -> tuple[np.ndarray, np.ndarray]:
    """The brackets (rows, 2) to be narrowed, and the verdicts of the scan at their ends. If already the first kick leads to a
    limit cycle, the bracket is the first step.
    """
    from_the_start = np.isnan(seen.low) & np.isfinite(seen.middle)
    brackets = np.where(from_the_start[:, None], scan[:2], seen.brackets)
    ends = np.array([Verdict.SLIDING, Verdict.LIMIT_CYCLE])
    return brackets, np.where(from_the_start[:, None], verdicts[:, :2], ends)


def _hidden(scan: np.ndarray, verdicts: np.ndarray, seen: FirstCrossing) -> np.ndarray:
    """Whether undecided kicks outside the bracket might hide another change."""
    inside, no_kick = (scan > seen.low[:, None]) & (scan < seen.high[:, None]), scan == 1.0
    return np.any((verdicts < 0) & ~inside & ~no_kick, axis=1)


def _narrowed(
    run,
    method,
    columns: dict[str, np.ndarray],
    brackets: np.ndarray,
    at_ends: np.ndarray,
    tolerance: float,
    rounds: int | None = None,
) -> tuple[FirstCrossing, np.ndarray]:
    """The crossings inside brackets, narrowed to the tolerance, or to where undecided trajectories stop the narrowing; in so
    many `rounds` at most.

    The first ends of each bracket are run again, so that both ends of the returned crossing are verdicts of trajectories from
    the narrowing. Second result: which rows have a verdict that contradicts `at_ends` (rows, 2). Of two different verdicts on
    the same kick one is false, so no crossing is stated there.
    """
    # Points inside a bracket that are tried at once: with more points there are fewer rounds, and rounds take the time.
    points_per_round = 15
    nothing = np.full(len(brackets), np.nan)
    found = FirstCrossing(nothing, nothing.copy(), nothing.copy(), np.zeros(len(brackets), int))
    contradicted = np.zeros(len(brackets), bool)
    brackets = brackets.copy()
    open_ = np.flatnonzero(np.isfinite(brackets).all(axis=1))
    round_ = 0
    while len(open_) and round_ != rounds:
        round_ += 1
        shares = np.linspace(0, 1, points_per_round + 2)
        p = brackets[open_, :1] + shares * np.diff(brackets[open_])
        chosen = {name: column[open_] for name, column in columns.items()}
        label = f"narrowing {round_}"
        if round_ == 1:
            verdicts = _verdicts(run, method, chosen, p, label)
            before, again = at_ends[open_], verdicts[:, [0, -1]]
            contradicted[open_] = np.any((before >= 0) & (again >= 0) & (before != again), axis=1)
        else:
            verdicts = with_ends(_verdicts(run, method, chosen, p[:, 1:-1], label))
        now = first_crossings(p, verdicts)
        still = []
        for row, place in enumerate(open_):
            width = now.high[row] - now.low[row]
            narrower = round_ == 1 or width < 0.9 * (brackets[place, 1] - brackets[place, 0])
            for whole, part in zip(found, now, strict=True):
                whole[place] = part[row]
            if np.isfinite(width):
                brackets[place] = now.low[row], now.high[row]
            if narrower and width > tolerance and not contradicted[place]:
                still.append(place)
        open_ = np.array(still, int)
    # Two kicks that are neighbours in rounding cannot come closer.
    close = found.high - found.low <= np.maximum(tolerance, np.spacing(found.high))
    middle = np.where(close, 0.5 * (found.low + found.high), found.middle)
    middle = np.where(~close & np.isfinite(found.low), np.nan, middle)
    found = found._replace(
        middle=np.where(contradicted, np.nan, middle), high=np.where(contradicted, np.nan, found.high)
    )
    return found, contradicted
