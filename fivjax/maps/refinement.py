"""Adaptive maps: a coarse grid that is refined where neighbours differ, and checked at random elsewhere.

Memory and time grow with the length of the boundaries between verdicts, not with the grid: only points that are computed have
results, and only cells near a boundary are looked at. A cell is named by its lowest corner.
"""

import itertools
import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Bool, Float, Int

from ..verdicts.verdict import Verdict
from .plan import Indices
from .results import Verdicts, not_run

# A function that runs trajectories, given by their indices on the fine grid in rising order; it is told what they are for.
Run = Callable[[Indices, str], Verdicts]
# Points that are audited at most: enough to know a rate of one in ten thousand.
MOST_AUDITED = 10**5
# Points that are looked at together: what is made of them takes some hundred bytes each.
AT_A_TIME = 2**20


class Audit(NamedTuple):
    """Points that need not have been computed but were: their number, and how many had another verdict than was assumed."""

    cells: int
    wrong: int


class Levels(NamedTuple):
    """A grid whose intervals are halved again and again."""

    shape: tuple[int, ...]  # of the finest grid
    coarsest: int  # the step of the first level, in intervals of the finest grid
    finest: int  # that of the last level by now

    def before(self, places: Indices, step: int) -> Indices:
        """The corner before each point, or the point itself, on the grid of this step."""
        if step == 1:
            return places
        index = np.unravel_index(places, self.shape)
        return np.ravel_multi_index([one - one % step for one in index], self.shape)

    def corners(self, cells: Indices) -> Int[np.ndarray, "corners cells"]:
        """The corners of cells of the finest level."""
        index = np.unravel_index(cells, self.shape)
        ways = itertools.product(*((0, self.finest) if length > 1 else (0,) for length in self.shape))
        moved = [[one + far for one, far in zip(index, way, strict=True)] for way in ways]
        return np.stack([np.ravel_multi_index(at, self.shape) for at in moved])

    def every(self, step: int, last: int = 0) -> Indices:
        """All points of the grid of this step, but for its `last` intervals; axes of one value have none."""
        along = [np.arange(0, max(length - last, 1), step) for length in self.shape]
        return np.ravel_multi_index(np.ix_(*along), self.shape).ravel()

    def moved(self, places: Indices, step: int, by: Sequence[int], last: int = 0) -> Indices:
        """All points that are so many steps, `by` each of these numbers along each axis, from any of the places: those on the
        grid, but for its `last` intervals.
        """
        index, kept = np.unravel_index(places, self.shape), []
        for way in itertools.product(*(by if length > 1 else (0,) for length in self.shape)):
            at = [one + step * far for one, far in zip(index, way, strict=True)]
            inside = [
                (one >= 0) & (one <= (length - 1 - last if length > 1 else 0))
                for one, length in zip(at, self.shape, strict=True)
            ]
            on_grid = np.logical_and.reduce(inside)
            kept.append(np.ravel_multi_index([one[on_grid] for one in at], self.shape))
        return np.unique(np.concatenate(kept))


class Refined(NamedTuple):
    """A grid of which some points were computed: of a large one few."""

    places: Indices  # the computed points, in rising order
    steps: Int[np.ndarray, " computed"]  # the step of the level for which each was computed; 0 for the audit
    levels: Levels

    def rows(self, places: Int[np.ndarray, "*m"]) -> Int[np.ndarray, "*m"]:
        """The row of the result that each of these points of the grid takes: its own, if it was computed, or that of the corner
        before it which was when its level was filled; -1 for levels that are not there yet.
        """
        levels, rows, at = self.levels, np.full(np.size(places), -1), np.ravel(places)
        there, found = placed(self.places, at)
        rows[there] = found[there]
        left = np.flatnonzero(~there & (levels.before(at, levels.finest) == at))
        # The step of the level to which each belongs, once it is known.
        at, own, step = at[left], np.zeros(len(left), int), levels.finest
        while len(left) and step < levels.coarsest:
            corner = levels.before(at, 2 * step)
            own[(own == 0) & (corner != at)] = step
            step *= 2
            there, found = placed(self.places, corner)
            there &= self.steps[found] > own
            rows[left[there]] = found[there]
            left, at, own = left[~there], corner[~there], own[~there]
        return rows.reshape(np.shape(places))

    def every_row(self) -> Int[np.ndarray, " grid"]:
        """The same of all points."""
        total = math.prod(self.levels.shape)
        rows = np.empty(total, np.int32 if len(self.places) < 2**31 else np.int64)
        for start in range(0, total, AT_A_TIME):
            rows[start : start + AT_A_TIME] = self.rows(np.arange(start, min(start + AT_A_TIME, total)))
        return rows


def placed(computed: Indices, places: Indices) -> tuple[Bool[np.ndarray, " r"], Int[np.ndarray, " r"]]:
    """Which of these points are among the `computed` ones (in rising order), and where there."""
    found = np.minimum(np.searchsorted(computed, places), len(computed) - 1)
    return computed[found] == places, found


def finer_axis(values: Float[np.ndarray, " n"], halvings: int) -> Float[np.ndarray, " m"]:
    """An axis with each of its intervals halved `halvings` times."""
    parts = 2**halvings if len(values) > 1 else 1
    share = np.arange(parts) / parts
    inside = values[:-1, None] + share * np.diff(values)[:, None]
    finer = np.append(inside.ravel(), values[-1])
    if np.any(np.diff(finer) <= 0):
        raise ValueError(
            f"Argument `refine` asks for {parts} parts of each interval, but neighbouring values are closer than so many "
            f"numbers. Give a smaller one."
        )
    return finer


def refine_grid(shape: tuple[int, ...], halvings: int, audit: float, run: Run) -> tuple[Refined, Verdicts, Audit]:
    """Compute some points of a grid of this shape: which, their results, and what an audit says of the others.

    The coarse grid is every `2**halvings`-th value of each axis. In each halving, all points are computed that lie in a cell,
    or next to one, with corners of different verdict or attractor. Other new points take the result of the corner before them.
    Of the points that were never computed, a share `audit` is computed in the end and compared. After an interrupt nothing more
    is computed, and the finer points are not run.
    """
    if max(shape) == 1:
        halvings = 0
    levels = Levels(shape, 2**halvings, 2**halvings)
    places = levels.every(levels.coarsest)
    refined = Refined(places, np.full(len(places), levels.coarsest), levels)
    verdicts = run(places, "coarse grid")
    cells, nothing = levels.every(levels.coarsest, last=1), not_run(0, bool(verdicts.energy))
    for level in range(1, halvings + 1):
        # An interrupt leaves trajectories that were not run.
        if np.any(verdicts.pending()):
            break
        step, differing = 2 ** (halvings - level), cells[_differ(refined, verdicts, cells)]
        ringed = levels.moved(differing, 2 * step, (-1, 0, 1), last=2 * step)
        # Corners of the next cells differ only in these, or on their edges.
        beside = levels.moved(ringed, 2 * step, (-1, 0, 1), last=2 * step)
        cells = levels.moved(beside, step, (0, 1), last=step)
        wanted = levels.moved(ringed, step, (0, 1, 2))
        wanted = wanted[~placed(refined.places, wanted)[0]]
        found = run(wanted, f"halving {level} of {halvings}") if len(wanted) else nothing
        refined = refined._replace(levels=levels._replace(finest=step))
        refined, verdicts = _with_more(refined, verdicts, wanted, step, found)
    share = 0.0 if np.any(verdicts.pending()) else audit
    chosen = _points_to_audit(refined.places, math.prod(shape), share)
    assumed = verdicts.verdict[refined.rows(chosen)]
    found = run(chosen, "audit") if len(chosen) else nothing
    known = ~found.pending()
    checked = Audit(int(known.sum()), int(np.sum(known & (found.verdict != assumed))))
    return *_with_more(refined, verdicts, chosen, 0, found), checked


def _with_more(
    refined: Refined, verdicts: Verdicts, new: Indices, step: int, found: Verdicts
) -> tuple[Refined, Verdicts]:
    """The grid and the results of its points, with new ones that were computed for the level of this step."""
    places = np.concatenate([refined.places, new])
    order = np.argsort(places, kind="stable")
    steps = np.concatenate([refined.steps, np.full(len(new), step)])[order]
    verdicts = jax.tree.map(lambda *parts: np.concatenate(parts)[order], verdicts, found)
    return Refined(places[order], steps, refined.levels), verdicts


def _points_to_audit(computed: Indices, total: int, share: float) -> Indices:
    """A random share of the points that were not `computed`, without a list of them all: `MOST_AUDITED` at most."""
    left = total - len(computed)
    count = min(left, math.ceil(share * left), MOST_AUDITED)
    which = np.sort(np.random.default_rng(0).choice(left, count, replace=False))
    # So many points that were not computed come before each that was.
    return which + np.searchsorted(computed - np.arange(len(computed)), which, side="right")


def _differ(refined: Refined, verdicts: Verdicts, cells: Indices) -> Bool[np.ndarray, " cells"]:
    """Which of these cells of the finest level have corners that differ."""
    # If the amplitudes of neighbours on limit cycles differ by more than this factor, they count as different attractors. A
    # torus and the cycle that it locks to next door do not.
    jump = 1.1
    size = np.where(verdicts.verdict == Verdict.LIMIT_CYCLE, verdicts.amplitude, np.nan)
    found = [np.zeros(0, bool)]
    for start in range(0, len(cells), AT_A_TIME):
        rows = refined.rows(refined.levels.corners(cells[start : start + AT_A_TIME]))
        verdict, of_cycle = verdicts.verdict[rows], size[rows]
        unlike = np.min(verdict, axis=0) != np.max(verdict, axis=0)
        found.append(unlike | (np.fmax.reduce(of_cycle) > jump * np.fmin.reduce(of_cycle)))
    return np.concatenate(found)
