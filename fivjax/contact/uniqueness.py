r"""Whether sliding has a unique solution under any load: the P-matrix test, in JAX, for batches of scenes.

Sliding contacts obey $(G_{nn} + G_{nt} D) N = -a_n$ with $D = \mathrm{diag}(σ_i μ_i)$. A solution with $N ≥ 0$ is unique for
every right-hand side only if all principal minors are positive (else: Painlevé's paradox). They are linear in each $σ_i μ_i$,
so it is enough to check $±μ_i$. `model.delassus_matrix` has the same test for one structure, by NumPy.
"""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from ..foundation.linear_solve import determinant
from .mechanics import Mechanics
from .mode import Contact, Status

# Up to `ALL` contacts, all principal minors are checked; with more contacts, those of up to `TOGETHER` contacts at a time.
ALL, TOGETHER = 4, 3


def slides_uniquely(mechanics: Mechanics) -> Bool[Array, ""]:
    """Whether the matrix of sliding is a P-matrix for all directions of slip. With more than `ALL` contacts it may say so
    although a principal minor of more than `TOGETHER` contacts is not positive.
    """
    # Every motion that slides or comes to rest passes through these slip speeds.
    largest = mechanics.friction.largest(jnp.abs(mechanics.belt_speed))
    if not mechanics.several:
        one = jnp.ones_like(largest)
        return (mechanics.normal_compliance(one, largest) > 0) & (mechanics.normal_compliance(-one, largest) > 0)
    _, g_tn, g_nn = mechanics.compliance
    count, dragged = len(mechanics.places), g_tn.T * largest
    unique, determinants = jnp.ones((), bool), jax.vmap(jax.vmap(determinant))
    for size in range(1, 1 + (count if count <= ALL else TOGETHER)):
        subsets = np.array(list(itertools.combinations(range(count), size)))
        signs = np.array(list(itertools.product((1.0, -1.0), repeat=size)))
        rows, columns = subsets[:, :, None], subsets[:, None, :]
        matrices = g_nn[rows, columns] + dragged[rows, columns] * signs[:, None, None, :]
        unique = unique & jnp.all(determinants(matrices) > 0)
    return unique


def is_beyond_the_model(mechanics: Mechanics, contact: Contact, mu: Float[Array, "*contacts"]) -> Bool[Array, ""]:
    """Whether the law has led a sliding contact to where there is no motion: to negative friction, or past Painlevé's limit."""
    compliance = mechanics.normal_compliance(contact.direction, mu)
    if mechanics.several:
        compliance = jnp.diagonal(compliance)
    return jnp.any((contact.status == Status.SLIDE) & ~((compliance > 0) & (mu >= 0)))
