"""Checks on what a structure is made of: symmetric matrices of one size, indices and names of coordinates."""

from collections.abc import Sequence

import numpy as np

from ..foundation import arguments
from ..foundation.digits import apart
from ..foundation.precision import is_known


def check_matrix(name: str, matrix, *, definite: bool) -> None:
    if not is_known(matrix):
        return
    given = arguments.numeric_array(name, matrix)
    array = given.astype(np.float64)
    if array.ndim != 2 or array.shape[0] != array.shape[1]:
        raise ValueError(f"Argument `{name}` must be a square matrix, but has shape {array.shape}.")
    if array.shape[0] < 2:
        raise ValueError(
            f"Argument `{name}` must have at least two rows (a tangential and a normal coordinate), but has "
            f"{array.shape[0]}."
        )
    if not np.all(np.isfinite(array)):
        raise ValueError(f"Argument `{name}` must be finite, but holds {array[~np.isfinite(array)][0]}.")
    # Rounding in sums of a few products; a matrix entered by hand is either symmetric or wrong by far more.
    asymmetry = np.abs(array - array.T)
    if np.any(asymmetry > 1e-9 * np.abs(array).max()):
        i, j = np.unravel_index(np.argmax(asymmetry), array.shape)
        above, below = apart(array[i, j], array[j, i])
        raise ValueError(
            f"Argument `{name}` must be symmetric, but entry ({i}, {j}) is {above} and entry ({j}, {i}) is "
            f"{below}. Friction does not belong here: give the symmetric matrix of the free structure."
        )
    # Checked after scaling the diagonal to one, so that masses of very different size do not look indefinite.
    diagonal = np.diag(array)
    scale = 1.0 / np.sqrt(np.where(diagonal > 0, diagonal, 1.0))
    # Rows first, then columns: the product of two scales of the smallest possible numbers would be infinite.
    lowest = np.linalg.eigvalsh(array * scale * scale[:, None])[0]
    if definite and lowest <= 0:
        raise ValueError(
            f"Argument `{name}` must be positive definite, but its smallest eigenvalue (diagonal scaled to one) is "
            f"{lowest:.3g}. Every coordinate needs a positive mass{_without(diagonal)}."
        )
    if lowest < -1e-9:
        rounded = given.dtype == np.float32 and lowest > -1e-6 * len(array)
        remedy = "Its entries are in single precision, whose rounding this is: give them in double precision"
        raise ValueError(
            f"Argument `{name}` must be positive semi-definite, but its smallest eigenvalue (diagonal scaled to one) "
            f"is {lowest:.3g}. {remedy if rounded else 'Negative springs or dampers are not modelled'}."
        )


def _without(diagonal: np.ndarray) -> str:
    """Which rows have no mass, and what takes them."""
    rows = np.flatnonzero(diagonal <= 0)
    if not rows.size:
        return ""
    return (
        f"; that with index {', '.join(map(str, rows[:5]))}{', …' if rows.size > 5 else ''} has none. Eliminate coordinates "
        f"without mass and Lagrange multipliers, as `fj.craig_bampton` does with what `fj.read_structure` read"
    )


def check_shapes(n: int, **matrices) -> None:
    for name, matrix in matrices.items():
        if matrix.shape != (n, n):
            raise ValueError(
                f"Argument `{name}` must have shape ({n}, {n}) to go with the mass matrix, but has shape {matrix.shape}."
            )


def check_index(name: str, index, n: int) -> int:
    if not arguments.is_whole(index):
        raise TypeError(f"Argument `{name}` must be the index of a coordinate, but is {arguments.describe(index)}.")
    if not 0 <= index < n:
        raise ValueError(
            f"Argument `{name}` must be the number of a coordinate, 0 to {n - 1} for {n} coordinates, but is {index}."
        )
    return int(index)


def check_names(names: Sequence[str] | None, n: int) -> tuple[str, ...]:
    """The names of the coordinates, q0, q1, … unless given."""
    if names is None:
        return tuple(f"q{i}" for i in range(n))
    if isinstance(names, str):
        raise TypeError(f"Argument `coordinates` must be a list of names, but is {names!r}.")
    names = arguments.listed_names("coordinates", names, "x")
    if len(names) != n or len(set(names)) != n:
        raise ValueError(f"Argument `coordinates` must hold {n} different names, but is {list(names)!r}.")
    if any("/" in name or not name for name in names):
        raise ValueError(
            f"Argument `coordinates` must hold names without `/`, as files need them, but is {list(names)!r}."
        )
    velocity = next((name for name in names if f"d{name}" in names), None)
    if velocity is not None:
        raise ValueError(
            f"Argument `coordinates` must not hold `d{velocity}`, which is the velocity of `{velocity}` in results. Call one "
            f"of them otherwise."
        )
    return tuple(names)
