"""Batches of trajectories cut into blocks of one size, so that a scene is compiled once for any number of trajectories.

A block consists of rows. The trajectories of a row belong to one *group* and share the data worked out for it. Blocks run in
threads, one per core or device.
"""

import collections
import os
from collections.abc import Callable, Iterable
from concurrent.futures import Executor, ThreadPoolExecutor, wait

import jax
import numpy as np

from .flattened import Flattened
from .precision import own_settings

# Trajectories in a block: few enough to stay in a core's cache, and enough to outweigh the start of each kernel.
BLOCK_ON_CPU = 64
LARGE_BLOCK_ON_CPU = 512
# With several contacts each trajectory is more work, and a block padded with copies costs as much as a full one.
BLOCK_OF_SEVERAL = 16
BLOCK_ELSEWHERE = 65536
# The number of trajectories from which it pays to compile the larger block.
MANY = 8192


def workers() -> int:
    # XLA does not split such a small block among cores, so there is a block for each core; elsewhere one for each device.
    if jax.default_backend() != "cpu":
        return len(jax.local_devices())
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else (os.cpu_count() or 1)


def in_threads(run: Callable, parts: Iterable, pool: Executor, threads: int) -> None:
    """`run(part)` for all parts, in so many threads: this one begins at once, and others of the pool take what is left once
    they have woken.
    """
    left = iter(list(parts))

    def work() -> None:
        for part in left:
            run(part)

    others = [pool.submit(work) for _ in range(threads - 1)]
    try:
        work()
    finally:
        # Where this thread fails or is interrupted, too, the others end before the arrays that they write to are gone. One that
        # has not begun by now has nothing to do.
        collections.deque(left, maxlen=0)
        running = [other for other in others if not other.cancel()]
        wait(running)
    for other in running:
        other.result()


def in_blocks(
    function,
    shared: Flattened,
    group: np.ndarray,
    trajectories: Flattened,
    width: int,
    pool: ThreadPoolExecutor,
    in_place: bool = False,
    size: int | None = None,
) -> Flattened:
    """`function(shared, trajectories)` of all trajectories, in blocks of one size.

    `group` is the row of `shared` of each trajectory. In a block, `shared` has an axis of rows, and `trajectories` one more
    axis, of length `width`. With `in_place` the results, of the same form, replace `trajectories`. `size` is the number of
    trajectories in a block on a CPU; chosen here unless given.
    """
    slots, filled = _side_by_side(group, width)
    if jax.default_backend() != "cpu":
        size = BLOCK_ELSEWHERE
    elif size is None:
        size = LARGE_BLOCK_ON_CPU if len(group) >= MANY else BLOCK_ON_CPU
    rows, devices = max(1, size // width), jax.local_devices()

    def run(start: int) -> tuple[np.ndarray, np.ndarray, tuple]:
        # The last block is padded with copies of its first row.
        chosen = np.arange(start, start + rows)
        real = filled[chosen % len(slots)] & (chosen < len(slots))[:, None]
        place = slots[np.where(chosen < len(slots), chosen, start)]
        device = devices[start // rows % len(devices)] if len(devices) > 1 else None
        with own_settings(), jax.default_device(device):
            own = Flattened(shared.numbers[group[place[:, 0]]], shared.form)
            result = function(own, Flattened(trajectories.numbers[place], trajectories.form))
            return place[real], np.asarray(result.numbers)[real], result.form

    def keep(place: np.ndarray, numbers: np.ndarray, _: tuple) -> None:
        results.numbers[place] = numbers

    starts, results = range(0, len(slots), rows), trajectories
    if not in_place:
        # The first blocks say what the results look like.
        begun, starts = list(pool.map(run, starts[: workers()])), starts[workers() :]
        results = Flattened(np.empty((len(group), begun[0][1].shape[-1])), begun[0][2])
        for block in begun:
            keep(*block)
    # Written into the result at once, so that the parts do not take memory as well.
    for _ in pool.map(lambda start: keep(*run(start)), starts):
        pass
    return results


def _side_by_side(group: np.ndarray, width: int) -> tuple[np.ndarray, np.ndarray]:
    """Rows of `width` trajectories of the same group, as indices into `group`, padded with the first of the row; and which
    entries are not padding.
    """
    order = np.argsort(group, kind="stable")
    _, first, count = np.unique(group[order], return_index=True, return_counts=True)
    rows = -(-count // width)
    before = np.cumsum(rows) - rows
    start = np.repeat(first, rows) + width * (np.arange(rows.sum()) - np.repeat(before, rows))
    places = start[:, None] + np.arange(width)
    filled = places < np.repeat(first + count, rows)[:, None]
    return order[np.where(filled, places, start[:, None])], filled
