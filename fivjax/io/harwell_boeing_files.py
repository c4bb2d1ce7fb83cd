"""Harwell–Boeing files, as Ansys writes them with `HBMAT`: assembled matrices by columns.

Four lines of header, and a fifth where there are right-hand sides: a title; the numbers of lines that follow, in all and by
part; the kind of matrix with its rows, columns and entries; the Fortran formats of the parts. Then for each column the position
of its first entry, the row of each entry, and the values (Duff, Grimes and Lewis, Users' Guide for the Harwell-Boeing Sparse
Matrix Collection, 1992). Of a symmetric matrix the file has one triangle.
"""

import re
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy import sparse

from .file_matrix import FileMatrix, fortran_number, text_of
from .sparse_parts import compressed

# How much of a file tells whether it is one; digits of the longest number in its header.
HEAD, LONGEST = 400, 12


class _Header(NamedTuple):
    lines: tuple[int, int, int]  # of the columns' positions, of the rows, and of the values
    kind: str
    shape: tuple[int, int]
    entries: int
    formats: tuple[tuple[int, int], ...]  # fields in a line, and characters in a field, of each part
    length: int  # of the header, in lines


def begins_like_harwell_boeing(head: str) -> bool:
    """Whether a file that begins so has a Harwell–Boeing header: numbers in its second line, and a kind in its third."""
    lines = head.split("\n")
    return (
        len(lines) > 3
        and re.fullmatch(r"\s*(\d+\s+){2,4}\d+\s*", lines[1]) is not None
        and re.match(r"\s*[RCP][SUHZR][AE]\s+\d+\s+\d+\s+\d+", lines[2], re.IGNORECASE) is not None
    )


def matrix(path: Path) -> dict[str, FileMatrix | str]:
    """The matrix of a Harwell–Boeing file by the file's name; in place of a complex one, a sentence that says so."""
    place, lines = f"File `{path}`", text_of(path).splitlines()
    header = _header(place, lines)
    if header.kind[0] == "C":
        return {path.stem: f"{place} holds a complex matrix. Write the real stiffness, mass or damping."}
    columns = header.shape[1]
    ends = np.cumsum([header.length, *header.lines])
    if ends[-1] > len(lines):
        raise ValueError(f"{place} must have {ends[-1]} lines by its header, but has {len(lines)}. Write it again.")
    wanted = (columns + 1, header.entries, header.entries)
    positions, places, values = (
        _numbers(f"{place}, lines {a + 1} to {b}", lines[a:b], header.formats[part], kind, wanted[part])
        for part, (a, b, kind) in enumerate(zip(ends[:3], ends[1:], (int, int, float), strict=False))
    )
    starts = positions - 1
    if starts[0] != 0 or starts[-1] != header.entries or np.any(np.diff(starts) < 0):
        raise ValueError(
            f"{place}: the positions of its columns must go from 1 up to {header.entries + 1}. Write it again."
        )
    found = compressed(path, "Harwell-Boeing", "csc", values, places - 1, starts, header.shape).tocoo()
    column = np.repeat(np.arange(columns), np.diff(starts))
    order = np.lexsort((places, column))
    double = order[1:][(np.diff(places[order]) == 0) & (np.diff(column[order]) == 0)]
    if len(double):
        raise ValueError(
            f"{place} gives row {places[double[0]]} of column {column[double[0]] + 1} twice. Write each entry once."
        )
    i, j, data = found.row, found.col, found.data
    if header.kind[1] == "S":
        if np.any(i < j) and np.any(i > j):
            raise ValueError(
                f"{place} is said to be symmetric, but has entries on both sides of the diagonal. Write it again."
            )
        off = i != j
        i, j, data = np.append(i, j[off]), np.append(j, i[off]), np.append(data, data[off])
    return {path.stem: FileMatrix(sparse.csr_array((data, (i, j)), shape=header.shape), None, place)}


def _header(place: str, lines: list[str]) -> _Header:
    kind, *sizes = [*(" ".join(lines[2:3])).upper().split(), ""]
    words, sizes = lines[1].split(), sizes[:3]
    numbers = all(re.fullmatch(rf"[0-9]{{1,{LONGEST}}}", word) for word in [*words, *sizes])
    if len(lines) < 4 or len(words) < 4 or len(sizes) < 3 or len(kind) < 3 or not numbers:
        raise ValueError(f"{place}, lines 2 and 3: the numbers of lines and the sizes are damaged. Write it again.")
    counts, (rows, columns, entries) = [int(word) for word in words], [int(word) for word in sizes]
    if kind[2] == "E" or kind[0] == "P" or kind[1] in "HZ":
        raise ValueError(
            f"{place} holds a matrix of kind {kind}, but must hold an assembled one with values: RSA, RUA or RRA. Write it so."
        )
    formats = re.findall(r"\(([^()]*)\)", lines[3])[:3]
    fields = [re.search(r"(\d*)[IEDFG](\d+)", text.upper().split("P")[-1]) for text in formats]
    if len(fields) < 3 or None in fields or any(len(part) > LONGEST for one in fields if one for part in one.groups()):
        raise ValueError(
            f"{place}, line 4: three Fortran formats expected, such as `(8I10) (8I10) (3E25.16)`. Write it again."
        )
    return _Header(
        lines=(counts[1], counts[2], counts[3]),
        kind=kind,
        shape=(rows, columns),
        entries=entries,
        formats=tuple((int(field[1] or 1), int(field[2])) for field in fields if field),
        length=5 if len(counts) > 4 and counts[4] > 0 else 4,
    )


def _numbers(place: str, lines: list[str], fields: tuple[int, int], kind: type, wanted: int) -> np.ndarray:
    """The numbers of some lines at this place, in `fields`: so many of one width."""
    # No line has more fields than characters.
    count, width = min(fields[0], max(map(len, lines), default=0)), fields[1]
    words = " ".join(lines).split()
    if len(words) != wanted:  # fields that touch each other
        fields_read = (line[k * width : (k + 1) * width] for line in lines for k in range(count))
        words = [field.strip() for field in fields_read if field.strip()]
    if len(words) != wanted:
        raise ValueError(f"{place}: {wanted} numbers expected, {len(words)} found. Write it again.")
    try:
        numbers = list(map(int, words)) if kind is int else [float(fortran_number(word)) for word in words]
        return np.array(numbers, np.int64 if kind is int else np.float64)
    except (ValueError, OverflowError) as error:
        raise ValueError(f"{place}: {error}. Write it again.") from None
