"""Contacts and loads of a finite-element model, by node and direction."""

import dataclasses
from collections.abc import Mapping, Sequence

import numpy as np

from ..foundation import arguments
from .file_matrix import Label

AXES = {"x": 1, "y": 2, "z": 3}


@dataclasses.dataclass(frozen=True)
class NodeContact:
    """A contact of a finite-element model: a node, and its directions along the belt and away from it.

        fj.NodeContact(17, tangential="x", normal="-z")
        fj.NodeContact(17, tangential="x", normal="-z", against=903)

    - `node`: the node in contact. Its displacement along `normal` is the gap, positive away from the belt or from `against`.
    - `tangential`, `normal`: "x", "-z" and so on, a direction 1 to 6, or three numbers along x, y and z (made a unit vector).
    - `against`: the other node, where the contact is between two nodes of the structure; displacements are then those of
      `node` less those of `against`. Unless given, the node touches the belt.

    **Example:**

        >>> contact = fj.NodeContact(17, tangential="x", normal="-z")
    """

    node: int
    tangential: str | int | Sequence[float]
    normal: str | int | Sequence[float]
    against: int | None = None


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
    for (node, direction), share in load.items():
        arguments.real_number(f"load[{node}, {direction!r}]", share)
        found += share * _along(node, direction, order, size)
    return found


def _along(node: int, direction, order, size: int) -> np.ndarray:
    """The unit displacement of a node in a direction, as a vector of all coordinates."""
    if order is None:
        raise ValueError(f"Node {node} cannot be found: the files name no nodes. Say which row is which with `labels`.")
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
    elif isinstance(direction, int | np.integer) and not isinstance(direction, bool):
        if 0 <= direction <= 6:
            return {int(direction): 1.0}
    elif np.shape(direction) == (3,) and np.linalg.norm(direction) > 0:
        unit = np.asarray(direction, float) / np.linalg.norm(direction)
        return {axis + 1: float(share) for axis, share in enumerate(unit) if share != 0}
    raise ValueError(
        f"A direction must be 'x', '-z' and so on, a number from 1 to 6, or three numbers, but is {direction!r}."
    )
