"""Sparse matrices from the arrays that files keep them in. SciPy trusts indices, and reads and writes wherever they point."""

from pathlib import Path

import numpy as np
from scipy import sparse

from .reading_limits import check_rows, unreadable


def compressed(path: Path, kind: str, by: str, data, indices, starts, shape: tuple[int, int]):
    """A matrix from compressed rows (`by` "csr") or columns ("csc").

    **Raises:** `ValueError` for parts that do not fit together, and for indices outside the matrix.
    """
    lines, across = shape if by == "csr" else shape[::-1]
    what = ("row", "column") if by == "csr" else ("column", "row")
    data, indices, starts = _vector(path, kind, data), _whole(path, kind, indices), _whole(path, kind, starts)
    check_rows(path, kind, max(shape), len(data))
    if min(shape) < 0 or len(starts) != lines + 1:
        raise unreadable(
            path,
            kind,
            f"a sparse matrix of shape {shape} must have {lines + 1} starts of a {what[0]}, not {len(starts)}",
        )
    if starts[0] != 0 or np.any(np.diff(starts) < 0) or starts[-1] > min(len(data), len(indices)):
        raise unreadable(
            path, kind, f"the starts of a sparse matrix's {what[0]}s must go up from 0 to its {len(data)} entries"
        )
    # MATLAB allots more entries than it uses.
    count = int(starts[-1])
    data, indices = data[:count], indices[:count]
    _inside(path, kind, what[1], indices, across)
    maker = sparse.csr_array if by == "csr" else sparse.csc_array
    return maker((data, indices, starts), shape=shape)


def triplets(path: Path, kind: str, data, rows, columns, shape: tuple[int, int]):
    """A matrix from its entries, each with a row and a column, counted from 0; entries at one place add up.

    **Raises:** `ValueError` for parts that do not fit together, and for indices outside the matrix.
    """
    data, rows, columns = _vector(path, kind, data), _whole(path, kind, rows), _whole(path, kind, columns)
    check_rows(path, kind, max(shape), len(data))
    if not len(data) == len(rows) == len(columns):
        raise unreadable(
            path, kind, f"a sparse matrix has {len(data)} entries, {len(rows)} rows of them and {len(columns)} columns"
        )
    _inside(path, kind, "row", rows, shape[0])
    _inside(path, kind, "column", columns, shape[1])
    return sparse.csr_array((data, (rows, columns)), shape=shape)


def diagonals(path: Path, kind: str, data, offsets, shape: tuple[int, int]):
    """A matrix from its diagonals, as `scipy.sparse.dia_array` keeps them.

    **Raises:** `ValueError` for parts that do not fit together.
    """
    data, offsets = np.asarray(data), _whole(path, kind, offsets)
    check_rows(path, kind, max(shape), data.size)
    if data.ndim != 2 or len(data) != len(offsets) or data.dtype.kind not in "biufc":
        raise unreadable(path, kind, f"a sparse matrix has {len(offsets)} diagonals, but data of shape {data.shape}")
    if len(np.unique(offsets)) != len(offsets) or data.shape[1] > max(shape):
        raise unreadable(path, kind, "the diagonals of a sparse matrix must be in it, each once")
    # By entries: row and column of each, those outside the matrix being unused.
    columns = np.broadcast_to(np.arange(data.shape[1]), data.shape)
    rows = columns - offsets[:, None]
    used = (rows >= 0) & (rows < shape[0]) & (columns < shape[1]) & (data != 0)
    return sparse.csr_array((data[used], (rows[used], columns[used])), shape=shape)


def blocks(path: Path, kind: str, data, indices, starts, shape: tuple[int, int]):
    """A matrix from compressed rows of dense blocks, as `scipy.sparse.bsr_array` keeps them.

    **Raises:** `ValueError` for parts that do not fit together, and for indices outside the matrix.
    """
    data = np.asarray(data)
    if data.ndim != 3 or not data.size or data.dtype.kind not in "biufc":
        raise unreadable(path, kind, f"a sparse matrix of blocks has data of shape {data.shape}")
    _, high, wide = data.shape
    if shape[0] % high or shape[1] % wide:
        raise unreadable(path, kind, f"blocks of {high} rows and {wide} columns do not fill shape {shape}")
    check_rows(path, kind, max(shape), data.size)
    # Where each block goes, from a matrix of the blocks' numbers.
    outer = shape[0] // high, shape[1] // wide
    where = compressed(path, kind, "csr", np.arange(len(data)), indices, starts, outer)
    found = sparse.bsr_array((data[: where.nnz], where.indices, where.indptr), shape=shape).tocsr()
    found.sum_duplicates()
    return found


def shape_of(path: Path, kind: str, shape) -> tuple[int, int]:
    """The two sizes of a matrix.

    **Raises:** `ValueError` unless they are two whole numbers that are not negative.
    """
    sizes = _whole(path, kind, shape)
    if len(sizes) != 2 or np.any(sizes < 0):
        raise unreadable(path, kind, f"a matrix must have two sizes, but has {sizes.tolist()[:8]}")
    return int(sizes[0]), int(sizes[1])


def _inside(path: Path, kind: str, what: str, indices: np.ndarray, size: int) -> None:
    bad = np.flatnonzero((indices < 0) | (indices >= size))
    if bad.size:
        raise unreadable(
            path,
            kind,
            f"entry {bad[0] + 1} of a sparse matrix is in {what} {indices[bad[0]] + 1}, but the matrix has {size}",
        )


def _vector(path: Path, kind: str, values) -> np.ndarray:
    array = np.asarray(values)
    array = array.ravel() if array.size == max(array.shape, default=1) else array
    if array.ndim != 1 or array.dtype.kind not in "biufc":
        raise unreadable(
            path, kind, f"a part of a sparse matrix must be a vector of numbers, but has shape {array.shape}"
        )
    return array


def _whole(path: Path, kind: str, values) -> np.ndarray:
    array = _vector(path, kind, values)
    if array.dtype.kind == "f" and np.all(np.isfinite(array)) and np.all(np.abs(array) < 2.0**62):
        whole = array.astype(np.int64)
        if np.all(whole == array):
            return whole
    if array.dtype.kind not in "iu" or (array.dtype.kind == "u" and array.size and array.max() >= 2**62):
        raise unreadable(path, kind, "the places of a sparse matrix's entries must be whole numbers")
    return array.astype(np.int64)
