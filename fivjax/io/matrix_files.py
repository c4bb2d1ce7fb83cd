"""Matrices from files of finite-element codes and numerical libraries: which formats are read, and by which module.

Each reader gives matrices by name, with the node and direction of every row where the file has them. Errors name the file, and
the line or the matrix. Loads, and rectangular and complex matrices, are listed with the reason why they are neither mass nor
damping nor stiffness; they do not keep the rest from being read.
"""

from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np
from scipy import sparse

from ..foundation import arguments
from . import abaqus_files, array_files, harwell_boeing_files, nastran_files
from .file_matrix import FileMatrix
from .files import check_there


class FileMatrices(dict[str, FileMatrix]):
    """The square, real matrices of a file by name; in `left_out`, by name, why each other one is not among them."""

    def __init__(self, matrices: Mapping[str, FileMatrix], left_out: Mapping[str, str]):
        super().__init__(matrices)
        self.left_out = dict(left_out)

    def __missing__(self, name: str):
        raise KeyError(self.left_out.get(name, f"There is no matrix `{name}`, but {', '.join(self)}."))


def read_matrices(path: str | Path) -> FileMatrices:
    """The matrices of a file by name, in the file's units.

        matrices = fj.read_matrices("model.op4")
        matrices["KAA"].matrix, matrices["KAA"].labels
        matrices.left_out       # rectangular and complex ones, such as loads: {"PAX": "File …: …"}

    - Matrix Market and Harwell–Boeing, under any suffix: what the file begins with tells (Ansys: `*EXPORT,…,MMF` and `HBMAT`).
    - `.mtx`: Abaqus `*MATRIX OUTPUT` (rows: node, direction, node, direction, value; or row, column, value) or Abaqus
      `*SUBSTRUCTURE MATRIX OUTPUT`.
    - `.pch`, `.bdf`, `.dat`: Nastran DMIG entries. `.op4`: Nastran OUTPUT4, read by pyyeti (`pip install "fivjax[fe]"`).
    - `.mat`: MATLAB. `.npy`, `.npz`: NumPy, also sparse matrices that SciPy saved.

    Matrices have the names that the file gives them, else the name of the file without its suffix. One triangle in an Abaqus
    `.mtx` file is completed to a symmetric matrix.

    **Returns:** a dictionary of `FileMatrix`. Matrices that are not square, or complex, are not in it; its attribute `left_out`
    has the reason for each by name.

    **Raises:** `ValueError` naming the file with the line, or the matrix, that is damaged, or a file with nothing but matrices
    that cannot be used; `ImportError` where pyyeti is not installed.

    **Example:**

        >>> np.savez("model.npz", K=np.diag([2e4, 3e4]), M=np.eye(2))
        >>> sorted(fj.read_matrices("model.npz"))
        ['K', 'M']
    """
    path = arguments.path("path", path)
    check_there(path)
    if path.stat().st_size == 0:
        raise ValueError(f"File `{path}` is empty. Write it again.")
    return usable(f"File `{path}`", _reader(path)(path))


def _reader(path: Path) -> Callable[[Path], Mapping[str, FileMatrix | str]]:
    with path.open("rb") as file:
        head = file.read(harwell_boeing_files.HEAD).decode("latin-1")
    if head[:14].lower() == "%%matrixmarket":
        return array_files.matrix_market
    if harwell_boeing_files.begins_like_harwell_boeing(head):
        return harwell_boeing_files.matrix
    readers = {
        ".mtx": abaqus_files.matrices,
        ".pch": nastran_files.dmig,
        ".bdf": nastran_files.dmig,
        ".dat": nastran_files.dmig,
        ".op4": nastran_files.output4,
        ".mat": array_files.matlab,
        ".npy": array_files.numpy_array,
        ".npz": array_files.numpy_archive,
    }
    if path.suffix.lower() not in readers:
        ending = repr(path.suffix) if path.suffix else "none of them"
        raise ValueError(
            f"File `{path}` must be one of {', '.join(readers)}, or hold a Matrix Market or Harwell-Boeing matrix, but ends in "
            f"{ending} and begins like neither. Save the matrices as one of these; `.npz` is the simplest."
        )
    return readers[path.suffix.lower()]


def usable(place: str, found: Mapping[str, FileMatrix | str]) -> FileMatrices:
    """The matrices that could be mass, damping or stiffness, and the reasons why the others are not.

    **Raises:** `ValueError` if none could.
    """
    matrices, left_out = {}, {}
    for name, matrix in found.items():
        reason = matrix if isinstance(matrix, str) else _reason(matrix)
        if reason:
            left_out[name] = reason
        elif isinstance(matrix, FileMatrix):
            matrices[name] = _check(matrix)
    if not matrices:
        raise ValueError(next(iter(left_out.values()), f"{place} holds no matrix. Write it again."))
    return FileMatrices(matrices, left_out)


def _reason(found: FileMatrix) -> str:
    """Why a matrix is neither mass nor damping nor stiffness; empty if it may be."""
    shape = tuple(found.matrix.shape or ())
    if len(shape) != 2 or shape[0] != shape[1] or shape[0] == 0:
        return f"{found.place} must be a square matrix, but has shape {shape}. Give mass, damping or stiffness."
    if np.iscomplexobj(found.matrix):
        return (
            f"{found.place} is complex. Give the real stiffness, and structural damping as a viscous damping matrix: its "
            f"imaginary part divided by the frequency of interest in rad/s."
        )
    return ""


def _check(found: FileMatrix) -> FileMatrix:
    """The matrix without stored zeros.

    **Raises:** `ValueError` unless it is finite.
    """
    labels, place = found.labels, found.place
    matrix = sparse.csr_array(found.matrix, dtype=np.float64)
    matrix.eliminate_zeros()
    bad = np.flatnonzero(~np.isfinite(matrix.data))
    if bad.size:
        entries = matrix.tocoo()
        i, j = int(entries.row[bad[0]]), int(entries.col[bad[0]])
        where = f"row {i + 1}, column {j + 1}" if labels is None else f"{labels[i]} with {labels[j]}"
        raise ValueError(f"{place} must be finite, but {where} is {matrix.data[bad[0]]}. Write it again.")
    return found._replace(matrix=matrix)
