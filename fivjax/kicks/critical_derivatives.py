"""Critical kicks to rounding, with kind and derivatives, and with trajectories on both sides that prove them."""

from collections.abc import Callable

import numpy as np
from jaxtyping import Int

from ..maps.crossing import FirstCrossing
from ..model.scene import Scene
from .narrowing import AT_ENDS, Kicked
from .stable_manifold import Critical, critical_kick
from .touching import GrazingKick, grazing_kick

Narrowed = Callable[[Int[np.ndarray, " r"], FirstCrossing, float], FirstCrossing]

KINDS = ("none", "manifold", "grazing")
# Relative distance of the two proving trajectories from a critical kick; and the width of the narrowest brackets.
BESIDE, CLOSEST = 1e-9, 1e-10

NO_CHANGE = "no change from sliding to a limit cycle lies in the range"
NO_SADDLE = (
    "the motion after the critical kick passes no saddle cycle that closes and touches no other contact mode, or the kind of "
    "the border changes here"
)
NOT_PROVED = "the verdicts on either side contradict what Newton's method found: the kind of the border changes here"


def differentiable(scene: Scene) -> tuple[str, ...]:
    """Names of the parameters by which a critical kick is differentiated: all scalar ones but p itself."""
    return tuple(name for name, value in scene.parameters.items() if np.ndim(value) == 0 and name != "p")


def with_derivatives(
    kicked: Kicked, found: FirstCrossing, narrowed: Narrowed
) -> tuple[FirstCrossing, dict[str, np.ndarray]]:
    """The crossings, by Newton's method where it finds them; and kind, derivatives and reasons for each row.

    `narrowed(rows, found, width)` gives the crossings of those rows in narrower brackets, for where Newton's method does not
    find them from these.
    """
    names, rows = differentiable(kicked.scene), len(found.middle)
    kind, why = np.full(rows, KINDS[0], dtype="<U8"), np.full(rows, NO_CHANGE, dtype=object)
    slopes, trajectories = np.full((rows, len(names)), np.nan), np.zeros(rows, int)
    middle, low, high = found.middle.copy(), found.low.copy(), found.high.copy()
    left = np.flatnonzero(np.isfinite(found.low) & np.isfinite(found.high))
    why[left] = NO_SADDLE
    # By each method, in brackets of this width; without one, in those of the attempt before. A motion that passes no saddle, or
    # one that is not on the boundary, may just touch another contact mode. On the way to a saddle a motion may have other
    # modes than the saddle has, for a hundred crossings that part neighbours; only the closest ones come on together.
    attempts = (
        (KINDS[1], critical_kick, None),
        (KINDS[1], critical_kick, np.inf),
        (KINDS[2], grazing_kick, None),
        (KINDS[1], critical_kick, CLOSEST),
    )
    for attempt, (name, method, width) in enumerate(attempts):
        if width is not None and len(left):
            finer = narrowed(left, found._replace(middle=middle, low=low, high=high), width)
            # Where undecided kicks keep a bracket from becoming the narrowest, the one before stands, and has been tried.
            narrow = np.isfinite(finer.middle) | (width != CLOSEST)
            for whole, part in ((middle, finer.middle), (low, finer.low), (high, finer.high)):
                whole[left[narrow]] = part[narrow]
            left = left[narrow & np.isfinite(finer.low) & np.isfinite(finer.high)]
            if width != CLOSEST:
                why[left] = NO_SADDLE
        critical: dict[int, Critical | GrazingKick] = {}
        for row in left:
            here = kicked.scene.replace(**{key: float(column[row]) for key, column in kicked.columns.items()})
            answer = method(here, (low[row], high[row]), names)
            # In a wide bracket another crossing may be near, which is not the first.
            if answer is not None and (attempt > 0 or low[row] <= answer.p <= high[row]):
                critical[int(row)] = answer
        known = np.array(list(critical), int)
        if not len(known):
            continue
        exact = np.array([critical[row].p for row in known])
        beside = exact[:, None] * (1 + BESIDE * np.array([-1.0, 1.0]))
        proved = np.all(kicked.only(known).verdicts(beside, "both sides") == AT_ENDS, axis=1)
        why[known[~proved]] = NOT_PROVED
        held = known[proved]
        kind[held], why[held], middle[held] = name, "", exact[proved]
        low[held], high[held] = beside[proved, 0], beside[proved, 1]
        for row in held:
            trajectories[row] = critical[row].trajectories
            slopes[row] = [critical[row].d_p[key] for key in names]
        left = np.setdiff1d(left, held)
    answers = {"kind": kind, "d_p_crit": slopes, "why_none": why.astype(str), "newton_trajectories": trajectories}
    return found._replace(middle=middle, low=low, high=high), answers
