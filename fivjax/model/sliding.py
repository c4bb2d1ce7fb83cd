r"""Sliding as a projection of the structure: the normal coordinate is held, and friction joins the tangential row (Eq. 3).

While a contact slides, its normal coordinate stays at zero and that row gives the normal force $N$. Friction
$T = σμN$ then adds $-σμ$ times that row to the tangential one; of several contacts, all slide.
Everything that needs the matrices, the coordinates or the load of the sliding motion takes them from here. Without friction
($μ = 0$) they are the structure's own without the normal rows and columns.
"""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .structure import Structure

# A coordinate, or those of several contacts.
Places = int | np.ndarray


def contact_coordinates(structure: Structure) -> tuple[Places, Places]:
    """The tangential and the normal coordinate of a structure's contact; with several contacts, an array of each."""
    if len(structure.places) == 1:
        return structure.tangential, structure.normal
    tangential, normal = zip(*structure.places, strict=True)
    return np.array(tangential), np.array(normal)


def sliding_coordinates(size: int, normal: Places) -> np.ndarray:
    """The coordinates that sliding leaves free: all but the normal ones."""
    return np.delete(np.arange(size), normal)


def free_in_sliding(structure: Structure) -> np.ndarray:
    """The coordinates of a structure that sliding at all its contacts leaves free."""
    return sliding_coordinates(structure.size, contact_coordinates(structure)[1])


def sliding_states(size: int, normal: Places) -> np.ndarray:
    """Places of these coordinates in a state: displacements first, then velocities."""
    free = sliding_coordinates(size, normal)
    return np.concatenate([free, size + free])


def sliding_rows(
    structure: Structure, matrix: Float[Array, "n k"], friction: Float[Array, "*contacts"]
) -> Float[Array, "m k"]:
    """Rows of the sliding motion: the structure's without the normal ones, each tangential row less σμ times its normal row.

    `friction` is σμ: the coefficient with the sign of the belt's direction, 0 for motion without friction; one number, or
    one for each of several contacts.
    """
    tangential, normal = contact_coordinates(structure)
    index = np.arange(structure.size)
    if isinstance(tangential, np.ndarray):
        pulls = jnp.asarray(index[:, None] == tangential, matrix.dtype) * friction
        return (matrix - pulls @ matrix[normal])[free_in_sliding(structure)]
    # A product with a constant rather than an update in place: in a batch it stays elementwise.
    along = jnp.asarray(index == tangential, matrix.dtype)[:, None]
    return (matrix - along * (friction * matrix[normal]))[free_in_sliding(structure)]


def sliding_matrices(
    structure: Structure, friction: Float[Array, "*contacts"]
) -> tuple[Float[Array, "m m"], Float[Array, "m m"], Float[Array, "m m"]]:
    """M, C and K of the sliding motion (Eq. 3) under constant friction σμ, in kg, N·s/m and N/m."""
    free = free_in_sliding(structure)
    mass, damping, stiffness = (sliding_rows(structure, matrix, friction)[:, free] for matrix in structure.matrices[:3])
    return mass, damping, stiffness


def sliding_load(structure: Structure, friction: Float[Array, "*contacts"]) -> Float[Array, " m"]:
    """The share of a unit load that each row of the sliding motion carries (F of Eq. 3), without unit."""
    return sliding_rows(structure, structure.load_direction[:, None], friction)[:, 0]
