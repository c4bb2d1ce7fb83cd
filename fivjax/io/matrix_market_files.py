"""Matrix Market files: a line that says what follows, a line of sizes, and a line for each entry.

Read here, line by line as the format says (Boisvert, Pozo, Remington: The Matrix Market Exchange Formats, NISTIR 5935), because
the readers at hand believe the sizes, and pass over what is wrong: of an entry `1.0D+02` SciPy's reads 1, and of a symmetric
matrix that gives both triangles twice the entries.
"""

import io
from pathlib import Path

import numpy as np
from scipy import sparse

from .reading_limits import check_length, check_rows, unreadable
from .sparse_parts import triplets

KIND = "Matrix Market"


def read_matrix_market(path: Path) -> sparse.csr_array:
    """The matrix, with both triangles where the file gives one.

    **Raises:** `ValueError` for a file that is damaged, or whose sizes do not fit its entries.
    """
    check_length(path)
    head, _, rest = path.read_bytes().partition(b"\n")
    words = head.decode("latin-1").lower().split()
    if len(words) != 5 or words[0] != "%%matrixmarket" or words[1] != "matrix":
        raise unreadable(path, KIND, "its first line must be `%%MatrixMarket matrix`, a layout, a field and a symmetry")
    layout, field, symmetry = words[2:]
    fields = ("real", "double", "integer", "complex", "pattern")
    symmetries = ("general", "symmetric", "skew-symmetric", "hermitian")
    if layout not in ("coordinate", "array") or field not in fields or symmetry not in symmetries:
        raise unreadable(path, KIND, f"its first line ends in {' '.join(words[2:])!r}, which is not known")
    if (layout, field) == ("array", "pattern") or (symmetry == "hermitian") > (field == "complex"):
        raise unreadable(path, KIND, f"its first line ends in {' '.join(words[2:])!r}, which cannot be")
    sizes, begin = _sizes(path, rest)
    table = _table(path, rest[begin:])
    if layout == "array":
        return _array(path, table, sizes, field, symmetry)
    return _coordinates(path, table, sizes, field, symmetry)


def _sizes(path: Path, text: bytes) -> tuple[list[int], int]:
    """The numbers of the first line that is neither empty nor a comment, and where the lines after it begin."""
    begin = 0
    while begin < len(text):
        end = text.find(b"\n", begin)
        end = len(text) if end < 0 else end
        line = text[begin:end].strip()
        begin = end + 1
        if line and not line.startswith(b"%"):
            words = line.split()[:4]
            if not all(word.isdigit() and len(word) < 19 for word in words):
                raise unreadable(
                    path, KIND, f"its sizes must be whole numbers, but are {line[:60].decode('latin-1')!r}"
                )
            return [int(word) for word in words], begin
    raise unreadable(path, KIND, "it has no line of sizes")


def _table(path: Path, text: bytes) -> np.ndarray:
    if not text.strip():
        return np.zeros((0, 1))
    # Fortran writes exponents with a D.
    text = text.replace(b"D", b"E").replace(b"d", b"e")
    try:
        return np.loadtxt(io.BytesIO(text), comments="%", ndmin=2, encoding="latin-1")
    except ValueError as error:
        raise unreadable(path, KIND, f"an entry after the line of sizes is damaged ({error})") from None


def _values(path: Path, table: np.ndarray, field: str) -> np.ndarray:
    """The last columns of the lines: a number, two of a complex one, or none, which stands for 1."""
    wanted = {"complex": 2, "pattern": 0}.get(field, 1)
    if table.shape[1] != wanted:
        raise unreadable(path, KIND, f"an entry must have {wanted} numbers as its value, but has {table.shape[1]}")
    if field == "complex":
        return table[:, 0] + 1j * table[:, 1]
    return table[:, 0] if wanted else np.ones(len(table))


def _array(path: Path, table: np.ndarray, sizes: list[int], field: str, symmetry: str) -> sparse.csr_array:
    if len(sizes) != 2 or (symmetry != "general" and sizes[0] != sizes[1]):
        raise unreadable(path, KIND, f"its sizes must be rows and columns, but are {sizes}")
    rows, columns = sizes
    wanted = {"general": rows * columns, "skew-symmetric": rows * (rows - 1) // 2}.get(symmetry, rows * (rows + 1) // 2)
    if wanted != len(table):
        raise unreadable(path, KIND, f"it declares {rows} rows and {columns} columns, but {len(table)} numbers follow")
    if max(sizes) > max(wanted, 1):
        raise unreadable(path, KIND, f"it declares {rows} rows and {columns} columns")
    values = _values(path, table, field)
    if symmetry == "general":
        return sparse.csr_array(values.reshape(columns, rows).T)
    # One triangle, column by column to the last row.
    whole = np.zeros((rows, rows), values.dtype)
    whole.T[np.triu_indices(rows, int(symmetry == "skew-symmetric"))] = values
    return sparse.csr_array(whole + _mirror(np.tril(whole, -1), symmetry).T)


def _coordinates(path: Path, table: np.ndarray, sizes: list[int], field: str, symmetry: str) -> sparse.csr_array:
    if len(sizes) != 3 or (symmetry != "general" and sizes[0] != sizes[1]):
        raise unreadable(path, KIND, f"its sizes must be rows, columns and entries, but are {sizes}")
    rows, columns, count = sizes
    if count != len(table):
        raise unreadable(path, KIND, f"it declares {count} entries, but {len(table)} lines follow")
    check_rows(path, KIND, max(rows, columns), count)
    if not count:
        return sparse.csr_array((rows, columns))
    if table.shape[1] < 2:
        raise unreadable(path, KIND, "an entry must have a row and a column")
    i, j, values = table[:, 0] - 1, table[:, 1] - 1, _values(path, table[:, 2:], field)
    given = triplets(path, KIND, values, i, j, (rows, columns))
    if symmetry == "general":
        return given
    lower, upper = sparse.tril(given, -1, format="csr"), sparse.triu(given, 1, format="csr")
    both = lower.astype(bool).multiply(upper.T.astype(bool))
    if both.nnz:
        i, j = (int(index[0]) + 1 for index in both.nonzero())
        raise unreadable(path, KIND, f"it is {symmetry}, but gives row {i}, column {j} and its mirror image, too")
    return sparse.csr_array(given + _mirror(lower, symmetry).T + _mirror(upper, symmetry).T)


def _mirror(part, symmetry: str):
    return {"symmetric": part, "skew-symmetric": -part, "hermitian": part.conj()}[symmetry]
