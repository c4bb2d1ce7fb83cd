"""Growth rates and derivatives that are safe from rounding at double eigenvalues and from single precision."""

import functools
from collections.abc import Callable

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..foundation.compiling import transformed
from ..foundation.matrix_routines import eigenvectors
from ..foundation.numpy_evaluation import by_numpy
from ..foundation.precision import in_double_precision

# Time grows with the fourth power of the number of coordinates: for twenty NumPy takes a tenth of a second, and XLA seconds to
# compile.
by_numpy_if_small = functools.partial(by_numpy, up_to=20**2)


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

    Known values are computed by NumPy, also where a caller's `jax.grad` asks for the derivative. It is NaN where
    `exists(value)` is false.

    Without double precision turned on, JAX runs the backward pass after the public function has returned, in single precision,
    and fails. Here only a sum of products with the gradient is left to the backward pass.
    """

    @functools.wraps(function)
    def call(*args):
        return differentiated(*args) if transformed(args) else call.value(*args)

    def value(*args):
        return function(*args)

    def value_and_gradient(*args):
        return jax.value_and_grad(function, argnums=tuple(range(len(args))))(*args)

    for part in (value, value_and_gradient):
        # By this name what is traced of it is kept for later processes.
        part.__module__, part.__qualname__ = function.__module__, f"{function.__qualname__}.{part.__name__}"
        setattr(call, part.__name__, by_numpy_if_small(part))
    differentiated = jax.custom_jvp(call.value)

    @differentiated.defjvp
    @in_double_precision
    def rule(primals, tangents):
        found, gradients = call.value_and_gradient(*primals)
        return jnp.asarray(found), _along(exists, found, gradients, tangents)

    return call


@functools.partial(jax.jit, static_argnums=0)
def _along(exists, value, gradients, tangents):
    """The derivative along some tangents."""
    flag = jnp.where(exists(value), 1.0, jnp.nan)
    products = jax.tree.map(lambda gradient, tangent: jnp.sum(flag * gradient * tangent), gradients, tangents)
    return sum(jax.tree.leaves(products))
