"""JAX functions of one trajectory that kernels compute, for one trajectory or many, with their derivatives.

A `KernelFunction` is traced, written as C++ (`kernel_text`) and compiled by Warp's own compiler, once for arguments of one
form; the kernel is kept for later processes. With known values it takes and gives arrays of NumPy, and XLA compiles nothing.
Inside JAX's transformations it is a primitive: `jit` calls the kernel, `vmap` makes more trajectories of one call, and `jvp`,
`jacfwd` and `grad` use a kernel that computes tangents beside values, one direction for each number that is perturbed.
"""

import functools
import hashlib
import linecache
import math
from collections.abc import Callable, Sequence
from concurrent.futures import Executor
from itertools import pairwise

import jax
import jax.numpy as jnp
import numpy as np
from jax.custom_derivatives import SymbolicZero
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir
from jaxtyping import Float

from .compiling import compiled
from .forking import refuse_if_forked
from .kept_programs import kept_value
from .kernel_text import Form, Place, text, written
from .precision import is_known, known_to_numpy
from .warp_library import ONE_AT_A_TIME, folder_of_texts, load, warp

# Directions side by side in one kernel: as few of these as serve, or several calls with the most.
WIDTHS = (1, 2, 4, 8, 16)
# And no more than so many numbers, because a thread's stack holds them.
MOST_SIDE_BY_SIDE = 2**14
# Parts of a call's work for each thread, because some trajectories take longer.
AT_A_TIME = 4
# The arrays of every kernel, with their axes: over trajectories, then as said.
GIVEN = {"given": 2, "dots": 3, "instants": 2}  # numbers; numbers and directions; instants
FOUND = {"ends": 2, "rows": 2, "end_dots": 3, "row_dots": 3}


def width_for(directions: int, numbers: int) -> int:
    """How many directions a kernel has side by side, for so many to come and so many numbers that it is given."""
    most = max((width for width in WIDTHS if width * numbers <= MOST_SIDE_BY_SIDE), default=1)
    return min(next((width for width in WIDTHS if width >= directions), WIDTHS[-1]), most)


class KernelFunction:
    """A JAX function `function(args, instants)` of a tree of arrays and other values, and of instants (shape `(k,)`).

    It gives two trees of arrays: results at the end, and results with one row for each instant. The instants may only be what
    one `scan` goes along, so that one kernel serves any number of them. Real numbers are in double precision.
    """

    def __init__(self, function: Callable, differentiated: Callable | None = None):
        """`differentiated` is the function whose derivatives are taken, if it is another: with shorter steps, say."""
        self.function = function
        self.differentiated = function if differentiated is None else differentiated

    def __call__(self, args, instants, *, by_kernel: bool = True):
        """The results: arrays of NumPy where all values are known, else traced ones; by XLA unless `by_kernel`.

        **Raises:** `NotImplementedError` for a function that cannot be written as C++.
        """
        refuse_if_forked()
        form, arrays = Form.of(args)
        known = all(map(is_known, (*arrays, instants)))
        if not by_kernel:
            found = self._by_xla(form, _typed(form, arrays), instants)
            return jax.tree.map(known_to_numpy, found) if known else found
        if known:
            kernel = kernel_of(self, form)
            ends, rows, _, _ = kernel.launched(_row(arrays)[None], np.asarray(instants)[None])
            return kernel.results(ends[0], rows[0])
        return kernel_of(self, form).results(*_values(self, form, tuple(arrays), instants))

    def many(self, shared: tuple, own: tuple, instants, *, by_kernel: bool = True):
        """The results for several trajectories with known values: `args` are those that they share, then their own, whose
        arrays have a leading axis over them.
        """
        refuse_if_forked()
        first = jax.tree.map(lambda leaf: np.asarray(leaf)[0], own)
        form, _ = Form.of((*shared, *first))
        _, common = Form.of(shared)
        _, each = Form.of(own)
        if by_kernel:
            count = len(each[0])
            rows = [np.reshape(leaf, (count, -1)).astype(np.float64) for leaf in each]
            given = np.concatenate([np.broadcast_to(_row(common), (count, len(_row(common)))), *rows], axis=1)
            return self.of_many(form, given, np.asarray(instants))
        types = form.arrays[len(common) :]
        each = [np.asarray(leaf, one.dtype) for leaf, one in zip(each, types, strict=True)]
        found = self._of_each_by_xla(form, _typed(form, common), each, np.asarray(instants))
        return jax.tree.map(known_to_numpy, found)

    def derived(self, args, instants, directions, *, by_kernel: bool = True):
        """The results for known values; and the derivatives of real ones along directions.

        `directions` is a tree like `args`, with one more, last axis over the directions; what is zero in all of them is not
        perturbed. In the tree of derivatives, results that are not real are None.
        """
        refuse_if_forked()
        form, arrays = Form.of(args)
        _, dots = Form.of(directions)
        dots, instants = [np.asarray(dot, float) for dot in dots], np.asarray(instants)
        if not by_kernel:
            found, slopes = self._derived_by_xla(form, _typed(form, arrays), dots, instants)
            return jax.tree.map(known_to_numpy, found), jax.tree.map(known_to_numpy, slopes)
        wide = tuple(_is_real(array) and bool(np.any(dot)) for array, dot in zip(form.arrays, dots, strict=True))
        total = dots[0].shape[-1]
        moving = [dot.reshape(-1, total) for dot, is_wide in zip(dots, wide, strict=True) if is_wide]
        given = _row(arrays)[None]
        width = width_for(total, given.shape[1])
        along, parts = np.concatenate(moving), []
        kernel = kernel_of(self, form, wide, width)
        for start in range(0, total, width):
            part = along[:, start : start + width]
            part = np.pad(part, ((0, 0), (0, width - part.shape[1])))
            parts.append(kernel.launched(given, instants[None], part[None]))
        ends, rows = parts[0][:2]
        end_dots, row_dots = (np.concatenate([part[k][0] for part in parts], axis=-1)[:, :total] for k in (2, 3))
        return kernel.results(ends[0], rows[0]), kernel.slopes(end_dots, row_dots, len(instants))

    @functools.cached_property
    def _by_xla(self):
        return compiled(lambda form, arrays, instants: self.function(form.args(arrays), instants))

    @functools.cached_property
    def _of_each_by_xla(self):
        def run(form: Form, common, each, instants):
            return jax.vmap(lambda own: self.function(form.args([*common, *own]), instants))(each)

        return compiled(run)

    @functools.cached_property
    def _derived_by_xla(self):
        def run(form: Form, arrays, dots, instants):
            real = [_is_real(array) for array in arrays]
            moving = [array for array, is_real in zip(arrays, real, strict=True) if is_real]

            def of(moving):
                left = iter(moving)
                whole = [next(left) if is_real else array for array, is_real in zip(arrays, real, strict=True)]
                found = self.differentiated(form.args(whole), instants)
                return jax.tree.map(lambda leaf: leaf if _is_real(leaf) else None, found), found

            def along(dots):
                _, slopes, found = jax.jvp(of, (moving,), (dots,), has_aux=True)
                return found, slopes

            dots = [dot for dot, is_real in zip(dots, real, strict=True) if is_real]
            return jax.vmap(along, in_axes=-1, out_axes=(None, -1))(dots)

        return compiled(run)

    def of_many(self, form: Form, given: Float[np.ndarray, "lanes numbers"], instants, pool: Executor | None = None):
        """The results for many trajectories, of which each has a row: all arrays of its arguments, one after the other. The
        instants are one row, or one for each trajectory.
        """
        kernel = kernel_of(self, form)
        return kernel.results(*kernel.launched(given, np.atleast_2d(instants), pool=pool)[:2])

    def derived_of_many(
        self, form: Form, given, instants, wide: tuple[bool, ...], directions, pool: Executor | None = None
    ):
        """The same, and the derivatives of real results at the end along each direction (the last axis): `directions` has one
        column for each, of the numbers of those arrays that are `wide`.
        """
        kernel = kernel_of(self, form, wide, directions.shape[1])
        ends, rows, dots, _ = kernel.launched(given, np.atleast_2d(instants), directions[None], pool)
        slopes = [
            dots[:, place.start : place.start + place.size].reshape(len(given), *place.shape, -1)
            for place in kernel.text.end_dots
        ]
        return kernel.results(ends, rows), slopes


class Kernel:
    """A compiled kernel."""

    def __init__(self, function: KernelFunction, form: Form, wide: tuple[bool, ...], width: int):
        own = function.differentiated if width else function.function
        self.width = width
        self.text = text(kept_value(written, own, form, wide, folder=folder_of_texts()))
        self.directions = sum(array.size for array, is_wide in zip(form.arrays, wide, strict=False) if is_wide)
        with ONE_AT_A_TIME:
            self.kernel = _compiled(self.text.source, self.text.widths(), self.directions, width)

    def launched(self, given, instants, dots=None, pool: Executor | None = None):
        """What the kernel finds for each row of numbers: values at the end and in rows, and the tangents of both."""
        # Tangents that do not depend on what is perturbed are not written: they are zero.
        found = tuple(np.zeros(shape) for shape in self.shapes(given.shape[:-1], instants.shape[-1]))
        width = max(self.width, 1)
        dots = np.zeros((1, 1, width)) if dots is None else np.ascontiguousarray(dots)
        self.launch([np.ascontiguousarray(given), dots, np.ascontiguousarray(instants)], list(found), pool)
        return found

    def shapes(self, batch: tuple[int, ...], count: int) -> tuple[tuple[int, ...], ...]:
        """Those of what is found, for a batch of trajectories with so many instants."""
        ends, rows, end_dots, row_dots = self.text.widths()
        width = max(self.width, 1)
        of_rows = count * row_dots if self.width else 1
        return (*batch, ends), (*batch, count * rows), (*batch, end_dots, width), (*batch, of_rows, width)

    def launch(self, given: list, found: list, pool: Executor | None = None) -> None:
        """Run the kernel for all rows of these arrays, and fill those that are `found`."""
        wp = warp()
        arrays = [wp.array(part, dtype=wp.float64, device="cpu", copy=False) for part in (*given, *found)]
        lanes = len(found[0])

        def run(part: tuple[int, int]) -> None:
            wp.launch(self.kernel, dim=part[1] - part[0], inputs=[*arrays, part[0]], device="cpu", block_dim=1)

        if pool is None or lanes == 1:
            run((0, lanes))
            return
        parts = min(lanes, AT_A_TIME * getattr(pool, "_max_workers", 2))
        for _ in pool.map(run, pairwise(np.linspace(0, lanes, parts + 1).astype(int).tolist())):
            pass

    def slopes(self, end_dots, row_dots, count: int):
        """The derivatives of real results from rows of directions: trees like those of the results, without the others."""
        trees = []
        of_dots = (end_dots, self.text.ends, self.text.end_dots, None), (row_dots, self.text.rows, self.text.row_dots, count)
        for structure, (dots, places, own, rows) in zip(self.text.structures, of_dots, strict=True):
            real, leaves = iter(own), []
            for place in places:
                leaves.append(next(real).slopes(dots, rows) if place.is_real else None)
            trees.append(jax.tree.unflatten(structure, leaves))
        return tuple(trees)

    def results(self, ends, rows):
        """The function's results from rows of numbers; these may have more axes before their own."""
        total = self.text.widths()[1]
        parts = (
            [place.of(ends) for place in self.text.ends],
            [place.of(rows, rows.shape[-1] // total) for place in self.text.rows],
        )
        return tuple(map(jax.tree.unflatten, self.text.structures, parts))


_KERNELS: dict = {}


def kernel_of(function: KernelFunction, form: Form, wide: tuple[bool, ...] = (), width: int = 0) -> Kernel:
    """The kernel of a function for arguments of a form; with tangents in so many directions, along arrays that are `wide`."""
    key = function, form, wide, width
    if key not in _KERNELS:
        with ONE_AT_A_TIME:
            if key not in _KERNELS:
                _KERNELS[key] = Kernel(function, form, wide, width)
    return _KERNELS[key]


def _compiled(source: str, widths: tuple[int, ...], directions: int, width: int):
    """The Warp kernel with this code."""
    wp = warp()
    name = hashlib.sha256(repr((source, widths, directions, width)).encode()).hexdigest()[:16]
    ends, rows, end_dots, row_dots = widths
    wide = f"double wide __attribute__((ext_vector_type({width}), aligned(8)))" if width > 1 else "double wide"
    body = f"""
typedef {wide};
const long long lane_ = lane, count = instants_.shape[1];
const double* given = given_.data + lane_ * given_.shape[1];
const wide* dots = (const wide*)dots_.data;
const double* instants = instants_.data + (instants_.shape[0] == 1 ? 0 : lane_) * count;
double* ends = ends_.data + lane_ * {ends};
double* rows = rows_.data + lane_ * count * {rows};
wide* end_dots = (wide*)end_dots_.data + lane_ * {end_dots};
wide* row_dots = (wide*)row_dots_.data + lane_ * {f"count * {row_dots}" if width else 1};
{source}
"""
    arrays = {**GIVEN, **FOUND}
    signature = ", ".join(f"{own}_: A{axes}" for own, axes in arrays.items())
    names = ", ".join(f"{own}_" for own in arrays)
    code = (
        f"@wp.func_native(body)\ndef run(lane: int, {signature}): ...\n\n"
        f"def followed({signature}, first: int):\n    run(first + wp.tid(), {names})\n"
    )
    # Warp reads a kernel's source by `inspect`, which looks here.
    place = f"<fivjax kernel {name}>"
    linecache.cache[place] = (len(code), None, code.splitlines(keepends=True), place)
    space = {"wp": wp, "body": body, **{f"A{axes}": wp.array(dtype=wp.float64, ndim=axes) for axes in (2, 3, 4)}}
    exec(compile(code, place, "exec"), space)
    module = wp.get_module(f"fivjax.kernel_{name}")
    flags = f"{wp.config.cpu_compiler_flags or '-march=native'} -O3 -ffp-contract=fast"
    module.options.update(max_unroll=1, cpu_compiler_flags=flags, enable_backward=False)
    kernel = wp.kernel(space["followed"], enable_backward=False, module=module)
    load(module, ["cpu"])
    return kernel


def _row(arrays) -> Float[np.ndarray, " numbers"]:
    return np.concatenate([np.zeros(0), *(np.ravel(np.asarray(array)).astype(np.float64) for array in arrays)])


def _typed(form: Form, arrays) -> list:
    """The arrays with the types of the form, where they are known."""
    return [
        np.asarray(array, like.dtype) if is_known(array) else array
        for array, like in zip(arrays, form.arrays, strict=False)
    ]


# Inside JAX's transformations.


@functools.partial(jax.custom_jvp, nondiff_argnums=(0, 1))
def _values(function: KernelFunction, form: Form, arrays: tuple, instants):
    """Numbers at the end, and in rows."""
    ends, rows, _, _ = _bind(function, form, arrays, instants, (), 0, None)
    return ends, rows


@functools.partial(_values.defjvp, symbolic_zeros=True)
def _values_jvp(function: KernelFunction, form: Form, primals, tangents):
    arrays, instants = primals
    dots, of_instants = tangents
    if not isinstance(of_instants, SymbolicZero):
        raise NotImplementedError("Rows have no derivative with respect to their instants here.")
    wide = tuple(not isinstance(dot, SymbolicZero) and _is_real(dot) for dot in dots)
    if not any(wide):
        ends, rows = _values(function, form, arrays, instants)
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


def _is_real(array) -> bool:
    return jnp.issubdtype(array.dtype, jnp.floating)


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


def _no_second_derivative(primals, tangents, **_):
    raise NotImplementedError(
        "A kernel has first derivatives only. Take second ones without `jax.jit` inside of them: then the motion is followed "
        "by XLA's programs, which have them."
    )


ad.primitive_jvps[kernel_p] = _no_second_derivative


def _lowered(given, dots, instants, *, kernel: _Hashed):
    shapes = kernel.kernel.shapes(given.shape[:-1], instants.shape[-1])
    lanes = math.prod(given.shape[:-1])
    flat = (
        given.reshape(lanes, given.shape[-1]),
        dots[None],
        instants.reshape(-1, instants.shape[-1]),
    )
    call = _callable(kernel)
    dims = {f"{name}_": (lanes, *shape[given.ndim - 1 :]) for name, shape in zip(FOUND, shapes, strict=True)}
    return [found.reshape(shape) for found, shape in zip(call(*flat, output_dims=dims), shapes, strict=True)]


@functools.cache
def _callable(kernel: _Hashed):
    """A function of JAX arrays that launches the kernel."""
    wp, own = warp(), kernel.kernel

    def launch(given_, dots_, instants_, ends_, rows_, end_dots_, row_dots_):
        for part in (rows_, end_dots_, row_dots_):
            part.zero_()
        wp.launch(
            own.kernel,
            dim=given_.shape[0],
            inputs=[given_, dots_, instants_, ends_, rows_, end_dots_, row_dots_, 0],
            device="cpu",
            block_dim=1,
        )

    launch.__annotations__ = {
        f"{name}_": wp.array(dtype=wp.float64, ndim=axes) for name, axes in {**GIVEN, **FOUND}.items()
    }
    # The module that Warp looks whether it is loaded.
    launch.__module__ = own.kernel.module.name
    return wp.jax_callable(launch, num_outputs=len(FOUND), graph_mode=wp.JaxCallableGraphMode.NONE)


mlir.register_lowering(kernel_p, mlir.lower_fun(_lowered, multiple_results=True), platform="cpu")
