"""Where verdicts over kicks change from sliding to limit cycle: the proved kicks on both sides, and undecided ones between."""

from typing import NamedTuple

import numpy as np

from ..verdicts.verdict import Verdict


class FirstCrossing(NamedTuple):
    """The first change from sliding to limit cycle in each row of verdicts; arrays over rows, NaN where there is none."""

    low: np.ndarray  # largest kick proved to slide below it
    high: np.ndarray  # smallest kick proved to end on a limit cycle above it
    middle: np.ndarray  # between the two; NaN where trajectories in between are undecided
    changes: np.ndarray  # the number of changes between decided neighbours

    @property
    def brackets(self) -> np.ndarray:
        return np.stack([self.low, self.high], axis=-1)


def with_ends(inner: np.ndarray) -> np.ndarray:
    """Verdicts inside brackets (rows, kicks), with the proved ones of their ends added: sliding and limit cycle."""
    ends = np.broadcast_to([[Verdict.SLIDING, Verdict.LIMIT_CYCLE]], (len(inner), 2))
    return np.concatenate([ends[:, :1], inner, ends[:, 1:]], axis=1)


def first_crossings(kicks: np.ndarray, verdicts: np.ndarray, computed: np.ndarray | bool = True) -> FirstCrossing:
    """The first crossing of each row of `verdicts` (rows, kicks) at `kicks` (one row for all, or one for each).

    If already the first kick of a row ends on the limit cycle, that kick is `high` and the middle. Verdicts that were not
    `computed`, but taken from a neighbour, prove nothing: `low` and `high` are others.
    """
    kicks, computed = np.broadcast_to(kicks, verdicts.shape), np.broadcast_to(computed, verdicts.shape)
    low, high, middle = (np.full(len(verdicts), np.nan) for _ in range(3))
    changes = np.zeros(len(verdicts), int)
    for row, (p, verdict, known) in enumerate(zip(kicks, verdicts, computed, strict=True)):
        decided = np.flatnonzero((verdict == Verdict.SLIDING) | (verdict == Verdict.LIMIT_CYCLE))
        if len(decided) == 0:
            continue
        found = verdict[decided]
        flips = np.flatnonzero(np.diff(found) != 0)
        changes[row] = len(flips)
        upward = flips[found[flips] == Verdict.SLIDING]
        if found[0] == Verdict.LIMIT_CYCLE:
            above = decided[0]
            middle[row] = p[0] if above == 0 else np.nan
        elif len(upward):
            below, above = decided[upward[0]], decided[upward[0] + 1]
            slides = np.flatnonzero(known[: below + 1] & (verdict[: below + 1] == Verdict.SLIDING))
            low[row] = p[slides[-1]] if len(slides) else np.nan
            middle[row] = 0.5 * (p[below] + p[above]) if above == below + 1 else np.nan
        else:
            continue
        squeals = above + np.flatnonzero(known[above:] & (verdict[above:] == Verdict.LIMIT_CYCLE))
        high[row] = p[squeals[0]] if len(squeals) else np.nan
    return FirstCrossing(low, high, middle, changes)
