"""Small linear systems by elimination, written out.

In a batch every operation here acts on all systems at once and fuses with its neighbours, on any device.
`jax.numpy.linalg.solve` calls LAPACK system by system instead. Worse, two such calls in one compiled batch of some ten
thousand systems can wait for each other for ever (jaxlib 0.10.2 on two cores: batched triangular solves share a pool of
threads and block it).
"""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Inexact

# For larger systems LAPACK is the better choice, and batches of them are small.
LARGEST = 10


def solve(matrix: Inexact[Array, "n n"], right: Inexact[Array, " n *k"]) -> Inexact[Array, " n *k"]:
    """The solution of a linear system, by Gauss–Jordan elimination with partial pivoting.

    Not finite for a singular matrix. A derivative takes one more solution; the elimination itself is not differentiated.
    """
    if matrix.shape[0] > LARGEST:
        return jnp.linalg.solve(matrix, right)
    return jax.lax.custom_linear_solve(
        lambda x: matrix @ x,
        right,
        lambda _, b: _eliminated(matrix, b),
        lambda _, b: _eliminated(matrix.T, b),
    )


def _eliminated(matrix, right):
    n = matrix.shape[0]
    table = jnp.concatenate([matrix, right.reshape(n, -1)], axis=1)
    index = np.arange(n)
    for k in range(n):
        size = jnp.where(index >= k, jnp.abs(table[:, k]), -1.0)
        largest = size == jnp.max(size)
        largest = largest & (jnp.cumsum(largest) == 1)
        pivot = jnp.sum(jnp.where(largest[:, None], table, 0.0), axis=0)
        table = jnp.where(largest[:, None], table[k], table)
        pivot = pivot / pivot[k]
        table = jnp.where((index == k)[:, None], pivot, table - table[:, k, None] * pivot)
    return table[:, n:].reshape(right.shape)


def inverse(matrix: Inexact[Array, "n n"]) -> Inexact[Array, "n n"]:
    """The inverse, not finite for a singular matrix."""
    return solve(matrix, jnp.eye(matrix.shape[0], dtype=matrix.dtype))
