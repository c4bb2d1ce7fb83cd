"""Where verdicts along kicks change from sliding to limit cycle: what is proved on either side, and what is not."""

from typing import NamedTuple

import numpy as np

from ..verdicts.verdict import Verdict

# The kick that is none.
NO_KICK = 1.0


class Crossing(NamedTuple):
    """The first change from sliding to limit cycle in each row of verdicts; arrays over rows, NaN where there is none."""

    low: np.ndarray  # largest kick proved to slide below it
    high: np.ndarray  # smallest kick proved to end on a limit cycle above it
    middle: np.ndarray  # between the two; NaN where trajectories in between are undecided
    changes: np.ndarray  # changes between decided neighbours that were seen at all

    @property
    def brackets(self) -> np.ndarray:
        return np.stack([self.low, self.high], axis=-1)


def with_ends(inner: np.ndarray) -> np.ndarray:
    """Verdicts inside brackets (rows, kicks) between those at their ends, which are proved: sliding and limit cycle."""
    ends = np.broadcast_to([[Verdict.SLIDING, Verdict.LIMIT_CYCLE]], (len(inner), 2))
    return np.concatenate([ends[:, :1], inner, ends[:, 1:]], axis=1)


def first_crossings(kicks: np.ndarray, verdicts: np.ndarray) -> Crossing:
    """The first crossing of each row of `verdicts` (rows, kicks) at `kicks`, one row for all or one for each.

    Where a row ends on the limit cycle from its first kick on, that kick is `high` and the middle. An undecided kick of
    `NO_KICK` before it stands for the same: no kick at all is no motion, and only a stable equilibrium is proved to slide.
    """
    kicks = np.broadcast_to(kicks, verdicts.shape)
    low, high, middle = (np.full(len(verdicts), np.nan) for _ in range(3))
    changes = np.zeros(len(verdicts), int)
    for row, (p, verdict) in enumerate(zip(kicks, verdicts, strict=True)):
        decided = np.flatnonzero((verdict == Verdict.SLIDING) | (verdict == Verdict.LIMIT_CYCLE))
        if len(decided) == 0:
            continue
        found = verdict[decided]
        flips = np.flatnonzero(np.diff(found) != 0)
        changes[row] = len(flips)
        upward = flips[found[flips] == Verdict.SLIDING]
        if found[0] == Verdict.LIMIT_CYCLE:
            high[row] = p[decided[0]]
            from_the_start = decided[0] == 0 or (decided[0] == 1 and p[0] == NO_KICK)
            middle[row] = p[0] if from_the_start else np.nan
        elif len(upward):
            below, above = decided[upward[0]], decided[upward[0] + 1]
            low[row], high[row] = p[below], p[above]
            middle[row] = 0.5 * (low[row] + high[row]) if above == below + 1 else np.nan
    return Crossing(low, high, middle, changes)
