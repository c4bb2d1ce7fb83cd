"""The points of a branch of cycles."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Complex

from ..attractors.closing import close_near
from ..cycles.one_period import follow_period, middle_of_longest
from ..section.crossings import Point as SectionPoint
from ..section.return_maps import ReturnMaps
from .multiple_shooting import phases_around
from .pseudo_arclength import ComputedCycle, Curve, Family, multipliers_of
from .special_points import Special
from .verification import RealMotion, crossings_of, on_section, real_motion

# Distances at which a branch goes on beyond what cannot be followed, as shares of the parameter's scale. A cycle that differs
# much more in period or size is of another branch.
BEYOND = (1e-3, 3e-3, 1e-2)


class BranchPoint(NamedTuple):
    """A cycle on the branch with its multipliers, and its kind if it is a special point."""

    curve: Curve
    cycle: ComputedCycle
    real: RealMotion | None
    multipliers: Complex[np.ndarray, " m"]
    special: Special | None = None

    @property
    def is_real(self) -> bool:
        """Whether the real motion has the contact modes with which the cycle was computed, and its events where that has
        them.
        """
        return _moves_as_computed(self.real, self.cycle)

    @property
    def name(self) -> str:
        """The kind of special point; empty for all others."""
        return "" if self.special is None else self.special.name


def branch_point(family: Family, curve: Curve, cycle: ComputedCycle, special: Special | None = None) -> BranchPoint:
    """A point of the branch from a computed cycle, with the real motion that starts on it."""
    real = motion_on(family, cycle)
    return BranchPoint(curve, cycle, real, multipliers_of(cycle.images), special)


def point_through(family: Family, parameter: float, start: SectionPoint, period: float) -> BranchPoint | None:
    """The point of a branch that is the cycle through a state; None at a special point, where its equations are singular."""
    scene = family.at(parameter)
    segments = follow_period(scene, start, period).segments
    if np.any(segments.ended):
        # The point on the section may be where an event ends: a landing can make the tangential velocity jump through zero.
        segments = follow_period(scene, middle_of_longest(segments), period).segments
    phases = phases_around(segments)
    if phases is None:
        return None
    curve = Curve(family, phases)
    cycle = curve.at_parameter(curve.unknowns(phases, parameter), parameter)
    return None if cycle is None else branch_point(family, curve, cycle)


def cycle_beyond(family: Family, last: BranchPoint, at: float, sense: float) -> BranchPoint | None:
    """A cycle much like a point's for somewhat larger (`sense` 1) or smaller (-1) values of the parameter than `at`, closed on
    the section: there may be many changes of modes in between, as where a chain of rebounds ends no longer.
    """
    phases, scene = last.cycle.phases, family.at(last.cycle.parameter)
    start = None if last.real is None else on_section(scene, phases, last.real)
    crossings = None if start is None else crossings_of(ReturnMaps.of(scene), start)
    if start is None or crossings is None:
        return None
    for share in BEYOND:
        parameter = at + sense * share * family.scale
        if not family.is_possible(parameter):
            return None
        closed = close_near(ReturnMaps.of(family.at(parameter)), start, crossings)
        found = None if closed is None else point_through(family, parameter, closed.point, closed.period)
        # Period and size may change as the parameter does, relative to itself, and somewhat more: not with its bounds.
        most = share * max(1.0, 2 * family.scale / max(abs(at), 0.2 * family.scale))
        if found is not None and found.is_real and _are_alike(last, found, most):
            return found
    return None


def _are_alike(one: BranchPoint, other: BranchPoint, share: float) -> bool:
    periods = one.cycle.phases.period, other.cycle.phases.period
    sizes = [at.cycle.phases.size(at.curve.weights) for at in (one, other)]
    return all(abs(b / a - 1) <= share for a, b in (periods, sizes))


def is_real_motion(family: Family, cycle: ComputedCycle) -> bool:
    """Whether the real motion has the modes and events of a computed cycle."""
    return _moves_as_computed(motion_on(family, cycle), cycle)


def motion_on(family: Family, cycle: ComputedCycle) -> RealMotion | None:
    """The real motion that starts on a computed cycle; None where it does not last, or no scene has the cycle's parameter."""
    if not family.is_possible(cycle.parameter):
        return None
    return real_motion(family.at(cycle.parameter), cycle.phases)


def _moves_as_computed(real: RealMotion | None, cycle: ComputedCycle) -> bool:
    return real is not None and real.moves_as(cycle.phases) and not risen_to_zero(cycle)


def risen_to_zero(cycle: ComputedCycle) -> list[int]:
    """The phases at whose computed end the guard rises: it has passed zero before, where the real motion has its event. In the
    last rebounds of a chain it neither rises nor falls, to rounding.
    """
    return [k for k in cycle.phases.lasting() if not cycle.images.guard_h[k] < 0]
