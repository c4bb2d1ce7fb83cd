r"""The Delassus matrix $G = W^T M^{-1} W$: how contact forces accelerate the contacts, and whether sliding is unique."""

import itertools
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..foundation.kept_programs import kept
from ..foundation.linear_solve import solve
from ..foundation.precision import returning_numpy
from .contact_coordinates import check_structure
from .structure import Structure


class Delassus(NamedTuple):
    """The blocks of G, in 1/kg: the acceleration of contact i (row) by a unit force at contact j (column).

    **Example:**

        >>> fj.delassus(structure).normal.shape
        (1, 1)
    """

    tangential: Float[Array | np.ndarray, "c c"]  # G_tt
    coupling: Float[Array | np.ndarray, "c c"]  # G_tn: tangential acceleration by normal forces
    normal: Float[Array | np.ndarray, "c c"]  # G_nn

    @property
    def matrix(self) -> Float[Array | np.ndarray, "k k"]:
        """All of G: tangential directions first, then normal ones."""
        xp = jnp if isinstance(self.normal, Array) else np
        return xp.concatenate(
            [
                xp.concatenate([self.tangential, self.coupling], axis=1),
                xp.concatenate([self.coupling.T, self.normal], axis=1),
            ]
        )


@returning_numpy
def delassus(structure: Structure) -> Delassus:
    r"""The Delassus matrix of a structure's contacts, $G = W^T M^{-1} W$ with $W = [W_t, W_n]$.

    **Example:**

        >>> G = fj.delassus(structure)
        >>> round(float(G.normal[0, 0] / abs(G.coupling[0, 0])), 2)  # Painlevé's limit
        108.49
    """
    check_structure(structure)
    return _delassus(structure)


@kept
def _delassus(structure: Structure) -> Delassus:
    count = len(structure.contacts)
    w = jnp.concatenate([structure.tangential_directions, structure.normal_directions], axis=1)
    g = w.T @ solve(structure.mass, w)
    g = 0.5 * (g + g.T)
    return Delassus(g[:count, :count], g[:count, count:], g[count:, count:])


def has_one_solution(g: Delassus, friction: np.ndarray) -> bool:
    r"""Whether sliding has a unique solution for all friction coefficients up to these, by NumPy.

    Sliding contacts obey $(G_{nn} + G_{nt} D) N = -a_n$ with $D = \mathrm{diag}(σ_i μ_i)$. A solution with $N ≥ 0$ (contacts
    that would need less lift off) is unique for every right-hand side if the matrix is a P-matrix: all principal minors
    positive. These are linear in each $σ_i μ_i$, so it is enough to check $±μ_i$. For one contact this is
    $μ < G_{nn}/|G_{nt}|$ (Painlevé).

    **Raises:** `ValueError` for more contacts than can be checked, unless the coupling is so small that no check is needed.
    """
    # All subsets of contacts are checked in all directions of slip: at most 65,536 determinants for eight contacts.
    most_contacts = 8
    g = Delassus(*map(np.asarray, g))
    count = len(friction)
    scale = 1 / np.sqrt(np.diag(g.normal))
    normal, coupling = scale[:, None] * g.normal * scale, scale[:, None] * g.coupling.T * scale
    # With a positive definite symmetric part all principal minors are positive.
    if np.linalg.eigvalsh(normal)[0] > np.linalg.norm(coupling * friction, 2):
        return True
    if count > most_contacts:
        raise ValueError(
            f"Whether friction on {count} contacts leaves one answer cannot be decided for more than {most_contacts} contacts "
            f"that are this strongly coupled in the mass matrix. Lower the friction, or take fewer contacts."
        )
    signs = np.array(list(itertools.product((1.0, -1.0), repeat=count)))
    matrices = normal + coupling * (signs * friction)[:, None, :]
    subsets = itertools.chain.from_iterable(itertools.combinations(range(count), k) for k in range(1, count + 1))
    return all(np.all(np.linalg.det(matrices[:, np.ix_(s, s)[0], np.ix_(s, s)[1]]) > 0) for s in map(list, subsets))
