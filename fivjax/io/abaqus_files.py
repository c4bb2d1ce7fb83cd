"""Abaqus matrices: `*MATRIX OUTPUT` of a `*MATRIX GENERATE` step, and `*SUBSTRUCTURE MATRIX OUTPUT`.

`FORMAT=MATRIX INPUT` and `FORMAT=LABELS` write rows of row node, row direction, column node, column direction and value,
`FORMAT=COORDINATE` rows of row, column and value: no Matrix Market file, though both end in `.mtx`. Negative nodes and rows
are internal: Lagrange multipliers, and unknowns that elements have of their own. `TYPE=SYMMETRIC` gives one triangle, or both
where they agree. A substructure is written as a linear `*USER ELEMENT`: its nodes in comments, their directions, and each
matrix column by column, down to the diagonal where it is symmetric (Abaqus Keywords Reference Guide: *MATRIX INPUT,
*USER ELEMENT, *MATRIX).
"""

import io
import re
from pathlib import Path

import numpy as np
from scipy import sparse

from ..foundation.digits import apart
from .file_matrix import FileMatrix, Label, from_entries, integer, real, text_of


def matrices(path: Path) -> dict[str, FileMatrix]:
    """The matrices of an Abaqus `.mtx` file by name: one, by the file's, or `STIFFNESS` and `MASS` of a substructure."""
    text = text_of(path)
    if re.search(r"^\s*\*USER ELEMENT", text, re.IGNORECASE | re.MULTILINE):
        return _substructure(path, text)
    return {path.stem: _matrix_input(path, text)}


def _matrix_input(path: Path, text: str) -> FileMatrix:
    place, lines = f"File `{path}`", text.splitlines()
    symmetric = None
    numbers, kept = [], []
    for number, line in enumerate(lines, 1):
        stripped = line.strip()
        if stripped.startswith("*") and not stripped.startswith("**"):
            keyword, options = _keyword(stripped)
            if keyword != "MATRIX INPUT":
                raise ValueError(
                    f"{place}, line {number}: `*{keyword}` does not belong in a file of matrix entries. "
                    f"Give the file that `*MATRIX OUTPUT` wrote."
                )
            if "SCALE FACTOR" in options:
                raise ValueError(
                    f"{place}, line {number}: `SCALE FACTOR` is not read. Write the matrix with its factor applied."
                )
            symmetric = options.get("TYPE", "SYMMETRIC").startswith("SYM") or None
            if options.get("TYPE", "").startswith("UNSYM"):
                symmetric = False
        elif stripped and not stripped.startswith("**"):
            numbers.append(number)
            kept.append(stripped)
    if not kept:
        raise ValueError(f"{place} holds no matrix entries. Write it again.")
    table = _table(place, numbers, kept)
    numbers = np.array(numbers)
    count = 1 if table.shape[1] == 3 else 2
    labels, values = table[:, : 2 * count], table[:, -1]
    _whole(place, numbers, kept, labels)
    if count == 1 and np.any(labels == 0):
        line = numbers[np.argmax(np.any(labels == 0, axis=1))]
        raise ValueError(
            f"{place}, line {line}: rows and columns are numbered from 1, and internal ones from -1, but one is 0. "
            f"Write it again."
        )
    rows, columns = (_with_directions(part) for part in (labels[:, :count], labels[:, count:]))
    if symmetric:
        kept, values = _one_of_each(place, rows, columns, values, numbers)
        rows, columns, values, numbers = rows[kept], columns[kept], values[kept], numbers[kept]
    found = from_entries(place, rows, columns, values, lines=numbers, symmetric=symmetric)
    if count == 2:
        return found
    return found._replace(labels=None, rows=tuple(label.node for label in found.labels or ()))


def _with_directions(labels: np.ndarray) -> np.ndarray:
    """Pairs of node and direction; what is only numbered has direction 0."""
    with np.errstate(invalid="ignore"):  # what is no node is refused next
        found = labels.astype(np.int64)
    return found if found.shape[1] == 2 else np.hstack([found, np.zeros_like(found)])


def _one_of_each(place: str, rows, columns, values, lines) -> tuple[np.ndarray, np.ndarray]:
    """Which entries give a symmetric matrix once, and their values, where some pairs of labels may come in both orders.

    **Raises:** `ValueError` for a pair whose two entries differ.
    """
    # The two entries of a symmetric pair may differ by what a file rounds, and by what is lost in sums of much larger entries,
    # as a share of what the diagonal has.
    printed, noise = 1e-6, 1e-9
    table, index = np.unique(np.concatenate([rows, columns]), axis=0, return_inverse=True)
    i, j = index.ravel()[: len(rows)], index.ravel()[len(rows) :]
    upper, lower = np.flatnonzero(i < j), np.flatnonzero(i > j)
    _, first, second = np.intersect1d(
        i[upper] * len(table) + j[upper], j[lower] * len(table) + i[lower], return_indices=True
    )
    first, second = upper[first], lower[second]
    own = np.zeros(len(table))
    own[i[i == j]] = np.abs(values[i == j])
    a, b = values[first], values[second]
    differ = np.abs(a - b) > np.maximum(
        printed * np.maximum(np.abs(a), np.abs(b)), noise * np.sqrt(own[i[first]] * own[j[first]])
    )
    if np.any(differ):
        k = np.argmax(differ)
        here, there = sorted((first[k], second[k]), key=lambda entry: lines[entry])
        one, other = apart(values[here], values[there])
        names = [Label(int(node), int(direction)) for node, direction in table[[i[here], j[here]]]]
        raise ValueError(
            f"{place}, line {lines[there]}: the matrix is marked as symmetric, but the entry of {names[1]} and {names[0]} is "
            f"{other}, and that of {names[0]} and {names[1]} is {one} on line {lines[here]}. Give one triangle, or mark it by "
            f"`TYPE=UNSYMMETRIC`."
        )
    values = values.copy()
    values[first] = 0.5 * (a + b)
    kept = np.ones(len(values), bool)
    kept[second] = False
    return kept, values


def _keyword(line: str) -> tuple[str, dict[str, str]]:
    keyword, *options = (part.strip().upper() for part in line.lstrip("* ").split(","))
    pairs = (option.partition("=") for option in options if option)
    return keyword, {name.strip(): value.strip() for name, _, value in pairs}


def _entries(line: str) -> list[str]:
    parts = [part.strip() for part in line.split(",")] if "," in line else line.split()
    return parts[:-1] if parts and parts[-1] == "" else parts


def _table(place: str, numbers: list[int], lines: list[str]) -> np.ndarray:
    """The rows as an array with five columns, or three; read at once. Where that fails, line by line, to name the bad one."""
    try:
        width = len(_entries(lines[0]))
        text = "\n".join(lines).replace("D", "E").replace("d", "e")
        delimiter = "," if "," in lines[0] else None
        table = np.loadtxt(io.StringIO(text), delimiter=delimiter, ndmin=2, comments=None)
        if table.shape[1] == width and width in (3, 5) and np.all(np.isfinite(table)):
            return table
    except ValueError:
        pass
    rows = []
    for number, line in zip(numbers, lines, strict=True):
        entries = _entries(line)
        if len(entries) not in (3, 5):
            raise ValueError(
                f"{place}, line {number}: five entries expected (node, direction, node, direction, value), "
                f"{len(entries)} found. Write it again, or mend the line."
            )
        if rows and len(entries) != len(rows[0]):
            raise ValueError(
                f"{place}, line {number}: {len(rows[0])} entries expected, {len(entries)} found. Mend the line."
            )
        rows.append([real(f"{place}, line {number}", entry) for entry in entries])
    return np.array(rows)


def _whole(place: str, numbers: np.ndarray, lines: list[str], labels: np.ndarray) -> None:
    broken = np.flatnonzero(np.any(labels != np.round(labels), axis=1))
    if broken.size:
        raise ValueError(
            f"{place}, line {numbers[broken[0]]}: nodes and directions must be whole numbers, but the line is "
            f"{lines[broken[0]]!r}. Mend the line."
        )


def _substructure(path: Path, text: str) -> dict[str, FileMatrix]:
    """The matrices of a linear user element: nodes in comments, directions by node, matrices column by column."""
    place = f"File `{path}`"
    nodes: list[int] = []
    directions: dict[int, list[int]] = {}
    values: dict[str, list[float]] = {}
    first_line: dict[str, int] = {}
    reading, listing, symmetric, count = "", False, True, 0
    for number, line in enumerate(text.splitlines(), 1):
        stripped, here = line.strip(), f"{place}, line {number}"
        if not stripped:
            continue
        if stripped.startswith("**"):
            words = stripped.lstrip("* ")
            if words.upper().startswith("ELEMENT NODES"):
                listing = True
            elif listing and words:
                nodes += [integer(here, entry) for entry in _entries(words)]
            continue
        listing = False
        if stripped.startswith("*"):
            keyword, options = _keyword(stripped)
            if keyword == "USER ELEMENT":
                if count:
                    raise ValueError(f"{here}: a second element begins. Give one substructure in a file.")
                count = integer(here, options.get("NODES", ""))
                symmetric, reading = "UNSYMM" not in options, "directions"
            elif keyword == "MATRIX":
                reading = options.get("TYPE", "")
                if reading in values or not reading:
                    raise ValueError(f"{here}: `*MATRIX` must say a `TYPE` of its own, but is {stripped!r}.")
                values[reading], first_line[reading] = [], number
            else:
                reading = ""  # load vectors and recovery matrices are not needed
        elif reading == "directions":
            entries = [integer(here, entry) for entry in _entries(stripped)]
            # The first line is for the first node; each later one begins with the number of the first node that it is for.
            first = 1 if not directions else entries[0]
            directions[first] = entries if not directions else entries[1:]
        elif reading:
            values[reading] += [real(here, entry) for entry in _entries(stripped)]
    if len(nodes) != count:
        raise ValueError(
            f"{place} must list its {count} nodes under `** ELEMENT NODES`, but lists {len(nodes)}. Write it again."
        )
    labels, current, most = [], [], max((len(one) for one in values.values()), default=0)
    for position, node in enumerate(nodes, 1):
        current = directions.get(position, current)
        labels += [Label(node, direction) for direction in current]
        if len(labels) > max(most, 1):
            raise ValueError(
                f"{place}: its nodes have more directions than its matrices have entries, {most}. Write it again."
            )
    if len(set(labels)) != len(labels):
        double = next(label for label in labels if labels.count(label) > 1)
        raise ValueError(f"{place}: {double} is there twice. Write the substructure with each retained node once.")
    if not values:
        raise ValueError(f"{place} holds no `*MATRIX`. Write it with `STIFFNESS=YES, MASS=YES`.")
    return {
        name: FileMatrix(
            _fill(f"{place}, line {first_line[name]}: `{name}`", numbers, len(labels), symmetric),
            tuple(labels),
            f"{place}, matrix `{name}`",
        )
        for name, numbers in values.items()
    }


def _fill(place: str, values: list[float], size: int, symmetric: bool) -> sparse.csr_array:
    wanted = size * (size + 1) // 2 if symmetric else size * size
    if len(values) != wanted:
        raise ValueError(
            f"{place} must have {wanted} entries for {size} degrees of freedom, but has {len(values)}. Write it again."
        )
    if not symmetric:
        return sparse.csr_array(np.reshape(values, (size, size), order="F"))
    matrix = np.zeros((size, size))
    matrix[np.tril_indices(size)] = values
    return sparse.csr_array(matrix + np.tril(matrix, -1).T)
