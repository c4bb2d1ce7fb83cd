"""The exponential of a matrix, and orthonormal columns, without LAPACK: see `linear_solve` for why."""

import math

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from .linear_solve import solve

# The [13/13] Padé approximant of exp is exact to rounding up to this 1-norm (Higham 2005, SIAM J. Matrix Anal. 26, Table 2.3).
ORDER, LARGEST = 13, 5.371920351148152
MOST_SQUARINGS = 32


def exponential(matrix: Float[Array, "n n"]) -> Float[Array, "n n"]:
    """exp of a matrix, by scaling and squaring (Higham 2005); NaN where its 1-norm is above 2·10¹⁰."""
    norm = jax.lax.stop_gradient(jnp.max(jnp.sum(jnp.abs(matrix), axis=0)))
    squarings = jnp.maximum(jnp.ceil(jnp.log2(jnp.maximum(norm / LARGEST, 1.0))), 0.0)
    scaled = matrix * jnp.exp2(-squarings)
    square = scaled @ scaled
    even, odd = (_polynomial(square, _COEFFICIENTS[part::2]) for part in (0, 1))
    odd = scaled @ odd

    def squared(k, power):
        return jnp.where(k < squarings, power @ power, power)

    found = jax.lax.fori_loop(0, MOST_SQUARINGS, squared, solve(even - odd, even + odd))
    return jnp.where(squarings <= MOST_SQUARINGS, found, jnp.nan)


# Numerator; in the denominator the odd ones have the other sign.
_COEFFICIENTS = [
    math.factorial(2 * ORDER - k)
    * math.factorial(ORDER)
    / (math.factorial(2 * ORDER) * math.factorial(k) * math.factorial(ORDER - k))
    for k in range(ORDER + 1)
]


def _polynomial(matrix, coefficients: list[float]):
    """Σ cₖ Aᵏ, by Horner's rule."""
    unit = jnp.eye(matrix.shape[0], dtype=matrix.dtype)
    total = coefficients[-1] * unit
    for c in reversed(coefficients[:-1]):
        total = matrix @ total + c * unit
    return total


def orthonormal_columns(columns: Float[Array, "r c"]) -> tuple[Float[Array, "r c"], Float[Array, "c c"]]:
    """The factors Q R of a matrix, Q with orthonormal columns and R upper triangular with a positive diagonal; by Gram–Schmidt,
    twice for each column, which makes Q orthogonal to rounding. Not finite where the columns are dependent.
    """
    count = columns.shape[1]

    def further(k, so_far):
        q, upper = so_far
        rest, shares = columns[:, k], 0.0
        for _ in range(2):
            share = q.T @ rest
            rest, shares = rest - q @ share, shares + share
        size = jnp.linalg.norm(rest)
        return q.at[:, k].set(rest / size), upper.at[:, k].set(shares).at[k, k].set(size)

    nothing = jnp.zeros_like(columns), jnp.zeros((count, count), columns.dtype)
    return jax.lax.fori_loop(0, count, further, nothing)
