"""Nastran matrices: DMIG bulk entries, as in punch files, and OUTPUT4 files.

DMIG is read here: fixed fields of 8 or 16 characters, or free fields with commas. (pyyeti reads it too, but fills a dense
matrix, and takes an entry that was cut off for zero.) OUTPUT4 in its many variants is read by pyyeti.

A DMIG matrix has a header `DMIG NAME 0 IFO TIN TOUT POLAR NCOL`, and for each column an entry `DMIG NAME GJ CJ G1 C1 A1 B1
G2 C2 A2 B2 …`, G being nodes and C directions; A is real where TIN is 1 or 2 (MSC Nastran Quick Reference Guide: DMIG).
A matrix that is neither mass nor damping nor stiffness, such as loads, is not read: in its place stands the reason.
"""

import importlib.util
import re
from pathlib import Path

import numpy as np

from . import sparse_parts
from .file_matrix import FileMatrix, Label, from_entries, integer, real, text_of
from .separate_reading import parts_of

SQUARE, SYMMETRIC = 1, 6


def dmig(path: Path) -> dict[str, FileMatrix | str]:
    """The DMIG matrices of a bulk data or punch file, by name; a sentence for each that is rectangular or complex."""
    place = f"File `{path}`"
    headers: dict[str, int | str] = {}
    entries: dict[str, list] = {}
    for line, fields in _cards(place, text_of(path)):
        here, name = f"{place}, line {line}", fields[0].upper()
        if not name:
            raise ValueError(f"{here}: a DMIG entry must name its matrix. Mend the line.")
        if fields[1] == "0":
            if name in headers:
                raise ValueError(f"{here}: matrix `{name}` has a second header. Give each matrix once.")
            headers[name] = _form(here, name, fields)
            entries[name] = []
        elif name not in headers:
            raise ValueError(f"{here}: matrix `{name}` has no header `DMIG {name} 0 …` before it. Add it.")
        elif isinstance(headers[name], int):
            entries[name] += _column(here, line, fields)
    if not headers:
        raise ValueError(f"{place} holds no DMIG entries. Write it with `EXTSEOUT(DMIGPCH)` or `PARAM,EXTOUT,DMIGPCH`.")
    found: dict[str, FileMatrix | str] = {}
    for name, form in headers.items():
        if isinstance(form, str):
            found[name] = form
            continue
        if not entries[name]:
            raise ValueError(f"{place}: matrix `{name}` has a header and no entries. Write it again.")
        rows, columns, values, lines = zip(*entries[name], strict=True)
        found[name] = from_entries(
            f"{place}, matrix `{name}`",
            rows,
            columns,
            np.array(values),
            lines=np.array(lines),
            symmetric=form == SYMMETRIC,
        )
    return found


def _form(here: str, name: str, fields: list[str]) -> int | str:
    """The form of a matrix by its header, or why it is not read."""
    form, kind = (integer(here, field) for field in fields[2:4])
    if form not in (SQUARE, SYMMETRIC):
        return (
            f"{here}: matrix `{name}` has form {form} (rectangular), but mass, damping and stiffness are square (1) or "
            f"symmetric (6). Name another matrix of the file."
        )
    if kind not in (1, 2):
        return (
            f"{here}: matrix `{name}` has type {kind}, but must be real (1 or 2). Give structural damping as a viscous "
            f"damping matrix."
        )
    return form


def _column(here: str, line: int, fields: list[str]) -> list[tuple]:
    column = _label(here, fields[1], fields[2])
    # The name and the label of the column fill the first fields; then come four for each row.
    rest = fields[4:]
    while rest and not rest[-1]:
        rest.pop()
    entries = []
    for start in range(0, len(rest), 4):
        group = [*rest[start : start + 4], "", "", ""][:4]
        if not group[2]:
            raise ValueError(f"{here}: the entry of {column} ends before its value. Write the file again.")
        entries.append((_label(here, group[0], group[1]), column, real(here, group[2]), line))
    if not entries:
        raise ValueError(f"{here}: the column of {column} has no entries. Write the file again.")
    return entries


def _cards(place: str, text: str):
    """Each DMIG card with its first line and its fields, without the word DMIG and the marks of continuation."""
    card: list[str] = []
    first_line = 0
    for number, raw in enumerate(text.splitlines(), 1):
        line = raw.split("$")[0].rstrip()
        if not line:
            continue
        if re.match(r"\s*DMIG[\s*,]", line, re.IGNORECASE):
            if card:
                yield first_line, card
            first_line, card = number, _fields(f"{place}, line {number}", line)
        elif card and line[0] in "*+, ":
            # A continuation line goes on where the line before ended.
            card += _fields(f"{place}, line {number}", line)
        elif card:
            yield first_line, card
            card = []
    if card:
        yield first_line, card


def _fields(here: str, line: str) -> list[str]:
    """The fields of a line without the first and the last, which name the card and its continuation."""
    if "," in line:
        fields = [field.strip() for field in line.split(",")]
        if any(fields[10:]):
            raise ValueError(
                f"{here}: a line has ten fields at most, but this one has {len(fields)}. Continue it on the next one."
            )
        return [*fields[1:9], *[""] * 8][:8]
    if "\t" in line:
        raise ValueError(f"{here}: tabs do not fit fixed fields. Write fields of 8 or 16 characters, or commas.")
    wide = "*" in line[:8]
    width, count = (16, 4) if wide else (8, 8)
    return [line[8 + k * width : 8 + (k + 1) * width].strip() for k in range(count)]


def _label(here: str, node: str, direction: str) -> Label:
    return Label(integer(here, node), integer(here, direction or "0"))


def output4(path: Path) -> dict[str, FileMatrix]:
    """The matrices of an OUTPUT4 file, by name; it does not say which node and direction a row belongs to.

    **Raises:** `ImportError` without pyyeti, `ValueError` for a file that is damaged.
    """
    if importlib.util.find_spec("pyyeti") is None:
        raise ImportError(
            f'File `{path}` needs pyyeti to be read. Install it with `pip install "fivjax[fe]"`, or give the '
            f"matrices as DMIG in a `.pch` file."
        )
    shapes, parts, found = {}, {}, {}
    kind = "OUTPUT4"
    for about, values in parts_of(path, "output4", kind):
        if values is None:
            shapes[about["name"]] = tuple(about["shape"])
        else:
            parts[about["name"]] = values
    for name, shape in shapes.items():
        data, rows, columns = (parts[f"{name}/{part}"] for part in ("data", "row", "col"))
        matrix = sparse_parts.triplets(path, kind, data, rows, columns, shape)
        found[name.upper()] = FileMatrix(matrix, None, f"File `{path}`, matrix `{name.upper()}`")
    if not found:
        raise ValueError(f"File `{path}` holds no matrix. Write it again.")
    return found
