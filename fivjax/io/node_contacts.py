"""Contacts and loads of a finite-element model, by node and direction."""

import csv
import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from ..foundation import arguments
from ..model.sparse_structure import AXES
from .file_matrix import Label, text_of
from .files import check_there

# Columns of a file of contacts; the last one may be missing.
COLUMNS = ("node", "along", "away", "against")


@dataclasses.dataclass(frozen=True)
class NodeContact:
    """A contact of a finite-element model: a node, and its directions along the belt and away from it.

        fj.NodeContact(17, tangential="x", normal="-z")
        fj.NodeContact(17, tangential="x", normal="-z", against=903)

    - `node`: the node in contact. Its displacement along `normal` is the gap, positive away from the belt or from `against`.
    - `tangential`, `normal`: "x", "-z" and so on, a direction 1 to 6, or three numbers along x, y and z (made a unit vector).
    - `against`: the other node, where the contact is between two nodes of the structure; displacements are then those of
      `node` less those of `against`. Unless given, the node touches the belt.

    **Raises:** `TypeError` for a node that is no whole number, `ValueError` for one against itself; `read_structure` refuses
    what is no direction.

    **Example:**

        >>> contact = fj.NodeContact(17, tangential="x", normal="-z")
    """

    node: int
    tangential: str | int | Sequence[float]
    normal: str | int | Sequence[float]
    against: int | None = None

    def __post_init__(self):
        for name, node in (("node", self.node), ("against", self.against)):
            if not arguments.is_whole(node) and not (name == "against" and node is None):
                raise TypeError(f"Argument `{name}` must be the number of a node, but is {arguments.describe(node)}.")
        if self.against == self.node:
            raise ValueError(f"Argument `against` must be another node than `node`, but both are {self.node}.")
        for name in ("tangential", "normal"):
            # Lists and arrays are not compared or hashed as one.
            value = getattr(self, name)
            parts = value.tolist() if hasattr(value, "tolist") else value
            if isinstance(parts, list):
                object.__setattr__(self, name, tuple(parts))


def read_contacts(path: str | Path) -> list[NodeContact]:
    """Contacts from a file with the columns `node`, `along` and `away`, and perhaps `against`, by commas or semicolons.

    Directions are written as x, -z, a number from 1 to 6, or three numbers separated by blanks. Where `against` is empty, the
    node touches the belt. Lines that begin with # are passed over.

    **Raises:** `ValueError` with the line that cannot be used.
    """
    check_there(Path(path), " of contacts")
    lines = [
        (number, line)
        for number, line in enumerate(text_of(Path(path)).lstrip("\ufeff").splitlines(), 1)
        if line.strip() and not line.lstrip().startswith("#")
    ]
    if not lines:
        raise ValueError(f"File `{path}` of contacts is empty. Its columns are node, along, away, and perhaps against.")
    delimiter = ";" if ";" in lines[0][1] else ","
    (first, *header), *rows = (
        (number, *(field.strip() for field in next(csv.reader([line], delimiter=delimiter)))) for number, line in lines
    )
    names = [str(name).lower() for name in header]
    if len(set(names)) < len(names) or not set(COLUMNS[:3]) <= set(names) <= set(COLUMNS):
        raise ValueError(
            f"File `{path}`, line {first}: the columns must be node, along, away, and perhaps against, but are "
            f"{', '.join(names)}."
        )
    if not rows:
        raise ValueError(f"File `{path}` holds no contact. Write one in each line below the names of the columns.")
    return [_contact(f"File `{path}`, line {number}", names, fields) for number, *fields in rows]


def _contact(here: str, names: list[str], fields: list) -> NodeContact:
    if len(fields) != len(names):
        raise ValueError(
            f"{here}: {len(names)} fields expected ({', '.join(names)}), {len(fields)} found. Mend the line."
        )
    row = dict(zip(names, map(str, fields), strict=True))
    nodes, directions = {}, {}
    for name in ("node", "against"):
        text = row.get(name, "")
        if not text.isdecimal() and (text or name == "node"):
            raise ValueError(f"{here}: `{name}` must be the number of a node, but is {text!r}. Mend the line.")
        nodes[name] = int(text) if text else None
    for name in ("along", "away"):
        parts = row[name].split()
        try:
            found = (
                tuple(map(float, parts)) if len(parts) > 1 else int(parts[0]) if row[name].isdecimal() else row[name]
            )
            _components(found)
        except ValueError:
            raise ValueError(
                f"{here}: `{name}` must be a direction such as x, -z, 2 or three numbers separated by blanks, but is "
                f"{row[name]!r}. Mend the line."
            ) from None
        directions[name] = found
    return NodeContact(nodes["node"], directions["along"], directions["away"], nodes["against"])


def contact_directions(
    contacts: Sequence[NodeContact], order: tuple[Label, ...] | None, size: int
) -> tuple[np.ndarray, np.ndarray]:
    """The directions of contacts along the belt and away from it, a column for each contact."""
    tangential, normal = np.zeros((size, len(contacts))), np.zeros((size, len(contacts)))
    for number, contact in enumerate(contacts):
        arguments.instance(f"contacts[{number}]", contact, NodeContact, "an fj.NodeContact(node, tangential, normal)")
        for column, direction in ((tangential, contact.tangential), (normal, contact.normal)):
            column[:, number] = _along(contact.node, direction, order, size)
            if contact.against is not None:
                column[:, number] -= _along(contact.against, direction, order, size)
        if abs(tangential[:, number] @ normal[:, number]) > 1e-9:
            raise ValueError(
                f"Argument `contacts[{number}]` must have a tangential direction at right angles to its normal one, but has "
                f"{contact.tangential!r} and {contact.normal!r}."
            )
    return tangential, normal


def load_direction(load: Mapping, order: tuple[Label, ...] | None, size: int) -> np.ndarray:
    """Each coordinate's share of a positive load, without unit."""
    found = np.zeros(size)
    for place, share in load.items():
        if not isinstance(place, tuple) or len(place) != 2:
            raise ValueError(
                f"Argument `load` must have pairs of a node and a direction, such as (903, 'z'), but has {place!r}."
            )
        node, direction = place
        arguments.real_number(f"load[{node}, {direction!r}]", share)
        found += share * _along(node, direction, order, size)
    return found


def _along(node: int, direction, order, size: int) -> np.ndarray:
    """The unit displacement of a node in a direction, as a vector of all coordinates."""
    if order is None:
        raise ValueError(
            f"Node {node} cannot be found: the matrices name no nodes. Say which row is which with `labels`."
        )
    places = {label.direction: place for place, label in enumerate(order) if label.node == node}
    if not places:
        first = next((label.node for label in order if label.node > 0), order[0].node)  # after the internal ones
        raise ValueError(f"Node {node} is not in the matrices, which have nodes {first} to {order[-1].node}.")
    found = np.zeros(size)
    for axis, share in _components(direction).items():
        if axis not in places:
            raise ValueError(
                f"Node {node} has no direction {axis} in the matrices (held, perhaps); it has: "
                f"{', '.join(map(str, places))}."
            )
        found[places[axis]] += share
    return found


def _components(direction) -> dict[int, float]:
    if isinstance(direction, str):
        name, sign = direction.strip().lstrip("+-").lower(), -1.0 if direction.strip().startswith("-") else 1.0
        if name in AXES:
            return {AXES[name]: sign}
    elif arguments.is_whole(direction):
        if 0 <= direction <= 6:
            return {int(direction): 1.0}
    elif (unit := _vector(direction)) is not None:
        return {axis + 1: float(share) for axis, share in enumerate(unit) if share != 0}
    raise ValueError(
        f"A direction must be 'x', '-z' and so on, a number from 1 to 6, or three numbers, not all zero, but is {direction!r}."
    )


def _vector(direction) -> np.ndarray | None:
    """The unit vector along three finite numbers, of which one is not zero; None for anything else."""
    try:
        numbers = np.asarray(direction)
    except ValueError:
        return None
    if numbers.shape != (3,) or numbers.dtype.kind not in "iuf":
        return None
    unit = numbers.astype(float)
    if not np.all(np.isfinite(unit)) or not np.any(unit):
        return None
    # The largest is 1 first: squares of huge numbers are none.
    unit /= np.max(np.abs(unit))
    return unit / np.linalg.norm(unit)
