"""What is left to LAPACK: eigenvalues, and determinants of large matrices. One matrix at a time.

Given a batch, the calls of jaxlib 0.10.0 to 0.10.2 can wait for each other for ever (see `linear_solve`). Given one matrix they
wait for nothing. So on a CPU `jax.vmap` makes a loop over the matrices here.

Nothing that steps trajectories calls these, and nothing else in fivjax calls LAPACK inside JAX
(`tests/foundation/test_standstill.py`).
"""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float, Num


def register() -> None:
    """Make LAPACK known to JAX in this process, as it does by itself where it lowers a call of it."""
    jax.jit(jnp.linalg.eigvals).lower(np.eye(2))


@jax.custom_jvp
def eigenvalues(matrix: Num[Array, "n n"]) -> Complex[Array, " n"]:
    """The eigenvalues of a general matrix, in any order. Differentiable, more than once, where they are simple."""
    return _one_at_a_time(jnp.linalg.eigvals)(matrix)


@jax.custom_jvp
def eigenvectors(
    matrix: Num[Array, "n n"],
) -> tuple[Complex[Array, " n"], Complex[Array, "n n"], Complex[Array, "n n"]]:
    """The eigenvalues of a general matrix, and its left and right eigenvectors as columns.

    Differentiable where the eigenvalues are simple. Derivatives have no part along an eigenvector itself, whose length is free.
    """
    return _one_at_a_time(lambda one: tuple(jax.lax.linalg.eig(one, compute_left_eigenvectors=True)))(matrix)


@jax.custom_jvp
def log_determinant(matrix: Float[Array, "n n"]) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """The sign of a determinant and the logarithm of its size. Differentiable where the matrix is regular."""
    return _one_at_a_time(lambda one: tuple(jnp.linalg.slogdet(one)))(matrix)


def _one_at_a_time(function: Callable) -> Callable:
    """A function of one array whose batches are loops on a CPU; elsewhere it is left as it is."""
    return jax.custom_batching.sequential_vmap(function) if jax.default_backend() == "cpu" else function


@eigenvalues.defjvp
def _(primals, tangents):
    (matrix,), (change,) = primals, tangents
    values, left, right = eigenvectors(matrix)
    left = left.conj()
    # That of left* A right with constant eigenvectors.
    along = jnp.sum(left * (change.astype(left.dtype) @ right), axis=0) / jnp.sum(left * right, axis=0)
    return values, along


@eigenvectors.defjvp
def _(primals, tangents):
    (matrix,), (change,) = primals, tangents
    values, left, right = eigenvectors(matrix)
    projected = left.conj().T @ change.astype(left.dtype) @ right
    lengths = jnp.sum(left.conj() * right, axis=0)
    gaps = jnp.where(jnp.eye(len(values), dtype=bool), jnp.inf, values[None, :] - values[:, None])
    along = projected / lengths[:, None] / gaps  # the parts of each right eigenvector's change along the others
    against = projected / lengths[None, :] / gaps
    return (values, left, right), (jnp.diagonal(projected) / lengths, -left @ against.conj().T, right @ along)


@log_determinant.defjvp
def _(primals, tangents):
    (matrix,), (change,) = primals, tangents
    sign, size = log_determinant(matrix)
    inverse = _one_at_a_time(jnp.linalg.inv)(matrix)
    return (sign, size), (jnp.zeros_like(sign), jnp.sum(inverse.T * change))
