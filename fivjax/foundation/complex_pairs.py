"""Complex numbers as pairs of real ones, for functions that kernels compute, too: code of kernels has real numbers only.

What reads only the parts `real` and `imag` takes complex arrays and pairs alike.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import PyTree


class Pair(NamedTuple):
    """Arrays of the same shape."""

    real: Any
    imag: Any

    def __getitem__(self, index) -> "Pair":
        return Pair(self.real[index], self.imag[index])


def in_pairs(tree: PyTree) -> PyTree:
    """The tree with pairs in place of complex arrays."""
    return jax.tree.map(lambda leaf: Pair(leaf.real, leaf.imag) if np.iscomplexobj(leaf) else leaf, tree)


def times(a, b) -> Pair:
    """The product, number by number."""
    return Pair(a.real * b.real - a.imag * b.imag, a.real * b.imag + a.imag * b.real)


def size(a):
    """The absolute value of each number."""
    return jnp.hypot(a.real, a.imag)


def exponential(a) -> Pair:
    """The exponential of each number."""
    grown = jnp.exp(a.real)
    return Pair(grown * jnp.cos(a.imag), grown * jnp.sin(a.imag))


def from_real(matrix, vector) -> Pair:
    """The product of a complex matrix and a real vector."""
    return Pair(matrix.real @ vector, matrix.imag @ vector)


def real_part(matrix, vector):
    """The real part of the product of a complex matrix and a complex vector."""
    return matrix.real @ vector.real - matrix.imag @ vector.imag
