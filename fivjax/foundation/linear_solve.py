"""Products of a matrix and a vector, linear systems and determinants by elimination, without LAPACK.

In a batch every operation here acts on all systems at once and fuses with its neighbours, on any device. LAPACK is called
system by system instead. Worse, its calls can wait for each other for ever: those of jaxlib 0.10.0 to 0.10.2 share a batch out
to XLA's pool of threads and wait for it, inside a thread of that pool. As many such calls at a time as the pool has threads,
in one program or in several, hold all of them (`tests/foundation/test_standstill.py`). See `matrix_routines` for what is
left to LAPACK.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Inexact

# Larger systems are eliminated in a loop: written out, they would take longer to compile than to solve.
LARGEST = 4


def product(matrix: Inexact[Array, "m n"], vector: Inexact[Array, " n"]) -> Inexact[Array, " m"]:
    """A matrix times a vector. Small ones as a sum over columns: in a batch this becomes one fused loop over trajectories."""
    # Products with vectors up to this length are written as sums over columns.
    largest_by_columns = 12
    if len(vector) > largest_by_columns:
        return matrix @ vector
    total = matrix[:, 0] * vector[0]
    for j in range(1, len(vector)):
        total = total + matrix[:, j] * vector[j]
    return total


def solve(matrix: Inexact[Array, "n n"], right: Inexact[Array, " n *k"]) -> Inexact[Array, " n *k"]:
    """The solution of a linear system, by Gauss–Jordan elimination with partial pivoting.

    Not finite for a singular matrix. A derivative takes one more solution; the elimination itself is not differentiated.
    """
    return jax.lax.custom_linear_solve(
        lambda x: matrix @ x,
        right,
        lambda _, b: _in_columns(matrix, b),
        lambda _, b: _in_columns(matrix.T, b),
    )


def inverse(matrix: Inexact[Array, "n n"]) -> Inexact[Array, "n n"]:
    """The inverse, not finite for a singular matrix."""
    return solve(matrix, jnp.eye(matrix.shape[0], dtype=matrix.dtype))


def determinant(matrix: Inexact[Array, "n n"]) -> Inexact[Array, ""]:
    """The determinant, by Gauss elimination with partial pivoting, which is differentiated as it stands."""
    n = matrix.shape[0]
    index = np.arange(n)

    def further(k, so_far):
        product, table = so_far
        pivot, swapped, place = _pivoted(table, k)
        # What is no number has no largest entry, and so no place.
        sign = jnp.where(place == k, 1.0, jnp.where(place < n, -1.0, jnp.nan))
        product = product * pivot[k] * sign
        # A pivot of zero has nothing but zeros below it.
        shares = jnp.where(index > k, swapped[:, k], 0.0) / jnp.where(pivot[k] == 0, 1.0, pivot[k])
        return product, swapped - shares[:, None] * pivot

    return _repeated(n, further, (jnp.ones((), matrix.dtype), matrix))[0]


def eliminated(matrix: Inexact[Array | np.ndarray, "n n"], right: Inexact[Array | np.ndarray, "n k"], xp=jnp):
    """`solve` without its derivative; by NumPy, if that is `xp`."""
    n = matrix.shape[0]
    index = np.arange(n)

    # Apart from each other, because in a kernel the right side may be tangents, and the matrix none.
    def further(k, sides):
        matrix, right = sides
        pivot, swapped, place = _pivoted(matrix, k, xp)
        own, right = _with_row_at(right, k, place, xp)
        at_k, factors, divisor = (index == k)[:, None], swapped[:, k, None], pivot[k]
        pivot, own = pivot / divisor, own / divisor
        return xp.where(at_k, pivot, swapped - factors * pivot), xp.where(at_k, own, right - factors * own)

    return _repeated(n, further, (matrix, right), xp)[1]


@jax.jit
def fivjax_elimination(matrix, right):
    # A call of its own, which is traced once: that takes longer than most of what is around it.
    return eliminated(matrix, right)


def is_elimination(equation) -> bool:
    """Whether an equation of a traced function is `fivjax_elimination` of one system, not of a batch of some."""
    own = equation.params.get("name") == fivjax_elimination.__name__
    return own and all(variable.aval.ndim == 2 for variable in equation.invars)


def _in_columns(matrix, right):
    return fivjax_elimination(matrix, right.reshape(right.shape[0], -1)).reshape(right.shape)


def _pivoted(table, k, xp=jnp):
    """The pivot's row in column k, the table with row k in its place, and that place. (Row k itself is left where it was, too:
    nobody reads it there.)
    """
    index = np.arange(table.shape[0])
    size = xp.where(index >= k, xp.abs(table[:, k]), -1.0)
    # By sums and comparisons, because indices that differ within a batch would be gathered system by system.
    place = xp.min(xp.where(size == xp.max(size), index, table.shape[0]))
    return *_with_row_at(table, k, place, xp), place


def _with_row_at(table, k, place, xp):
    """The row at a place, and the table with row k there."""
    chosen = (np.arange(table.shape[0]) == place)[:, None]
    return xp.sum(xp.where(chosen, table, 0.0), axis=0), xp.where(chosen, table[k], table)


def _repeated(count: int, further, value, xp=jnp):
    """`further(k, value)` for each k below a count: written out for a few, else in a loop."""
    if count > LARGEST and xp is jnp:
        return jax.lax.fori_loop(0, count, further, value)
    for k in range(count):
        value = further(k, value)
    return value
