"""The arithmetic of a JAX function as C++ for scalars, so that a kernel for one trajectory computes what the function says.

The function is traced, and each number in it becomes one variable. What only moves numbers (slices, reshapes, concatenation)
is carried out on their names, and loops are not known: this is for functions of a few numbers, such as the laws of contact of
one point.
"""

from collections.abc import Callable
from itertools import count, repeat

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend.core import ClosedJaxpr, Jaxpr, Literal

# C++ for the primitives that act on each number; functions are Warp's, which has them for CPUs and for GPUs.
BY_NUMBER = {
    "add": "{} + {}",
    "sub": "{} - {}",
    "mul": "{} * {}",
    "div": "{} / {}",
    "neg": "-{}",
    "abs": "wp::abs({})",
    "sign": "({0} > 0.0 ? 1.0 : ({0} < 0.0 ? -1.0 : {0}))",
    "sqrt": "wp::sqrt({})",
    "square": "{0} * {0}",
    "exp": "wp::exp({})",
    "log": "wp::log({})",
    "floor": "wp::floor({})",
    "max": "({0} > {1} ? {0} : {1})",
    "min": "({0} < {1} ? {0} : {1})",
    "lt": "{} < {}",
    "le": "{} <= {}",
    "gt": "{} > {}",
    "ge": "{} >= {}",
    "eq": "{} == {}",
    "ne": "{} != {}",
    "and": "{} && {}",
    "or": "{} || {}",
    "xor": "{} != {}",
    "not": "!{}",
    "copy": "{}",
    "copy_p": "{}",
    "stop_gradient": "{}",
}
# Primitives that move numbers without computing anything. (Done by NumPy: JAX compiles a program for each size.)
MOVING: dict[str, Callable] = {
    "reshape": lambda part, p: part.reshape(p["new_sizes"]),
    "squeeze": lambda part, p: np.squeeze(part, tuple(p["dimensions"])),
    "slice": lambda part, p: part[tuple(map(slice, p["start_indices"], p["limit_indices"], p["strides"] or repeat(1)))],
    "transpose": lambda part, p: np.transpose(part, p["permutation"]),
    "rev": lambda part, p: np.flip(part, p["dimensions"]),
    "broadcast_in_dim": lambda part, p: _broadcast(part, p["shape"], p["broadcast_dimensions"]),
    "split": lambda part, p: np.split(part, np.cumsum(p["sizes"])[:-1], p["axis"]),
    "concatenate": lambda *parts: np.concatenate(parts[:-1], parts[-1]["dimension"]),
    "stack": lambda *parts: np.stack(parts[:-1], parts[-1]["axis"]),
}
# The commonest arithmetic of numbers that are known, such as places in arrays; the rest is left to JAX, which compiles a
# program for each.
OF_NUMBERS: dict[str, Callable] = {
    "iota": lambda p: np.indices(p["shape"], p["dtype"])[p["dimension"]],
    "convert_element_type": lambda a, p: a.astype(p["new_dtype"]),
    "add": lambda a, b, _: a + b,
    "eq": lambda a, b, _: a == b,
    "ne": lambda a, b, _: a != b,
    "lt": lambda a, b, _: a < b,
    "ge": lambda a, b, _: a >= b,
}
# The same, with operands that say where; and how many operands are moved.
MOVING_TO_PLACES = {"gather": 1, "dynamic_slice": 1, "dynamic_update_slice": 2, "scatter": 3}
# Reductions, by the primitive that they repeat.
FOLDED = {
    "reduce_sum": "add",
    "reduce_max": "max",
    "reduce_min": "min",
    "reduce_and": "and",
    "reduce_or": "or",
}


def scalar_source(function: Callable, **lengths: int) -> tuple[str, int]:
    """The body of a C++ function of vectors of these lengths, by name, with the length of the vector `found` that it fills.

    `function` takes the vectors in double precision, in this order, and gives one vector of numbers of any type.

    **Raises:** `NotImplementedError` if it has a loop or a branch that JAX does not unroll.
    """
    with jax.enable_x64(True):
        like = [jax.ShapeDtypeStruct((length,), np.float64) for length in lengths.values()]
        closed = jax.make_jaxpr(function)(*like)
        writer = _Writer()
        given = [_named(f"{name}[{{}}]", length) for name, length in lengths.items()]
        (found,) = writer.run(closed.jaxpr, closed.consts, given)
    ends = [f"found[{place}] = (double)({_text(entry)});" for place, entry in enumerate(found.ravel())]
    return "\n".join([*writer.lines, *ends]), found.size


def _named(form: str, length: int) -> np.ndarray:
    return np.array([form.format(place) for place in range(length)], object)


class _Writer:
    """Traced arithmetic, line by line. Arrays hold names of variables, or numbers where these are known."""

    def __init__(self):
        self.lines: list[str] = []
        self.count = count()

    def run(self, jaxpr: Jaxpr, consts, given) -> list[np.ndarray]:
        """The results of a traced function."""
        known = dict(zip(jaxpr.constvars, map(_of_numbers, consts), strict=True))
        known.update(zip(jaxpr.invars, given, strict=True))

        def read(atom) -> np.ndarray:
            return _of_numbers(atom.val) if isinstance(atom, Literal) else known[atom]

        for equation in jaxpr.eqns:
            operands = [read(atom) for atom in equation.invars]
            results = self.applied(equation, operands)
            known.update(zip(equation.outvars, results, strict=True))
        return [read(atom) for atom in jaxpr.outvars]

    def applied(self, equation, operands: list[np.ndarray]) -> list[np.ndarray]:
        primitive, within = equation.primitive, _within(equation.params)
        name = primitive.name
        if within is not None:
            return self.run(within.jaxpr, within.consts, operands)
        kinds = [variable.aval.dtype for variable in equation.outvars]
        if name in MOVING:
            found = MOVING[name](*operands, equation.params)
            return list(found) if primitive.multiple_results else [found]
        if all(map(_is_known, operands)):
            values = [_typed(part, atom) for part, atom in zip(operands, equation.invars, strict=True)]
            if name in OF_NUMBERS:
                found = OF_NUMBERS[name](*values, equation.params)
            else:
                found = primitive.bind(*map(jnp.asarray, values), **equation.params)
            return [_of_numbers(part) for part in (found if primitive.multiple_results else [found])]
        if name == "select_n" and len(operands) == 3 and _is_known(operands[0]):
            return [np.where(operands[0].astype(bool), operands[2], operands[1])]
        if name in MOVING_TO_PLACES:
            return [_moved_to_places(equation, operands)]
        if name == "scatter-add":
            return [self.added_at(equation, operands)]
        if name in FOLDED:
            return [self.folded(FOLDED[name], operands[0], equation.params["axes"], kinds[0])]
        if name == "dot_general":
            return [self.product(operands[0], operands[1], equation.params["dimension_numbers"], kinds[0])]
        return [self.by_number(name, equation.params, operands, kinds[0])]

    def by_number(self, name: str, params, operands: list[np.ndarray], kind) -> np.ndarray:
        if name == "select_n" and len(operands) == 3:
            form = "({0} ? {2} : {1})"
        elif name == "convert_element_type":
            form = f"({_type(kind)})({{}})"
        elif name == "integer_pow" and params["y"] > 0:
            form = " * ".join(["{0}"] * params["y"])
        elif name == "clamp":
            form = "({1} < {0} ? {0} : ({1} > {2} ? {2} : {1}))"
        elif name in BY_NUMBER:
            form = BY_NUMBER[name]
        else:
            raise NotImplementedError(f"The primitive `{name}` has no C++ here; write the function without it.")
        return self.each(form, operands, kind)

    def each(self, form: str, operands: list[np.ndarray], kind) -> np.ndarray:
        if form in (BY_NUMBER["max"], BY_NUMBER["min"]) and not np.issubdtype(kind, np.integer):
            form = form.replace(" ?", " || {0} != {0} ?")  # not a number stays that, as in JAX
        spread = np.broadcast_arrays(*operands)
        found = np.empty(spread[0].shape, object)
        for place in np.ndindex(found.shape):
            found[place] = self.line(form.format(*(_text(part[place]) for part in spread)), kind)
        return found

    def line(self, text: str, kind) -> str:
        variable = f"v{next(self.count)}"
        self.lines.append(f"const {_type(kind)} {variable} = {text};")
        return variable

    def folded(self, name: str, operand: np.ndarray, axes, kind) -> np.ndarray:
        for axis in sorted(axes, reverse=True):
            parts = np.moveaxis(operand, axis, 0)
            operand = np.asarray(parts[0], object)
            for part in parts[1:]:
                operand = self.each(BY_NUMBER[name], [operand, np.asarray(part, object)], kind)
        return operand

    def product(self, left: np.ndarray, right: np.ndarray, numbers, kind) -> np.ndarray:
        ((along_left,), (along_right,)), batch = numbers
        if any(batch):
            raise NotImplementedError("Matrix products of batches have no C++ here; write them as sums.")
        left, right = np.moveaxis(left, along_left, -1), np.moveaxis(right, along_right, -1)
        rows, columns = left.reshape(-1, left.shape[-1]), right.reshape(-1, right.shape[-1])
        found = np.empty((len(rows), len(columns)), object)
        for i, j in np.ndindex(found.shape):
            terms = [f"{_text(a)} * {_text(b)}" for a, b in zip(rows[i], columns[j], strict=True)]
            found[i, j] = self.line(" + ".join(terms), kind)
        return found.reshape(*left.shape[:-1], *right.shape[:-1])

    def added_at(self, equation, operands: list[np.ndarray]) -> np.ndarray:
        """The first operand with what is to be added at known places."""
        operand, index, updates = operands
        places = np.arange(1, updates.size + 1).reshape(updates.shape)
        put = jax.lax.scatter(
            np.zeros(operand.shape, places.dtype),
            index.astype(np.int32),
            places,
            equation.params["dimension_numbers"],
        )
        put, found = np.asarray(put), operand.copy()
        for place in zip(*np.nonzero(put), strict=True):
            more = updates.ravel()[put[place] - 1]
            found[place] = self.line(f"{_text(operand[place])} + {_text(more)}", equation.outvars[0].aval.dtype)
        return found


def _within(params) -> ClosedJaxpr | None:
    """The traced function that an equation calls once, if it calls one."""
    if any(name in params for name in ("branches", "cond_jaxpr", "body_jaxpr", "length")):
        raise NotImplementedError("Loops and branches have no C++ here; write the function with `jnp.where`.")
    return next(
        (part for name in ("jaxpr", "call_jaxpr", "fun_jaxpr") if isinstance(part := params.get(name), ClosedJaxpr)),
        None,
    )


def _broadcast(part: np.ndarray, shape: tuple[int, ...], along: tuple[int, ...]) -> np.ndarray:
    """The array with its axes at these places among those of the shape."""
    own = [1] * len(shape)
    for axis, size in zip(along, part.shape, strict=True):
        own[axis] = size
    return np.broadcast_to(part.reshape(own), shape)


def _moved_to_places(equation, operands: list[np.ndarray]) -> np.ndarray:
    """Where the entries of operands go: the numbers of entries are moved in their stead."""
    name = equation.primitive.name
    given, entries = [], []
    for position, (operand, atom) in enumerate(zip(operands, equation.invars, strict=True)):
        if (name == "scatter" and position == 1) or position >= MOVING_TO_PLACES[name]:
            given.append(_typed(operand, atom))
        else:
            given.append(np.arange(len(entries), len(entries) + operand.size).reshape(operand.shape))
            entries += list(operand.ravel())
    params = dict(equation.params)
    if "fill_value" in params:
        params["fill_value"] = None
    found = equation.primitive.bind(*map(jnp.asarray, given), **params)
    return np.asarray(np.array([*entries, None], object)[np.asarray(found)], object)


def _of_numbers(value) -> np.ndarray:
    """An array whose entries are Python's numbers: these are known."""
    value = np.asarray(value)
    found = np.empty(value.shape, object)
    found[...] = value.tolist() if value.ndim else value.item()
    return found


def _typed(part: np.ndarray, atom) -> np.ndarray:
    """Known numbers in the type that they have where they are used."""
    return np.array(part.tolist(), atom.aval.dtype).reshape(part.shape)


def _is_known(part: np.ndarray) -> bool:
    return not any(isinstance(entry, str) for entry in part.ravel())


def _text(entry) -> str:
    if isinstance(entry, str):
        return entry
    if isinstance(entry, bool):
        return "true" if entry else "false"
    if isinstance(entry, float) and not np.isfinite(entry):
        return "(0.0 / 0.0)" if np.isnan(entry) else "(1.0 / 0.0)" if entry > 0 else "(-1.0 / 0.0)"
    return f"({entry!r})"


def _type(kind) -> str:
    if np.issubdtype(kind, np.bool_):
        return "bool"
    return "int" if np.issubdtype(kind, np.integer) else "double"
