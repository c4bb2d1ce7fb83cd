"""The proof of a limit cycle for several contacts: the directions that section and contact modes leave free.

With one contact these are coordinates. With several, the section is a weighted sum of velocities, and the free directions are a
subspace; a basis of it, orthonormal in weighted coordinates, takes the place of the coordinates.
"""

import numpy as np
from jaxtyping import Float, Int

from ..contact import Status
from .capture import LARGEST, SHELLS, Trial, adapted_norm, directions


def free_directions(
    weights: Float[np.ndarray, " state"],
    section: Float[np.ndarray, " n"],
    tangential: Int[np.ndarray, " c"],
    normal: Int[np.ndarray, " c"],
    status: Int[np.ndarray, " c"],
) -> Float[np.ndarray, "state f"]:
    """Orthonormal weighted directions in which the section and the contact modes leave the state free.

    `section` has the weights of the velocities whose sum is zero on the section (`steppers.section`).
    """
    n = len(section)
    closed, sticking = normal[status != Status.DETACH], tangential[status == Status.STICK]
    held = np.eye(2 * n)[np.concatenate([closed, n + closed, n + sticking])]
    rows = np.concatenate([held, np.concatenate([np.zeros(n), section / weights[n:]])[None]])
    _, sizes, turned = np.linalg.svd(rows)
    return turned[np.sum(sizes > 1e-12 * sizes[0]) :].T


def trial_of_several(
    centre: Float[np.ndarray, " state"],
    status: Int[np.ndarray, " c"],
    direction: Float[np.ndarray, " c"],
    jacobian: Float[np.ndarray, "state state"],
    weights: Float[np.ndarray, " state"],
    basis: Float[np.ndarray, "state f"],
) -> Trial | None:
    """`capture.trial` with a `basis` of free directions; None if the cycle is not stable by a margin.

    Uncoupled oscillators have a second multiplier of 1, for a shift in time between them, so there is no check to make.
    """
    found = adapted_norm(basis.T @ (weights[:, None] * jacobian / weights) @ basis)
    size = float(np.linalg.norm(weights * centre))
    if found is None or size == 0:
        return None
    root, rate = found
    shells = np.concatenate([share * directions(basis.shape[1]) for share in SHELLS])
    steps = np.linalg.solve(root, shells.T).T @ basis.T / weights
    norm = np.concatenate([root @ basis.T, np.eye(len(weights)) - basis @ basis.T]) * weights
    return Trial(
        centre, status, direction, norm, steps, np.linalg.norm(shells, axis=1), 0.5 * (1 + rate), LARGEST * size
    )
