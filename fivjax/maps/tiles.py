"""Batches of lanes cut into tiles of one size, so that a scene is compiled once for any number of lanes.

A tile is a number of rows of lanes side by side. The lanes of a row belong to one *group* and share what is worked out
once for it; tiles run in threads, one per core.
"""

import os
from concurrent.futures import ThreadPoolExecutor

import jax
import numpy as np

from .packed import Packed

# Lanes that a tile holds: few enough that they stay in a core's cache, enough to outweigh the start of each kernel.
TILE_ON_CPU = 128
LARGE_TILE_ON_CPU = 512
TILE_ELSEWHERE = 65536
# Lanes from which on it pays to compile the larger tile.
MANY = 8192


def workers() -> int:
    # A tile is too small for XLA to split among cores; tiles side by side use them all.
    if jax.default_backend() != "cpu":
        return 1
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else (os.cpu_count() or 1)


def in_tiles(
    function,
    shared: Packed,
    group: np.ndarray,
    lanes: Packed,
    width: int,
    pool: ThreadPoolExecutor,
    in_place: bool = False,
) -> Packed:
    """`function(shared, lanes)` of all lanes, in tiles of one size, so that a scene is compiled once for any map.

    `group` says which row of `shared` is each lane's. In a tile, `shared` has an axis of rows, `lanes` one more. With
    `in_place` the results, of the same form, take the place of `lanes`.
    """
    slots, filled = _side_by_side(group, width)
    size = TILE_ELSEWHERE
    if jax.default_backend() == "cpu":
        size = LARGE_TILE_ON_CPU if len(group) >= MANY else TILE_ON_CPU
    rows = max(1, size // width)

    def run(start: int, numbers: np.ndarray | None) -> Packed:
        # The last tile is filled up with copies of its first row.
        chosen = np.arange(start, start + rows)
        real = filled[chosen % len(slots)] & (chosen < len(slots))[:, None]
        place = slots[np.where(chosen < len(slots), chosen, start)]
        with jax.enable_x64(True):  # the setting is a thread's own
            own = Packed(shared.numbers[group[place[:, 0]]], shared.form)
            result = function(own, Packed(lanes.numbers[place], lanes.form))
            part = np.asarray(result.numbers)
        numbers = np.empty((len(group), part.shape[-1])) if numbers is None else numbers
        # Into place at once, so that parts are not kept beside the whole.
        numbers[place[real]] = part[real]
        return Packed(numbers, result.form)

    results = lanes if in_place else run(0, None)
    for _ in pool.map(lambda start: run(start, results.numbers), range(0 if in_place else rows, len(slots), rows)):
        pass
    return results


def _side_by_side(group: np.ndarray, width: int) -> tuple[np.ndarray, np.ndarray]:
    """Rows of `width` lanes of one group each, as places in `group`; what is left over repeats the row's first lane.

    Second, which of the places are not such repetitions.
    """
    order = np.argsort(group, kind="stable")
    _, first, count = np.unique(group[order], return_index=True, return_counts=True)
    rows = -(-count // width)
    before = np.cumsum(rows) - rows
    start = np.repeat(first, rows) + width * (np.arange(rows.sum()) - np.repeat(before, rows))
    places = start[:, None] + np.arange(width)
    filled = places < np.repeat(first + count, rows)[:, None]
    return order[np.where(filled, places, start[:, None])], filled
