"""NetCDF files, which are HDF5: read in a process of its own, which a damaged one may crash."""

from pathlib import Path
from typing import Any

import numpy as np

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
    if not is_hdf5(path):
        raise unreadable(path, "NetCDF", "it does not begin as such a file does")
    for about, values in parts_of(path, "netcdf", "NetCDF"):
        if "name" not in about:
            attributes = _attributes(about["attrs"])
        else:
            variables[about["name"]] = (about["dims"], values, _attributes(about["attrs"]))
    return attributes, variables


def _attributes(sent: dict) -> dict:
    found: dict[str, Any] = {}
    for name, value in sent.items():
        if "hex" in value:
            array = np.frombuffer(bytes.fromhex(value["hex"]), value["dtype"]).reshape(value["shape"])
            found[name] = array if array.ndim else array[()]
        elif "bytes" in value:
            found[name] = bytes.fromhex(value["bytes"])
        else:
            found[name] = value.get("text", value.get("texts"))
    return found
