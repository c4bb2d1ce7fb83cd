"""A matrix as a file gives it, with the node and direction of its rows; and how it is made from single entries."""

import re
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy import sparse

from .reading_limits import check_length


class Label(NamedTuple):
    """A degree of freedom of a finite-element model: a node and a direction, 1–3 along x, y, z and 4–6 about them."""

    node: int
    direction: int

    def __str__(self) -> str:
        # Direction 0: a scalar point, or a row that the file only numbers.
        return f"node {self.node}, direction {self.direction}" if self.direction else f"point {self.node}"


class FileMatrix(NamedTuple):
    """A matrix of a file, in the file's units.

    - `matrix`: sparse, real, square.
    - `labels`: what node and direction its rows and columns belong to; None where the file does not say.
    - `place`: the file, and the matrix in it, for sentences about it.
    - `rows`: the numbers of its rows where the file has only those, negative for internal ones; rows without entries are not
      there.
    """

    matrix: sparse.csr_array
    labels: tuple[Label, ...] | None
    place: str
    rows: tuple[int, ...] | None = None

    @property
    def size(self) -> int:
        """Number of rows."""
        return self.matrix.indptr.size - 1


def text_of(path: Path) -> str:
    """The text of a file.

    **Raises:** `ValueError` for a file that is no text.
    """
    check_length(path)
    content = path.read_bytes()
    if b"\0" in content:
        raise ValueError(f"File `{path}` is not text: byte {content.index(0)} is zero. Write it as text, or again.")
    return content.decode("utf-8", errors="replace")


def integer(place: str, field: str) -> int:
    """The whole number in a field of a file, at this place."""
    try:
        return int(field)
    except ValueError:
        raise ValueError(f"{place}: {field!r} is no whole number. Write the file again, or mend the line.") from None


def real(place: str, field: str) -> float:
    """The finite number in a field of a file, at this place."""
    try:
        value = float(fortran_number(field))
    except ValueError:
        raise ValueError(f"{place}: {field!r} is no number. Write the file again, or mend the line.") from None
    if not np.isfinite(value):
        raise ValueError(f"{place}: must be finite, but is {field}. Write the file again.")
    return value


def fortran_number(field: str) -> str:
    """A number as Fortran writes it, as others do: it may have a D for the E, or leave it out; 1.5+3 is 1500."""
    return re.sub(r"(?<=[\d.])([+-]\d+)$", r"E\1", field.upper().replace("D", "E"))


def from_entries(
    place: str,
    rows: list[Label] | np.ndarray,
    columns: list[Label] | np.ndarray,
    values: np.ndarray,
    *,
    lines: np.ndarray,
    symmetric: bool | None,
) -> FileMatrix:
    """A matrix from its entries: row label, column label and value of each.

    `symmetric`: whether the file gives one triangle of a symmetric matrix; None where it does not say. Then the entries are
    taken for one triangle if no pair of labels comes in both orders.

    **Raises:** `ValueError` for an entry that comes twice; and, where the file does not say whether it gives one triangle, for
    a matrix with some pairs in both orders and others in only one.
    """
    rows, columns = _labels(place, rows), _labels(place, columns)
    table, index = np.unique(np.concatenate([rows, columns]), axis=0, return_inverse=True)
    index = index.ravel()
    labels = tuple(Label(int(node), int(direction)) for node, direction in table)
    n, i, j = len(labels), index[: len(rows)], index[len(rows) :]
    # Each pair of labels as one number, the same for both orders.
    ordered, pair = i * n + j, np.minimum(i, j) * n + np.maximum(i, j)
    _twice(place, labels, ordered, i, j, lines)
    off = i != j
    _, times = np.unique(pair[off], return_counts=True)
    if symmetric and np.any(times == 2):
        both = pair[off][np.isin(pair[off], np.unique(pair[off])[times == 2])][0]
        raise ValueError(
            f"{place}: a symmetric matrix must give each pair of labels once, but gives {labels[both // n]} with "
            f"{labels[both % n]} in both orders. Give one triangle, or mark it as not symmetric."
        )
    if symmetric is None:
        symmetric = not np.any(times == 2)
        if not symmetric and np.any(times == 1):
            single = np.unique(pair[off])[times == 1][0]
            raise ValueError(
                f"{place}: some pairs of labels come in both orders, but {labels[single // n]} with "
                f"{labels[single % n]} comes in one. Write one triangle, or all of the matrix."
            )
    if symmetric:
        i, j, values = np.append(i, j[off]), np.append(j, i[off]), np.append(values, values[off])
    return FileMatrix(sparse.csr_array((values, (i, j)), shape=(n, n)), labels, place)


def _labels(place: str, labels) -> np.ndarray:
    # As floating-point numbers first: too large ones cannot be kept as whole ones, and wrap around.
    table = np.asarray(labels, np.float64).reshape(-1, 2)
    # Of a node or direction: finite-element codes number with 32 bits.
    largest_label = 2**31 - 1
    if np.any(np.abs(table) > largest_label):
        raise ValueError(
            f"{place}: nodes and directions must be at most {largest_label}, but {np.abs(table).max():.17g} is there. Write "
            f"the file again."
        )
    return table.astype(np.int64)


def _twice(place, labels, ordered, i, j, lines) -> None:
    order = np.argsort(ordered, kind="stable")
    same = np.flatnonzero(np.diff(ordered[order]) == 0)
    if same.size:
        first, second = order[same[0]], order[same[0] + 1]
        raise ValueError(
            f"{place}, line {lines[second]}: the entry of {labels[i[first]]} and {labels[j[first]]} is there twice, first "
            f"on line {lines[first]}. Write the assembled matrix, each entry once."
        )
