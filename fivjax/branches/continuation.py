r"""Branches of limit cycles over a parameter, by pseudo-arclength continuation, stable and unstable ones alike.

A branch passes folds, where the parameter turns back, and changes of the contact modes: a guard grazes zero, and beyond there
is one more phase of sticking or detachment, or one more impact. Each sequence of modes has a smooth curve of cycles
(`multiple_shooting`). The point where this curve no longer is the real motion is computed as a root (`grazing`); the branch
continues along the curve for the sequence of modes that the real motion has beyond.
"""

import contextlib
import warnings
from typing import TYPE_CHECKING

import equinox as eqx
import numpy as np

from ..attractors.closing import closed_at
from ..contact import Contact, Status
from ..cycles.cycle import LimitCycle, limit_cycle_of, point_of, stability_margin, under_final_load
from ..cycles.own_coordinates import cycle_in_own_coordinates, in_own_coordinates
from ..cycles.saddle import saddle_cycle
from ..cycles.search import NoLimitCycle, limit_cycle
from ..foundation import arguments
from ..foundation.digits import apart
from ..foundation.precision import in_double_precision
from ..foundation.progress import reported, stage
from ..foundation.quantities import quantity_of
from ..io.datasets import labelled, named
from ..linear.linearisation import sliding_rates
from ..model.contact_coordinates import to_contact_coordinates
from ..model.directions import direction_of
from ..model.scene import Scene, check_corners, scene_in_contact_coordinates
from ..section.about_sliding import sliding_state
from ..section.crossings import Point as SectionPoint
from ..section.free_directions import snapped_to_section
from ..section.return_maps import ReturnMaps
from .branch_points import BranchPoint, point_through
from .following import HalfBranch, follow_branch
from .multiple_shooting import Mode, Phases
from .pseudo_arclength import Family
from .special_derivatives import derivatives_of_special_points
from .special_points import MEETS_SLIDING, SMOOTH
from .verification import amplitude, crossings_of, on_section

if TYPE_CHECKING:
    import xarray as xr


@reported("branch")
@in_own_coordinates
@in_double_precision
def continue_cycle(
    scene: Scene,
    parameter: str,
    bounds: tuple[float, float],
    start=None,
    *,
    points: int = 400,
    derivatives: bool = False,
    progress: bool | None = None,
) -> "xr.Dataset":
    """The branch of limit cycles, stable and unstable, that contains a given one, over a parameter of the scene.

        branch = fj.continue_cycle(scene, "mu", (0.02, 0.3))
        unstable = fj.continue_cycle(scene, "mu", (0.02, 0.3), start=fj.saddle_cycle(scene))

    The branch is followed both ways from the start, past folds, through stable and unstable cycles. Where the next ones
    cannot be followed, because a rebound grazes or a chain of them no longer rests, it goes on up to a hundredth of the bounds'
    distance further, if the cycle there has nearly the same period and size.

    **Arguments:**

    - `scene`; `parameter`, the name of one of its scalar parameters, such as "mu" or "belt_speed". The load is the final one.
    - `bounds`: the lowest and the highest value of the parameter, in its unit; the scene's own value lies between them.
    - `start`: as in `limit_cycle`; a `LimitCycle` may be unstable. Unless given, the scene's limit cycle, or its saddle cycle
      if the limit cycle is a torus.
    - `progress`: as in `limit_cycle`.
    - `points`: the largest number of cycles computed in each direction.
    - `derivatives`: whether to differentiate special points in all parameters.

    **Returns:** a dataset over `point`, in the order along the branch:

    - `parameter` (its value), `period` (s), `amplitude` (peak tangential speed, m/s), `stable`;
    - `sliding_stable`, whether steady sliding is stable there;
    - `multipliers` over `multiplier`, largest first, without the one for a deviation along the cycle;
    - `word`, the contact modes in order; `state`, on the section, in m and m/s (just after an impact that makes the tangential
      velocity jump over zero), and the contact mode there, `status` and the `direction` of friction on the structure, 1 where
      the belt is faster (with several contacts over `contact`, too);
    - `special`: the kind of a special point, else empty: "fold", "non-smooth fold" (no multiplier is one: an impact begins to
      end the slip there, say), "period doubling", "Neimark–Sacker", "amplitude meets the sliding equilibrium", or how the
      contact modes change there, also where the branch turns back with them, as seen from the start outwards ("grazing of slip:
      stick inserted"; with several contacts "… at contact 1", or that two events change their order). "edge of the friction
      cone": static friction begins or ceases to hold the contact. Special points are computed to rounding;
    - with `derivatives`, `d_special` over `of`: derivatives of the parameter's value at a special point. NaN at all other
      points, for the parameter itself, and where the change of modes is not a simple one.

    The attributes `begins` and `ends` say in a sentence where each end is, and why. A closed curve is passed once. A branch of
    cycles whose two halves become alike ends there, at the period doubling from which it comes. Where cycles cannot be followed
    it goes on with the next one much like the last, if there is one; others that coexist there are not looked for. Interrupted
    by the user, it returns the cycles known by then, without `d_special`, and the attribute `interrupted` is 1.

    **Raises:** `ValueError` for a name that is no scalar parameter, bounds that do not contain the scene's value or that it
    cannot have, and for anything that `limit_cycle` refuses; `NoLimitCycle` if there is no periodic cycle to start from.

    **Example:**

        >>> branch = fj.continue_cycle(scene.replace(belt_speed=1.0), "mu", (0.2, 0.24))  # doctest: +SLOW
        >>> bool(branch["stable"].any())
        True
    """
    arguments.instance("scene", scene, Scene, "a Scene")
    arguments.known("scene", scene)
    final = under_final_load(scene)
    known = [name for name, value in final.parameters.items() if np.ndim(value) == 0]
    arguments.one_of("parameter", parameter, tuple(known))
    parameter = str(parameter)
    low, high = arguments.pair("bounds", bounds, "(0.02, 0.3)")
    check_corners(final, {parameter: np.array([low, high])})
    value = float(final.parameters[parameter])
    if not low <= value <= high:
        own, lower, upper = apart(value, low, high)
        raise ValueError(
            f"Argument `bounds` must hold the scene's own {parameter}, {own}, but is ({lower}, {upper}). "
            f"Widen it, or begin with a scene whose {parameter} lies between them."
        )
    points = arguments.whole_number("points", points, minimum=2)
    arguments.truth("derivatives", derivatives)
    cycle = limit_cycle(final, start)
    if cycle.kind != "periodic" and start is None:
        # Past a fold, the branch of the saddle cycle leads to the unstable cycle inside the torus. Where sliding is unstable
        # there is no saddle cycle.
        with contextlib.suppress(NoLimitCycle):
            cycle = saddle_cycle(final, cycle)
    if cycle.kind != "periodic":
        raise NoLimitCycle(
            f"The motion to start from, at {parameter} = {value:g}, is a torus, which is not continued. Start where the limit "
            f"cycle is periodic, or give a `LimitCycle` as `start`."
        )
    family = Family(final, direction_of(final, parameter), parameter, value, (low, high))
    first = point_through(family, value, point_of(cycle), cycle.period)
    if first is None:
        raise NoLimitCycle(
            "The cycle to start from lies at a special point, where its equations are singular: start a little beside it. Or "
            "the modes of two contacts end at the same instant, as where they move alike, and an impact at one changes the "
            "other: such cycles have no branch here."
        )
    down = follow_branch(family, first, -1.0, points)
    # A closed curve is whole by one half; its first cycle is its last as well. The other may have ended on the way.
    no_more = down.closed or down.interrupted
    up = HalfBranch([], down.ending) if no_more else follow_branch(family, first, 1.0, points)
    if up.closed:
        down = HalfBranch([], up.ending)
    along = [*reversed(down.points), first, *up.points]
    interrupted, slopes = down.interrupted or up.interrupted, None
    if derivatives and not interrupted:
        try:
            stage("differentiating special points")
            slopes = derivatives_of_special_points(family, along)
        except KeyboardInterrupt:
            interrupted = True
    if interrupted:
        warnings.warn(f"Interrupted: the branch has the {len(along)} cycles that were computed by then.", stacklevel=2)
    return labelled(_dataset(family, along, slopes), final, parameter=parameter).assign_attrs(
        parameter=parameter, begins=down.ending, ends=up.ending, interrupted=int(interrupted)
    )


@in_double_precision
def cycle_at(branch: "xr.Dataset", i: int) -> LimitCycle:
    """The limit cycle at a point of a branch.

    **Arguments:** `branch`, from `continue_cycle`; `i`, the index of the point.

    **Returns:** a `LimitCycle`. Where contact modes change, the return map has no derivative, and the multipliers are those of
    the branch, on one side of that point. Where the branch ends because the two halves of its cycle become one, that one is
    returned, with half of the branch's period.

    **Raises:** `TypeError` or `ValueError` for an object that is no branch, an `i` that is not among its points, and a
    structure by a function of your own that has made none in this process;
    `NoLimitCycle` if the motion does not come back to the section: at nearly zero amplitude, and at some grazings, where
    rounding tells what it does.

    **Example:**

        >>> branch = fj.continue_cycle(scene.replace(belt_speed=1.0), "mu", (0.2, 0.24))  # doctest: +SLOW
        >>> fj.cycle_at(branch, 0).kind
        'periodic'
    """
    if not arguments.is_whole(i):
        raise TypeError(f"Argument `i` must be the index of a point, a whole number, but is {arguments.describe(i)}.")
    try:
        name, row = branch.attrs["parameter"], branch.isel(point=i)
        value = float(row["parameter"])
    except (AttributeError, KeyError, IndexError, ValueError):
        raise ValueError(
            f"Argument `branch` must come from `fivjax.continue_cycle`, and `i` be the place of one of its points, "
            f"but is {i!r}."
        ) from None
    given = Scene.from_dataset(branch)
    if name not in given.parameters:
        raise ValueError(
            f"The branch is over `{name}`, a parameter of a structure by a function of your own, which its dataset does not "
            f"hold. Make a structure by that function first."
        )
    given = given.replace(**{name: value})
    scene = scene_in_contact_coordinates(given)
    state = np.asarray(row["state"])
    if scene is not given:
        state = np.asarray(to_contact_coordinates(given.structure, state))
    y = state - np.asarray(sliding_state(scene, scene.load.final))
    contact = Contact(np.asarray(row["status"].values, np.int32), np.asarray(row["direction"].values, float))
    point = SectionPoint(y if scene is given else snapped_to_section(scene, y, contact), contact)
    maps = ReturnMaps.of(scene)
    crossings = crossings_of(maps, point)
    if crossings is None:
        raise NoLimitCycle(
            f"At point {i} of the branch the motion does not come back to the section. Take a point beside it."
        )
    cycle = limit_cycle_of(maps, scene, closed_at(maps, point, crossings))
    if str(row["special"].values) not in SMOOTH:
        values = np.append(np.asarray(row["multipliers"]), 1.0)
        values = values[np.argsort(-np.abs(values), kind="stable")]
        cycle = eqx.tree_at(lambda c: (c.multipliers, c.stable), cycle, (values, bool(row["stable"])))
    return cycle_in_own_coordinates(given, cycle)


def _dataset(family: Family, points: list[BranchPoint], slopes) -> "xr.Dataset":
    import xarray as xr

    size = 2 * family.scene.structure.size
    count = len(family.scene.structure.contacts)
    each, none = (("point",), ()) if count == 1 else (("point", "contact"), (count,))
    states, status, direction, peaks, slides = [], [], [], [], []
    for point in points:
        scene = family.at(point.cycle.parameter)
        slides.append(bool(sliding_rates(scene)[0].real < 0))
        rest = sliding_state(scene, scene.load.final)
        at = None if point.real is None else on_section(scene, point.cycle.phases, point.real)
        states.append(np.full(size, np.nan) if at is None else np.asarray(at.y) + rest)
        status.append(np.full(none, -1) if at is None else at.contact.status)
        direction.append(np.full(none, np.nan) if at is None else at.contact.direction)
        peaks.append(np.nan if point.real is None else amplitude(scene, point.cycle.phases, point.real))
        if point.name == MEETS_SLIDING:
            states[-1], peaks[-1] = rest, 0.0
    multipliers = np.stack([point.multipliers for point in points])
    largest = np.abs(multipliers[:, 0])
    names = list(family.scene.structure.coordinates)
    dataset = xr.Dataset(
        {
            "parameter": ("point", [point.cycle.parameter for point in points]),
            "period": ("point", [point.cycle.phases.period for point in points]),
            "amplitude": ("point", peaks),
            "multipliers": (("point", "multiplier"), multipliers),
            "stable": ("point", largest < 1 - stability_margin(count)),
            "sliding_stable": ("point", slides),
            "word": ("point", [word_of(point.cycle.phases) for point in points]),
            "special": ("point", [point.name for point in points]),
            "state": (("point", "coordinate"), np.stack(states)),
            "status": (each, np.array(status, np.int8)),
            "direction": (each, np.array(direction, float)),
        },
        coords={"coordinate": [*names, *(f"d{name}" for name in names)]},
    )
    if slopes is not None:
        of, values = slopes
        dataset = dataset.assign_coords(of=of).assign(d_special=(("point", "of"), values))
    return named(
        dataset,
        parameter=quantity_of(family.name) or (family.name, ""),
        stable=("whether the cycle is stable", "1"),
        state=("state on the section: displacements, then velocities", "m, m/s"),
        direction=("direction of friction on the section, where it slides", "1"),
    )


def word_of(phases: Phases) -> str:
    """The contact modes of a cycle as text; sliding faster than the belt is "slide back". Of several contacts it is
    "slide+stick", say.
    """
    first = phases.modes[int(np.argmax(phases.h))]

    def of(mode: Mode, contact: int) -> str:
        # Which way a contact slides in the longest phase; else in the first in which it does.
        ways = [one.direction[contact] for one in (first, *phases.modes) if one.status[contact] == Status.SLIDE]
        status, way = Status(mode.status[contact]), mode.direction[contact]
        return f"{status.name.lower()} back" if status == Status.SLIDE and way != ways[0] else status.name.lower()

    words = ["+".join(of(mode, contact) for contact in range(len(mode.status))) for mode in phases.modes]
    turned = [words[k:] + words[:k] for k in range(len(words))]
    # Rotated to a unique beginning, so that the same cycle has the same word at all points.
    return " – ".join(max(turned))
