"""Derivatives that eigenvalues and single precision would spoil, formed with care."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..foundation.precision import in_double_precision


def significant_growth(matrix: Float[Array, "n n"]) -> Float[Array, ""]:
    """The largest real part of the eigenvalues, less what rounding may have put there: an undamped mode does not grow.

    The matrix is in units where displacements, velocities and frequencies are of order one. Differentiable.
    """
    usable = jnp.all(jnp.isfinite(matrix))
    matrix = jnp.where(usable, matrix, 0.0)
    _, left, right = jax.lax.linalg.eig(jax.lax.stop_gradient(matrix), compute_left_eigenvectors=True)
    left = left.conj().T
    left = left / jnp.sum(left * right.T, axis=1, keepdims=True)
    # The derivative of an eigenvalue is that of left A right with its vectors held fixed.
    real_parts = jnp.sum(left * (matrix @ right).T, axis=1).real
    # An error of the matrix moves an eigenvalue by its size times the eigenvalue's condition number, which is large
    # at a double eigenvalue that is none (an undamped mode met by another, but not coupled to it).
    condition = jnp.linalg.norm(left, axis=1) * jnp.linalg.norm(right, axis=0)
    error = 3e-15 * jax.lax.stop_gradient(jnp.linalg.norm(matrix)) * condition
    growth = jnp.max(jnp.where(jnp.isfinite(error), real_parts - error, -1e-12))
    return jnp.where(usable, growth, -1e-12)


def with_own_gradient(function: Callable, exists: Callable = jnp.isfinite) -> Callable:
    """A scalar function whose derivative is formed at once, in double precision, and only applied later.

    The derivative is NaN where `exists` says of the value that there is none.

    In a process that has not turned on double precision JAX carries out the backward pass after the public function has
    returned, in single precision, and stumbles. Here the backward pass is left with a sum of products.
    """
    own = jax.custom_jvp(function)

    @own.defjvp
    @in_double_precision
    def rule(primals, tangents):
        value, gradients = jax.value_and_grad(function, argnums=tuple(range(len(primals))))(*primals)
        flag = jnp.where(exists(value), 1.0, jnp.nan)
        products = jax.tree.map(lambda g, t: jnp.sum(flag * g * t), gradients, tangents)
        return value, sum(jax.tree.leaves(products))

    return own
