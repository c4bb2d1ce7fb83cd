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
    """A state matrix for time in units of 1 / `scale` (s), and each displacement times its coordinate's own frequency.

    One unit for all displacements would lose the digits of what is slow beside a coordinate that is far faster.
    """
    half = matrix.shape[0] // 2
    squares = jnp.abs(jnp.diagonal(jax.lax.stop_gradient(matrix)[half:, :half]))
    units = jnp.concatenate([jnp.where(squares > 0, jnp.sqrt(squares), scale), jnp.ones(half)])
    return matrix * (units[:, None] / units[None, :]) / scale


def significant_growth(matrix: Float[Array, "n n"]) -> Float[Array, ""]:
    """The largest real part of the eigenvalues, less its possible rounding error: an undamped mode must not seem to grow.

    The matrix is `in_natural_units`, so that displacements and velocities of a motion are of one size. Differentiable.
    """
    usable = jnp.all(jnp.isfinite(matrix))
    matrix = jnp.where(usable, matrix, 0.0)
    _, left, right = eigenvectors(jax.lax.stop_gradient(matrix))
    left = left.conj().T
    left = left / jnp.sum(left * right.T, axis=1, keepdims=True)
    # The derivative of an eigenvalue is that of left A right with constant eigenvectors.
    real_parts = jnp.sum(left * (matrix @ right).T, axis=1).real
    # Rounding of each entry changes an eigenvalue by no more than this, which is much at a double eigenvalue. Entries that a
    # mode does not meet leave it as it is: those of a coordinate that is far stiffer do not hide the growth of others.
    met = jnp.sum(jnp.abs(left) * (jnp.abs(matrix) @ jnp.abs(right)).T, axis=1)
    error = 1e-14 * jax.lax.stop_gradient(met)
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
