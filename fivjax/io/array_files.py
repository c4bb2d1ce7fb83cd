"""Matrices without labels: Matrix Market, MATLAB and NumPy files."""

from pathlib import Path

import numpy as np
from scipy import sparse

from . import numpy_files, sparse_parts
from .file_matrix import FileMatrix
from .matlab_files import read_matlab
from .matrix_market_files import read_matrix_market
from .reading_limits import unreadable


def matrix_market(path: Path) -> dict[str, FileMatrix]:
    """The matrix of a Matrix Market file, by the file's name."""
    return {path.stem: FileMatrix(read_matrix_market(path), None, f"File `{path}`")}


def matlab(path: Path) -> dict[str, FileMatrix]:
    """The matrices of a MATLAB file, by name; anything else in it is passed over."""
    return _matrices(path, read_matlab(path))


def numpy_array(path: Path) -> dict[str, FileMatrix]:
    """The matrix of a `.npy` file, by the file's name."""
    return {path.stem: matrix_of(f"File `{path}`", numpy_files.load_array(path))}


def numpy_archive(path: Path) -> dict[str, FileMatrix]:
    """The matrices of a `.npz` file: several by name, or a sparse one as `scipy.sparse.save_npz` writes it."""
    found = numpy_files.load_archive(path)
    if {"format", "shape", "data"} <= set(found):
        return {path.stem: matrix_of(f"File `{path}`", _sparse(path, found))}
    return _matrices(path, found)


def _sparse(path: Path, parts: dict[str, np.ndarray]):
    """The matrix of which `scipy.sparse.save_npz` wrote these parts."""
    kind = parts["format"].tolist()
    kind = kind.decode("latin-1") if isinstance(kind, bytes) else kind
    wanted = dict.fromkeys(("csr", "csc", "bsr"), ("indices", "indptr"))
    wanted |= {"dia": ("offsets",), "coo": ("coords",) if "coords" in parts else ("row", "col")}
    if not isinstance(kind, str) or kind not in wanted or not set(wanted[kind]) <= set(parts):
        raise unreadable(
            path, numpy_files.KIND, f"it holds a sparse matrix of format {kind!r}, or not all parts of one"
        )
    known = numpy_files.KIND
    shape, data = sparse_parts.shape_of(path, known, parts["shape"]), parts["data"]
    first, last = parts[wanted[kind][0]], parts[wanted[kind][-1]]
    if kind in ("csr", "csc"):
        return sparse_parts.compressed(path, known, kind, data, first, last, shape)
    if kind == "dia":
        return sparse_parts.diagonals(path, known, data, first, shape)
    if kind == "bsr":
        return sparse_parts.blocks(path, known, data, first, last, shape)
    if "coords" in parts:
        if first.ndim != 2 or len(first) != 2:
            raise unreadable(path, known, f"the places of its entries have shape {first.shape}")
        first, last = first
    return sparse_parts.triplets(path, known, data, first, last, shape)


def _matrices(path: Path, found: dict) -> dict[str, FileMatrix]:
    # Numbers, names and vectors beside the matrices are no error.
    square = {
        name: value
        for name, value in found.items()
        if len(np.shape(value)) == 2 and min(np.shape(value)) > 1 and value.dtype.kind in "biufc"
    }
    if not square:
        held = ", ".join(f"`{name}`" for name in found) or "nothing"
        raise ValueError(f"File `{path}` holds no matrix, but {held}. Save the matrices under names of their own.")
    return {name: matrix_of(f"File `{path}`, matrix `{name}`", value) for name, value in square.items()}


def matrix_of(place: str, value) -> FileMatrix:
    """An array or a sparse matrix as one from a file at this place.

    **Raises:** `ValueError` for what is no matrix of numbers.
    """
    if np.ma.is_masked(value):
        raise ValueError(f"{place} has masked entries. Fill them, for instance by `filled(0.0)`.")
    if not sparse.issparse(value):
        try:
            value = np.asarray(value)
        except ValueError:
            raise ValueError(
                f"{place} must be a square matrix of numbers, but its rows are of different lengths."
            ) from None
        if value.dtype.kind not in "biufc" or value.ndim != 2:
            raise ValueError(
                f"{place} must be a square matrix of numbers, but has shape {value.shape} and type {value.dtype}."
            )
        # In this machine's order of bytes, and no shorter than its numbers are.
        value = value.astype(np.result_type(value.dtype, np.float64))
    return FileMatrix(sparse.csr_array(value), None, place)
