"""Following a branch of cycles: its steps, the changes of the contact modes on the way, and its ends."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Complex, Float

from ..foundation.compiling import compiled
from ..linear.linearisation import linear_sliding
from ..model.scene import Scene
from .multiple_shooting import AT_SECTION, Phases
from .pseudo_arclength import Curve, Family, Place, multipliers_of
from .special_points import MEETS_SLIDING, Special, between, change_between, grazing_of, name_of, vanishing, without
from .verification import Real, on_section, real_motion

# Lengths of steps, in the units of the curve (cycle size, period and parameter scale).
FIRST, LONGEST, SHORTEST = 0.01, 0.04, 1e-7
# After a step that converged quickly, the next is longer: by the first factor below the length `FIRST`, by the second above.
SOON, LATER = 3.0, 1.5
# The angle between the tangents at neighbouring points has at least this cosine.
STRAIGHT = 0.99
# Halvings that bracket a change of modes before it is computed.
HALVINGS = 14
# Distances beyond a change of modes at which the next modes are determined, as shares of the step.
BEYOND = (1e-6, 1e-5, 1e-4, 1e-3, 1e-2, 1e-1)
# A cycle of pure sliding that has shrunk to this share of its size ends at the equilibrium.
SMALL = 0.02


class Point(NamedTuple):
    """A cycle on the branch with its multipliers, and its kind if it is a special point."""

    curve: Curve
    place: Place
    real: Real | None
    multipliers: Complex[np.ndarray, " m"]
    special: Special | None = None

    @property
    def name(self) -> str:
        """The kind of special point; empty for all others."""
        return "" if self.special is None else self.special.name


class Followed(NamedTuple):
    """One direction of a branch."""

    points: list[Point]
    ending: str  # why it ends, a sentence


def seen(family: Family, curve: Curve, place: Place, special: Special | None = None) -> Point:
    """A point of the branch from a computed cycle, with the real motion that starts on it."""
    real = real_motion(family.at(place.parameter), family.stepper, place.phases)
    return Point(curve, place, real, multipliers_of(place.images), special)


def is_real(family: Family, place: Place) -> bool:
    """Whether the real motion has the contact modes with which a cycle was computed."""
    real = real_motion(family.at(place.parameter), family.stepper, place.phases)
    return real is not None and real.has_the_modes_of(place.phases)


def follow_branch(family: Family, start: Point, sense: float, bounds: tuple[float, float], most: int) -> Followed:
    """The branch in one direction from a cycle, at first towards larger (`sense` 1) or smaller (-1) values of the parameter."""
    curve, here = start.curve, start
    tangent = curve.tangent(here.place, None)
    tangent = tangent * (sense if tangent[-1] >= 0 else -sense)
    points: list[Point] = []
    step = FIRST
    while len(points) < most:
        # Not beyond the equilibrium, where the amplitude is zero.
        step = min(step, 0.5 * _smallness(curve, here.place))
        following = curve.along(here.place, tangent, step)
        if following is None:
            if step <= 4 * SHORTEST:
                return Followed(points, _at(family, here, "no cycle is found further on, however short the step"))
            step *= 0.5
            continue
        turned = curve.tangent(following, tangent)
        if turned @ tangent < STRAIGHT and step > 1e-3:
            step *= 0.5
            continue
        beyond = not bounds[0] <= following.parameter <= bounds[1]
        last = seen(family, curve, following)
        if last.real is None or not last.real.has_the_modes_of(following.phases):
            changed = _change(family, here, tangent, step)
            if changed is None:
                if step > 100 * SHORTEST:
                    step *= 0.25
                    continue
                return Followed(points, _at(family, here, "the contact modes change in a way that is not understood"))
            special, onward = changed
            if not bounds[0] <= special.place.parameter <= bounds[1]:
                return Followed(points, _at(family, here, "the bound is reached"))
            points += _specials(family, curve, here.place, tangent, special.place if special.curve is curve else None)
            points.append(seen(family, special.curve, special.place, special))
            if onward is None:
                return Followed(points, _at(family, points[-1], f"{special.name}: no cycle goes on beyond"))
            here, tangent, step = onward
            curve = here.curve
            continue
        points += [
            point
            for point in _specials(family, curve, here.place, tangent, following)
            if bounds[0] <= point.place.parameter <= bounds[1]
        ]
        if beyond:
            bound = bounds[0] if following.parameter < bounds[0] else bounds[1]
            share = (bound - here.place.parameter) / (following.parameter - here.place.parameter)
            at = curve.at_parameter(here.place.u + share * (following.u - here.place.u), bound)
            if at is not None:
                points.append(seen(family, curve, at))
            return Followed(points, f"The bound {family.name} = {bound:.10g} is reached.")
        if _smallness(curve, following) < SMALL:
            end = _meets_sliding(family, last)
            return Followed([*points, *end.points], end.ending)
        points.append(last)
        if len(points) > 8 and _closes(start, here, last):
            return Followed(points, _at(family, last, "the branch is back where it began"))
        easy = following.iterations <= 3
        step = min(step * ((SOON if step < FIRST else LATER) if easy else 0.7), LONGEST)
        here, tangent = last, turned
    return Followed(points, _at(family, here, f"`points` = {most} points are computed"))


def _at(family: Family, point: Point, why: str) -> str:
    return f"At {family.name} = {point.place.parameter:.12g} {why}."


def _specials(family, curve: Curve, a: Place, tangent, b: Place | None) -> list[Point]:
    if b is None:
        return []
    return [seen(family, curve, special.place, special) for special in between(curve, a, tangent, b)]


def _smallness(curve: Curve, place: Place) -> float:
    """The size of a cycle of pure sliding, relative to its size where the curve began; other cycles end before they are
    small.
    """
    pure = len(place.phases.modes) == 1 and place.phases.modes[0].ending == AT_SECTION
    return float(np.linalg.norm(place.u[: len(curve.of_state)])) if pure else np.inf


def _closes(start: Point, here: Point, last: Point) -> bool:
    if start.curve.modes != last.curve.modes:
        return False
    a, b, c = (point.place.u * point.curve.scales / start.curve.scales for point in (here, start, last))
    return bool(np.linalg.norm(b - a) < np.linalg.norm(c - a) and np.linalg.norm(c - b) < np.linalg.norm(c - a))


@compiled
def _sliding_matrix(scene: Scene):
    return linear_sliding(scene).matrix


def sliding_rates(scene: Scene) -> Complex[np.ndarray, " m"]:
    """Eigenvalues of steady sliding, in 1/s, the fastest growing first."""
    matrix = np.asarray(_sliding_matrix(scene))
    if not np.all(np.isfinite(matrix)):
        return np.full(len(matrix), np.nan, complex)
    values = np.linalg.eigvals(matrix).astype(complex)
    return values[np.lexsort((-values.imag, -values.real))]


def _meets_sliding(family: Family, last: Point) -> Followed:
    """The end of a branch of shrinking cycles: the last cycle, and the equilibrium at its stability limit."""
    from scipy.optimize import brentq

    def growth(parameter: float) -> float:
        return float(sliding_rates(family.at(parameter))[0].real)

    near, width = last.place.parameter, 1e-6 * family.scale
    for _ in range(16):
        low, high = growth(near - width), growth(near + width)
        if low * high < 0:
            limit = float(brentq(growth, near - width, near + width, xtol=1e-15, rtol=1e-15))
            fastest = sliding_rates(family.at(limit))[0]
            rest, period = np.zeros_like(last.place.phases.y), np.array([2 * np.pi / abs(fastest.imag)])
            place = last.place._replace(parameter=limit, phases=last.place.phases._replace(y=rest, h=period))
            unknown = np.full_like(last.multipliers, np.nan)
            end = Point(last.curve, place, None, unknown, Special(MEETS_SLIDING, last.curve, place))
            return Followed(
                [last, end],
                f"At {family.name} = {limit:.13g} the amplitude meets the sliding equilibrium, whose stability changes there.",
            )
        width *= 2
    return Followed([last], _at(family, last, "the amplitude goes to zero"))


def _change(family: Family, here: Point, tangent: Float[np.ndarray, " m"], step: float):
    """The change of modes within a step: the special point, and the point, tangent and step with which to go on, if any."""
    curve = here.curve
    low, high, ahead = 0.0, step, curve.along(here.place, tangent, step)
    valid = here.place
    for _ in range(HALVINGS):
        middle = 0.5 * (low + high)
        place = curve.along(here.place, tangent, middle)
        if place is None:
            high = middle
            continue
        if is_real(family, place):
            low, valid = middle, place
        else:
            high, ahead = middle, place
    if ahead is None:
        return None
    gone = [k for k in range(len(ahead.phases.h)) if ahead.phases.h[k] <= 0]
    if gone:
        return _removed(family, curve, valid, tangent, gone[0], step)
    return _inserted(family, curve, valid, ahead, tangent, step) or _removed(
        family, curve, valid, tangent, int(np.argmin(valid.phases.h)), step
    )


def _inserted(family: Family, curve: Curve, valid: Place, ahead: Place, tangent, step: float):
    """A change beyond which there are more phases."""
    for share in BEYOND:
        place = curve.along(ahead, tangent, share * step)
        if place is None:
            continue
        real = real_motion(family.at(place.parameter), family.stepper, place.phases)
        if real is None or real.phases is None or len(real.phases.modes) <= len(curve.modes):
            continue
        change = change_between(real.phases.modes, curve.modes)
        longer = Curve(family, real.phases)
        first = longer.corrected(longer.unknowns(real.phases, place.parameter))
        if first is None or not is_real(family, first):
            continue
        special, grazing = None, grazing_of(curve, ahead)
        if grazing is not None and _near(curve, grazing.place, ahead, step):
            name = name_of(grazing, change, removed=False)
            special = Special(name, curve, grazing.place, grazing.row, grazing)
        elif change is not None and not change.merges:
            special = vanishing(longer, first, change.phase)
        if special is None:
            special = Special("", curve, valid)
        if not special.name:
            special = special._replace(name=name_of(None, change, removed=False))
        away = longer.tangent(first, None)
        vanishes = change is not None and change.word != "impact"
        index = len(longer.of_state) + change.phase if change is not None else 0
        if vanishes and abs(away[index]) > 1e-6:
            away = away * np.sign(away[index])
        else:
            away = _outward(family, longer, first, away, special.place)
        return special, (seen(family, longer, first), away, max(share * step, 1e-3))
    return None


def _removed(family: Family, curve: Curve, valid: Place, tangent, phase: int, step: float):
    """A change beyond which there are fewer phases."""
    shorter = _shorter(family, valid, phase)
    if shorter is None:
        return None
    guess, change = shorter
    fewer = Curve(family, guess)
    first = fewer.corrected(fewer.unknowns(guess, valid.parameter))
    if first is None:
        return None
    special, away = None, fewer.tangent(first, None)
    grazing = grazing_of(fewer, first)
    if grazing is not None and _near(fewer, grazing.place, first, 1e-3):
        special = Special(name_of(grazing, change, removed=True), fewer, grazing.place, grazing.row, grazing)
        away = fewer.tangent(grazing.place, None)
        away = away * np.sign(grazing.row @ away)
    else:
        found = None if change.merges else vanishing(curve, valid, phase)
        special = Special("", curve, valid) if found is None else found
        special = special._replace(name=name_of(None, change, removed=True))
        away = _outward(family, fewer, first, away, None)
    begin = special.place if special.curve is fewer else first
    for length in (1e-6, 1e-5, 1e-4, 1e-3, 1e-2):
        onward = fewer.along(begin, away, length)
        if onward is not None and is_real(family, onward):
            return special, (seen(family, fewer, onward), fewer.tangent(onward, away), max(length, 1e-3))
    return special, None


def _shorter(family: Family, valid: Place, phase: int):
    """The phases without the given one, as a guess of a cycle; and the change that leads to them."""
    phases = valid.phases
    count, modes = len(phases.modes), phases.modes
    before, after = modes[phase - 1], modes[(phase + 1) % count]
    if count == 2 and modes[phase][:2] != after[:2]:
        # The remaining phase has no event: it starts and ends on the section.
        kept = (after._replace(ending=AT_SECTION),)
        change = change_between(modes, kept)
        real = real_motion(family.at(valid.parameter), family.stepper, phases)
        point = None if real is None else on_section(family.at(valid.parameter), family.stepper, real)
        if change is None or point is None:
            return None
        return Phases(kept, np.asarray(point.y)[None], np.array([phases.period])), change
    if count > 2 and before[:2] == after[:2]:
        kept = tuple(mode for j, mode in enumerate(modes) if j not in (phase, (phase - 1) % count))
    else:
        kept = modes[:phase] + modes[phase + 1 :]
    change = change_between(modes, kept)
    if change is None:
        return None
    guess = without(phases, change._replace(phase=phase), kept)
    return None if guess is None else (guess, change)


def _near(curve: Curve, found: Place, guess: Place, step: float) -> bool:
    return float(np.linalg.norm(found.u - guess.u)) < max(2 * step, 1e-3)


def _outward(family: Family, curve: Curve, first: Place, tangent, special: Place | None):
    """The direction along a curve in which its cycles are real motions."""
    for length in (1e-6, 1e-5, 1e-4, 1e-3):
        real = []
        for sign in (1.0, -1.0):
            place = curve.along(first, tangent, sign * length)
            real.append(place is not None and is_real(family, place))
        if real[0] != real[1]:
            return tangent if real[0] else -tangent
    if special is not None and special.parameter != first.parameter and abs(tangent[-1]) > 1e-12:
        return tangent * np.sign(tangent[-1] * (first.parameter - special.parameter))
    return tangent
