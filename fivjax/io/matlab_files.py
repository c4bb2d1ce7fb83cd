"""Variables of MATLAB files, as far as they are numbers: by SciPy, and those of version 7.3, which are HDF5, by h5py."""

from pathlib import Path

import numpy as np

from . import sparse_parts
from .hdf5_files import is_hdf5
from .separate_reading import parts_of


def read_matlab(path: Path) -> dict:
    """The variables of a file by name: arrays and sparse matrices, and None for each that holds no numbers.

    **Raises:** `ValueError` for a file that is damaged, or whose data are in other files.
    """
    found, rows, parts = {}, {}, {}
    for about, values in parts_of(path, "matlab73" if is_hdf5(path) else "matlab", "MATLAB"):
        name = about["name"]
        if "rows" in about:
            rows[name] = about["rows"]
        elif "/" in name:
            parts[name] = values
        elif name:
            found[name] = None if values is None else values.T  # stored column by column
    for name, count in rows.items():
        starts = parts.get(f"{name}/jc", np.zeros(0, int))
        # A matrix of zeros has no data.
        data, entries = parts.get(f"{name}/data", np.zeros(0)), parts.get(f"{name}/ir", np.zeros(0, int))
        shape = (count, max(starts.size - 1, 0))
        found[name] = sparse_parts.compressed(path, "MATLAB", "csc", data, entries, starts, shape)
    return found
