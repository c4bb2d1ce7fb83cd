"""Where the contact modes of a branch of cycles change: the special point there, and the cycles with other modes beyond it."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from .branch_points import BranchPoint, branch_point, is_real_motion, motion_on, risen_to_zero
from .grazing import touch
from .multiple_shooting import AT_SECTION, Phases, images_of_phases
from .pseudo_arclength import ComputedCycle, Curve, Family
from .special_points import Special, change_between, grazing_of, name_of, root, vanishing, without
from .verification import on_section, real_motion

# The most phases of a cycle that is followed: its equations are a matrix of so many states. Ever shorter impacts have more.
MOST_PHASES = 256


class _Bracket(NamedTuple):
    """Two distances along the tangent at a point of a branch between which the modes change, with the computed cycles there."""

    family: Family
    here: BranchPoint
    tangent: Float[np.ndarray, " m"]
    step: float  # in which the change was found
    low: float
    high: float
    valid: ComputedCycle  # at the lower distance, a real motion
    ahead: ComputedCycle | None  # at the higher one, where the equations have a solution beyond the change

    def halved(self, times: int) -> "_Bracket":
        """A narrower one."""
        _, here, tangent, _, low, high, valid, ahead = self
        for _ in range(times):
            middle = 0.5 * (low + high)
            cycle = here.curve.along(here.cycle, tangent, middle)
            if cycle is None:
                high = middle
            elif is_real_motion(self.family, cycle):
                low, valid = middle, cycle
            else:
                high, ahead = middle, cycle
        return self._replace(low=low, high=high, valid=valid, ahead=ahead)

    def root(self, test: Callable[[ComputedCycle], float]) -> ComputedCycle | None:
        """The cycle between the two on which a function is zero; None unless it has other signs on them."""
        here = self.here
        return root(lambda s: here.curve.along(here.cycle, self.tangent, s), test, self.low, self.high)[1]

    def last_real(self) -> ComputedCycle:
        """The last real motion, to rounding: for a change that is not known to be where some function is zero."""
        return self.halved(30).valid


def change_of_modes(family: Family, here: BranchPoint, tangent: Float[np.ndarray, " m"], step: float):
    """The change of modes within a step: the special point, and the point, tangent and step with which to go on, if any."""
    curve = here.curve
    whole = _Bracket(family, here, tangent, step, 0.0, step, here.cycle, curve.along(here.cycle, tangent, step))
    bracket = whole.halved(14)
    valid, ahead = bracket.valid, bracket.ahead
    if ahead is None:
        return None
    # Events of two contacts that move alike are always at once. What was no short rebound may be as short as one by now.
    before = here.cycle.phases
    gone = [k for k in before.lasting() if ahead.phases.h[k] <= 0 and not before.is_at_once(k)]
    if gone:
        return _reordered(family, curve, valid, gone[0]) or _removed(bracket, gone[0])
    if turned_back := _missed(bracket, ahead):
        return turned_back, None
    shrinks = _shrinking(valid.phases, before)
    return (
        _inserted(bracket, ahead)
        or (None if shrinks is None else _removed(bracket, shrinks, seen=True))
        or _grazes(curve, valid, ahead)
        or (None if shrinks is None else _removed(bracket, shrinks))
        or (Special("contact modes change", curve, bracket.last_real()), None)
    )


def _shrinking(phases: Phases, before: Phases) -> int | None:
    """The phase that has become shortest beside its length before, if it has shrunk by half."""
    lasting = phases.lasting()
    among = [k for k in lasting if not before.is_at_once(k)] or lasting
    shares = np.abs(phases.h[among] / np.where(before.h[among] == 0, np.inf, before.h[among]))
    return among[int(np.argmin(shares))] if np.min(shares) < 0.5 else None


def _missed(bracket: _Bracket, ahead: ComputedCycle) -> Special | None:
    """The cycle on which a guard only just falls to zero at the end of a phase, between two distances along the tangent.
    Beyond, it rises there, so the event came before; and the parameter has turned back.
    """
    curve = bracket.here.curve
    for k in risen_to_zero(ahead):
        if curve.modes[k].ending == AT_SECTION:
            continue
        cycle = bracket.root(lambda cycle, k=k: float(cycle.images.guard_h[k]))
        if cycle is not None:
            mode = curve.modes[k]
            return Special(touch(mode, mode.ending), curve, cycle, turns=True)
    return None


def _grazes(curve: Curve, valid: ComputedCycle, ahead: ComputedCycle):
    """A change beyond which no cycle is found, though it is known which guard touches zero."""
    grazing = grazing_of(curve, ahead)
    if grazing is None or not _between(grazing.cycle, valid, ahead):
        return None
    return Special(name_of(grazing, None, removed=False), curve, grazing.cycle, grazing.row, grazing), None


def _inserted(bracket: _Bracket, ahead: ComputedCycle):
    """A change beyond which there are more phases."""
    family, curve, tangent, step = bracket.family, bracket.here.curve, bracket.tangent, bracket.step
    # Distances beyond a change of modes at which the next modes are determined, as shares of the step.
    beyond = (1e-6, 1e-5, 1e-4, 1e-3, 1e-2, 1e-1)
    for share in beyond:
        cycle = curve.along(ahead, tangent, share * step)
        if cycle is None:
            continue
        real = motion_on(family, cycle)
        if real is None or real.phases is None or not len(curve.modes) < len(real.phases.modes) <= MOST_PHASES:
            continue
        change = change_between(real.phases.modes, curve.modes)
        longer = Curve(family, real.phases)
        first = longer.corrected(longer.unknowns(real.phases, cycle.parameter))
        if first is None or not is_real_motion(family, first):
            continue
        special, grazing = None, grazing_of(curve, ahead)
        if grazing is not None and _between(grazing.cycle, bracket.valid, ahead):
            name = name_of(grazing, change, removed=False)
            special = Special(name, curve, grazing.cycle, grazing.row, grazing)
        elif change is not None and not change.merges:
            special = vanishing(longer, first, change.phase)
        if special is None:
            special = Special("", curve, bracket.last_real())
        if not special.name:
            special = special._replace(name=name_of(None, change, removed=False))
        away = longer.tangent(first, None)
        vanishes = change is not None and change.word != "impact"
        index = len(longer.of_state) + change.phase if change is not None else 0
        if vanishes and abs(away[index]) > 1e-6:
            away = away * np.sign(away[index])
        else:
            away = _outward(family, longer, first, away, special.cycle)
        return special, (branch_point(family, longer, first), away, max(share * step, 1e-3))
    return None


def _removed(bracket: _Bracket, phase: int, seen: bool = False):
    """A change beyond which there are fewer phases; if it is to be `seen`, only where a guard touches zero or the phase
    vanishes.
    """
    family, curve, valid = bracket.family, bracket.here.curve, bracket.valid
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
    if grazing is not None and _apart(grazing.cycle, first) < 2e-3:
        special = Special(name_of(grazing, change, removed=True), fewer, grazing.cycle, grazing.row, grazing)
        away = fewer.tangent(grazing.cycle, None)
        # Beyond the edge of static friction the contact slides on.
        held = grazing.minimum.mode.status != fewer.modes[grazing.minimum.phase].status
        away = away * np.sign(grazing.row @ away) * (-1.0 if held else 1.0)
    else:
        found = None if change.merges else vanishing(curve, valid, phase)
        if seen and (found is None or bracket.ahead is None or not _between(found.cycle, valid, bracket.ahead)):
            return None
        special = Special("", curve, bracket.last_real()) if found is None else found
        special = special._replace(name=name_of(None, change, removed=True))
        away = _outward(family, fewer, first, away, special.cycle)
    return special, _onward(family, fewer, special.cycle if special.curve is fewer else first, away)


def _reordered(family: Family, curve: Curve, valid: ComputedCycle, phase: int):
    """A change beyond which two contacts have their events in the other order, if the phase between these vanishes."""
    modes = list(curve.modes)
    before, own, after = modes[phase - 1], modes[phase], modes[(phase + 1) % len(modes)]
    first, second = before.ending // 2, own.ending // 2
    # Each event changes nothing of the other contact.
    if first == second or before.mode_of(second) != own.mode_of(second) or own.mode_of(first) != after.mode_of(first):
        return None
    special = vanishing(curve, valid, phase)
    if special is None:
        return None
    cycle = special.cycle
    modes[phase - 1] = before._replace(ending=own.ending)
    modes[phase] = before.with_mode_of(second, after.mode_of(second))._replace(ending=before.ending)
    ends = images_of_phases(
        family.at(cycle.parameter),
        family.direction,
        [modes[phase - 1]],
        [modes[phase]],
        cycle.phases.y[[phase - 1]],
        cycle.phases.h[[phase - 1]],
    )
    y = cycle.phases.y.copy()
    y[phase] = ends.y[0]
    guess = Phases(tuple(modes), y, cycle.phases.h)
    other = Curve(family, guess)
    begin = other.corrected(other.unknowns(guess, cycle.parameter))
    if begin is None:
        return None
    away = other.tangent(begin, None)
    away = away * np.sign(away[len(other.of_state) + phase])
    special = special._replace(name="the events of two contacts change their order")
    onward = _onward(family, other, begin, away)
    return None if onward is None else (special, onward)


def _onward(family: Family, curve: Curve, begin: ComputedCycle, away: Float[np.ndarray, " m"]):
    """The point, tangent and step with which to go on along a curve, from the first of its cycles that is a real motion."""
    for length in (1e-6, 1e-5, 1e-4, 1e-3, 1e-2):
        cycle = curve.along(begin, away, length)
        if cycle is not None and is_real_motion(family, cycle):
            return branch_point(family, curve, cycle), curve.tangent(cycle, away), max(length, 1e-3)
    return None


def _shorter(family: Family, valid: ComputedCycle, phase: int):
    """The phases without the given one, as a guess of a cycle; and the change that leads to them."""
    phases = valid.phases
    count, modes = len(phases.modes), phases.modes
    before, after = modes[phase - 1], modes[(phase + 1) % count]
    if count == 2 and modes[phase][:2] != after[:2]:
        # The remaining phase has no event: it starts and ends on the section.
        kept = (after._replace(ending=AT_SECTION),)
        change = change_between(modes, kept)
        real = real_motion(family.at(valid.parameter), phases)
        point = None if real is None else on_section(family.at(valid.parameter), phases, real)
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
    return without(phases, change._replace(phase=phase), len(kept)), change


def with_own_rebounds(
    family: Family, here: BranchPoint, tangent: Float[np.ndarray, " m"]
) -> tuple[BranchPoint, Float[np.ndarray, " m"]]:
    """The point and tangent with as many rebounds as the real motion has before it rests: their number changes along a branch,
    and no cycle changes with it.
    """
    phases = None if here.real is None else here.real.phases
    if phases is None or len(phases.modes) == len(here.curve.modes) or len(phases.modes) > MOST_PHASES:
        return here, tangent
    curve = Curve(family, phases)
    cycle = curve.corrected(curve.unknowns(phases, here.cycle.parameter))
    if cycle is None or not is_real_motion(family, cycle):
        return here, tangent
    onward = curve.tangent(cycle, None)
    before, after = (
        np.array([np.sum(one[k:-1]), one[-1]])
        for one, k in ((tangent, len(here.curve.of_state)), (onward, len(curve.of_state)))
    )
    return branch_point(family, curve, cycle), onward * (1.0 if before @ after >= 0 else -1.0)


def _between(found: ComputedCycle, valid: ComputedCycle, ahead: ComputedCycle) -> bool:
    """Whether a cycle is where the modes change: another guard may graze not far away. Very short rebounds count late."""
    return _apart(found, ahead) < max(2 * _apart(valid, ahead), 1e-4)


def _apart(one: ComputedCycle, other: ComputedCycle) -> float:
    return float(np.linalg.norm(one.u - other.u))


def _outward(family: Family, curve: Curve, first: ComputedCycle, tangent, special: ComputedCycle | None):
    """The direction along a curve in which its cycles are real motions."""
    for length in (1e-6, 1e-5, 1e-4, 1e-3):
        real = []
        for sign in (1.0, -1.0):
            cycle = curve.along(first, tangent, sign * length)
            real.append(cycle is not None and is_real_motion(family, cycle))
        if real[0] != real[1]:
            return tangent if real[0] else -tangent
    if special is not None and special.parameter != first.parameter and abs(tangent[-1]) > 1e-12:
        return tangent * np.sign(tangent[-1] * (first.parameter - special.parameter))
    return tangent
