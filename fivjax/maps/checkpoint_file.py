"""The bytes of a checkpoint: NetCDF for any reader, and behind it a list of its contents with checksums, for fivjax.

A checksum stands for so many values of a result. Damage to one costs these; damage to the rest of the NetCDF costs nothing,
because the list says where the results are. Only of the list itself must every bit be right.
"""

import json
import zlib
from collections.abc import Mapping
from io import BytesIO
from typing import NamedTuple

import numpy as np

from ..foundation.seals import Damaged, sealed, unsealed

KIND = "fivjax checkpoint"
# The last bytes of the file, after the length of the list.
MARK, LENGTH = b"fivjax.2", 8
# The number of values that share a checksum.
BLOCK = 1024


class Contents(NamedTuple):
    """What a checkpoint contains, as far as it is not damaged."""

    run: dict
    results: dict[str, np.ndarray]
    damaged: dict[str, list[slice]]  # parts of the results
    elsewhere: bool  # whether anything else is damaged
    found: dict[int, bytes]  # attractors, by the first trajectory of the job


def written(run: dict, results: dict[str, np.ndarray], found: Mapping[int, bytes]) -> bytes:
    """The bytes of a checkpoint."""
    import h5py
    import xarray as xr

    dataset = xr.Dataset({name: ("trajectory", values) for name, values in results.items()})
    dataset.attrs.update(kind=KIND, run=json.dumps(run))
    content = BytesIO()
    dataset.to_netcdf(content, engine="h5netcdf")
    data = content.getvalue()
    with h5py.File(BytesIO(data)) as file:
        places = {name: file[name].id.get_offset() for name in results}
    arrays = {
        name: [places[name], values.dtype.str, len(values), [zlib.crc32(values[part]) for part in _blocks(len(values))]]
        for name, values in results.items()
    }
    blobs = {place: sealed(content) for place, content in found.items()}
    contents = {
        "run": run,
        "arrays": arrays,
        "netcdf": [len(data), _without(data, arrays)],
        "found": [[place, len(blob)] for place, blob in blobs.items()],
    }
    listed = sealed(json.dumps(contents).encode())
    return b"".join([data, *blobs.values(), listed, len(listed).to_bytes(LENGTH, "little"), MARK])


def read(data: bytes) -> Contents:
    """The contents again.

    **Raises:** `Damaged` where the list of the contents is.
    """
    end = len(data) - len(MARK) - LENGTH
    if data[end + LENGTH :] != MARK:
        raise Damaged("The end of the file is missing.")
    begin = end - int.from_bytes(data[end : end + LENGTH], "little")
    contents = json.loads(unsealed(data[max(begin, 0) : end]))
    size, rest = contents["netcdf"]
    if size + sum(length for _, length in contents["found"]) != begin:
        raise Damaged("Parts of the file are missing.")
    results, damaged, found = {}, {}, {}
    for name, (place, kind, count, checksums) in contents["arrays"].items():
        values = np.frombuffer(data, kind, count, place).copy()
        bad = [part for part, sum_ in zip(_blocks(count), checksums, strict=True) if zlib.crc32(values[part]) != sum_]
        results[name] = values
        if bad:
            damaged[name] = bad
    elsewhere = _without(data[:size], contents["arrays"]) != rest
    for place, length in contents["found"]:
        try:
            found[place] = unsealed(data[size : size + length])
        except Damaged:
            elsewhere = True
        size += length
    return Contents(contents["run"], results, damaged, elsewhere, found)


def _blocks(count: int) -> list[slice]:
    return [slice(start, min(start + BLOCK, count)) for start in range(0, count, BLOCK)]


def _without(data: bytes, arrays: Mapping) -> int:
    """The checksum of all but the arrays."""
    at, total = 0, 0
    for place, kind, count, _ in sorted(arrays.values()):
        total = zlib.crc32(data[at:place], total)
        at = place + np.dtype(kind).itemsize * count
    return zlib.crc32(data[at:], total)
