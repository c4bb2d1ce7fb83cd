r"""Whether sliding contacts have one answer whatever acts on them: the P-matrix test, in JAX, for one of many scenes.

Sliding contacts obey $(G_{nn} + G_{nt} D) N = -a_n$ with $D = \mathrm{diag}(σ_i μ_i)$. One solution with $N ≥ 0$ for every
right-hand side needs all principal minors positive (else: Painlevé's paradox). They are linear in each $σ_i μ_i$, so the ends
decide. `model.delassus_matrix` has the same for one structure, by NumPy.
"""

import itertools

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool

from .mechanics import Mechanics

# Contacts of which all principal minors are looked at; of more contacts those of up to so many of them together.
ALL, TOGETHER = 4, 3


def slides_uniquely(mechanics: Mechanics) -> Bool[Array, ""]:
    """False where the sliding problem of some mode, in some directions of slip, is no P-matrix. Of more than `ALL` contacts it
    may be true although more than `TOGETHER` of them have none.
    """
    if not mechanics.several:
        static = mechanics.friction.static
        one = jnp.ones_like(static)
        return (mechanics.normal_compliance(one, static) > 0) & (mechanics.normal_compliance(-one, static) > 0)
    _, g_tn, g_nn = mechanics.compliance
    count, dragged = len(mechanics.places), g_tn.T * mechanics.friction.static
    unique = jnp.ones((), bool)
    for size in range(1, 1 + (count if count <= ALL else TOGETHER)):
        subsets = np.array(list(itertools.combinations(range(count), size)))
        signs = np.array(list(itertools.product((1.0, -1.0), repeat=size)))
        rows, columns = subsets[:, :, None], subsets[:, None, :]
        matrices = g_nn[rows, columns] + dragged[rows, columns] * signs[:, None, None, :]
        unique = unique & jnp.all(jnp.linalg.det(matrices) > 0)
    return unique
