"""Critical kicks: the smallest that lead to a limit cycle, found by a scan and narrowed down in batches."""

import json

import numpy as np
import xarray as xr
from jaxtyping import Float, Int

from ..cycles.own_coordinates import in_own_coordinates
from ..foundation import arguments
from ..foundation.precision import in_double_precision
from ..foundation.progress import reported, stage
from ..io.datasets import check_axis_names, labelled, named
from ..maps.axes import at_middle, check_size, checked_axes, checked_time_limit, linear_limit
from ..maps.crossing import FirstCrossing
from ..maps.datasets import time_limit
from ..maps.engine import RunOptions
from ..maps.executors import with_workers
from ..maps.groups import Limits
from ..model.load import Pulse
from ..model.scene import Scene
from ..steppers.base import AbstractStepper, describe_method
from ..steppers.event_exact import EventExact
from ..steppers.where_switched import WhereSwitched
from ..verdicts.verdict import Verdict
from .critical_derivatives import differentiable, with_derivatives
from .narrowing import AT_ENDS, Kicked, Scan, checked_range

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

    The range of p is scanned in steps of `p_step` or less, then the first change from sliding to limit cycle is narrowed down.
    The boundary may have islands (sliding above a limit cycle); those narrower than the steps are missed.

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
      doubled, and infinite where nothing near it is found then;
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
    t_max = checked_time_limit(scene, method, t_max, memory)
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
    arguments.real_number("tolerance", tolerance, above=0)
    low, high, p_step, scanned = checked_range(p_range, p_step)
    check_size({**axis, "p": range(scanned)}, energy=bool(energy))
    axes = checked_axes(scene, axis)
    check_axis_names(axes, OF_RESULTS, "critical kicks")
    columns = {
        name: values.ravel() for name, values in zip(axes, np.meshgrid(*axes.values(), indexing="ij"), strict=True)
    }
    options = RunOptions("scan", memory, progress, executor, all_or_none=True)
    kicked = Kicked(at_middle(scene, axes), columns, method, Limits(t_max), options, {})
    scan = Scan.of(kicked, np.linspace(low, high, scanned))
    # Newton's method mostly finds the kick from what one round leaves.
    fine, contradicted = kicked.narrowed(*scan.brackets, tolerance, 1 if derivatives else None)
    answers = {}
    if derivatives:
        stage("Newton's method and derivatives")

        def narrowed(rows: Int[np.ndarray, " s"], found: FirstCrossing, at_most: float) -> FirstCrossing:
            ends = np.tile(AT_ENDS, (len(rows), 1))
            finer, again = kicked.only(rows).narrowed(found.brackets[rows], ends, min(tolerance, at_most))
            contradicted[rows] |= again
            return finer

        fine, answers = with_derivatives(kicked, fine, narrowed)
    # If the lower end of the range already squeals, there is no kick that slides.
    width = np.where(np.isnan(fine.low), 0.0, fine.high - fine.low)
    error = np.where(np.isnan(fine.middle), np.nan, 0.5 * width + _stepping_error(kicked, fine, p_step, tolerance))
    found = {
        "p_crit": fine.middle,
        "p_crit_low": fine.low,
        "p_crit_high": fine.high,
        "p_crit_error": error,
        "crossings": scan.seen.changes,
        "only_crossing": scan.has_one_change & ~contradicted,
        **answers,
    }
    if energy:
        found |= _energies_of_the_kick(kicked, fine.middle)
    dataset = _over_axes(axes, found, scene)
    dataset.attrs.update(linear_limit(scene, axes))
    dataset.attrs["range"] = json.dumps([float(low), float(high)])
    settings = {"method": describe_method(method), **time_limit(t_max), "tolerance": tolerance, "p_step": p_step}
    dataset = labelled(dataset, scene, **settings)
    return named(dataset, kind=("where the critical kick leads", "1")) if derivatives else dataset


def _stepping_error(
    kicked: Kicked, fine: FirstCrossing, p_step: float, tolerance: float
) -> Float[np.ndarray, " r"] | float:
    """By how much steps of one size may have moved the critical kicks. Errors are of first order in the step, so doubling it
    changes the result by as much as the error that remains.
    """
    method = kicked.method
    if not isinstance(method, WhereSwitched):
        return 0.0
    coarser, moved = kicked._replace(method=WhereSwitched(method.solver, 2 * method.dt)), np.zeros(len(fine.middle))
    left = np.flatnonzero(np.isfinite(fine.low))
    for away in (1, 8, 64):
        around = np.maximum(fine.brackets[left] + away * p_step * np.array([-1.0, 1.0]), 0.0)
        unknown = np.full(around.shape, Verdict.UNDECIDED)
        coarse, _ = coarser.only(left).narrowed(around, unknown, tolerance)
        # Where the lower end squeals, the crossing lies below it.
        moved[left] = np.where(np.isfinite(coarse.low), np.abs(coarse.middle - fine.middle[left]), np.nan)
        left = left[np.isnan(moved[left])]
        if not len(left):
            break
    moved[left] = np.inf
    return moved


def _energies_of_the_kick(kicked: Kicked, p: Float[np.ndarray, " r"]) -> dict[str, Float[np.ndarray, " r"]]:
    """The energy of the vibration at the end of each kick, and the work of the kick, in J."""
    known = np.isfinite(p)
    start, duration = (
        np.asarray(kicked.columns.get(name, kicked.scene.parameters[name])) for name in ("start", "duration")
    )
    energies = {name: np.full(len(p), np.nan) for name in ("critical_energy", "kick_work")}
    if np.any(known):
        limits = Limits(float(np.max(start + duration)), energy=True)
        outcome = kicked.only(known)._replace(limits=limits).run(p[known, None], "energy")
        energies["critical_energy"][known] = outcome.energy["kick_energy"]
        energies["kick_work"][known] = outcome.energy["kick_work"]
    return energies


def _over_axes(axes: dict[str, np.ndarray], found: dict[str, np.ndarray], scene: Scene) -> xr.Dataset:
    """What was found of each row, over the axes; what has one more axis, also over the parameters of derivatives."""
    shape = tuple(len(values) for values in axes.values())
    named = {1: tuple(axes), 2: (*axes, "parameter")}
    variables = {
        name: (named[values.ndim], values.reshape(*shape, *values.shape[1:])) for name, values in found.items()
    }
    parameters = {"parameter": list(differentiable(scene))} if "d_p_crit" in found else {}
    return xr.Dataset(variables, coords={**axes, **parameters})
