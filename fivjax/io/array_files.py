"""Matrices without labels: Matrix Market, MATLAB and NumPy files."""

from pathlib import Path

import numpy as np
from scipy import sparse

from .file_matrix import FileMatrix


def matrix_market(path: Path) -> dict[str, FileMatrix]:
    """The matrix of a Matrix Market file, by the file's name."""
    from scipy.io import mmread

    # The reader raises many kinds of errors for damaged files; all become one sentence.
    try:
        matrix = mmread(path, spmatrix=False)
    except (ValueError, OSError, EOFError, OverflowError, IndexError, TypeError) as error:
        raise _unreadable(path, "Matrix Market", error) from None
    return {path.stem: FileMatrix(sparse.csr_array(matrix), None, f"File `{path}`")}


def matlab(path: Path) -> dict[str, FileMatrix]:
    """The matrices of a MATLAB file, by name; anything else in it is passed over."""
    import scipy.io

    try:
        loaded = scipy.io.loadmat(path, spmatrix=False)
    except NotImplementedError:  # version 7.3 is HDF5
        loaded = _matlab_73(path)
    except (ValueError, TypeError, OSError, EOFError, KeyError, scipy.io.matlab.MatReadError) as error:
        raise _unreadable(path, "MATLAB", error) from None
    found = {name: value for name, value in loaded.items() if not name.startswith("__")}
    return _matrices(path, found)


def _matlab_73(path: Path) -> dict:
    import h5py

    found = {}
    with h5py.File(path) as file:
        for name, item in file.items():
            if isinstance(item, h5py.Dataset) and item.ndim == 2:
                found[name] = np.transpose(item[()])  # stored column by column
            elif isinstance(item, h5py.Group) and "MATLAB_sparse" in item.attrs:
                # Compressed columns; a matrix of zeros has no data.
                starts, rows = np.asarray(item["jc"]), int(item.attrs["MATLAB_sparse"])
                data = np.asarray(item["data"]) if "data" in item else np.zeros(0)
                entries = np.asarray(item["ir"]) if "ir" in item else np.zeros(0, int)
                found[name] = sparse.csc_array((data, entries, starts), shape=(rows, len(starts) - 1))
    return found


def numpy_array(path: Path) -> dict[str, FileMatrix]:
    """The matrix of a `.npy` file, by the file's name."""
    return {path.stem: _matrix(path, "", _load(path))}


def numpy_archive(path: Path) -> dict[str, FileMatrix]:
    """The matrices of a `.npz` file: several by name, or a sparse one as `scipy.sparse.save_npz` writes it."""
    with _load(path) as archive:
        names = set(archive.files)
        if {"format", "shape", "data"} <= names:
            try:
                return {path.stem: FileMatrix(sparse.csr_array(sparse.load_npz(path)), None, f"File `{path}`")}
            except (ValueError, KeyError, TypeError) as error:
                raise _unreadable(path, "NumPy", error) from None
        try:
            found = {name: archive[name] for name in archive.files}
        except (ValueError, OSError, EOFError) as error:
            raise _unreadable(path, "NumPy", error) from None
    return _matrices(path, found)


def _load(path: Path):
    import zipfile

    try:
        return np.load(path, allow_pickle=False)
    except (ValueError, OSError, EOFError, zipfile.BadZipFile) as error:
        raise _unreadable(path, "NumPy", error) from None


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
    return {name: _matrix(path, f", matrix `{name}`", value) for name, value in square.items()}


def _matrix(path: Path, name: str, value) -> FileMatrix:
    if not sparse.issparse(value):
        value = np.asarray(value)
        if value.dtype.kind not in "biufc" or value.ndim != 2:
            raise ValueError(
                f"File `{path}`{name} must be a square matrix of numbers, but has shape {value.shape} and type "
                f"{value.dtype}."
            )
    return FileMatrix(sparse.csr_array(value), None, f"File `{path}`{name}")


def _unreadable(path: Path, kind: str, error: Exception) -> ValueError:
    said = str(error).strip().rstrip(".").splitlines()
    if said and "pickle" in said[0]:
        # NumPy takes any file that it does not know for pickled objects.
        said = ["it holds no arrays of numbers"]
    return ValueError(
        f"File `{path}` cannot be read as {kind}: {said[0] if said else type(error).__name__}. Write it again."
    )
