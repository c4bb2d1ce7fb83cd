"""The search for the best fit: from first guesses far from the answer to the minimum, over growing windows of the recordings.

1. Guesses are improved by coarse residuals, which do not depend on phases.
2. Unknown time offsets are scanned (`time_offsets`).
3. The waveform is fitted over growing windows, from the best few guesses.
4. The best fit is tried again some periods earlier and later.

Every fit leaves out what is next to a jump of the motion that it starts from; where it ends with others, it goes on without
those.

If all recordings are of limit cycles, guesses that have a limit cycle are first brought to the measured frequency. Then the
harmonics are fitted roughly and then the waveform, from one guess after the other until the residuals are noise.
"""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from ..io.recordings import Recording
from .cycle_closing import growth_of_disturbances
from .goodness_of_fit import residual_tests
from .least_squares import Minimum, minimise
from .problem import About, Problem
from .time_offsets import KEPT_WITH_OFFSETS, MOST_ROUNDS, best_offsets, periods_aside
from .waveform_misfit import KickMisfit

# Number of guesses that go on from the coarse residuals to the waveform, beside the scene's own parameters.
KEPT = 4
# Guesses this close in every parameter (relative) count as the same.
ALIKE, ALIKE_CYCLES = 0.01, 0.05
# A guess that no scene takes is moved half the way to the scene's own parameters, so many times at most.
MOST_HALVINGS = 8
WINDOWS = (0.15, 0.4, 1.0)
# Distances from the minimum at which a fit stops, in standard deviations of identifiable combinations. Rounding of nearly
# parallel modes leaves a thousandth.
EARLY_TOLERANCE, FINAL_TOLERANCE = 0.1, 1e-2
MOST_EVALUATIONS = 60
# The least share of a recording that a fit compares: where more is next to jumps, the rate is too low for the contact's events.
LEAST_KEPT = 0.5


class Candidate(NamedTuple):
    """A point from which the search continues, and its data."""

    x: Float[np.ndarray, " j"]
    about: About | None


class FitSearch:
    """The search of one fit; `best` is its end."""

    best: Minimum

    def __init__(self, problem: Problem, guesses: np.ndarray, recordings: tuple[Recording, ...]):
        self.problem, self.recordings = problem, recordings
        self.guesses = [self._within(guess, guesses[0]) for guess in guesses]
        self.cycles_only = len(problem.cycles) == len(problem.misfits)
        self.count = 2 if self.cycles_only else len(WINDOWS) + 3
        self.evaluations = 0

    def run(self) -> Iterator[str]:
        """Run the search; yields the name of each stage before it begins."""
        yield "guesses"
        if self.cycles_only:
            candidates = self._at_measured_frequency()
            yield "harmonics"
            self._fitted_in_turn(candidates)
            return
        candidates = self._improved()
        yield "time offsets"
        candidates = self._with_offsets(candidates)
        for share in WINDOWS:
            yield f"waveform, {100 * share:.0f} %"
            candidates = self._fitted(candidates, share)
        yield "whole periods"
        self._other_periods()

    def _within(self, guess: np.ndarray, own: np.ndarray) -> np.ndarray:
        """The guess, or what lies half, a quarter, … as far from the scene's own parameters, until there is such a scene."""
        for _ in range(MOST_HALVINGS):
            if self.problem.is_scene(guess):
                return guess
            guess = 0.5 * (guess + own)
        return own

    def _at_measured_frequency(self) -> list[Candidate]:
        """The guesses closest to the measured limit cycles, brought to their frequency by the smallest change of parameters.

        A scene far from the answer may have no limit cycle, and no derivative leads to one.
        """
        # The most guesses of a limit cycle that are fitted, until one explains the recording; and steps to bring one to the
        # frequency.
        most_in_turn, frequency_steps = 16, 2
        found: list[tuple[float, Candidate]] = []
        for guess in map(self.problem.first, self.guesses):
            x, about = guess, None
            for _ in range(1 + frequency_steps):
                if not self.problem.is_scene(x):
                    break
                at = self.problem.compared(x, guess, WINDOWS[0], about)
                self.evaluations += 1
                if not np.isfinite(at.cost):
                    break
                found.append((at.cost, Candidate(x, at.about)))
                rows = self.problem.frequency_rows
                step = -np.linalg.lstsq(at.jacobian[rows], at.residual[rows], rcond=1e-2)[0]
                x, about = x + np.clip(step, -0.5, 0.5), at.about
        found.sort(key=lambda one: one[0])
        kept = _distinct([one.x for _, one in found], ALIKE_CYCLES)[:most_in_turn]
        # If no guess has a limit cycle, the fit ends with the scene's own parameters and an outcome that says so.
        return [one for _, one in found if any(one.x is x for x in kept)] or [
            Candidate(self.problem.first(self.guesses[0]), None)
        ]

    def _fitted_in_turn(self, candidates: list[Candidate]) -> None:
        """Fit from one candidate after the other until the residuals are noise."""
        for k, candidate in enumerate(candidates):
            rough = self.fit_from(candidate, WINDOWS[0], EARLY_TOLERANCE)
            found = self.fit_from(Candidate(rough.x, rough.at.about))
            if k == 0 or self.cost(found) < self.cost(self.best):
                self.best = found
            squares, freedom = found.at.cost, max(self.compared_numbers(found) - found.x.size, 1)
            if found.arrived and not residual_tests(squares, freedom, [], stated=False).larger:
                break

    def _improved(self) -> list[Candidate]:
        found = []
        for guess in self.guesses:
            found.append(
                minimise(
                    lambda u, _, u0=guess: self.problem.coarse(u, u0),
                    guess,
                    None,
                    EARLY_TOLERANCE,
                    MOST_EVALUATIONS,
                    self.problem.is_scene,
                )
            )
            self.evaluations += found[-1].evaluations
        best_first = [one.x for one in sorted(found, key=lambda one: one.at.cost)]
        # Of an aliased recording coarse residuals say little. So the scene's own parameters go on, whatever others promise.
        kept = _distinct([*best_first, *self.guesses])[:KEPT]
        return [Candidate(self.problem.first(x), None) for x in _distinct([*kept, found[0].x, self.guesses[0]])]

    def _with_offsets(self, candidates: list[Candidate]) -> list[Candidate]:
        """The candidates with the time offsets at which each agrees best, over the whole recording or its beginning."""
        moved = self.moved
        if not moved:
            return candidates
        chosen = [one.x for one in candidates[: KEPT_WITH_OFFSETS // len(WINDOWS)]]
        points = [x[: self.problem.size] for x in chosen]
        offsets = {k: best_offsets(self.problem, k, self.recordings[k].offset, points, WINDOWS) for k in moved}
        found = []
        for i, x in enumerate(chosen):
            for j in range(len(WINDOWS)):
                begin = x.copy()
                for k in moved:
                    begin[self.problem.places[k]] = offsets[k][i, j]
                found.append(Candidate(begin, None))
        return found

    def _fitted(self, candidates: list[Candidate], share: float) -> list[Candidate]:
        """Fits from all candidates, the best first; `best` is that of the last call."""
        # A candidate is given up after a window if its sum of squares, relative to the best, is larger than this.
        hopelessly_worse = 25.0
        tolerance = EARLY_TOLERANCE if share < WINDOWS[-1] else FINAL_TOLERANCE
        found = [self.fit_from(one, share, tolerance) for one in candidates]
        found.sort(key=self.cost)
        self.best = found[0]
        good = [one for one in found if self.cost(one) <= hopelessly_worse * self.cost(self.best)]
        kept = _distinct([one.x for one in good])
        return [Candidate(one.x, one.at.about) for one in good if any(one.x is x for x in kept)]

    def _other_periods(self) -> None:
        for k in self.moved:
            place = self.problem.places[k].start
            for _ in range(MOST_ROUNDS):
                before = self.best
                tried, half = periods_aside(self.problem, k, self.recordings[k].offset, before.x)
                self.best = min([before, *(self.fit_from(Candidate(x, None)) for x in tried)], key=self.cost)
                if abs(self.best.x[place] - before.x[place]) <= half:
                    break

    @property
    def moved(self) -> list[int]:
        """The recordings whose time offset is unknown."""
        return [
            k for k, m in enumerate(self.problem.misfits) if isinstance(m, KickMisfit) and m.unknowns and not m.free
        ]

    def fit_from(self, candidate: Candidate, share: float = WINDOWS[-1], tolerance: float = FINAL_TOLERANCE) -> Minimum:
        """The minimum that one candidate leads to, without what is next to a jump there."""
        x0, about = candidate
        at = self.problem.compared(x0, x0, share, about)
        self.evaluations += 1
        found = Minimum(x0, at, False, 1)
        for _ in range(MOST_ROUNDS):
            left_out = found.at.about.touched
            problem = self.problem.without(left_out)
            found = minimise(
                lambda x, about, problem=problem: problem.compared(x, x0, share, about),
                found.x,
                found.at.about,
                tolerance,
                MOST_EVALUATIONS,
                problem.is_scene,
            )
            self.evaluations += found.evaluations
            found, now = found._replace(left_out=left_out), found.at.about.touched
            if not any(np.any(np.asarray(new) & ~np.asarray(old)) for new, old in zip(now, left_out, strict=True)):
                break
        return found

    def compared_numbers(self, found: Minimum) -> float:
        """The number of measured numbers that a fit compared."""
        return self.problem.without(found.left_out).numbers

    def cost(self, found: Minimum) -> float:
        """The sum of squares of a fit, as if nothing had been left out: with half of everything left out, none is good."""
        share = self.compared_numbers(found) / self.problem.numbers
        return found.at.cost / share if share > LEAST_KEPT else np.inf

    @property
    def growth(self) -> float:
        """Size of the largest multiplier of the cycles; 0 without cycles."""
        where = self.problem.scene.structure.size + self.problem.tangential
        systems = self.best.at.about.systems
        return max((growth_of_disturbances(np.asarray(system), where) for system in systems), default=0.0)


def _distinct(points: list[np.ndarray], alike: float = ALIKE) -> list[np.ndarray]:
    """The points without those that repeat an earlier one."""
    kept = []
    for point in points:
        if not any(np.allclose(point, other, rtol=0, atol=alike) for other in kept):
            kept.append(point)
    return kept
