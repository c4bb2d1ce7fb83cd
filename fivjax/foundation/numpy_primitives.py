"""JAX's primitives by NumPy, for values that are known; and which places of arrays the indexing ones read and write."""

import contextlib
import enum
from collections.abc import Callable, Sequence
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Int

# By name, of operands alone.
PLAIN: dict[str, Callable] = {
    "add": np.add,
    "add_any": np.add,
    "sub": np.subtract,
    "mul": np.multiply,
    "neg": np.negative,
    "abs": np.abs,
    "sign": np.sign,
    "sqrt": np.sqrt,
    "square": np.square,
    "exp": np.exp,
    "log": np.log,
    "sin": np.sin,
    "cos": np.cos,
    "tanh": np.tanh,
    "max": np.maximum,
    "min": np.minimum,
    "lt": np.less,
    "le": np.less_equal,
    "gt": np.greater,
    "ge": np.greater_equal,
    "eq": np.equal,
    "ne": np.not_equal,
    "and": np.bitwise_and,
    "or": np.bitwise_or,
    "not": np.invert,
    "is_finite": np.isfinite,
    "conj": np.conj,
    "real": np.real,
    "imag": np.imag,
    "complex": lambda real, imaginary: _complex(real, imaginary),
    "stop_gradient": np.asarray,
    "copy": np.asarray,
    "copy_p": np.asarray,
}
# By name, of operands and then the primitive's parameters; None where NumPy has no such case.
WITH_PARAMETERS: dict[str, Callable] = {
    "div": lambda a, b, p: a / b if np.issubdtype(np.result_type(a), np.inexact) else _quotient(a, b),
    "rem": lambda a, b, p: np.fmod(a, b) if np.issubdtype(np.result_type(a), np.inexact) or np.all(b) else None,
    "integer_pow": lambda a, p: a ** p["y"] if p["y"] >= 0 else 1.0 / a ** -p["y"],
    "iota": lambda p: np.indices(p["shape"], p["dtype"])[p["dimension"]],
    "convert_element_type": lambda a, p: _converted(np.asarray(a), np.dtype(p["new_dtype"])),
    "bitcast_convert_type": lambda a, p: (
        np.asarray(a).view(p["new_dtype"]) if np.dtype(p["new_dtype"]).itemsize == a.dtype.itemsize else None
    ),
    "reshape": lambda a, p: np.reshape(a, p["new_sizes"]),
    "squeeze": lambda a, p: np.squeeze(a, tuple(p["dimensions"])),
    "transpose": lambda a, p: np.transpose(a, p["permutation"]),
    "rev": lambda a, p: np.flip(a, p["dimensions"]),
    "slice": lambda a, p: a[tuple(map(slice, p["start_indices"], p["limit_indices"], p["strides"] or [1] * a.ndim))],
    "dynamic_slice": lambda a, *rest: _sliced(a, rest[:-1], rest[-1]["slice_sizes"]),
    "concatenate": lambda *a: np.concatenate(a[:-1], a[-1]["dimension"]),
    "stack": lambda *a: np.stack(a[:-1], a[-1]["axis"]),
    "pad": lambda a, filling, p: _padded(a, filling, p["padding_config"]),
    "broadcast_in_dim": lambda a, p: _broadcast(a, p["shape"], p["broadcast_dimensions"]),
    "reduce_sum": lambda a, p: np.sum(a, axis=tuple(p["axes"])),
    "reduce_max": lambda a, p: np.max(a, axis=tuple(p["axes"])) if a.size else None,
    "reduce_min": lambda a, p: np.min(a, axis=tuple(p["axes"])) if a.size else None,
    "reduce_and": lambda a, p: np.all(a, axis=tuple(p["axes"])),
    "reduce_or": lambda a, p: np.any(a, axis=tuple(p["axes"])),
    "cumsum": lambda a, p: _summed_up(a, p["axis"], p["reverse"]),
    "argmax": lambda a, p: np.argmax(a, axis=p["axes"][0]),
    "argmin": lambda a, p: np.argmin(a, axis=p["axes"][0]),
    "select_n": lambda which, *cases: _selected(which, cases[:-1]),
    "dot_general": lambda a, b, p: _product(a, b, p["dimension_numbers"]),
    "gather": lambda a, places, p: _gathered(a, places, p),
    "scatter": lambda a, places, update, p: _scattered(a, places, update, p, False),
    "scatter-add": lambda a, places, update, p: _scattered(a, places, update, p, True),
}
# The same with several results.
SEVERAL: dict[str, Callable] = {
    "split": lambda a, p: np.split(a, np.cumsum(p["sizes"])[:-1], p["axis"]),
    "unstack": lambda a, p: list(np.moveaxis(a, p["axis"], 0)),
    "sort": lambda *a: _sorted(a[:-1], a[-1]["dimension"], a[-1]["num_keys"]),
    "eig": lambda a, p: _eigen(a, p["compute_left_eigenvectors"], p["compute_right_eigenvectors"]),
}
# Those of them for which it depends on shapes and types whether there is such a case. (For `gather` it depends on indices.)
SOME_CASES = ("div", "bitcast_convert_type", "pad", "reduce_max", "reduce_min")


def function_of(equation) -> Callable[[list[np.ndarray]], Sequence[np.ndarray]]:
    """A primitive's results from its operands; what NumPy does not have is left to JAX, which compiles a program for it."""
    primitive, params = equation.primitive, equation.params
    by_numpy = function_named(primitive.name, plain_parameters(params))

    def applied(operands):
        if by_numpy is not None and (found := by_numpy(operands)) is not None:
            return found
        with jax.enable_x64(True):
            found = primitive.bind(*map(jnp.asarray, operands), **params)
        return list(map(np.asarray, found)) if primitive.multiple_results else (np.asarray(found),)

    return applied


def function_named(name: str, params: dict) -> Callable[[list[np.ndarray]], tuple | None] | None:
    """The results of the primitive with this name and these `plain_parameters`; None where NumPy has no such function, or no
    such case of it.
    """
    if (plain := PLAIN.get(name)) is not None:
        return lambda operands: (plain(*operands),)
    if (several := SEVERAL.get(name)) is not None:
        return lambda operands: tuple(several(*operands, params))
    if (rule := WITH_PARAMETERS.get(name)) is None:
        return None
    if "dimension_numbers" in params and isinstance(params["dimension_numbers"], dict):
        params = {**params, "dimension_numbers": SimpleNamespace(**params["dimension_numbers"])}
    return lambda operands: None if (found := rule(*operands, params)) is None else (found,)


def has_case(name: str, params: dict, avals) -> bool:
    """Whether NumPy has this function for operands of these shapes and types."""
    if name in SOME_CASES:
        applied = function_named(name, params)
        with np.errstate(all="ignore"):
            return applied is not None and applied([np.ones(own.shape, own.dtype) for own in avals]) is not None
    return any(name in those for those in (PLAIN, WITH_PARAMETERS, SEVERAL))


def plain_parameters(params) -> dict:
    """A primitive's parameters, as far as they are numbers, text, and lists and named tuples of such."""
    plain = {name: _plain(value) for name, value in params.items()}
    return {name: value for name, value in plain.items() if value is not NotImplemented}


def _plain(value):
    if value is None or isinstance(value, bool | str):
        return value
    if isinstance(value, int | np.integer):
        return int(value)
    if isinstance(value, np.dtype):
        return value.name
    if isinstance(value, enum.Enum):
        return value.name
    if isinstance(value, tuple | list):
        parts = [_plain(part) for part in value]
        if any(part is NotImplemented for part in parts):
            return NotImplemented
        names = getattr(value, "_fields", None)
        return parts if names is None else dict(zip(names, parts, strict=True))
    return NotImplemented


def gathered_places(shape: tuple[int, ...], places, params) -> Int[np.ndarray, "..."] | None:
    """The places in an array of this shape, flattened, that `gather` reads; None if some are outside of it."""
    numbers, sizes = params["dimension_numbers"], params["slice_sizes"]
    one_of_each = (*numbers.collapsed_slice_dims, *numbers.operand_batching_dims)
    kept = [size for axis, size in enumerate(sizes) if axis not in one_of_each]
    batch = places.shape[:-1]
    flat = np.arange(np.prod(shape, dtype=int)).reshape(shape)
    found = np.empty((*batch, *kept), int)
    for at in np.ndindex(*batch):
        start = [0] * len(shape)
        for axis, of_batch in zip(numbers.operand_batching_dims, numbers.start_indices_batching_dims, strict=True):
            start[axis] = at[of_batch]
        for axis, own in zip(numbers.start_index_map, places[at], strict=True):
            start[axis] = int(own)
        window = _window(shape, start, sizes, params["mode"])
        if window is None:
            return None
        found[at] = flat[window].reshape(kept)
    return np.moveaxis(found, range(len(batch), found.ndim), numbers.offset_dims)


def scattered_places(shape: tuple[int, ...], places, update_shape: tuple[int, ...], params):
    """Pairs of a place in an array of this shape and one in the update that `scatter` puts there, both flattened."""
    numbers = params["dimension_numbers"]
    one_of_each = (*numbers.inserted_window_dims, *numbers.operand_batching_dims)
    kept = [axis for axis in range(len(shape)) if axis not in one_of_each]
    within = numbers.update_window_dims
    sizes = [1] * len(shape)
    for axis, own in zip(kept, within, strict=True):
        sizes[axis] = update_shape[own]
    flat, update = (np.arange(np.prod(s, dtype=int)).reshape(s) for s in (shape, update_shape))
    update = np.moveaxis(update, within, range(update.ndim - len(within), update.ndim))
    for at in np.ndindex(*places.shape[:-1]):
        start = [0] * len(shape)
        for axis, of_batch in zip(numbers.operand_batching_dims, numbers.scatter_indices_batching_dims, strict=True):
            start[axis] = at[of_batch]
        for axis, own in zip(numbers.scatter_dims_to_operand_dims, places[at], strict=True):
            start[axis] = int(own)
        window = _window(shape, start, sizes, params["mode"])
        if window is not None:
            yield from zip(flat[window].ravel().tolist(), update[at].ravel().tolist(), strict=True)


def _window(shape, start, sizes, mode) -> tuple[slice, ...] | None:
    """A part of an array; None outside of it, where `mode` does not move it inside."""
    last = [own - size for own, size in zip(shape, sizes, strict=True)]
    if getattr(mode, "name", mode) == jax.lax.GatherScatterMode.CLIP.name:
        start = [min(max(own, 0), most) for own, most in zip(start, last, strict=True)]
    if not all(0 <= own <= most for own, most in zip(start, last, strict=True)):
        return None
    return tuple(slice(own, own + size) for own, size in zip(start, sizes, strict=True))


def _gathered(array, places, params):
    # Mostly the same places are read again and again.
    key = array.shape, places.shape, places.tobytes()
    last, found = params.get("latest", (None, None))
    if last != key:
        found = gathered_places(array.shape, places, params)
        params["latest"] = key, found
    return None if found is None else array.ravel()[found]


def _scattered(array, places, update, params, added: bool):
    found, numbers = array.ravel().copy(), update.ravel()
    for place, own in scattered_places(array.shape, places, update.shape, params):
        found[place] = found[place] + numbers[own] if added else numbers[own]
    return found.reshape(array.shape)


def _sliced(array, starts, sizes):
    places = [min(max(int(at), 0), own - size) for at, own, size in zip(starts, array.shape, sizes, strict=True)]
    return array[tuple(slice(at, at + size) for at, size in zip(places, sizes, strict=True))]


def _broadcast(array, shape, along):
    own = [1] * len(shape)
    for axis, size in zip(along, np.shape(array), strict=True):
        own[axis] = size
    # A view of a small array takes five times as long to make as a copy.
    found = np.empty(shape, array.dtype)
    found[...] = np.reshape(array, own)
    return found


def _selected(which, cases):
    if np.ndim(which) == 0:
        return cases[int(which)]
    return np.choose(np.asarray(which, int), cases) if len(cases) > 2 else np.where(which, cases[1], cases[0])


def _converted(array, kind: np.dtype):
    # NumPy warns where an imaginary part is left out.
    array = array.real if np.iscomplexobj(array) and kind.kind != "c" else array
    if kind.kind in "iu" and array.dtype.kind == "f":
        # As XLA has it: the nearest number that there is, and zero for none.
        limits = np.iinfo(kind)
        beyond, below = array >= float(limits.max), array <= float(limits.min)
        inside = np.where(beyond | below | np.isnan(array), 0.0, array).astype(kind)
        return np.where(beyond, limits.max, np.where(below, limits.min, inside)).astype(kind)
    return array.astype(kind)


def _quotient(a, b):
    """Of whole numbers, towards zero; of none by zero."""
    return (a - np.fmod(a, b)) // b if np.all(b) else None


def _complex(real, imaginary):
    # By parts: i times infinity would have a real part, too, which is no number.
    found = np.empty(np.shape(real), np.result_type(real, 1j))
    found.real, found.imag = real, imaginary
    return found


def _summed_up(array, along: int, from_the_end: bool):
    turned = np.flip(array, along) if from_the_end else array
    found = np.cumsum(turned, along, array.dtype)
    return np.flip(found, along) if from_the_end else found


def _sorted(operands, along: int, keys: int):
    order = np.lexsort(operands[:keys][::-1], along)
    return [np.take_along_axis(own, order, along) for own in operands]


def _eigen(matrices, left: bool, right: bool):
    """By the routine of LAPACK that JAX calls."""
    from scipy import linalg

    kept = 1 + left + right
    shape, size = matrices.shape[:-2], matrices.shape[-1]
    found = [np.full((*shape, *(size,) * (1 + (k > 0))), complex(np.nan, np.nan)) for k in range(kept)]
    for at in np.ndindex(*shape):
        # As by JAX, nothing is a number where the matrix is none, or where the routine does not converge.
        if not np.all(np.isfinite(matrices[at])):
            continue
        with contextlib.suppress(np.linalg.LinAlgError):
            parts = linalg.eig(matrices[at], left=left, right=right, check_finite=False)
            for own, part in zip(found, parts if kept > 1 else [parts], strict=True):
                own[at] = part
    return found


def _product(left, right, numbers):
    (along_left, along_right), (batch_left, batch_right) = numbers
    if not batch_left:
        return np.tensordot(left, right, (along_left, along_right))
    # As products of matrices: each has what is summed over as one axis, and what is left as another.
    free = [
        [axis for axis in range(side.ndim) if axis not in (*batch, *along)]
        for side, batch, along in ((left, batch_left, along_left), (right, batch_right, along_right))
    ]
    left = np.transpose(left, (*batch_left, *free[0], *along_left))
    right = np.transpose(right, (*batch_right, *along_right, *free[1]))
    batch, count = left.shape[: len(batch_left)], left.ndim - len(along_left)
    kept, rest = left.shape[len(batch) : count], right.shape[len(batch) + len(along_right) :]
    summed = int(np.prod(left.shape[count:]))
    found = left.reshape(*batch, -1, summed) @ right.reshape(*batch, summed, -1)
    return found.reshape(*batch, *kept, *rest)


def _padded(array, filling, config):
    if any(low < 0 or high < 0 for low, high, _ in config):
        return None
    steps = [inside + 1 for _, _, inside in config]
    ends = [
        low + max((size - 1) * step + 1, 0) for size, step, (low, _, _) in zip(array.shape, steps, config, strict=True)
    ]
    found = np.full([end + high for end, (_, high, _) in zip(ends, config, strict=True)], filling, array.dtype)
    found[tuple(slice(low, end, step) for (low, _, _), end, step in zip(config, ends, steps, strict=True))] = array
    return found
