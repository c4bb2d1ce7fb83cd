"""Where a structure may touch the belt: a tangential and a normal direction for each contact.

A direction is a coordinate or any vector: a column of $W_t$ or $W_n$. The slip velocity of contact $i$ is $w_{t,i}^T \\dot q$
(less the belt's speed), its gap $w_{n,i}^T q$.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ..foundation import arguments
from ..foundation.precision import is_known
from .matrix_checks import check_index

Direction = int | str | np.ndarray


@dataclass(frozen=True, eq=False)
class ContactPoint:
    """One contact of a structure.

    **Arguments:** `tangential` (along the belt) and `normal` (the gap, positive away from the belt), each the index of a
    coordinate, its name, or a vector `(n,)` without unit.

    **Raises:** `TypeError` for anything else. Shapes and names are checked by the `Structure` that the contact belongs to.

    **Example:**

        >>> pads = [fj.ContactPoint(tangential=0, normal=2), fj.ContactPoint(tangential=1, normal=3)]
        >>> disc = fj.Structure(np.eye(4), np.zeros((4, 4)), np.eye(4), [0.0, 0.0, -1.0, -1.0], contacts=pads)
        >>> len(disc.contacts)
        2
    """

    tangential: Direction
    normal: Direction

    def __post_init__(self):
        for name in ("tangential", "normal"):
            value = getattr(self, name)
            if isinstance(value, str) or arguments.is_whole(value):
                continue
            if not is_known(value):
                raise TypeError(
                    f"Argument `{name}` must be known when the contact is made, not a value under a JAX transformation."
                )
            array = arguments.numeric_array(name, value)
            if array.ndim != 1:
                raise TypeError(
                    f"Argument `{name}` must be a coordinate's index or name, or a vector, but is {arguments.describe(value)}."
                )
            object.__setattr__(self, name, array.astype(np.float64))

    def __repr__(self) -> str:
        def text(value):
            return np.array2string(value, separator=", ") if isinstance(value, np.ndarray) else repr(value)

        return f"ContactPoint(tangential={text(self.tangential)}, normal={text(self.normal)})"


def resolve_contacts(contacts, names: tuple[str, ...]) -> tuple[ContactPoint, ...]:
    """The contacts with their directions as indices where these are coordinates, else as vectors."""
    n = len(names)
    if isinstance(contacts, ContactPoint):
        contacts = (contacts,)
    if not isinstance(contacts, Sequence) or not all(isinstance(contact, ContactPoint) for contact in contacts):
        raise TypeError(
            "Argument `contacts` must be a list of contacts, such as [ContactPoint(tangential=0, normal=2)], but is "
            f"{arguments.describe(contacts)}."
        )
    if not contacts:
        raise ValueError("Argument `contacts` must hold at least one contact, but is empty.")

    def resolve(name: str, value: Direction) -> int | np.ndarray:
        if isinstance(value, str):
            if value not in names:
                raise ValueError(
                    f"Argument `{name}` must be the index or name of a coordinate ({', '.join(names)}), but is {value!r}."
                    f"{arguments.did_you_mean(value, names)}"
                )
            return names.index(value)
        if not isinstance(value, np.ndarray):
            return check_index(name, value, n)
        if value.shape != (n,) or not np.all(np.isfinite(value)) or not np.any(value):
            raise ValueError(
                f"Argument `{name}` must be a finite vector of shape ({n},) that is not zero, but is {value.tolist()}."
            )
        is_coordinate = np.count_nonzero(value) == 1 and np.max(value) == 1
        return int(np.argmax(value)) if is_coordinate else value

    found = tuple(
        ContactPoint(resolve("tangential", contact.tangential), resolve("normal", contact.normal))
        for contact in contacts
    )
    chosen = [direction for contact in found for direction in (contact.tangential, contact.normal)]
    if all(isinstance(direction, int) for direction in chosen) and len(set(chosen)) == len(chosen):
        return found
    columns = np.concatenate(directions(found, n), axis=1)
    if np.linalg.matrix_rank(columns / np.linalg.norm(columns, axis=0)) < columns.shape[1]:
        if len(found) == 1 and all(isinstance(direction, int) for direction in chosen):
            raise ValueError(
                f"Arguments `tangential` and `normal` must name two different coordinates, but both are {found[0].normal}."
            )
        raise ValueError(
            "Argument `contacts` must hold directions that are linearly independent, two for each contact, but some of them "
            "follow from the others. Contact forces would not be unique."
        )
    return found


def directions(contacts: Sequence[ContactPoint], n: int) -> tuple[np.ndarray, np.ndarray]:
    """$W_t$ and $W_n$, each (n, contacts): the directions as columns."""

    def column(direction: Direction) -> np.ndarray:
        return np.arange(n) == direction if isinstance(direction, int) else np.asarray(direction)

    tangential = np.stack([column(contact.tangential) for contact in contacts], axis=1)
    normal = np.stack([column(contact.normal) for contact in contacts], axis=1)
    return tangential.astype(np.float64), normal.astype(np.float64)


def pivots(columns: np.ndarray) -> list[int]:
    """For each column the row of its pivot in Gaussian elimination: the coordinate that this direction may replace."""
    left, rows = columns / np.linalg.norm(columns, axis=0), []
    for k in range(left.shape[1]):
        sizes = np.abs(left[:, k])
        sizes[rows] = -1.0
        row = int(np.argmax(sizes))
        left[:, k + 1 :] -= np.outer(left[:, k] / left[row, k], left[row, k + 1 :])
        rows.append(row)
    return rows
