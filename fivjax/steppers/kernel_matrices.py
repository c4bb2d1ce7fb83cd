"""The matrices of `propagation` in the order in which kernels read them: in blocks, each contact mode by itself."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from .propagation import INTERVALS, ORDER, Propagators

# Rows of a block of a matrix: two vectors of a processor. A block is contiguous, column by column.
BLOCK = 8


class Blocks(NamedTuple):
    """Where the parts of a mode's matrices begin, in blocks; of a structure with `n` degrees of freedom."""

    intervals: int  # control points of both guards in each interval, and the tangential velocity at its end
    hull: int  # control points of the guards' series in the first interval
    samples: int
    guards: int  # their series, and their values at the end of the interval
    displacements: int  # their series, power by power
    sizes: int
    total: int


def blocks_of(n: int) -> Blocks:
    lengths = 2 * ORDER, (INTERVALS + 1) * padded(2 * n), 2 * (ORDER + 2), abreast(n) * (ORDER + 2), BLOCK
    return Blocks(0, *np.cumsum([INTERVALS, *(padded(length) // BLOCK for length in lengths)]).tolist())


def padded(rows: int) -> int:
    """The next multiple of a block's length."""
    return -(-rows // BLOCK) * BLOCK


def abreast(n: int) -> int:
    """How many numbers there are for each power in the series of displacements: whole vectors of a processor."""
    return -(-n // 4) * 4


def places_of(n: int, normal: int) -> list[int]:
    """The places in (state, load, one) of the columns: first those that are not zero in contact."""
    closed = [place for place in range(2 * n + 2) if place not in (normal, n + normal)]
    return [*closed, normal, n + normal]


def matrices(prepared: Propagators, n: int, tangential: int, normal: int) -> Float[np.ndarray, "groups m"]:
    """The matrices of several scenes (leading axis), mode by mode: sticking, sliding in either direction, detached."""
    window, series, sizes = (np.asarray(part) for part in (prepared.window, prepared.series, prepared.sizes))
    count = len(window)
    hull, control, samples = np.split(window, np.cumsum((2 * ORDER, 6 * INTERVALS)), axis=1)
    guards, displacements = np.split(series, [2 * (ORDER + 2)], axis=1)
    control = control.reshape(count, 3, INTERVALS, 2, -1).transpose(0, 2, 1, 3, 4).reshape(count, INTERVALS, 6, -1)
    samples = samples.reshape(count, INTERVALS + 1, 2 * n, -1)
    displacements = displacements.reshape(count, ORDER + 2, n, -1)
    displacements = np.pad(displacements, [(0, 0), (0, 0), (0, abreast(n) - n), (0, 0)])
    displacements = displacements.reshape(count, abreast(n) * (ORDER + 2), -1)
    intervals = np.concatenate([control, samples[:, 1:, n + tangential, None]], axis=2)
    parts = [_in_blocks(part) for part in (intervals, hull, samples, guards, displacements, sizes)]
    rows = np.concatenate([part.reshape(count, -1, BLOCK, part.shape[-1]) for part in parts], axis=1)
    found = np.zeros((count, 4, rows.shape[1], 2 * n + 2, BLOCK))
    for mode in range(3):
        found[:, mode, :, : 2 * n] = rows[..., 2 * n * mode : 2 * n * (mode + 1)].swapaxes(-1, -2)
    found[:, 3] = rows[..., 6 * n :][..., places_of(n, normal)].swapaxes(-1, -2)
    return found.reshape(count, -1)


def _in_blocks(rows: Float[np.ndarray, "*parts rows c"]) -> Float[np.ndarray, "*parts padded c"]:
    more = padded(rows.shape[-2]) - rows.shape[-2]
    return np.pad(rows, [(0, 0)] * (rows.ndim - 2) + [(0, more), (0, 0)])
