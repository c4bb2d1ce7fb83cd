"""A tree of arrays as one array of numbers, with one row per trajectory: calls with few arrays start faster."""

import math

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, PyTree

# Number of rows copied at a time.
MOVED_AT_ONCE = 4096


class Flattened(eqx.Module):
    """The leaves of a tree side by side, in double precision: real, complex, integer or boolean values."""

    numbers: Float[Array, "*rows m"]
    form: tuple = eqx.field(static=True)  # the tree's structure, and the shape in one row and the type of each leaf

    @property
    def tree(self) -> PyTree:
        """The tree again. For a NumPy array its real leaves are views: writing to them changes this array."""
        structure, shapes, types = self.form
        leaves, start, rows = [], 0, self.numbers.shape[:-1]
        for shape, kind in zip(shapes, types, strict=True):
            is_complex = np.issubdtype(kind, np.complexfloating)
            size = math.prod(shape) * (2 if is_complex else 1)
            part = self.numbers[..., start : start + size]
            if is_complex:
                part = part.reshape(*rows, -1, 2)
                part = part[..., 0] + 1j * part[..., 1]
            leaves.append(part.reshape(*rows, *shape).astype(kind, copy=False))
            start += size
        return jax.tree.unflatten(structure, leaves)

    def compacted(self, rows: Int[np.ndarray, " r"]) -> "Flattened":
        """Only these rows, in rising order, moved in place to the beginning of the array, without a second array."""
        if len(rows) == len(self.numbers):
            return self
        for start in range(0, len(rows), MOVED_AT_ONCE):
            chosen = rows[start : start + MOVED_AT_ONCE]
            # No row moves to a higher index, so no row that is still needed is overwritten.
            self.numbers[start : start + len(chosen)] = self.numbers[chosen]
        return Flattened(self.numbers[: len(rows)], self.form)


def flatten(tree: PyTree, row_axes: int = 1) -> Flattened:
    """The flattened form of a tree whose leaves have `row_axes` leading axes in common."""
    leaves, structure = jax.tree.flatten(tree)
    xp = np if all(isinstance(leaf, np.ndarray) for leaf in leaves) else jnp

    def flat(leaf):
        if np.issubdtype(leaf.dtype, np.complexfloating):
            leaf = xp.stack([leaf.real, leaf.imag], axis=-1)
        return leaf.reshape(*leaf.shape[:row_axes], -1).astype(np.float64)

    shapes = tuple(leaf.shape[row_axes:] for leaf in leaves)
    types = tuple(np.dtype(leaf.dtype).name for leaf in leaves)
    return Flattened(xp.concatenate([flat(leaf) for leaf in leaves], axis=-1), (structure, shapes, types))
