"""HDF5 files, which NetCDF and MATLAB 7.3 files are: read in a process of its own, which a damaged one may crash."""

from pathlib import Path

import numpy as np

from . import sparse_parts
from .reading_limits import unreadable
from .separate_reading import parts_of


def is_hdf5(path: Path) -> bool:
    """Whether a file has HDF5's signature."""
    # Where the signature may stand: after a block of the user's own.
    places = (0, 512, 1024, 2048)
    signature = b"\x89HDF\r\n\x1a\n"
    with path.open("rb") as file:
        for place in places:
            file.seek(place)
            if file.read(len(signature)) == signature:
                return True
    return False


def read_netcdf(path: Path) -> tuple[dict, dict[str, tuple[list[str], np.ndarray, dict]]]:
    """The attributes of a NetCDF file; and dimensions, values and attributes of its variables by name. Nothing is decoded.

    **Raises:** `ValueError` for a file that is damaged, or whose data are in other files.
    """
    attributes, variables = {}, {}
    for about, values in _parts(path, "netcdf", "NetCDF"):
        if "name" not in about:
            attributes = _attributes(about["attrs"])
        else:
            variables[about["name"]] = (about["dims"], values, _attributes(about["attrs"]))
    return attributes, variables


def read_matlab(path: Path) -> dict:
    """The variables of a MATLAB 7.3 file by name: arrays and sparse matrices, and None for each that holds no numbers.

    **Raises:** `ValueError` for a file that is damaged, or whose data are in other files.
    """
    found, rows, parts = {}, {}, {}
    for about, values in _parts(path, "matlab", "MATLAB"):
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


def _parts(path: Path, what: str, kind: str):
    if not is_hdf5(path):
        raise unreadable(path, kind, "it does not begin as such a file does")
    return parts_of(path, what, kind)


def _attributes(sent: dict) -> dict:
    found = {}
    for name, value in sent.items():
        if "hex" in value:
            array = np.frombuffer(bytes.fromhex(value["hex"]), value["dtype"]).reshape(value["shape"])
            found[name] = array if array.ndim else array[()]
        elif "bytes" in value:
            found[name] = bytes.fromhex(value["bytes"])
        else:
            found[name] = value.get("text", value.get("texts"))
    return found
