"""Adaptive maps: a coarse grid that is refined where neighbours differ, and checked at random elsewhere."""

import functools
import math
from collections.abc import Callable
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Bool, Float, Int

from ..verdicts.verdict import Verdict
from .plan import Indices
from .results import Verdicts, not_run

# A function that runs trajectories, given by their indices on the fine grid in rising order; it is told what they are for.
Run = Callable[[Indices, str], Verdicts]


class Audit(NamedTuple):
    """Points that need not have been computed but were: their number, and how many had another verdict than was assumed."""

    cells: int
    wrong: int


class Refined(NamedTuple):
    """A grid of which some cells were computed: of a large one few, so that there is no result for each cell."""

    verdicts: Verdicts  # of the computed cells; behind these, a trajectory that was not run
    places: Indices  # the computed cells
    row: Int[np.ndarray, " cells"]  # the result that each cell takes
    audit: Audit


def finer_axis(values: Float[np.ndarray, " n"], halvings: int) -> Float[np.ndarray, " m"]:
    """An axis with each of its intervals halved `halvings` times."""
    parts = 2**halvings if len(values) > 1 else 1
    share = np.arange(parts) / parts
    inside = values[:-1, None] + share * np.diff(values)[:, None]
    return np.append(inside.ravel(), values[-1])


def refine_grid(shape: tuple[int, ...], halvings: int, audit: float, run: Run) -> Refined:
    """Compute some points of a grid of this shape.

    The coarse grid is every `2**halvings`-th value of each axis. In each halving, those new points are computed that lie in a
    cell, or next to one, with corners of different verdict or attractor. Other points take the result of the corner before
    them; a computed point takes its own. Of the points that were never computed, a share `audit` is computed in the end and
    compared. After an interrupt nothing more is computed, and the finer points are not run.
    """
    # Arrays of a map of many millions of points take hundreds of megabytes each. No result is the last one.
    row = np.full(math.prod(shape), -1, np.int32 if math.prod(shape) < 2**31 else np.int64)
    places = _every(2**halvings, shape, row.dtype).ravel()
    verdicts = run(places, "coarse grid")
    row[places] = np.arange(len(places))

    def compute(which: Indices, what: str) -> np.ndarray:
        """Compute these points; the rows of their results."""
        nonlocal places, verdicts
        rows = np.arange(len(places), len(places) + len(which))
        if which.size:
            verdicts = jax.tree.map(lambda *parts: np.concatenate(parts), verdicts, run(which, what))
            places = np.concatenate([places, which])
        return rows

    for level in range(1, halvings + 1):
        # An interrupt leaves trajectories that were not run.
        if not np.any(verdicts.pending()):
            wanted = _halve(shape, 2 ** (halvings - level), verdicts, row)
            row[wanted] = compute(wanted, f"halving {level} of {halvings}")
    chosen = _points_to_audit(np.sort(places), len(row), 0.0 if np.any(verdicts.pending()) else audit)
    rows, assumed = compute(chosen, "audit"), row[chosen]
    row[chosen] = rows
    known = ~verdicts.pending(rows)
    wrong = known & (verdicts.verdict[rows] != verdicts.verdict[assumed])
    checked = Audit(int(known.sum()), int(wrong.sum()))
    nothing = not_run(1, bool(verdicts.energy))
    return Refined(jax.tree.map(lambda *parts: np.concatenate(parts), verdicts, nothing), places, row, checked)


def _every(step: int, shape: tuple[int, ...], kind: np.dtype) -> Int[np.ndarray, "*grid"]:
    """The indices of every so many-th point along each axis of a grid of this shape."""
    along = (
        math.prod(shape[axis + 1 :]) * np.arange(0, length, min(step, length), dtype=kind)
        for axis, length in enumerate(shape)
    )
    return functools.reduce(np.add, np.ix_(*along))


def _halve(shape: tuple[int, ...], step: int, verdicts: Verdicts, row: Int[np.ndarray, " cells"]) -> Indices:
    """The points to be computed of a grid whose intervals are halved to this step; new points that need not be computed get
    the `row` of the corner before them.
    """
    new, old = _every(step, shape, row.dtype), tuple(slice(None, None, 2) for _ in shape)
    corners = new[old]
    wanted = _near_differences(_differ(verdicts, row[corners]), new.shape)
    rest = ~wanted
    wanted[old] = rest[old] = False
    before = corners[np.ix_(*(np.arange(length) // 2 for length in new.shape))]
    row[new[rest]] = row[before[rest]]
    return new[wanted]


def _points_to_audit(computed: Indices, total: int, share: float) -> Indices:
    """A random share of the points that were not `computed`, without a list of them all."""
    left = total - len(computed)
    count = min(left, math.ceil(share * left))
    which = np.sort(np.random.default_rng(0).choice(left, count, replace=False))
    # So many points that were not computed come before each that was.
    return which + np.searchsorted(computed - np.arange(len(computed)), which, side="right")


def _differ(verdicts: Verdicts, corners: Int[np.ndarray, "*grid"]) -> Bool[np.ndarray, "*cells"]:
    """Which cells have corners that differ."""
    verdict = verdicts.verdict[corners]
    size = np.where(verdict == Verdict.LIMIT_CYCLE, verdicts.amplitude[corners], np.nan)
    low, high = _over_corners(np.fmin, size), _over_corners(np.fmax, size)
    # If the amplitudes of neighbours on limit cycles differ by more than this factor, they count as different attractors. A
    # torus and the cycle that it locks to next door do not.
    jump = 1.1
    return (_over_corners(np.minimum, verdict) != _over_corners(np.maximum, verdict)) | (high > jump * low)


def _over_corners(combine, values: np.ndarray) -> np.ndarray:
    """The values at the corners of each cell combined, along each axis that has more than one value."""
    for axis, length in enumerate(values.shape):
        if length > 1:
            first, second = (np.take(values, np.arange(k, length - 1 + k), axis=axis) for k in (0, 1))
            values = combine(first, second)
    return values


def _near_differences(differ: Bool[np.ndarray, "*cells"], shape: tuple[int, ...]) -> Bool[np.ndarray, "*grid"]:
    """The points of the halved grid that lie in a cell with differing corners, or in a neighbouring cell."""
    for axis, length in enumerate(shape):
        if length == 1:
            continue
        # Neighbouring cells, too: a boundary between corners may leave the cell.
        aside = np.zeros_like(np.take(differ, [0], axis=axis))
        padded = np.concatenate([aside, aside, differ, aside, aside], axis=axis)
        count = differ.shape[axis]
        ringed = np.zeros_like(np.concatenate([differ, aside, aside], axis=axis))
        for k in range(3):
            ringed |= np.take(padded, np.arange(k, k + count + 2), axis=axis)
        # Point 2i is the corner between cells i - 1 and i, point 2i + 1 the middle of cell i.
        corner = np.take(ringed, np.arange(count + 1), axis=axis) | np.take(ringed, np.arange(1, count + 2), axis=axis)
        middle = np.take(ringed, np.arange(1, count + 1), axis=axis)
        halved = np.zeros((*differ.shape[:axis], length, *differ.shape[axis + 1 :]), bool)
        cut = [slice(None)] * differ.ndim
        for part, start in ((corner, 0), (middle, 1)):
            cut[axis] = slice(start, None, 2)
            halved[tuple(cut)] = part
        differ = halved
    return differ
