"""Variables of MATLAB files, as far as they are numbers: versions 4, 5 to 7.2 (one format), and 7.3, which is HDF5.

Read here, because the readers at hand crash on damaged files. In version 5 a file is a row of elements, each with a type, a
length and its content; a variable is an element of elements: flags, sizes, name, numbers, imaginary parts; sparse ones have
rows and column starts before the numbers (MathWorks, MAT-File Format). Texts, cells, structures and objects are passed over.
"""

import math
import zlib
from pathlib import Path
from typing import NamedTuple

import numpy as np

from . import hdf5_files, sparse_parts
from .reading_limits import PACKED, SMALL, check_declared, check_length, unreadable

KIND = "MATLAB"
# Element types that hold numbers, and the two that hold elements.
NUMBERS = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 9: "f8", 12: "i8", 13: "u8"}
MATRIX, PACKED_ELEMENT = 14, 15
# Classes of variables that hold numbers.
SPARSE = 5
COMPLEX, LOGICAL = 0x08, 0x02
# Numbers of version 4, by the tens digit of a variable's type; and its byte orders, by the thousands digit.
OLD_NUMBERS = {0: "f8", 1: "f4", 2: "i4", 3: "i2", 4: "u2", 5: "u1"}


def read_matlab(path: Path) -> dict:
    """The variables of a file by name: arrays and sparse matrices, and None for each that holds no numbers.

    **Raises:** `ValueError` for a file that is damaged.
    """
    check_length(path)
    with path.open("rb") as file:
        start = file.read(128)
    if hdf5_files.is_hdf5(path):
        return hdf5_files.read_matlab(path)
    try:
        # The byte order of version 5 stands at the end of its header; version 4 has no header.
        if len(start) == 128 and start[126:] in (b"IM", b"MI") and 0 not in start[:4]:
            return _variables(path, path.read_bytes(), "<" if start[126:] == b"IM" else ">")
        return _old_variables(path, path.read_bytes())
    except MemoryError:
        raise unreadable(path, KIND, "its numbers do not fit into the memory") from None


class _Element(NamedTuple):
    kind: int
    content: memoryview
    end: int  # where the next one begins


def _element(path: Path, content: memoryview, at: int, order: str) -> _Element:
    if at + 8 > len(content):
        raise unreadable(path, KIND, "it is cut off")
    kind, length = (int(number) for number in np.frombuffer(content, f"{order}u4", 2, at))
    if kind >> 16:  # up to four bytes, beside a type and a length of two bytes each
        kind, length = kind & 0xFFFF, kind >> 16
        if length > 4:
            raise unreadable(path, KIND, f"a short element has {length} bytes")
        return _Element(kind, content[at + 4 : at + 4 + length], at + 8)
    begin = at + 8
    if begin + length > len(content):
        raise unreadable(path, KIND, f"an element declares {length} bytes, but {len(content) - begin} follow")
    # Elements are filled up to eight bytes, but for packed ones.
    end = begin + length + (0 if kind == PACKED_ELEMENT else -length % 8)
    return _Element(kind, content[begin : begin + length], end)


def _variables(path: Path, content: bytes, order: str) -> dict:
    found, whole, at = {}, memoryview(content), 128
    while at < len(whole):
        element = _element(path, whole, at, order)
        at = element.end
        if element.kind == PACKED_ELEMENT:
            element = _unpack(path, element.content, order)
        if element.kind != MATRIX:
            raise unreadable(path, KIND, f"an element of type {element.kind} is no variable")
        name, value = _variable(path, element.content, order)
        if name in found:
            raise unreadable(path, KIND, f"variable `{name}` is there twice")
        if name:  # what belongs to functions has no name
            found[name] = value
    return found


def _unpack(path: Path, packed: memoryview, order: str) -> _Element:
    most = max(SMALL, PACKED * len(packed))
    try:
        unpacking = zlib.decompressobj()
        start = unpacking.decompress(packed, 8)
        if len(start) < 8:
            raise unreadable(path, KIND, "a packed variable is cut off")
        kind, length = (int(number) for number in np.frombuffer(start, f"{order}u4", 2))
        check_declared(path, KIND, length, len(packed))
        content = unpacking.decompress(unpacking.unconsumed_tail, min(length, most) + 1)
        # The checksum is behind the last byte.
        if len(content) == length and not unpacking.eof:
            unpacking.decompress(unpacking.unconsumed_tail, 1)
    except zlib.error as error:
        raise unreadable(path, KIND, f"a packed variable is damaged ({error})") from None
    if len(content) != length or not unpacking.eof:
        raise unreadable(path, KIND, f"a packed variable declares {length} bytes, but has {len(content)}")
    return _Element(kind, memoryview(content), 0)


def _variable(path: Path, content: memoryview, order: str) -> tuple[str, object]:
    parts, at = [], 0
    # Beyond the name there are elements of other kinds where the variable holds no numbers.
    while at < len(content) and len(parts) < 3:
        parts.append(_element(path, content, at, order))
        at = parts[-1].end
    if len(parts) < 2:
        raise unreadable(path, KIND, "a variable is cut off")
    flags = _numbers(path, parts[0], order)
    if parts[0].kind not in (5, 6) or len(flags) != 2:
        raise unreadable(path, KIND, "a variable does not begin with its class")
    kind, is_complex = int(flags[0]) & 0xFF, bool(int(flags[0]) >> 8 & COMPLEX)
    classes = {6: "f8", 7: "f4", 8: "i1", 9: "u1", 10: "i2", 11: "u2", 12: "i4", 13: "u4", 14: "i8", 15: "u8"}
    if kind not in (SPARSE, *classes):
        # An opaque object has its name in the place of its sizes.
        name = parts[2] if len(parts) > 2 and parts[1].kind in (5, 6) else parts[1]
        return _name(path, name), None
    if len(parts) < 3:
        raise unreadable(path, KIND, "a variable is cut off")
    shape, name = tuple(int(size) for size in _numbers(path, parts[1], order)), _name(path, parts[2])
    if len(shape) < 2 or len(shape) > 32 or min(shape) < 0:
        raise unreadable(path, KIND, f"variable `{name}` declares shape {shape[:32]}")
    numbers = []
    while at < len(content):
        element = _element(path, content, at, order)
        at = element.end
        # The values of a sparse matrix of truths are bytes, whatever their type says.
        if kind == SPARSE and int(flags[0]) >> 8 & LOGICAL and len(numbers) == 2:
            element = element._replace(kind=2)
        numbers.append(_numbers(path, element, order))
    wanted = (2 if kind == SPARSE else 0) + 1 + is_complex
    if len(numbers) != wanted:
        raise unreadable(path, KIND, f"variable `{name}` must have {wanted} parts, but has {len(numbers)}")
    values = numbers[-2] + 1j * numbers[-1] if is_complex and len(numbers[-2]) == len(numbers[-1]) else numbers[-1]
    if is_complex and not np.iscomplexobj(values):
        raise unreadable(path, KIND, f"variable `{name}` has imaginary parts for other numbers than it has")
    if kind == SPARSE:
        where = sparse_parts.shape_of(path, KIND, np.array(shape))
        return name, sparse_parts.compressed(path, KIND, "csc", values, numbers[0], numbers[1], where)
    # Whole numbers may be kept in a smaller type.
    wanted_type = np.dtype(classes[kind])
    return name, _reshape(path, name, values if is_complex else values.astype(wanted_type, copy=False), shape)


def _numbers(path: Path, element: _Element, order: str) -> np.ndarray:
    # An element of length 0 may be of any type.
    if not len(element.content):
        return np.zeros(0)
    if element.kind not in NUMBERS:
        raise unreadable(path, KIND, f"an element of type {element.kind} holds no numbers")
    dtype = np.dtype(order + NUMBERS[element.kind])
    if len(element.content) % dtype.itemsize:
        raise unreadable(path, KIND, f"the last number of {len(element.content)} bytes is cut off")
    return np.frombuffer(element.content, dtype).astype(dtype.newbyteorder("="))


def _name(path: Path, element: _Element) -> str:
    name = bytes(element.content).rstrip(b"\0")
    if element.kind not in (1, 2, 16) or not all(32 <= byte < 127 for byte in name) or len(name) > 4096:
        raise unreadable(path, KIND, "the name of a variable is damaged")
    return name.decode("ascii")


def _reshape(path: Path, name: str, values: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    if math.prod(shape) != len(values):
        raise unreadable(path, KIND, f"variable `{name}` declares shape {shape}, but has {len(values)} numbers")
    return values.reshape(shape, order="F")


def _old_variables(path: Path, content: bytes) -> dict:
    """The variables of version 4: of each, five whole numbers (type, rows, columns, complex or not, length of name) first."""
    found, at = {}, 0
    old_orders = {0: "<", 1: ">"}
    while at < len(content):
        if at + 20 > len(content):
            raise unreadable(path, KIND, "it is cut off")
        kind = int.from_bytes(content[at : at + 4], "little")
        # Types are small numbers. In the other byte order they would be very large.
        mark = "<" if kind < 10_000 else ">"
        kind, rows, columns, is_complex, length = (int(x) for x in np.frombuffer(content, f"{mark}u4", 5, at))
        order, numbers, what = old_orders.get(kind // 1000), OLD_NUMBERS.get(kind // 10 % 10), kind % 10
        if kind >= 10_000 or order != mark or kind // 100 % 10 or numbers is None or what > 2 or is_complex > 1:
            raise unreadable(path, KIND, f"no variable begins at byte {at}")
        dtype, at = np.dtype(mark + numbers), at + 20
        size = rows * columns * dtype.itemsize * (1 + is_complex)
        if at + length + size > len(content):
            raise unreadable(path, KIND, f"a variable declares {rows} rows and {columns} columns, but is cut off")
        name = _name(path, _Element(1, memoryview(content)[at : at + length], 0))
        parts = np.frombuffer(content, dtype, rows * columns * (1 + is_complex), at + length)
        parts = parts.astype(dtype.newbyteorder("=")).reshape(1 + is_complex, columns, rows).transpose(0, 2, 1)
        at += length + size
        if name in found:
            raise unreadable(path, KIND, f"variable `{name}` is there twice")
        values = parts[0] + 1j * parts[1] if is_complex else parts[0]
        found[name] = {0: values, 1: None}[what] if what < 2 else _old_sparse(path, name, values)
    return found


def _old_sparse(path: Path, name: str, table: np.ndarray):
    """A sparse matrix of version 4: row, column, value (and imaginary part) in each line; the last line has its size."""
    if np.iscomplexobj(table) or table.shape[1] not in (3, 4) or not len(table):
        raise unreadable(path, KIND, f"the sparse variable `{name}` has shape {table.shape}")
    shape = sparse_parts.shape_of(path, KIND, table[-1, :2])
    values = table[:-1, 2] if table.shape[1] == 3 else table[:-1, 2] + 1j * table[:-1, 3]
    return sparse_parts.triplets(path, KIND, values, table[:-1, 0] - 1, table[:-1, 1] - 1, shape)
