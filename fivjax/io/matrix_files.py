"""Matrices from files of finite-element codes and numerical libraries: which formats are read, and by which module.

Each reader gives matrices by name, with the node and direction of every row where the file has them. Errors name the file, and
the line or the matrix.
"""

from pathlib import Path

import numpy as np
from scipy import sparse

from . import abaqus_files, array_files, nastran_files
from .file_matrix import FileMatrix


def read_matrices(path: str | Path) -> dict[str, FileMatrix]:
    """Every matrix of a file, by name, in the file's units.

        matrices = fj.read_matrices("model.op4")
        matrices["KAA"].matrix, matrices["KAA"].labels

    - `.mtx`: Abaqus `*MATRIX OUTPUT` (rows: node, direction, node, direction, value; or row, column, value), Abaqus
      `*SUBSTRUCTURE MATRIX OUTPUT`, or Matrix Market. What the file holds tells which.
    - `.pch`, `.bdf`, `.dat`: Nastran DMIG entries. `.op4`: Nastran OUTPUT4, read by pyyeti (`pip install "fivjax[fe]"`).
    - `.mat`: MATLAB. `.npy`, `.npz`: NumPy, also sparse matrices that SciPy saved.

    Matrices have the names that the file gives them, else the name of the file without its suffix. One triangle in an Abaqus
    `.mtx` file is completed to a symmetric matrix.

    **Raises:** `ValueError` naming the file with the line, or the matrix, that cannot be used; `ImportError` where pyyeti is
    not installed.

    **Example:**

        >>> np.savez("model.npz", K=np.diag([2e4, 3e4]), M=np.eye(2))
        >>> sorted(fj.read_matrices("model.npz"))
        ['K', 'M']
    """

    path = Path(path)
    readers = {
        ".mtx": _mtx,
        ".pch": nastran_files.dmig,
        ".bdf": nastran_files.dmig,
        ".dat": nastran_files.dmig,
        ".op4": nastran_files.output4,
        ".mat": array_files.matlab,
        ".npy": array_files.numpy_array,
        ".npz": array_files.numpy_archive,
    }
    if path.suffix.lower() not in readers:
        raise ValueError(
            f"File `{path}` must be one of {', '.join(readers)}, but ends in {path.suffix or 'nothing'!r}. Save the "
            f"matrices as one of these; `.npz` is the simplest."
        )
    if not path.is_file():
        raise ValueError(f"File `{path}` does not exist.")
    if path.stat().st_size == 0:
        raise ValueError(f"File `{path}` is empty. Write it again.")
    found = readers[path.suffix.lower()](path)
    return {name: _checked(matrix) for name, matrix in found.items()}


def _mtx(path: Path) -> dict[str, FileMatrix]:

    with path.open("rb") as file:
        start = file.read(14)
    if start.lower() == b"%%matrixmarket":
        return array_files.matrix_market(path)
    return abaqus_files.matrices(path)


def _checked(found: FileMatrix) -> FileMatrix:
    """The matrix without stored zeros.

    **Raises:** `ValueError` unless it is square, not empty, real and finite, with as many labels as rows.
    """
    matrix, labels, place = found
    shape = tuple(matrix.shape or ())
    if len(shape) != 2 or shape[0] != shape[1] or shape[0] == 0:
        raise ValueError(f"{place} must be a square matrix, but has shape {shape}. Give mass, damping or stiffness.")
    if np.iscomplexobj(matrix):
        raise ValueError(
            f"{place} is complex. Give the real stiffness, and structural damping as a viscous damping matrix: its "
            f"imaginary part divided by the frequency of interest in rad/s."
        )
    matrix = sparse.csr_array(matrix, dtype=np.float64)
    matrix.eliminate_zeros()
    bad = np.flatnonzero(~np.isfinite(matrix.data))
    if bad.size:
        entries = matrix.tocoo()
        i, j = int(entries.row[bad[0]]), int(entries.col[bad[0]])
        where = f"row {i + 1}, column {j + 1}" if labels is None else f"{labels[i]} with {labels[j]}"
        raise ValueError(f"{place} must be finite, but {where} is {matrix.data[bad[0]]}. Write it again.")
    return FileMatrix(matrix, labels, place)
