"""Kernels as a primitive of JAX's.

Under `jit` it calls the kernel, under `vmap` it is one call for more trajectories, and under `jvp` a kernel that computes
tangents beside values takes its place.
"""

import ctypes
import functools
import hashlib
import math
from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jax.custom_derivatives import SymbolicZero
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir

from ..foundation.argument_forms import Form
from .code import Place
from .kernel import GIVEN, Kernel, kernel_of, width_for
from .xla_calls import Places, called_by_xla


@functools.partial(jax.custom_jvp, nondiff_argnums=(0, 1))
def values(function, form: Form, arrays: tuple, instants):
    """Numbers at the end, and in rows."""
    ends, rows, _, _ = _bind(function, form, arrays, instants, (), 0, None)
    return ends, rows


@functools.partial(values.defjvp, symbolic_zeros=True)
def _values_jvp(function, form: Form, primals, tangents):
    arrays, instants = primals
    dots, of_instants = tangents
    if not isinstance(of_instants, SymbolicZero):
        raise NotImplementedError("Rows have no derivative with respect to their instants here.")
    wide = tuple(not isinstance(dot, SymbolicZero) and is_real(dot) for dot in dots)
    if not any(wide):
        ends, rows = values(function, form, arrays, instants)
        return (ends, rows), (jnp.zeros_like(ends), jnp.zeros_like(rows))
    moving = jnp.concatenate([jnp.ravel(dot) for dot, is_wide in zip(dots, wide, strict=True) if is_wide])
    total, start, ends, rows, of_ends, of_rows = len(moving), 0, None, None, 0.0, 0.0
    while start < total:
        left = total - start
        width = width_for(left, sum(array.size for array in form.arrays))
        # One direction for each number that is perturbed.
        directions = np.eye(total)[:, start : start + width]
        directions = np.pad(directions, ((0, 0), (0, width - directions.shape[1])))
        ends, rows, end_dots, row_dots = _bind(function, form, arrays, instants, wide, width, directions)
        part = moving[start : start + width]
        of_ends = of_ends + end_dots[..., : len(part)] @ part
        of_rows = of_rows + row_dots[..., : len(part)] @ part
        start += width
    code, count = kernel_of(function, form, wide, width).text, instants.shape[-1]
    return (ends, rows), (
        _spread(ends, of_ends, code.ends, code.end_dots, 1),
        _spread(rows, of_rows, code.rows, code.row_dots, count),
    )


def _spread(values, dots, places: Sequence[Place], dot_places: Sequence[Place], repeated: int):
    """Tangents of all numbers, from those of the real ones; each array is there so many times."""
    real, parts = iter(dot_places), []
    for place in places:
        if place.is_real:
            own = next(real)
            parts.append(dots[own.start * repeated : (own.start + own.size) * repeated])
        else:
            parts.append(jnp.zeros(place.size * repeated))
    return jnp.concatenate(parts) if parts else jnp.zeros_like(values)


def is_real(array) -> bool:
    # A tangent may be a number of Python's.
    return isinstance(array, float) or jnp.issubdtype(array.dtype, jnp.floating)


def _bind(function, form: Form, arrays: Sequence, instants, wide: tuple[bool, ...], width: int, directions):
    given = jnp.concatenate([jnp.ravel(jnp.asarray(array)).astype(jnp.float64) for array in arrays])
    dots = jnp.zeros((1, 1)) if directions is None else jnp.asarray(directions)
    return kernel_p.bind(given, dots, jnp.asarray(instants), kernel=_Hashed(kernel_of(function, form, wide, width)))


class _Hashed:
    """A kernel as a parameter of the primitive."""

    def __init__(self, kernel: Kernel):
        self.kernel = kernel

    def __eq__(self, other) -> bool:
        return self.kernel is other.kernel

    def __hash__(self) -> int:
        return id(self.kernel)


kernel_p = Primitive("fivjax_kernel")
kernel_p.multiple_results = True


@kernel_p.def_abstract_eval
def _abstract(given, dots, instants, *, kernel: _Hashed):
    return [
        jax.core.ShapedArray(shape, np.dtype("float64"))
        for shape in kernel.kernel.shapes(given.shape[:-1], instants.shape[-1])
    ]


@kernel_p.def_impl
def _known(given, dots, instants, *, kernel: _Hashed):
    given, dots, instants = map(np.asarray, (given, dots, instants))
    own, batch = kernel.kernel, given.shape[:-1]
    found = own.launched(
        given.reshape(-1, given.shape[-1]), instants.reshape(-1, instants.shape[-1]), dots.reshape(-1, *dots.shape[-2:])
    )
    return [jnp.asarray(part.reshape(batch + part.shape[1:])) for part in found]


def _batched(operands, axes, *, kernel: _Hashed):
    given, dots, instants = operands
    of_given, of_dots, of_instants = axes
    size = next(part.shape[axis] for part, axis in zip(operands, axes, strict=True) if axis is not None)
    if of_dots is not None:
        raise NotImplementedError("Directions of a kernel's tangents are not batched.")
    given = jnp.moveaxis(given, of_given, 0) if of_given is not None else jnp.broadcast_to(given, (size, *given.shape))
    if of_instants is not None:
        instants = jnp.moveaxis(instants, of_instants, 0)
        instants = jnp.broadcast_to(
            instants.reshape(size, *[1] * (given.ndim - instants.ndim), *instants.shape[1:]),
            (*given.shape[:-1], instants.shape[-1]),
        )
    elif instants.ndim > 1:
        instants = jnp.broadcast_to(instants, (size, *instants.shape))
    return kernel_p.bind(given, dots, instants, kernel=kernel), [0] * 4


batching.primitive_batchers[kernel_p] = _batched


def _further_derivative(primals, tangents, *, kernel: _Hashed):
    """Those of what a kernel finds, by XLA: of the second order, if it finds derivatives itself."""
    tangents = tuple(ad.instantiate_zeros(tangent) for tangent in tangents)
    return jax.jvp(_program_of(kernel), tuple(map(jnp.asarray, primals)), tangents)


ad.primitive_jvps[kernel_p] = _further_derivative


@functools.cache
def _program_of(kernel: _Hashed):
    return jax.jit(functools.partial(_found_by_xla, kernel.kernel))


def _found_by_xla(kernel: Kernel, given, dots, instants) -> list:
    """What a kernel finds, by XLA: the same numbers in the same places."""
    if given.ndim > 1:
        axes = 0, None, 0 if instants.ndim > 1 else None
        return jax.vmap(functools.partial(_found_by_xla, kernel), axes)(given, dots, instants)
    moving = kernel.wide + (False,) * len(kernel.form.arrays)

    def arrays_from(numbers, chosen):
        found, start = [], 0
        for array in (array for array, is_chosen in zip(kernel.form.arrays, chosen, strict=False) if is_chosen):
            found.append(numbers[start : start + array.size].reshape(array.shape).astype(array.dtype))
            start += array.size
        return found

    arrays = arrays_from(given, (True,) * len(moving))

    def results(some):
        left = iter(some)
        whole = [next(left) if moves else array for array, moves in zip(arrays, moving, strict=False)]
        return tuple(map(jax.tree.leaves, kernel.function(kernel.form.args(whole), instants)))

    def in_a_row(leaves):
        leaves = [jnp.ravel(leaf).astype(jnp.float64) for leaf in leaves]
        return jnp.concatenate(leaves) if leaves else jnp.zeros(1)

    some = [array for array, moves in zip(arrays, moving, strict=False) if moves]
    ends, rows = results(some)
    if not kernel.width:
        of_ends, of_rows = jnp.zeros((1, 1)), jnp.zeros((1, 1))
    else:

        def along(dots):
            slopes = jax.jvp(results, (some,), (arrays_from(dots, moving),))[1]
            return [in_a_row([slope for slope in part if slope.dtype != jax.dtypes.float0]) for part in slopes]

        of_ends, of_rows = jax.vmap(along, in_axes=1, out_axes=1)(dots)
    shapes = kernel.shapes((), instants.shape[-1])
    found = in_a_row(ends), in_a_row(rows), of_ends, of_rows
    return [part if part.shape == shape else jnp.zeros(shape) for part, shape in zip(found, shapes, strict=True)]


def _lowered(given, dots, instants, *, kernel: _Hashed):
    shapes = kernel.kernel.shapes(given.shape[:-1], instants.shape[-1])
    lanes = math.prod(given.shape[:-1])
    flat = (
        given.reshape(lanes, given.shape[-1]),
        dots[None],
        instants.reshape(-1, instants.shape[-1]),
    )
    of_lanes = [jax.ShapeDtypeStruct((lanes, *shape[given.ndim - 1 :]), np.float64) for shape in shapes]
    found = _callable(kernel)(of_lanes)(*flat)
    return [part.reshape(shape) for part, shape in zip(found, shapes, strict=True)]


@functools.cache
def _callable(kernel: _Hashed):
    """A function of JAX arrays that launches the kernel."""

    def launch(places: Places) -> None:
        for address, shape in places[len(GIVEN) :]:
            ctypes.memset(address, 0, math.prod(shape) * np.dtype(np.float64).itemsize)
        kernel.kernel.launch(places)

    # XLA may keep a program for other processes, where the same name has to mean the same.
    digest = hashlib.sha256(kernel.kernel.of_lanes.body.encode()).hexdigest()
    return called_by_xla(f"fivjax_kernel_{digest}", launch)


mlir.register_lowering(kernel_p, mlir.lower_fun(_lowered, multiple_results=True), platform="cpu")
