"""Growth rates and derivatives that are safe from rounding at double eigenvalues and from single precision."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..foundation.matrix_routines import eigenvectors
from ..foundation.precision import in_double_precision


def in_natural_units(matrix: Float[Array, "n n"], scale) -> Float[Array, "n n"]:
    """A state matrix for time in units of 1 / `scale` (s), and displacements times it."""
    half = matrix.shape[0] // 2
    units = jnp.concatenate([jnp.full(half, scale), jnp.ones(half)])
    return matrix * (units[:, None] / units[None, :]) / scale


def significant_growth(matrix: Float[Array, "n n"]) -> Float[Array, ""]:
    """The largest real part of the eigenvalues, less its possible rounding error: an undamped mode must not seem to grow.

    The matrix is `in_natural_units`, so that displacements, velocities and frequencies are of order one. Differentiable.
    """
    usable = jnp.all(jnp.isfinite(matrix))
    matrix = jnp.where(usable, matrix, 0.0)
    _, left, right = eigenvectors(jax.lax.stop_gradient(matrix))
    left = left.conj().T
    left = left / jnp.sum(left * right.T, axis=1, keepdims=True)
    # The derivative of an eigenvalue is that of left A right with constant eigenvectors.
    real_parts = jnp.sum(left * (matrix @ right).T, axis=1).real
    # An error of the matrix changes an eigenvalue by the size of the error times the eigenvalue's condition number, which is
    # large at a double eigenvalue.
    condition = jnp.linalg.norm(left, axis=1) * jnp.linalg.norm(right, axis=0)
    error = 3e-15 * jax.lax.stop_gradient(jnp.linalg.norm(matrix)) * condition
    growth = jnp.max(jnp.where(jnp.isfinite(error), real_parts - error, -1e-12))
    return jnp.where(usable, growth, -1e-12)


def with_own_gradient(function: Callable, exists: Callable = jnp.isfinite) -> Callable:
    """A scalar function whose gradient is computed together with its value, in double precision.

    The derivative is NaN where `exists(value)` is false.

    Without double precision turned on, JAX runs the backward pass after the public function has returned, in single precision,
    and fails. Here only a sum of products with the gradient is left to the backward pass.
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
