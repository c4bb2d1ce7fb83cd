"""What code depends on of a function's arguments: their structure, and the shapes and types of their arrays."""

import functools
import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import numpy as np


class Form(NamedTuple):
    """What calls with the same code have in common: everything but numbers."""

    structure: Any
    leaves: tuple  # shapes and types of arrays, and what is no array

    @classmethod
    def of(cls, args) -> tuple["Form", list]:
        """The form of some arguments, and their arrays."""
        leaves, structure = jax.tree.flatten(args)
        arrays = list(map(_array, leaves))
        told = tuple(leaf if array is None else array for leaf, array in zip(leaves, arrays, strict=True))
        return cls(structure, told), [leaf for leaf, array in zip(leaves, arrays, strict=True) if array is not None]

    @property
    def kept(self) -> "Form":
        """The first that was the same, so that code is looked up without comparing all that a form says."""
        return _FORMS.setdefault(self, self)

    def args(self, arrays: Sequence) -> Any:
        """The arguments with these arrays."""
        remaining = iter(arrays)
        leaves = [next(remaining) if isinstance(leaf, ArrayForm) else leaf for leaf in self.leaves]
        return jax.tree.unflatten(self.structure, leaves)

    @property
    def arrays(self) -> list["ArrayForm"]:
        """Those of the arguments, in order."""
        return [leaf for leaf in self.leaves if isinstance(leaf, ArrayForm)]


_FORMS: dict[Form, Form] = {}


class ArrayForm(NamedTuple):
    """An array of a form."""

    shape: tuple[int, ...]
    dtype: str

    @property
    def size(self) -> int:
        return math.prod(self.shape)


_NUMBER = ArrayForm((), "float64")


def _array(leaf) -> ArrayForm | None:
    """What is told of an array; of what is none, nothing."""
    # In the order in which they are most frequent: a call looks at some hundred of them.
    if isinstance(leaf, np.ndarray):
        return ArrayForm(leaf.shape, _name_of(leaf.dtype))
    if isinstance(leaf, float):
        return _NUMBER
    if isinstance(leaf, jax.Array | np.number | np.bool):
        return ArrayForm(leaf.shape, _name_of(np.dtype(leaf.dtype)))
    return None


@functools.cache
def _name_of(own: np.dtype) -> str:
    return "float64" if np.issubdtype(own, np.floating) else own.name
