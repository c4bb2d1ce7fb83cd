"""Following a branch of cycles: its steps and its ends."""

import itertools
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from ..foundation.progress import stage
from ..linear.linearisation import sliding_rates
from . import halves
from .branch_points import BranchPoint, branch_point, cycle_beyond, is_real_motion
from .corners import around_corner
from .mode_changes import change_of_modes, with_own_rebounds
from .multiple_shooting import AT_SECTION
from .pseudo_arclength import ComputedCycle, Curve, Family
from .special_points import MEETS_SLIDING, Special, between

# Lengths of steps, in the units of the curve (cycle size, period and parameter scale).
FIRST, LONGEST, SHORTEST = 0.01, 0.04, 1e-7


class HalfBranch(NamedTuple):
    """One direction of a branch."""

    points: list[BranchPoint]
    ending: str  # why it ends, a sentence
    closed: bool = False  # whether it has come back to where it began
    interrupted: bool = False


def follow_branch(family: Family, start: BranchPoint, sense: float, most: int) -> HalfBranch:
    """The branch in one direction from a cycle, at first towards larger (`sense` 1) or smaller (-1) values of the parameter."""
    front = _Front(family, start, sense)
    while len(front.points) < most:
        try:
            stage(f"following, {len(front.points)} cycles so far")
            ended = front.advance()
        except KeyboardInterrupt:
            return front.ended(front.here, "it was interrupted")._replace(interrupted=True)
        if ended is not None:
            return ended
    return front.ended(front.here, f"`points` = {most} points are computed")


class _Front:
    """The front of a branch that is followed in one direction: its latest point, with the tangent and the step with which to go
    on, and the points behind it. Methods that go on return the whole branch where it ends, and None where it does not.
    """

    def __init__(self, family: Family, start: BranchPoint, sense: float):
        self.family, self.start, self.sense = family, start, sense
        tangent = start.curve.tangent(start.cycle, None)
        self.here, self.tangent, self.step = start, tangent * (sense if tangent[-1] >= 0 else -sense), FIRST
        self.points: list[BranchPoint] = []
        self.gaps = 0

    def ended(self, at: BranchPoint, why: str) -> HalfBranch:
        return HalfBranch(self.points, f"At {self.family.name} = {at.cycle.parameter:.12g} {why}.")

    def _within(self, cycle: ComputedCycle) -> bool:
        return self.family.is_within(cycle.parameter)

    def advance(self) -> HalfBranch | None:
        """One step further, or around what is in its way."""
        ahead = _ahead(self.here.curve, self.here.cycle, self.tangent, self.step)
        if ahead is None:
            return self._around_corner()
        following, turned, self.step = ahead
        if not self.family.is_possible(following.parameter):
            return self._up_to_bound(following)
        last = branch_point(self.family, self.here.curve, following)
        return self._come_to(last, turned) if last.is_real else self._through_change_of_modes()

    def _up_to_bound(self, beyond: ComputedCycle) -> HalfBranch | None:
        """To the bound of the parameter before what is `beyond` it, where there are no scenes."""
        here, along = self.here.cycle, beyond.u - self.here.cycle.u
        bound = self._bound_before(beyond)
        if here.parameter == bound:
            return self._to_bound(along, beyond)
        last = self._at_bound(along, bound)
        if last is not None and last.is_real:
            return self._come_to(last, self.here.curve.tangent(last.cycle, self.tangent))
        if self.step <= 100 * SHORTEST:
            return self.ended(self.here, "the contact modes change in a way that is not understood")
        self.step *= 0.25
        return None

    def _bound_before(self, beyond: ComputedCycle) -> float:
        low, high = self.family.bounds
        return low if beyond.parameter < low else high

    def _at_bound(self, along: Float[np.ndarray, " m"], bound: float) -> BranchPoint | None:
        """The point with this value of the parameter in the direction `along` from the front."""
        here = self.here
        share = (bound - here.cycle.parameter) / (along[-1] * self.family.scale)
        at = here.curve.at_parameter(here.cycle.u + share * along, bound)
        return None if at is None else branch_point(self.family, here.curve, at)

    def _around_corner(self) -> HalfBranch | None:
        beyond = around_corner(self.family, self.here, self.tangent)
        if beyond is None:
            return self._over_a_gap(self.here, "no cycle is found further on, however short the step")
        curve, (corner, onward) = self.here.curve, beyond
        if corner is not None and self._within(corner.cycle):
            self.points.append(branch_point(self.family, curve, corner.cycle, corner))
        self.here, self.tangent, self.step = onward
        self.points.append(self.here)
        return None

    def _through_change_of_modes(self) -> HalfBranch | None:
        family, here, curve = self.family, self.here, self.here.curve
        changed = change_of_modes(family, here, self.tangent, self.step)
        if changed is None:
            if self.step > 100 * SHORTEST:
                self.step *= 0.25
                return None
            return self.ended(here, "the contact modes change in a way that is not understood")
        special, onward = changed
        if not self._within(special.cycle):
            return self._to_bound(self.tangent, special.cycle)
        if special.curve is curve:
            # The parameter may turn back just there.
            passed = _specials(family, curve, here.cycle, self.tangent, special.cycle)
            self.points += [one for one in passed if np.linalg.norm(one.cycle.u - special.cycle.u) > 1e-6]
        # The rebounds of a landing that begins to have them are as short as those that are left out.
        begins = family.name.startswith("restitution") and special.cycle.parameter < 1e-5 and "impact" in special.name
        at_change = branch_point(family, special.curve, special.cycle, None if begins else special)
        if onward is not None or at_change.real is not None:
            self.points.append(at_change)
        if onward is None:
            return self._over_a_gap(at_change, f"{special.name}: no cycle was found to go on beyond")
        self.here, self.tangent, self.step = onward
        return None

    def _come_to(self, last: BranchPoint, turned: Float[np.ndarray, " m"]) -> HalfBranch | None:
        """To a cycle of the same contact modes, where the tangent is `turned`."""
        # A branch of pure sliding ends at the equilibrium once its cycle has shrunk to this share of its first size.
        small = 0.02
        family, here, curve, following = self.family, self.here.cycle, self.here.curve, last.cycle
        born = halves.born_between(family, curve, here, following)
        if born is not None and self._within(born.cycle):
            self.points = [*halves.without_seeming_folds(self.points, born), born]
            return self.ended(born, "the two halves of the cycle become one, whose period doubles there")
        self.points += [
            one for one in _specials(family, curve, here, self.tangent, following) if self._within(one.cycle)
        ]
        if not self._within(following):
            return self._to_bound(following.u - here.u, following)
        if (met := _met_before([self.start, *self.points], last)) is not None:
            return self._back_on_itself(met)
        self.points.append(last)
        if _smallness(curve, following) < small:
            return self._at_equilibrium(last)
        # After a step that converged quickly, the next is longer: by the first factor below the length `FIRST`, by the second
        # above.
        soon, later = 3.0, 1.5
        longer = (soon if self.step < FIRST else later) if following.iterations <= 3 else 0.7
        self.step = min(self.step * longer, LONGEST)
        self.here, self.tangent = with_own_rebounds(family, last, turned)
        return None

    def _back_on_itself(self, met: "_Met") -> HalfBranch | None:
        if met.onwards:
            return self.ended(self.start, "the branch is back where it began")._replace(closed=True)
        # What goes on there in truth has other modes: a chain of rebounds that no longer ends, say.
        self.points = self.points[: met.turned]
        why = "the branch would come back on itself, and nothing else was found to go on"
        return self._over_a_gap([self.start, *self.points][-1], why)

    def _at_equilibrium(self, last: BranchPoint) -> HalfBranch:
        end = _where_sliding_is_met(self.family, last)
        if end is None:
            return self.ended(last, "the amplitude goes to zero")
        return HalfBranch(
            [*self.points, end],
            f"At {self.family.name} = {end.cycle.parameter:.13g} the amplitude meets the sliding equilibrium, whose stability "
            f"changes there.",
        )

    def _to_bound(self, along: Float[np.ndarray, " m"], beyond: ComputedCycle) -> HalfBranch:
        """The points up to a bound of the parameter, which lies between the front and what is `beyond` it in the direction
        `along`: with the cycle at the bound, if it is found.
        """
        bound = self._bound_before(beyond)
        reached = f"The bound {self.family.name} = {bound:.10g} is reached."
        if self.here.cycle.parameter == bound:
            return HalfBranch(self.points, reached)
        last = self._at_bound(along, bound)
        return HalfBranch(self.points + ([last] if last is not None and last.is_real else []), reached)

    def _over_a_gap(self, at: BranchPoint, otherwise: str) -> HalfBranch | None:
        """Beyond a gap, where the next cycles cannot be followed; where nothing is found there, the branch ends for this
        reason. The parameter may turn back there, but not to where the branch has come from.
        """
        # Beyond a gap a branch may come back on itself, again and again.
        most_gaps = 16
        self.gaps += 1
        before, last = [self.start, self.start, *self.points][-2:]
        moved = last.cycle.parameter - before.cycle.parameter
        # What begins at a special point has not moved by more than rounding.
        onwards = np.sign(moved) if abs(moved) > SHORTEST * self.family.scale else self.sense
        ways = (onwards, -onwards) if self.points else (self.sense,)
        for way, near in itertools.product(ways, (last, before)) if self.gaps <= most_gaps else ():
            # At a special point rounding tells how the motion goes on.
            found = cycle_beyond(self.family, near, last.cycle.parameter, way)
            if found is None or not self._within(found.cycle):
                continue
            if _met_before([self.start, *self.points, found], found) is None:
                grazes = _grazing_between(self.family, last, found)
                self.points += [found] if grazes is None else [grazes, found]
                tangent = found.curve.tangent(found.cycle, None)
                self.here, self.tangent, self.step = found, tangent * np.sign(way * tangent[-1]), FIRST
                return None
        return self.ended(at, otherwise)


def _ahead(
    curve: Curve, here: ComputedCycle, tangent: Float[np.ndarray, " m"], step: float
) -> tuple[ComputedCycle, Float[np.ndarray, " m"], float] | None:
    """The next cycle, the tangent there, and the step to it, which is shortened until there is a cycle and the curve is nearly
    straight up to it. None if there is none, however short the step.
    """
    # The angle between the tangents at neighbouring points has at least this cosine.
    straight = 0.99
    # Not beyond the equilibrium, where the amplitude is zero.
    step = min(step, 0.5 * _smallness(curve, here))
    while True:
        following = curve.along(here, tangent, step)
        if following is not None:
            turned, chord = curve.tangent(following, tangent), float(np.linalg.norm(following.u - here.u))
            # Parts of a branch that lie beside each other may have the same direction: it is not to be left for another one.
            if (turned @ tangent >= straight and step >= straight * chord) or (step <= 1e-3 and chord <= 4 * step):
                return following, turned, step
        if step <= 4 * SHORTEST:
            return None
        step *= 0.5


def _specials(family: Family, curve: Curve, a: ComputedCycle, tangent, b: ComputedCycle) -> list[BranchPoint]:
    return [branch_point(family, curve, special.cycle, special) for special in between(curve, a, tangent, b)]


def _grazing_between(family: Family, last: BranchPoint, found: BranchPoint) -> BranchPoint | None:
    """The grazing at which the cycles end that lead back from the far side of a gap, if they end in it: a lift-off with all its
    rebounds may begin there, which is more than one change of modes.
    """
    tangent, back = found.curve.tangent(found.cycle, None), last.cycle.parameter - found.cycle.parameter
    if abs(tangent[-1]) < 1e-6:
        return None
    step = abs(back / (family.scale * tangent[-1]))
    tangent = tangent * np.sign(back * tangent[-1])
    ahead = found.curve.along(found.cycle, tangent, step)
    if ahead is None or is_real_motion(family, ahead):
        return None
    changed = change_of_modes(family, found, tangent, step)
    if changed is None or changed[0].grazing is None:
        return None
    special = changed[0]
    # As seen from the start outwards.
    swapped = {"inserted": "removed", "removed": "inserted"}
    special = special._replace(name=" ".join(swapped.get(word, word) for word in special.name.split(" ")))
    within = (special.cycle.parameter - last.cycle.parameter) * (special.cycle.parameter - found.cycle.parameter) < 0
    return branch_point(family, special.curve, special.cycle, special) if within else None


def _smallness(curve: Curve, cycle: ComputedCycle) -> float:
    """The size of a cycle of pure sliding, relative to its size where the curve began; other cycles end before they are
    small.
    """
    pure = len(cycle.phases.modes) == 1 and cycle.phases.modes[0].ending == AT_SECTION
    return float(np.linalg.norm(cycle.u[: len(curve.of_state)])) if pure else np.inf


class _Met(NamedTuple):
    """Where a branch has met itself."""

    onwards: bool  # whether it goes the way that it went then: it is closed
    turned: int  # the last point before it turned back, if it did


def _met_before(points: list[BranchPoint], last: BranchPoint) -> _Met | None:
    """Where a branch meets itself, if its latest cycle is one that it has come along before."""
    # Cycles of one parameter whose periods and sizes differ by no more than this share are the same, but for rebounds that are
    # none to speak of.
    same = 1e-7
    if last.real is None:
        return None
    parameters = np.array([point.cycle.parameter for point in points])
    value = last.cycle.parameter
    for k in np.flatnonzero((parameters[:-2] - value) * (parameters[1:-1] - value) <= 0):
        near = points[k]
        # How long the cycles are, and how large: each may differ by so much.
        one, other, own = (
            np.array([phases.period, phases.size(near.curve.weights)])
            for phases in (point.cycle.phases for point in (near, points[k + 1], last))
        )
        differing = own * [same, 10 * same]
        # Between these two points, or nearly so: elsewhere the cycle need not be computed.
        if np.any(np.abs(own - 0.5 * (one + other)) > 1.5 * np.abs(one - other) + differing):
            continue
        before = near.curve.at_parameter(near.cycle.u, value)
        if before is None:
            continue
        found = np.array([before.phases.period, before.phases.size(near.curve.weights)])
        if np.all(np.abs(found - own) <= differing):
            onwards = (parameters[k + 1] - parameters[k]) * (value - parameters[-1]) > 0
            return _Met(bool(onwards), int(k + np.argmax(np.abs(parameters[k:] - value))))
    return None


def _where_sliding_is_met(family: Family, last: BranchPoint) -> BranchPoint | None:
    """The stability limit of sliding next to the last of shrinking cycles, as a point of their branch; None if none is near."""
    from scipy.optimize import brentq

    def growth(parameter: float) -> float:
        return float(sliding_rates(family.at(parameter))[0].real)

    near, width = last.cycle.parameter, 1e-6 * family.scale
    for _ in range(16):
        low, high = growth(near - width), growth(near + width)
        if low * high < 0:
            limit = float(brentq(growth, near - width, near + width, xtol=1e-15, rtol=1e-15))
            fastest = sliding_rates(family.at(limit))[0]
            rest, period = np.zeros_like(last.cycle.phases.y), np.array([2 * np.pi / abs(fastest.imag)])
            cycle = last.cycle._replace(parameter=limit, phases=last.cycle.phases._replace(y=rest, h=period))
            unknown = np.full_like(last.multipliers, np.nan)
            return BranchPoint(last.curve, cycle, None, unknown, Special(MEETS_SLIDING, last.curve, cycle))
        width *= 2
    return None
