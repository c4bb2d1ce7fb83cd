"""A tree of arrays as one array of numbers, with one row per trajectory: calls with few arrays start faster."""

import functools
import math
from typing import NamedTuple

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
        """The tree again. For a NumPy array its real and complex leaves are views: writing to them changes this array."""
        (structure, shapes, types), numbers = self.form, self.numbers
        rows = numbers.shape[:-1]

        def leaf(place: _Place) -> Array | np.ndarray:
            part = numbers[..., place.numbers]
            if place.is_complex and isinstance(part, np.ndarray):
                part = part.view(np.complex128)
            elif place.is_complex:
                part = part.reshape(*rows, -1, 2)
                part = part[..., 0] + 1j * part[..., 1]
            return part.reshape(*rows, *place.shape).astype(place.kind, copy=False)

        return jax.tree.unflatten(structure, [leaf(place) for place in _places(shapes, types)])

    @property
    def starts(self) -> PyTree:
        """Where each leaf of the tree begins among the numbers of a row."""
        structure, shapes, types = self.form
        return jax.tree.unflatten(structure, [place.numbers.start for place in _places(shapes, types)])

    def compacted(self, rows: Int[np.ndarray, " r"]) -> "Flattened":
        """Only these rows, in rising order, moved in place to the beginning of the array, without a second array."""
        if len(rows) == len(self.numbers):
            return self
        for start in range(0, len(rows), MOVED_AT_ONCE):
            chosen = rows[start : start + MOVED_AT_ONCE]
            # No row moves to a higher index, so no row that is still needed is overwritten.
            self.numbers[start : start + len(chosen)] = self.numbers[chosen]
        return Flattened(self.numbers[: len(rows)], self.form)


class _Place(NamedTuple):
    """Where a leaf is among the numbers of a row, and its shape and type."""

    numbers: slice
    shape: tuple[int, ...]
    kind: np.dtype
    is_complex: bool


@functools.cache
def _places(shapes: tuple, types: tuple) -> list[_Place]:
    places, start = [], 0
    for shape, kind in zip(shapes, map(np.dtype, types), strict=True):
        is_complex = np.issubdtype(kind, np.complexfloating)
        end = start + math.prod(shape) * (2 if is_complex else 1)
        places.append(_Place(slice(start, end), shape, kind, is_complex))
        start = end
    return places


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
