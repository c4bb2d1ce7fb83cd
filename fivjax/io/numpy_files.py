"""Arrays from NumPy's files. Sizes are checked before room is made, and nothing is unpickled.

The format: the word `\\x93NUMPY`, two numbers of its version, the length of the header, the header, which is a Python literal
with type, shape and order, and the numbers (`numpy.lib.format`). An archive is a Zip file of such files.
"""

import ast
import math
import re
import zipfile
import zlib
from pathlib import Path
from typing import Literal

import numpy as np

from .reading_limits import check_declared, check_length, unreadable

KIND = "NumPy"


def load_array(path: Path) -> np.ndarray:
    """The array of a `.npy` file.

    **Raises:** `ValueError` for a file that is damaged, or that holds Python objects.
    """
    check_length(path)
    return _array(path, "", path.read_bytes())


def load_archive(path: Path) -> dict[str, np.ndarray]:
    """The arrays of a `.npz` file by name.

    **Raises:** `ValueError` for a file that is damaged, or that holds Python objects.
    """
    found = {}
    # What `zipfile` raises for damaged archives. (`RuntimeError`: encrypted; `NotImplementedError`: other ways of packing.)
    damage = (
        zipfile.BadZipFile,
        zlib.error,
        OSError,
        EOFError,
        RuntimeError,
        KeyError,
        IndexError,
        OverflowError,
        UnicodeError,
        MemoryError,
    )
    try:
        with zipfile.ZipFile(path) as archive:
            members = [member for member in archive.infolist() if member.filename.endswith(".npy")]
            check_declared(path, KIND, sum(member.file_size for member in members))
            for member in members:
                name = member.filename.removesuffix(".npy")
                if name in found:
                    raise unreadable(path, KIND, f"array `{name}` is there twice")
                found[name] = _array(path, f"array `{name}`: ", _unpack(path, archive, member))
    except damage as error:
        if isinstance(error, zipfile.BadZipFile) and path.read_bytes()[:1] == b"\x80":
            error = "it holds no arrays of numbers"
        raise unreadable(path, KIND, error) from None
    return found


def _unpack(path: Path, archive: zipfile.ZipFile, member: zipfile.ZipInfo) -> bytes:
    if member.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
        raise unreadable(path, KIND, f"`{member.filename}` is packed in a way that NumPy does not use")
    with archive.open(member) as file:
        # One byte more than declared, so that the checksum at the end is looked at.
        content = file.read(member.file_size + 1)
    if len(content) != member.file_size:
        raise unreadable(path, KIND, f"`{member.filename}` is cut off")
    return content


def _array(path: Path, where: str, content: bytes) -> np.ndarray:
    try:
        dtype, shape, order, begin = _header(content)
        count = math.prod(shape)
        if dtype.hasobject:
            raise ValueError("it holds Python objects, which could run code")
        if dtype.itemsize == 0 or count * dtype.itemsize != len(content) - begin:
            raise ValueError(f"it declares shape {shape} of {dtype}, but {len(content) - begin} bytes follow")
        return np.frombuffer(content, dtype, count, begin).reshape(shape, order=order).copy(order="K")
    # A damaged header is evaluated, and makes a type, in steps that raise errors of many kinds.
    except Exception as error:
        if type(error) is not ValueError:
            error = "its header is damaged"
        raise unreadable(path, KIND, f"{where}{error}") from None


def _header(content: bytes) -> tuple[np.dtype, tuple[int, ...], Literal["C", "F"], int]:
    """Type, shape and order of the numbers, and where they begin."""
    # Longest header, and how deep its brackets may go.
    header, depth = 100_000, 8
    magic = b"\x93NUMPY"
    if not content.startswith(magic):
        raise ValueError("it holds no arrays of numbers")
    width = {1: 2, 2: 4, 3: 4}[content[6]]
    begin = 8 + width + int.from_bytes(content[8 : 8 + width], "little")
    text = content[8 + width : begin]
    if begin > len(content) or len(text) > header or _depth(text) > depth:
        raise ValueError("its header is cut off, or too long")
    # Python 2 wrote an L behind whole numbers.
    literal = ast.literal_eval(re.sub(r"(\d)L\b", r"\1", text.decode("utf-8" if content[6] == 3 else "latin-1")))
    shape = tuple(literal["shape"])
    if not all(type(size) is int and size >= 0 for size in shape):
        raise ValueError(f"it declares shape {shape}")
    return np.lib.format.descr_to_dtype(literal["descr"]), shape, "F" if literal["fortran_order"] else "C", begin


def _depth(text: bytes) -> int:
    depth = deepest = 0
    for byte in text:
        depth += (byte in b"([{") - (byte in b")]}")
        deepest = max(deepest, depth)
    return deepest
