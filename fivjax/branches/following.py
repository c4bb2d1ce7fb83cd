"""Following a branch of cycles: its steps and its ends."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from ..foundation.progress import stage
from .branch_points import Point, beyond, seen
from .meeting_sliding import where_sliding_is_met
from .mode_changes import change_of_modes, with_own_rebounds
from .multiple_shooting import AT_SECTION
from .pseudo_arclength import Curve, Family, Place
from .special_points import between

# Lengths of steps, in the units of the curve (cycle size, period and parameter scale).
FIRST, LONGEST, SHORTEST = 0.01, 0.04, 1e-7
# After a step that converged quickly, the next is longer: by the first factor below the length `FIRST`, by the second above.
SOON, LATER = 3.0, 1.5
# The angle between the tangents at neighbouring points has at least this cosine.
STRAIGHT = 0.99
# Cycles of one parameter whose periods and sizes differ by no more than this share are the same, but for rebounds that are none
# to speak of.
SAME = 1e-7
# Gaps that a branch goes over: beyond one it may come back on itself, again and again.
MOST_GAPS = 16
# A cycle of pure sliding that has shrunk to this share of its size ends at the equilibrium.
SMALL = 0.02


class Followed(NamedTuple):
    """One direction of a branch."""

    points: list[Point]
    ending: str  # why it ends, a sentence


def follow_branch(family: Family, start: Point, sense: float, bounds: tuple[float, float], most: int) -> Followed:
    """The branch in one direction from a cycle, at first towards larger (`sense` 1) or smaller (-1) values of the parameter."""
    here, tangent = start, start.curve.tangent(start.place, None)
    tangent = tangent * (sense if tangent[-1] >= 0 else -sense)
    points: list[Point] = []
    step, gaps = FIRST, 0

    def over_a_gap():
        nonlocal gaps
        gaps += 1
        return _over_a_gap(family, points, start, sense, bounds) if gaps <= MOST_GAPS else None

    while len(points) < most:
        stage(f"following, {len(points)} cycles so far")
        curve = here.curve
        ahead = _ahead(curve, here.place, tangent, step)
        if ahead is None:
            return Followed(points, _at(family, here, "no cycle is found further on, however short the step"))
        following, turned, step = ahead
        last = seen(family, curve, following)
        if not last.is_real:
            changed = change_of_modes(family, here, tangent, step)
            if changed is None:
                if step > 100 * SHORTEST:
                    step *= 0.25
                    continue
                return Followed(points, _at(family, here, "the contact modes change in a way that is not understood"))
            special, onward = changed
            if not bounds[0] <= special.place.parameter <= bounds[1]:
                return _to_bound(family, points, here, tangent, special.place, bounds)
            if special.curve is curve:
                # The parameter may turn back just there.
                passed = _specials(family, curve, here.place, tangent, special.place)
                points += [one for one in passed if np.linalg.norm(one.place.u - special.place.u) > 1e-6]
            at_change = seen(family, special.curve, special.place, special)
            if onward is not None or at_change.real is not None:
                points.append(at_change)
            onward = onward or over_a_gap()
            if onward is None:
                return Followed(points, _at(family, at_change, f"{special.name}: no cycle was found to go on beyond"))
            here, tangent, step = onward
            continue
        passed = _specials(family, curve, here.place, tangent, following)
        points += [point for point in passed if bounds[0] <= point.place.parameter <= bounds[1]]
        if not bounds[0] <= following.parameter <= bounds[1]:
            return _to_bound(family, points, here, following.u - here.place.u, following, bounds)
        if (turned_at := _met_before(points, last)) is not None:
            # What goes on there in truth has other modes: a chain of rebounds that no longer ends, say.
            points = points[: turned_at + 1]
            onward = over_a_gap()
            if onward is None:
                why = "the branch would come back on itself, and nothing else was found to go on"
                return Followed(points, _at(family, points[-1], why))
            here, tangent, step = onward
            continue
        points.append(last)
        if _smallness(curve, following) < SMALL:
            end = where_sliding_is_met(family, last)
            if end is None:
                return Followed(points, _at(family, last, "the amplitude goes to zero"))
            return Followed(
                [*points, end],
                f"At {family.name} = {end.place.parameter:.13g} the amplitude meets the sliding equilibrium, whose stability "
                f"changes there.",
            )
        if len(points) > 8 and _closes(start, here, last):
            return Followed(points, _at(family, last, "the branch is back where it began"))
        easy = following.iterations <= 3
        step = min(step * ((SOON if step < FIRST else LATER) if easy else 0.7), LONGEST)
        here, tangent = with_own_rebounds(family, last, turned)
    return Followed(points, _at(family, here, f"`points` = {most} points are computed"))


def _ahead(
    curve: Curve, here: Place, tangent: Float[np.ndarray, " m"], step: float
) -> tuple[Place, Float[np.ndarray, " m"], float] | None:
    """The next cycle, the tangent there, and the step to it, which is shortened until there is a cycle and the curve is nearly
    straight up to it. None if there is none, however short the step.
    """
    # Not beyond the equilibrium, where the amplitude is zero.
    step = min(step, 0.5 * _smallness(curve, here))
    while True:
        following = curve.along(here, tangent, step)
        if following is not None:
            turned = curve.tangent(following, tangent)
            if turned @ tangent >= STRAIGHT or step <= 1e-3:
                return following, turned, step
        elif step <= 4 * SHORTEST:
            return None
        step *= 0.5


def _to_bound(
    family: Family,
    points: list[Point],
    here: Point,
    along: Float[np.ndarray, " m"],
    beyond: Place,
    bounds: tuple[float, float],
) -> Followed:
    """The points up to a bound of the parameter, which lies between a point and what is `beyond` it in the direction `along`:
    with the cycle at the bound, if it is found.
    """
    bound = bounds[0] if beyond.parameter < bounds[0] else bounds[1]
    share = (bound - here.place.parameter) / (along[-1] * family.scale)
    at = here.curve.at_parameter(here.place.u + share * along, bound)
    last = [] if at is None else [seen(family, here.curve, at)]
    return Followed(
        points + [point for point in last if point.is_real], f"The bound {family.name} = {bound:.10g} is reached."
    )


def _at(family: Family, point: Point, why: str) -> str:
    return f"At {family.name} = {point.place.parameter:.12g} {why}."


def _specials(family: Family, curve: Curve, a: Place, tangent, b: Place) -> list[Point]:
    return [seen(family, curve, special.place, special) for special in between(curve, a, tangent, b)]


def _over_a_gap(family: Family, points: list[Point], start: Point, sense: float, bounds: tuple[float, float]):
    """The point, tangent and step with which to go on where the next cycles cannot be followed; the point is added. The
    parameter may turn back there, but not to where the branch has come from.
    """
    before, last = [start, start, *points][-2:]
    onwards = np.sign(last.place.parameter - before.place.parameter) or sense
    for way in (onwards, -onwards) if points else (sense,):
        found = beyond(family, last, way)
        if found is None or not bounds[0] <= found.place.parameter <= bounds[1]:
            continue
        if _met_before([start, *points, found], found) is None:
            points.append(found)
            tangent = found.curve.tangent(found.place, None)
            return found, tangent * np.sign(way * tangent[-1]), FIRST
    return None


def _smallness(curve: Curve, place: Place) -> float:
    """The size of a cycle of pure sliding, relative to its size where the curve began; other cycles end before they are
    small.
    """
    pure = len(place.phases.modes) == 1 and place.phases.modes[0].ending == AT_SECTION
    return float(np.linalg.norm(place.u[: len(curve.of_state)])) if pure else np.inf


def _met_before(points: list[Point], last: Point) -> int | None:
    """Where a branch has turned back, if its latest cycle is one that it has come along before: the last point until then."""
    if last.real is None:
        return None
    parameters = np.array([point.place.parameter for point in points])
    value, period = last.place.parameter, last.place.phases.period
    for k in np.flatnonzero((parameters[:-2] - value) * (parameters[1:-1] - value) <= 0):
        near = points[k]
        # Between these two points, or nearly so: elsewhere the cycle need not be computed.
        one, other = near.place.phases.period, points[k + 1].place.phases.period
        if abs(period - 0.5 * (one + other)) > 1.5 * abs(one - other) + SAME * period:
            continue
        before = near.curve.at_parameter(near.place.u, value)
        if before is None or abs(before.phases.period - period) > SAME * period:
            continue
        size, own = (at.phases.size(near.curve.weights) for at in (before, last.place))
        if abs(size - own) <= 10 * SAME * size:
            return int(k + np.argmax(np.abs(parameters[k:] - value)))
    return None


def _closes(start: Point, here: Point, last: Point) -> bool:
    if start.curve.modes != last.curve.modes:
        return False
    a, b, c = (point.place.u * point.curve.scales / start.curve.scales for point in (here, start, last))
    return bool(np.linalg.norm(b - a) < np.linalg.norm(c - a) and np.linalg.norm(c - b) < np.linalg.norm(c - a))
