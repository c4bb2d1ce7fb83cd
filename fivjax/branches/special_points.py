"""Special points of a branch: folds, period doublings, Neimark–Sacker bifurcations, and changes of the contact modes."""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Complex, Float

from ..contact import Status
from .grazing import Grazing, grazing_near, guard_minima, touch, where
from .multiple_shooting import AT_SECTION, Mode, Phases, same_modes
from .pseudo_arclength import ComputedCycle, Curve, multipliers_of

FOLD, DOUBLING, TORUS = "fold", "period doubling", "Neimark–Sacker"
# Where the derivative of the return map jumps: an impact, say, begins to end the slip.
CORNER = "non-smooth fold"
MEETS_SLIDING = "amplitude meets the sliding equilibrium"
# Points at which the return map has a derivative.
SMOOTH = ("", FOLD, DOUBLING, TORUS, MEETS_SLIDING)


class Special(NamedTuple):
    """A special point."""

    name: str
    curve: Curve
    cycle: ComputedCycle
    # The linearised equation that it adds to those of the cycle; None where it adds none.
    row: Float[np.ndarray, " m"] | None = None
    grazing: Grazing | None = None
    multiplier: complex | None = None
    turns: bool = False  # whether the parameter turns back there, as at a fold


class Change(NamedTuple):
    """The change from one sequence of modes to another with fewer phases."""

    phase: int  # the phase of the longer sequence that vanishes, or at which two phases become one
    merges: bool  # whether its neighbours become one phase, inside which a guard then touches zero
    word: str  # the mode or event that is inserted or removed
    where: str  # at which contact, if there are several


# ------------------------------------------------------------------------------------------------------ smooth branches


def between(curve: Curve, a: ComputedCycle, tangent: Float[np.ndarray, " m"], b: ComputedCycle) -> list[Special]:
    """Folds, period doublings and Neimark–Sacker bifurcations between two neighbouring cycles, in order."""
    # How far from the unit circle a multiplier may be found where it passes it.
    on_circle = 1e-6
    # At a fold a multiplier is one, to rounding; at one that is not smooth it is so on neither side.
    near_one = 1e-4
    # A branch at a constant value of the parameter, up to rounding, has no folds: cycles of a linear motion at its stability
    # limit.
    level = 1e-8
    length = float(tangent @ (b.u - a.u))
    found: list[tuple[float, Special]] = []

    def cycle(s: float) -> ComputedCycle | None:
        return {0.0: a, length: b}.get(s) or curve.along(a, tangent, s)

    end = curve.tangent(b, tangent)
    if tangent[-1] * end[-1] < 0 and max(abs(tangent[-1]), abs(end[-1])) > level:

        def turning(at: ComputedCycle) -> float:
            return float(curve.tangent(at, tangent)[-1])

        s, at = root(cycle, turning, 0.0, length)
        if at is not None:
            smooth = np.min(np.abs(multipliers_of(at.images) - 1)) <= near_one
            found.append((s, Special(FOLD, curve, at, turns=True) if smooth else Special(CORNER, curve, at)))
    before, after = multipliers_of(a.images), multipliers_of(b.images)
    for name, test in ((DOUBLING, doubling), (TORUS, pairing)):
        values = test(before), test(after)
        if np.all(np.isfinite(values)) and values[0] * values[1] < 0:
            s, at = root(cycle, lambda at, test=test: test(multipliers_of(at.images)), 0.0, length)
            if at is not None:
                which = critical_multiplier(multipliers_of(at.images), name)
                # Two real multipliers may have the product one, too.
                if which is not None and abs(abs(which) - 1) <= on_circle:
                    found.append((s, Special(name, curve, at, multiplier=which)))
    return [special for _, special in sorted(found, key=lambda pair: pair[0])]


def doubling(values: Complex[np.ndarray, " m"]) -> float:
    """A function that changes its sign where a multiplier passes -1."""
    return float(np.prod(values + 1).real)


def pairing(values: Complex[np.ndarray, " m"]) -> float:
    """A function that changes its sign where a pair of conjugate multipliers passes the unit circle: the determinant of the
    bialternate product of the map's derivative with itself, less the identity. It is smooth where real multipliers become a
    pair.
    """
    one, other = np.triu_indices(len(values), 1)
    products = values[one] * values[other]
    # In factors of size one, so that their product does not overflow.
    return float(np.prod((products - 1) / (1 + np.abs(products))).real) if len(products) else np.nan


def critical_multiplier(values: Complex[np.ndarray, " m"], name: str) -> complex | None:
    """The multiplier that passes the unit circle: at -1, or as one of a pair."""
    # Multipliers this close to the real axis count as real.
    real = 1e-9
    if name == DOUBLING:
        return complex(values[np.argmin(np.abs(values + 1))])
    upper = values[values.imag > real * np.abs(values)]
    return complex(upper[np.argmin(np.abs(np.abs(upper) - 1))]) if len(upper) else None


def root(
    cycle: Callable[[float], ComputedCycle | None], test: Callable[[ComputedCycle], float], low: float, high: float
):
    """The distance along a step at which a test function vanishes, between two others, and the cycle there; None if there is no
    such cycle.
    """
    from scipy.optimize import brentq

    class Lost(Exception):
        pass

    def value(s: float) -> float:
        at = cycle(s)
        found = np.nan if at is None else test(at)
        if not np.isfinite(found):
            raise Lost
        return found

    try:
        s = float(brentq(value, low, high, xtol=1e-13, rtol=1e-13))
    except (Lost, ValueError):  # of one sign at both ends
        return low, None
    return s, cycle(s)


# ------------------------------------------------------------------------------------------------- changes of the modes


def change_between(longer: Sequence[Mode], shorter: Sequence[Mode]) -> Change | None:
    """The change that makes the longer sequence the shorter one; None if it takes more than one change."""
    longer, shorter = tuple(longer), tuple(shorter)
    count = len(longer)

    def alike(a: Mode, b: Mode) -> bool:
        return a[:2] == b[:2]

    if len(shorter) == 1 and shorter[0].ending == AT_SECTION:
        # Without any event the section takes the place of one.
        extra = [i for i in range(count) if not alike(longer[i], shorter[0])]
        return (
            Change(extra[0], True, *_inserted(longer[extra[0]], shorter[0])) if count == 2 and len(extra) == 1 else None
        )
    for i in range(count):
        before, after = longer[i - 1], longer[(i + 1) % count]
        if count - len(shorter) == 2 and alike(before, after) and count > 2:
            kept = [mode for j, mode in enumerate(longer) if j not in (i, (i - 1) % count)]
            if same_modes(tuple(kept), shorter):
                return Change(i, True, *_inserted(longer[i], after))
        if count - len(shorter) == 1:
            kept = longer[:i] + longer[i + 1 :]
            if same_modes(kept, shorter):
                if alike(longer[i], after) and (longer[i].ending != after.ending or longer[i].lands):
                    return Change(i, True, "impact", where(longer[i], longer[i].ending // 2))
                return Change(i, False, *_inserted(longer[i], after))
    return None


def _inserted(mode: Mode, after: Mode) -> tuple[str, str]:
    """What the contact does in a mode that does something else after it, and which contact."""
    changed = [mode.mode_of(contact) != after.mode_of(contact) for contact in range(len(mode.status))]
    contact = changed.index(True) if any(changed) else 0
    words = {Status.STICK: "stick", Status.SLIDE: "slip", Status.DETACH: "lift-off"}
    return words[Status(mode.status[contact])], where(mode, contact)


def grazing_of(curve: Curve, guess: ComputedCycle) -> Grazing | None:
    """The cycle near a guess on which a guard touches zero: the nearest one of those found."""
    # The most minima of guards that are tried, the lowest.
    lowest = 4
    for minimum in sorted(guard_minima(curve, guess), key=lambda minimum: abs(minimum.value))[:lowest]:
        found = grazing_near(curve, guess, minimum)
        if found is not None:
            return found
    return None


def vanishing(curve: Curve, guess: ComputedCycle, phase: int) -> Special | None:
    """The cycle near a guess on which the duration of a phase is zero."""
    u, normal = guess.u.copy(), np.zeros_like(guess.u)
    place_of = len(curve.of_state) + phase
    u[place_of], normal[place_of] = 0.0, 1.0
    cycle = curve.corrected(u, normal)
    return None if cycle is None else Special("", curve, cycle, row=normal)


def name_of(grazing: Grazing | None, change: Change | None, removed: bool) -> str:
    """The name of a change of the modes."""
    what = "" if change is None else f"{change.word} {'removed' if removed else 'inserted'}{change.where}"
    if grazing is None:
        return what or "contact modes change"
    mode = grazing.minimum.mode
    how = touch(mode, grazing.minimum.guard)
    # A contact that is named once need not be named again.
    return f"{how}: {what.removesuffix(where(mode, grazing.minimum.guard // 2))}" if what else how


def without(phases: Phases, change: Change, count_left: int) -> Phases:
    """The phases without the vanishing one, and where it takes another with it, without that: so many."""
    count, i = len(phases.modes), change.phase
    gone = [(i - 1) % count, i] if change.merges and count - count_left > 1 else [i]
    y, h = phases.y.copy(), phases.h.copy()
    if change.merges:
        following = (i + 1) % count
        y[following], h[following] = y[gone[0]], h[following] + h[gone].sum()
    keep = [j for j in range(count) if j not in gone]
    return Phases(tuple(phases.modes[j] for j in keep), y[keep], h[keep])
