"""The search for the best fit: from first guesses far off to the minimum, through windows that grow.

1. Guesses are improved by coarse residuals, which know no phase; those of limit cycles are screened.
2. Unknown time offsets are scanned (`time_offsets`).
3. The waveform is compared over windows that grow, and harmonics first roughly, then to the noise, from the best few.
4. The best one is tried again some periods earlier and later.
"""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from ..io.recordings import Recording
from .cycle_closing import growth_of_disturbances
from .least_squares import Minimum, minimise
from .problem import About, Problem
from .time_offsets import KEPT_WITH_OFFSETS, MOST_ROUNDS, best_offsets, periods_aside

# Guesses that go on from the coarse residuals to the waveform.
KEPT = 4
WINDOWS = (0.15, 0.4, 1.0)
# Where a fit stops: what is left along what the data tell, in standard deviations. Rounding of nearly parallel modes leaves
# a thousandth.
EARLY_TOLERANCE, FINAL_TOLERANCE = 0.1, 1e-2
MOST_EVALUATIONS = 60
# Sums of squares, relative to the best, above which a candidate is given up after a window.
HOPELESSLY_WORSE = 25.0


class Candidate(NamedTuple):
    """A point that the search goes on from, and what is known about it."""

    x: Float[np.ndarray, " j"]
    about: About | None


class Search:
    """One fit's search; `best` is where it ended."""

    best: Minimum

    def __init__(self, problem: Problem, guesses: np.ndarray, recordings: tuple[Recording, ...]):
        self.problem, self.guesses, self.recordings = problem, guesses, recordings
        # Limit cycles have no window that grows: their harmonics are compared first roughly, then to the noise.
        self.cycles_only = len(problem.cycles) == len(problem.misfits)
        self.windows = (WINDOWS[0], WINDOWS[-1]) if self.cycles_only else WINDOWS
        self.count = len(self.windows) + 3
        self.evaluations = 0

    def run(self) -> Iterator[str]:
        """Yields the name of each stage before it begins."""
        yield "guesses"
        candidates = self._screened() if self.cycles_only else self._improved()
        yield "time offsets"
        candidates = self._with_offsets(candidates)
        for share in self.windows:
            yield f"waveform, {100 * share:.0f} %"
            candidates = self._fitted(candidates, share)
        yield "whole periods"
        self._other_periods()

    def _screened(self) -> list[Candidate]:
        """The guesses that come closest to the limit cycles. Far off, a scene may have none, and no derivative leads there."""
        found = [self.problem.compared(x, x, self.windows[0], None) for x in self.guesses]
        order = np.argsort([at.cost for at in found], kind="stable")[:KEPT]
        return [Candidate(self.guesses[k], found[k].about if np.isfinite(found[k].cost) else None) for k in order]

    def _improved(self) -> list[Candidate]:
        found = []
        for guess in self.guesses:
            found.append(
                minimise(
                    lambda u, _, u0=guess: self.problem.coarse(u, u0), guess, None, EARLY_TOLERANCE, MOST_EVALUATIONS
                )
            )
            self.evaluations += found[-1].evaluations
        best_first = [one.x for one in sorted(found, key=lambda one: one.at.cost)]
        return [Candidate(x, None) for x in _distinct([*best_first, *self.guesses])[:KEPT]]

    def _with_offsets(self, candidates: list[Candidate]) -> list[Candidate]:
        """The candidates with the time offsets at which each agrees best over all of the recording, or its beginning."""
        moved = [k for k, one in enumerate(self.problem.moved) if one]
        if not moved:
            return candidates
        chosen = [one.x for one in candidates[: KEPT_WITH_OFFSETS // len(WINDOWS)]]
        offsets = [best_offsets(self.problem, k, self.recordings[k].offset, chosen, WINDOWS) for k in moved]
        # (candidate, window, recording)
        every = np.stack(offsets, axis=-1)
        return [
            Candidate(np.concatenate([x, every[i, j]]), None) for i, x in enumerate(chosen) for j in range(len(WINDOWS))
        ]

    def _fitted(self, candidates: list[Candidate], share: float) -> list[Candidate]:
        """Fits from all candidates, the best first; `best` is that of the last call."""
        tolerance = EARLY_TOLERANCE if share < WINDOWS[-1] else FINAL_TOLERANCE
        found = [self.fit_from(one, share, tolerance) for one in candidates]
        found.sort(key=lambda one: one.at.cost)
        self.best = found[0]
        good = [one for one in found if one.at.cost <= HOPELESSLY_WORSE * self.best.at.cost]
        kept = _distinct([one.x for one in good])
        return [Candidate(one.x, one.at.about) for one in good if any(one.x is x for x in kept)]

    def _other_periods(self) -> None:
        for k in [k for k, one in enumerate(self.problem.moved) if one]:
            place = self.problem.size + int(np.sum(self.problem.moved[:k]))
            for _ in range(MOST_ROUNDS):
                before = self.best
                tried, half = periods_aside(self.problem, k, self.recordings[k].offset, before.x)
                self.best = min([before, *(self.fit_from(Candidate(x, None)) for x in tried)], key=lambda m: m.at.cost)
                if abs(self.best.x[place] - before.x[place]) <= half:
                    break

    def fit_from(self, candidate: Candidate, share: float = WINDOWS[-1], tolerance: float = FINAL_TOLERANCE) -> Minimum:
        """The minimum that one candidate leads to."""
        x0 = candidate.x
        found = minimise(
            lambda x, about: self.problem.compared(x, x0, share, about), x0, candidate.about, tolerance, MOST_EVALUATIONS
        )
        self.evaluations += found.evaluations
        return found

    @property
    def growth(self) -> float:
        """Largest multiplier of the cycles, in a period; 0 without any."""
        structure = self.problem.scene.structure
        where = structure.size + structure.tangential
        systems = self.best.at.about.systems
        return max((growth_of_disturbances(np.asarray(system), where) for system in systems), default=0.0)


def _distinct(points: list[np.ndarray]) -> list[np.ndarray]:
    """Without those that repeat one before them."""
    kept = []
    for point in points:
        if not any(np.allclose(point, other, atol=1e-2) for other in kept):
            kept.append(point)
    return kept
