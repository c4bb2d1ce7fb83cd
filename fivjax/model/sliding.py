r"""Sliding as a projection of the structure: the normal coordinate is held, and friction joins the tangential row (Eq. 3).

While the contact slides, the normal coordinate stays at zero and its row gives the normal force $N$. Friction
$T = σμN$ then adds $-σμ$ times that row to the tangential one. Everything that needs the sliding motion's matrices, its
coordinates or its load takes them from here; without friction ($μ = 0$) they are the structure's own, normal row left out.
"""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .structure import Structure


def sliding_coordinates(size: int, normal: int) -> np.ndarray:
    """The coordinates that sliding leaves free: all but the normal one."""
    return np.delete(np.arange(size), normal)


def sliding_states(size: int, normal: int) -> np.ndarray:
    """Places of the same coordinates in a state: displacements first, then velocities."""
    free = sliding_coordinates(size, normal)
    return np.concatenate([free, size + free])


def sliding_rows(structure: Structure, matrix: Float[Array, "n k"], friction: Float[Array, ""]) -> Float[Array, "m k"]:
    """Rows of the sliding motion: the structure's without the normal one, the tangential row less σμ times the normal row.

    `friction` is σμ: the coefficient with the sign of the belt's direction, 0 for motion without friction.
    """
    # A product with a constant rather than an update in place: in a batch it stays elementwise.
    tangential = jnp.asarray(np.arange(structure.size) == structure.tangential, matrix.dtype)[:, None]
    return (matrix - tangential * (friction * matrix[structure.normal]))[
        sliding_coordinates(structure.size, structure.normal)
    ]


def sliding_matrices(
    structure: Structure, friction: Float[Array, ""]
) -> tuple[Float[Array, "m m"], Float[Array, "m m"], Float[Array, "m m"]]:
    """M, C and K of the sliding motion (Eq. 3) under constant friction σμ, in kg, N·s/m and N/m."""
    free = sliding_coordinates(structure.size, structure.normal)
    mass, damping, stiffness = (sliding_rows(structure, matrix, friction)[:, free] for matrix in structure.matrices[:3])
    return mass, damping, stiffness


def sliding_load(structure: Structure, friction: Float[Array, ""]) -> Float[Array, " m"]:
    """The share of a unit load that each row of the sliding motion carries (F of Eq. 3), without unit."""
    return sliding_rows(structure, structure.load_direction[:, None], friction)[:, 0]
