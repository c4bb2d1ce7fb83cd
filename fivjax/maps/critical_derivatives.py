"""Critical kicks to rounding, with their kind and their derivatives, proved on either side anew."""

import numpy as np

from ..cycles.stable_manifold import Critical, critical_kick
from ..model.scene import Scene
from ..verdicts.verdict import Verdict
from .crossing import Crossing

KINDS = ("none", "manifold", "grazing")
# Relative distance from a critical kick at which either side is proved.
BESIDE = 1e-9

NO_CHANGE = "no change from sliding to a limit cycle lies in the range"
NO_SADDLE = (
    "the motion after the critical kick passes no saddle cycle that closes, or the kind of the border changes here"
)
NOT_PROVED = "the verdicts on either side contradict what Newton's method found: the kind of the border changes here"


def differentiable(scene: Scene) -> tuple[str, ...]:
    """Names of the parameters that a critical kick is differentiated in: all numbers but p itself."""
    return tuple(name for name, value in scene.parameters.items() if np.ndim(value) == 0 and name != "p")


def with_derivatives(
    scene: Scene, verdicts, columns: dict[str, np.ndarray], found: Crossing
) -> tuple[Crossing, dict[str, np.ndarray]]:
    """The crossings by Newton's method where it finds them, and kind, derivatives and reasons for each row.

    `verdicts` are those of rows at their own values of p, as a function of columns, kicks and a label.
    """
    names, rows = differentiable(scene), len(found.middle)
    kind, why = np.full(rows, KINDS[0], dtype="<U8"), np.full(rows, "", dtype=object)
    slopes, exact = np.full((rows, len(names)), np.nan), np.full(rows, np.nan)
    trajectories = np.zeros(rows, int)
    for row in range(rows):
        low, high = found.low[row], found.high[row]
        if not np.isfinite([low, high]).all():
            why[row] = NO_CHANGE
            continue
        here = scene.replace(**{name: float(column[row]) for name, column in columns.items()})
        critical: Critical | None = critical_kick(here, (low, high), names)
        if critical is None:
            why[row] = NO_SADDLE
            continue
        exact[row], trajectories[row] = critical.p, critical.trajectories
        slopes[row] = [critical.d_p[name] for name in names]
    known = np.flatnonzero(np.isfinite(exact))
    middle, low, high = found.middle.copy(), found.low.copy(), found.high.copy()
    if len(known):
        beside = exact[known, None] * (1 + BESIDE * np.array([-1.0, 1.0]))
        chosen = {name: column[known] for name, column in columns.items()}
        proved = np.all(verdicts(chosen, beside, "both sides") == [Verdict.SLIDING, Verdict.LIMIT_CYCLE], axis=1)
        held = known[proved]
        kind[held], middle[held] = KINDS[1], exact[held]
        low[held], high[held] = beside[proved, 0], beside[proved, 1]
        why[known[~proved]], slopes[known[~proved]] = NOT_PROVED, np.nan
    answers = {"kind": kind, "d_p_crit": slopes, "why_none": why.astype(str), "newton_trajectories": trajectories}
    return found._replace(middle=middle, low=low, high=high), answers
