"""Arrays of numbers in C++ code that is being written: what moves numbers without computing anything.

A small array is an array of Python objects: texts that name variables, or numbers where these are known. A large one is a
`View` of a C array. Slices, transposes and their like are carried out here, so that the code has nothing of them.
"""

import math
from collections.abc import Callable
from typing import NamedTuple, TypeAlias

import jax
import numpy as np


class View(NamedTuple):
    """Numbers of a C array, with strides."""

    base: str
    offset: tuple  # what is known of it, then the texts of what is not
    shape: tuple[int, ...]
    strides: tuple[int, ...]
    kind: str  # their type in C++

    @property
    def size(self) -> int:
        return count_of(self.shape)

    @property
    def ndim(self) -> int:
        return len(self.shape)

    def at(self, index) -> str:
        """The text of one number; the index has numbers, or names of variables."""
        known, unknown = self.offset[0], list(self.offset[1:])
        for place, stride in zip(index, self.strides, strict=True):
            if isinstance(place, str):
                unknown += [f"{place} * {stride}" if stride != 1 else place] * (stride != 0)
            else:
                known += place * stride
        terms = [*unknown, str(known)] if known or not unknown else unknown
        return f"{self.base}[{' + '.join(terms)}]"

    def entries(self) -> np.ndarray:
        """All numbers by their texts."""
        found = np.empty(self.shape, object)
        for index in np.ndindex(self.shape):
            found[index] = self.at(index)
        return found

    def selected(self, offset: tuple, axes) -> "View":
        """The numbers from an offset on, along these axes."""
        return View(
            self.base, offset, tuple(self.shape[i] for i in axes), tuple(self.strides[i] for i in axes), self.kind
        )

    def broadcast(self, shape: tuple[int, ...]) -> "View":
        """Repeated along new first axes, and along those of length one."""
        own = zip(self.strides, self.shape, shape[len(shape) - self.ndim :], strict=True)
        strides = [0] * (len(shape) - self.ndim) + [stride if size == to else 0 for stride, size, to in own]
        return View(self.base, self.offset, tuple(shape), tuple(strides), self.kind)


Value: TypeAlias = np.ndarray | View


def count_of(shape) -> int:
    """How many numbers an array of this shape has."""
    return math.prod(shape)


def natural(shape) -> tuple[int, ...]:
    """The strides of a C array of this shape."""
    return tuple(count_of(shape[axis + 1 :]) for axis in range(len(shape)))


def of_text(text: str) -> np.ndarray:
    """One number, by the text that names it."""
    found = np.empty((), object)
    found[()] = text
    return found


def of_numbers(value) -> np.ndarray:
    """An array whose entries are Python's numbers: these are known."""
    value = np.asarray(value)
    found = np.empty(value.shape, object)
    if value.dtype == jax.dtypes.float0:  # tangents of counts, which have none
        found[...] = False
    else:
        found[...] = value.tolist() if value.ndim else value.item()
    return found


def has_known_numbers(value: Value) -> bool:
    """Whether all its numbers are."""
    return not isinstance(value, View) and not any(isinstance(entry, str) for entry in value.ravel())


def reshaped(value: Value, shape) -> Value | None:
    """The same numbers in another shape; none where that takes a copy."""
    shape = tuple(shape)
    if not isinstance(value, View):
        return value.reshape(shape)
    if value.strides == natural(value.shape):
        return value._replace(shape=shape, strides=natural(shape))
    # Axes of length one come and go.
    long = [(size, stride) for size, stride in zip(value.shape, value.strides, strict=True) if size != 1]
    if [size for size, _ in long] != [size for size in shape if size != 1]:
        return None
    strides = iter(stride for _, stride in long)
    return value._replace(shape=shape, strides=tuple(next(strides) if size != 1 else 0 for size in shape))


def squeezed(value: Value, params) -> Value:
    dimensions = tuple(params["dimensions"])
    if isinstance(value, View):
        return value.selected(value.offset, [axis for axis in range(value.ndim) if axis not in dimensions])
    return np.asarray(np.squeeze(value, dimensions), object)


def sliced(value: Value, params) -> Value:
    starts, limits = params["start_indices"], params["limit_indices"]
    steps = params["strides"] or [1] * value.ndim
    if not isinstance(value, View):
        return np.asarray(value[tuple(map(slice, starts, limits, steps))], object)
    shape = tuple(-(-(limit - start) // step) for start, limit, step in zip(starts, limits, steps, strict=True))
    known = value.offset[0] + sum(start * stride for start, stride in zip(starts, value.strides, strict=True))
    strides = tuple(stride * step for stride, step in zip(value.strides, steps, strict=True))
    return View(value.base, (known, *value.offset[1:]), shape, strides, value.kind)


def transposed(value: Value, params) -> Value:
    order = params["permutation"]
    return value.selected(value.offset, order) if isinstance(value, View) else np.transpose(value, order)


def reversed_along(value: Value, params) -> Value:
    if not isinstance(value, View):
        return np.flip(value, params["dimensions"])
    strides, known = list(value.strides), value.offset[0]
    for axis in params["dimensions"]:
        known += (value.shape[axis] - 1) * strides[axis]
        strides[axis] = -strides[axis]
    return value._replace(offset=(known, *value.offset[1:]), strides=tuple(strides))


def broadcast_in_dim(value: Value, params) -> Value:
    shape, along = tuple(params["shape"]), params["broadcast_dimensions"]
    own = [1] * len(shape)
    for axis, size in zip(along, value.shape, strict=True):
        own[axis] = size
    spread = reshaped(value, own)
    if isinstance(spread, View):
        return spread.broadcast(shape)
    return np.broadcast_to(value.reshape(own), shape) if spread is not None else _with_axes(value, shape, along)


def _with_axes(value: View, shape, along) -> View:
    strides = [0] * len(shape)
    for axis, size, stride in zip(along, value.shape, value.strides, strict=True):
        strides[axis] = stride if size == shape[axis] else 0
    return value._replace(shape=shape, strides=tuple(strides))


def split(value: Value, params) -> list[Value]:
    axis, found, start = params["axis"], [], 0
    for size in params["sizes"]:
        starts, limits = [0] * value.ndim, list(value.shape)
        starts[axis], limits[axis] = start, start + size
        found.append(sliced(value, {"start_indices": starts, "limit_indices": limits, "strides": None}))
        start += size
    return found


def unstacked(value: Value, params) -> list[Value]:
    axis = params["axis"]
    each = split(value, {"axis": axis, "sizes": [1] * value.shape[axis]})
    return [squeezed(one, {"dimensions": (axis,)}) for one in each]


def padded(value: np.ndarray, filling: np.ndarray, params) -> np.ndarray:
    """With room before, behind and between its entries; negative room takes entries away."""
    config = params["padding_config"]
    shape = [
        low + high + size + max(size - 1, 0) * inner
        for size, (low, high, inner) in zip(value.shape, config, strict=True)
    ]
    found = np.empty([max(size, 0) for size in shape], object)
    found[...] = filling.item()
    for place in np.ndindex(value.shape):
        to = tuple(low + i * (inner + 1) for i, (low, _, inner) in zip(place, config, strict=True))
        if all(0 <= at < size for at, size in zip(to, shape, strict=True)):
            found[to] = value[place]
    return found


# Primitives that only move numbers, in arrays of either form.
MOVING: dict[str, Callable] = {
    "squeeze": squeezed,
    "slice": sliced,
    "transpose": transposed,
    "rev": reversed_along,
    "broadcast_in_dim": broadcast_in_dim,
    "split": split,
    "unstack": unstacked,
}
# The same, for small arrays only.
MOVING_ENTRIES: dict[str, Callable] = {
    "concatenate": lambda *parts: np.concatenate(parts[:-1], parts[-1]["dimension"]),
    "stack": lambda *parts: np.stack(parts[:-1], parts[-1]["axis"]),
    "pad": padded,
}
