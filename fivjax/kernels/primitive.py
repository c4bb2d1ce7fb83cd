"""Kernels as a primitive of JAX's.

Under `jit` it calls the kernel, under `vmap` it is one call for more trajectories, and under `jvp` a kernel that computes
tangents beside values takes its place. JAX applies these rules after the call that it traces, under its caller's settings.
"""

import ctypes
import functools
import hashlib
import math
from collections.abc import Sequence
from itertools import compress

import jax
import jax.numpy as jnp
import numpy as np
from jax.custom_derivatives import SymbolicZero
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir

from ..foundation.argument_forms import ArrayForm, Form
from ..foundation.precision import own_settings
from .code import Slot, form_with_slopes, jvp_along
from .kernel import GIVEN, Kernel, kernel_of, width_for
from .xla_calls import Addresses, called_by_xla


@functools.partial(jax.custom_jvp, nondiff_argnums=(0, 1))
def values(function, form: Form, arrays: tuple, instants):
    """Numbers at the end, and in rows."""
    ends, rows, _, _ = _bind(function, form, arrays, instants, (), 0, None)
    return ends, rows


@functools.partial(values.defjvp, symbolic_zeros=True)
@own_settings()
def _values_jvp(function, form: Form, primals, tangents):
    arrays, instants = primals
    dots, of_instants = tangents
    if not isinstance(of_instants, SymbolicZero):
        raise NotImplementedError("Rows have no derivative with respect to their instants here.")
    wide = tuple(not isinstance(dot, SymbolicZero) and is_real(dot) for dot in dots)
    if not any(wide):
        ends, rows = values(function, form, arrays, instants)
        return (ends, rows), (jnp.zeros_like(ends), jnp.zeros_like(rows))
    moving = list(compress(dots, wide))
    total = sum(map(jnp.size, moving))
    width = width_for(total, sum(array.size for array in form.arrays))
    # One direction for each number that is perturbed; the last ones only fill the kernel's width.
    directions = np.eye(total, -(-total // width) * width)
    of_parts = [
        _bind(function, form, arrays, instants, wide, width, directions[:, start : start + width])
        for start in range(0, total, width)
    ]
    kernel, (ends, rows, *_) = kernel_of(function, form, wide, width), of_parts[0]
    slopes = [own for _, _, *own in of_parts]
    return (ends, rows), _tangents(kernel, ends.shape[-1], rows.shape[-1], instants.shape[-1], slopes, moving)


# One program: outside of others each operation would be one of its own.
@functools.partial(jax.jit, static_argnums=(0, 1, 2, 3))
def _tangents(kernel: Kernel, ends: int, rows: int, count: int, parts: list, moving: list):
    """The tangents of so many numbers at the end and in rows, from those by each number that is perturbed."""
    code, ways = kernel.text, jnp.concatenate([jnp.ravel(dot) for dot in moving])
    of_ends, of_rows = (jnp.concatenate(own, axis=-1)[..., : len(ways)] @ ways for own in zip(*parts, strict=True))
    return (
        _spread(ends, of_ends, code.ends, code.end_dots, 1),
        _spread(rows, of_rows, code.rows, code.row_dots, count),
    )


def _spread(size: int, dots, places: Sequence[Slot], dot_places: Sequence[Slot | None], repeated: int):
    """Tangents of all numbers, from those of the real ones; each array is there so many times."""
    parts = [
        dots[own.start * repeated : (own.start + own.size) * repeated] if own else jnp.zeros(place.size * repeated)
        for place, own in zip(places, dot_places, strict=True)
    ]
    return jnp.concatenate(parts) if parts else jnp.zeros(size)


def is_real(array) -> bool:
    # A tangent may be a number of Python's.
    return isinstance(array, float) or jnp.issubdtype(array.dtype, jnp.floating)


def _bind(function, form: Form, arrays: Sequence, instants, wide: tuple[bool, ...], width: int, directions):
    dots = jnp.zeros((1, 1)) if directions is None else jnp.asarray(directions)
    kernel = kernel_of(function, form, wide, width)
    return kernel_p.bind(dots, jnp.asarray(instants), *map(jnp.asarray, arrays), kernel=kernel)


kernel_p = Primitive("fivjax_kernel")
kernel_p.multiple_results = True


def _batch_of(kernel: Kernel, arrays: Sequence) -> tuple[int, ...]:
    """The leading axes that all arrays have alike, over trajectories."""
    return arrays[0].shape[: arrays[0].ndim - len(kernel.form.arrays[0].shape)]


def _in_rows(arrays: Sequence, lanes: int, xp):
    """The numbers of the arrays, a row for each trajectory."""
    return xp.concatenate([xp.reshape(array, (lanes, -1)).astype(np.float64) for array in arrays], axis=1)


@kernel_p.def_abstract_eval
def _abstract(dots, instants, *arrays, kernel: Kernel):
    shapes = kernel.shapes(_batch_of(kernel, arrays), instants.shape[-1])
    return [jax.core.ShapedArray(shape, np.dtype("float64")) for shape in shapes]


@kernel_p.def_impl
def _known(dots, instants, *arrays, kernel: Kernel):
    dots, instants, *arrays = map(np.asarray, (dots, instants, *arrays))
    batch = _batch_of(kernel, arrays)
    if 0 in batch:
        return [jax.device_put(np.zeros(shape)) for shape in kernel.shapes(batch, instants.shape[-1])]
    found = kernel.launched(
        _in_rows(arrays, math.prod(batch), np), instants.reshape(-1, instants.shape[-1]), dots[None]
    )
    return [jax.device_put(part.reshape(batch + part.shape[1:])) for part in found]


@own_settings()
def _batched(operands, axes, *, kernel: Kernel):
    (dots, instants, *arrays), (of_dots, of_instants, *of_arrays) = operands, axes
    size = next(part.shape[axis] for part, axis in zip(operands, axes, strict=True) if axis is not None)
    if of_dots is not None:
        raise NotImplementedError("Directions of a kernel's tangents are not batched.")
    arrays = [
        jnp.broadcast_to(array, (size, *jnp.shape(array))) if axis is None else jnp.moveaxis(array, axis, 0)
        for array, axis in zip(arrays, of_arrays, strict=True)
    ]
    batch = _batch_of(kernel, arrays)
    if of_instants is not None:
        instants = jnp.moveaxis(instants, of_instants, 0)
        instants = jnp.broadcast_to(
            instants.reshape(size, *[1] * (len(batch) + 1 - instants.ndim), *instants.shape[1:]),
            (*batch, instants.shape[-1]),
        )
    elif instants.ndim > 1:
        instants = jnp.broadcast_to(instants, (size, *instants.shape))
    return kernel_p.bind(dots, instants, *arrays, kernel=kernel), [0] * 4


batching.primitive_batchers[kernel_p] = _batched


@own_settings()
def _second_derivative(primals, tangents, *, kernel: Kernel):
    """Derivatives of what a kernel finds, tangents included."""
    (dots, instants, *arrays), (of_dots, of_instants, *of_arrays) = map(jnp.asarray, primals), tangents
    if not isinstance(of_dots, ad.Zero) or not isinstance(of_instants, ad.Zero):
        raise NotImplementedError("A kernel has no derivative with respect to its instants and its directions.")
    # What does not move takes no width.
    moves = [not isinstance(tangent, ad.Zero) and is_real(tangent) for tangent in of_arrays]
    dotted = list(compress(of_arrays, moves))
    _, slopes = jvp_along(lambda arrays: _by_kernel_with_slopes(kernel, dots, instants, *arrays), arrays, moves, dotted)
    return kernel_p.bind(*primals, kernel=kernel), slopes


ad.primitive_jvps[kernel_p] = _second_derivative


def _by_kernel_with_slopes(kernel: Kernel, dots, instants, *arrays) -> list:
    """What a kernel finds, so that its tangents have derivatives: by the kernel of a function that gives both."""
    if _batch_of(kernel, arrays):
        axes = None, 0 if instants.ndim > 1 else None, *(0 for _ in arrays)
        return jax.vmap(functools.partial(_by_kernel_with_slopes, kernel), axes)(dots, instants, *arrays)
    wide = list(compress(kernel.form.arrays, kernel.wide))
    function, form = kernel.function.with_slopes, form_with_slopes(kernel.form, kernel.wide)
    ends, rows = jax.vmap(lambda dot: values(function, form, (*arrays, *_arrays(wide, dot)), instants), 1, 1)(dots)
    found, slopes, count = [], [], instants.shape[-1]
    for numbers, places, repeated in ((ends, kernel.text.ends, 1), (rows, kernel.text.rows, count)):
        # What is found, and then its slopes.
        size = repeated * sum(place.size for place in places)
        found.append(numbers[:size, 0])
        slopes.append(numbers[size:])
    parts = zip((*found, *slopes), kernel.shapes((), count), strict=True)
    # A row that has no numbers is one zero.
    return [part if part.shape == shape else jnp.zeros(shape) for part, shape in parts]


def _arrays(like: Sequence[ArrayForm], numbers) -> list:
    """The arrays of which these are the numbers, one after the other."""
    ends = np.cumsum([array.size for array in like])[:-1]
    return [part.reshape(array.shape) for array, part in zip(like, jnp.split(numbers, ends), strict=True)]


@own_settings()
def _lowered(dots, instants, *arrays, kernel: Kernel):
    batch = _batch_of(kernel, arrays)
    shapes, lanes = kernel.shapes(batch, instants.shape[-1]), math.prod(batch)
    if not lanes:
        return list(map(jnp.zeros, shapes))
    flat = _in_rows(arrays, lanes, jnp), dots[None], instants.reshape(-1, instants.shape[-1])
    of_lanes = [jax.ShapeDtypeStruct((lanes, *shape[len(batch) :]), np.float64) for shape in shapes]
    found = _callable(kernel)(of_lanes)(*flat)
    return [part.reshape(shape) for part, shape in zip(found, shapes, strict=True)]


@functools.cache
def _callable(kernel: Kernel):
    """A function of JAX arrays that launches the kernel."""

    def launch(places: Addresses) -> None:
        for address, shape in places[len(GIVEN) :]:
            ctypes.memset(address, 0, math.prod(shape) * np.dtype(np.float64).itemsize)
        kernel.launch(places)

    # XLA may keep a program for other processes, where the same name has to mean the same.
    digest = hashlib.sha256(kernel.of_lanes.body.encode()).hexdigest()
    return called_by_xla(f"fivjax_kernel_{digest}", launch)


mlir.register_lowering(kernel_p, mlir.lower_fun(_lowered, multiple_results=True), platform="cpu")
