"""The directions that the Poincaré section and the contact modes leave a state free.

With one contact these are coordinates. With several, the section is a weighted sum of velocities, and the free directions are a
subspace, with a basis that is orthonormal in weighted coordinates.
"""

import numpy as np
from jaxtyping import Bool, Float, Int

from ..contact import Contact, Status
from ..model.scene import Scene
from ..model.sliding import contact_coordinates
from ..steppers.section import section_weights


def zero_on_section(
    size: int, tangential: int | Int[np.ndarray, " c"], normal: int | Int[np.ndarray, " c"], status
) -> Bool[np.ndarray, "... state"]:
    """Which entries of a state on the section are zero, in a structure of `size` coordinates, by the `status` `(..., *c)`: the
    gaps of closed contacts and their rates; with one contact also its tangential velocity (with several, a weighted sum).

    They are to be exactly zero where a state is computed. A velocity just below zero, by rounding, would cross the section at
    once, as if a period had passed; a gap just above it would be open.
    """
    entries, closed = np.arange(2 * size), status != Status.DETACH
    if np.ndim(tangential) == 0:
        return (closed[..., None] & (entries % size == normal)) | (entries == size + tangential)
    return (closed[..., None] & (entries % size == np.reshape(normal, (-1, 1)))).any(-2)


def snapped_to_section(scene: Scene, y: Float[np.ndarray, " state"], contact: Contact) -> Float[np.ndarray, " state"]:
    """A state of the section that a change of coordinates has rounded: what is zero there is zero again, and what sticks has
    the belt's speed.
    """
    n, (tangential, normal) = scene.structure.size, contact_coordinates(scene.structure)
    status = np.asarray(contact.status)
    zero = zero_on_section(n, tangential, normal, status)
    if jumped_to(y, np.asarray(scene.structure.weights), section_row(n, tangential), tangential):
        zero[n + tangential] = False
    snapped = np.where(zero, 0.0, y)
    snapped[n + tangential] = np.where(status == Status.STICK, scene.belt_speed, snapped[n + tangential])
    return snapped


def section_row(size: int, tangential: int | Int[np.ndarray, " c"]) -> Float[np.ndarray, " n"]:
    """The weights of the velocities whose sum is zero on the section, in a structure of `size` coordinates."""
    row, places = np.zeros(size), np.atleast_1d(tangential)
    row[places] = section_weights(len(places))
    return row


def jumped_to(y, weights: Float[np.ndarray, " state"], section: Float[np.ndarray, " n"], tangential):
    """Which states of the section (`(..., 2n)`) are those just after an impact that made the velocity jump over zero: there it
    need not be zero. Elsewhere it is, but for rounding.
    """
    n, rounding = len(section), 1e-9
    speed = weights[n + np.atleast_1d(tangential)].max() * abs(y[..., n:] @ section)
    return speed > rounding * ((weights * y) ** 2).sum(-1) ** 0.5


def directions_of_several(
    weights: Float[np.ndarray, " state"],
    section: Float[np.ndarray, " n"],
    tangential: Int[np.ndarray, " c"],
    normal: Int[np.ndarray, " c"],
    status: Int[np.ndarray, " c"],
    without_slip: Bool[np.ndarray, " c"] | None = None,
) -> Float[np.ndarray, "state f"]:
    """With several contacts: orthonormal weighted directions that are free.

    `section` has the weights of the velocities whose sum is zero on the section (`steppers.section`). Contacts `without_slip`
    are those that stick, unless given.
    """
    n = len(section)
    closed = normal[status != Status.DETACH]
    held = tangential[status == Status.STICK if without_slip is None else without_slip]
    fixed = np.eye(2 * n)[np.concatenate([closed, n + closed, n + held])]
    rows = np.concatenate([fixed, np.concatenate([np.zeros(n), section / weights[n:]])[None]])
    _, sizes, turned = np.linalg.svd(rows)
    return turned[np.sum(sizes > 1e-12 * sizes[0]) :].T
