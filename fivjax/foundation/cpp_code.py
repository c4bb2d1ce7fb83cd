"""A JAX function as C++, so that a kernel for one trajectory computes what the function says.

The function is traced, and its equations are written out one by one: arithmetic of a few numbers with a variable for each, of
many as loops over arrays; `while_loop`, `scan` and `cond` as loops and branches, of which one trajectory goes through one way,
where a batch under `vmap` computes all. What only moves numbers is carried out on their names.

A function may be traced through `jax.jvp`. Then some of what it is given are tangents, which are `wide`: several numbers side by
side, one for each direction. What depends on one is wide, too, and the rest is computed once for all directions.
"""

import re
from collections.abc import Callable, Sequence
from itertools import count

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend.core import ClosedJaxpr, Jaxpr, Literal

from .cpp_arrays import (
    MOVING,
    MOVING_ENTRIES,
    Value,
    View,
    count_of,
    is_known,
    natural,
    of_numbers,
    of_text,
    reshaped,
)
from .taylor import within

# Arrays with more numbers are gone through by loops.
FEW = 40
# Types in C++. What is wide is declared by the kernel: so many numbers in double precision.
WIDE = "wide"
TYPES = {
    "float64": "double",
    "bool": "bool",
    "int32": "int",
    "int8": "int",
    "int64": "long long",
    "uint32": "unsigned",
    "uint64": "unsigned long long",
}

# C++ for the primitives that act on each number.
BY_NUMBER = {
    "add": "{} + {}",
    "add_any": "{} + {}",
    "sub": "{} - {}",
    "mul": "{} * {}",
    "div": "{} / {}",
    "neg": "-{}",
    "abs": "wp::abs({})",
    "sign": "({0} > 0.0 ? 1.0 : ({0} < 0.0 ? -1.0 : {0}))",
    "sqrt": "wp::sqrt({})",
    "rsqrt": "1.0 / wp::sqrt({})",
    "cbrt": "wp::cbrt({})",
    "square": "{0} * {0}",
    "exp": "wp::exp({})",
    "exp2": "wp::pow(2.0, {})",
    "log": "wp::log({})",
    "log1p": "__builtin_log1p({})",
    "expm1": "__builtin_expm1({})",
    "erf": "wp::erf({})",
    "erfc": "wp::erfc({})",
    "pow": "wp::pow({}, {})",
    "sin": "wp::sin({})",
    "cos": "wp::cos({})",
    "tan": "wp::tan({})",
    "asin": "wp::asin({})",
    "acos": "wp::acos({})",
    "atan": "wp::atan({})",
    "atan2": "wp::atan2({}, {})",
    "sinh": "wp::sinh({})",
    "cosh": "wp::cosh({})",
    "tanh": "wp::tanh({})",
    "logistic": "1.0 / (1.0 + wp::exp(-{}))",
    "floor": "wp::floor({})",
    "ceil": "wp::ceil({})",
    "max": "({0} > {1} ? {0} : {1})",
    "min": "({0} < {1} ? {0} : {1})",
    "clamp": "({1} < {0} ? {0} : ({1} > {2} ? {2} : {1}))",
    "lt": "{} < {}",
    "le": "{} <= {}",
    "gt": "{} > {}",
    "ge": "{} >= {}",
    "eq": "{} == {}",
    "ne": "{} != {}",
    "and": "{} & {}",
    "or": "{} | {}",
    "xor": "{} ^ {}",
    "not": "!{}",
    "is_finite": "({0} - {0} == 0.0)",
}
# What leaves each number as it is.
SAME = ("copy", "copy_p", "stop_gradient", "optimization_barrier", "reduce_precision")
# Reductions, by the primitive that they repeat, and running totals.
FOLDED = {
    "reduce_sum": "add",
    "reduce_prod": "mul",
    "reduce_max": "max",
    "reduce_min": "min",
    "reduce_and": "and",
    "reduce_or": "or",
}
RUNNING = {"cumsum": "add", "cumprod": "mul", "cummax": "max", "cummin": "min"}
# The commonest arithmetic of numbers that are known; the rest is left to JAX, which compiles a program for each.
OF_NUMBERS: dict[str, Callable] = {
    "iota": lambda p: np.indices(p["shape"], p["dtype"])[p["dimension"]],
    "convert_element_type": lambda a, p: a.astype(p["new_dtype"]),
    "add": lambda a, b, _: a + b,
    "sub": lambda a, b, _: a - b,
    "mul": lambda a, b, _: a * b,
    "neg": lambda a, _: -a,
    "abs": lambda a, _: np.abs(a),
    "square": lambda a, _: a * a,
    "max": lambda a, b, _: np.maximum(a, b),
    "min": lambda a, b, _: np.minimum(a, b),
    "eq": lambda a, b, _: a == b,
    "ne": lambda a, b, _: a != b,
    "lt": lambda a, b, _: a < b,
    "le": lambda a, b, _: a <= b,
    "gt": lambda a, b, _: a > b,
    "ge": lambda a, b, _: a >= b,
    "and": lambda a, b, _: a & b,
    "or": lambda a, b, _: a | b,
}


class Writer:
    """Code that is being written, equation by equation."""

    def __init__(self, types: dict[str, str] | None = None):
        """`types`: those of the variables that the code is given."""
        self.lines: list[str] = []
        self.types = dict(types or {})
        self._count = count()
        # Blocks that are open, each with what has been computed in it: the same text is the same number.
        self._blocks: list[dict] = [{}]

    # Lines.

    def put(self, line: str) -> None:
        self.lines.append("  " * len(self._blocks) + line)

    def open(self, head: str) -> None:
        self.put(f"{head} {{")
        self._blocks.append({})

    def close(self, blocks: int = 1) -> None:
        for _ in range(blocks):
            self._blocks.pop()
            self.put("}")

    def name(self, kind: str, prefix: str = "v") -> str:
        """A new variable's, or a C array's."""
        found = f"{prefix}{next(self._count)}"
        self.types[found] = kind
        return found

    def line(self, text: str, kind: str) -> str:
        """The name of a variable that has the value of this text."""
        if self.types.get(text) == kind:
            return text
        found = self._computed((kind, text))
        if found is None:
            found = self.name(kind)
            self.put(f"const {kind} {found} = {text};")
            self._blocks[-1][kind, text] = found
        return found

    def _computed(self, key) -> str | None:
        return next((block[key] for block in reversed(self._blocks) if key in block), None)

    def array(self, size: int, kind: str) -> str:
        """The name of a new C array."""
        found = self.name(kind, "a")
        self.put(f"{kind} {found}[{max(size, 1)}];")
        return found

    def loops(self, shape) -> list[str]:
        """The variables of nested loops over all places of an array."""
        names = [self.name("int", "i") for _ in shape]
        for name, size in zip(names, shape, strict=True):
            self.open(f"for (int {name} = 0; {name} < {size}; ++{name})")
        return names

    # Numbers.

    def type_of(self, entry) -> str:
        if isinstance(entry, str):
            return self.types[entry.partition("[")[0]]
        return "bool" if isinstance(entry, bool) else "int" if isinstance(entry, int) else "double"

    def as_type(self, entry, kind: str) -> str:
        own = self.type_of(entry)
        return text_of(entry) if own == kind else f"({kind})({text_of(entry)})"

    def is_wide(self, value: Value) -> bool:
        if isinstance(value, View):
            return value.kind == WIDE
        return any(isinstance(entry, str) and self.type_of(entry) == WIDE for entry in value.ravel())

    # Arrays.

    def entries(self, value: Value) -> np.ndarray:
        return value.entries() if isinstance(value, View) else value

    def small(self, value: Value) -> Value:
        """A view only where there are many numbers."""
        return value.entries() if isinstance(value, View) and value.size <= FEW else value

    def view(self, value: Value, kind: str) -> View:
        """The value in a C array, of this type or wide."""
        if isinstance(value, View):
            return value
        kind = WIDE if self.is_wide(value) else kind
        entries = value.ravel().tolist()
        first = re.fullmatch(r"(\w+)\[(\d+)\]", str(entries[0])) if entries else None
        if first is not None and self.types[first[1]] == kind:
            start = int(first[2])
            if entries == [f"{first[1]}[{start + i}]" for i in range(len(entries))]:
                return View(first[1], (start,), value.shape, natural(value.shape), kind)
        key = kind, tuple(map(text_of, entries))
        base = self._computed(key)
        if base is None:
            base = self.array(value.size, kind)
            self.copy(value, base, kind)
            self._blocks[-1][key] = base
        return View(base, (0,), value.shape, natural(value.shape), kind)

    def copy(self, value: Value, base: str, kind: str, start: str = "0", strides=None) -> None:
        """All numbers into a C array."""
        strides = natural(value.shape) if strides is None else strides
        into = View(base, (0,) if start == "0" else (0, start), value.shape, strides, kind)
        if isinstance(value, View) and value.size > FEW:
            names = self.loops(value.shape)
            self.put(f"{into.at(names)} = {_converted(value.at(names), value.kind, kind)};")
            self.close(len(names))
            return
        entries = self.entries(value)
        for place in np.ndindex(value.shape):
            self.put(f"{into.at(place)} = {self.as_type(entries[place], kind)};")

    def new(self, shape, kind: str) -> View:
        """A view of a new C array."""
        return View(self.array(count_of(shape), kind), (0,), tuple(shape), natural(shape), kind)

    # Equations.

    def run(self, jaxpr: Jaxpr, consts, given: Sequence[Value]) -> list[Value]:
        """The results of a traced function."""
        known = dict(zip(jaxpr.constvars, map(of_numbers, consts), strict=True))
        known.update(zip(jaxpr.invars, given, strict=True))

        def read(atom) -> Value:
            return of_numbers(atom.val) if isinstance(atom, Literal) else known[atom]

        for equation in jaxpr.eqns:
            results = self.applied(equation, list(map(read, equation.invars)))
            known.update(zip(equation.outvars, results, strict=True))
        return list(map(read, jaxpr.outvars))

    def applied(self, equation, operands: list[Value]) -> list[Value]:
        primitive, params = equation.primitive, equation.params
        name = primitive.name
        if name in OWN:
            return OWN[name](self, equation, operands)
        called = within(params)
        if called is not None:
            return self.run(called.jaxpr, called.consts, operands)
        if name in SAME:
            return operands
        if name in MOVING:
            found = MOVING[name](*operands, params)
            return list(map(self.small, found)) if primitive.multiple_results else [self.small(found)]
        if all(map(is_known, operands)) and sum(part.size for part in operands) < 4096:
            return _of_known(equation, operands)
        kinds = [kind_of(variable.aval) for variable in equation.outvars]
        if name in MOVING_ENTRIES and not (name == "concatenate" and any(isinstance(x, View) for x in operands)):
            return [MOVING_ENTRIES[name](*map(self.entries, operands), params)]
        if name in WITH_PLACES:
            return [WITH_PLACES[name](self, equation, operands, kinds[0])]
        return [self.by_number(name, params, operands, kinds[0])]

    def by_number(self, name: str, params, operands: list[Value], kind: str) -> Value:
        if name == "select_n":
            which, *cases = operands
            if is_known(which) and which.size == 1:
                return cases[int(self.entries(which).item())]
            if len(cases) != 2:
                raise NotImplementedError("A choice among more than two values has no C++ here; write `jnp.where`.")
            form = "({0} ? {2} : {1})"
        elif name == "convert_element_type":
            value = operands[0]
            if self.is_wide(value) or (isinstance(value, View) and value.kind == kind):
                return value
            form = "({} != 0)" if kind == "bool" else f"({kind})({{}})"
        elif name == "integer_pow":
            power = params["y"]
            if power == 0:
                return of_numbers(np.ones(operands[0].shape))
            form = " * ".join(["{0}"] * abs(power))
            form = form if power > 0 else f"1.0 / ({form})"
        elif name == "rem":
            form = "__builtin_fmod({}, {})" if kind == "double" else "({} % {})"
        elif name == "round":
            form = "wp::round({})" if params["rounding_method"] == jax.lax.RoundingMethod.AWAY_FROM_ZERO else "wp::rint({})"
        elif name in BY_NUMBER:
            form = BY_NUMBER[name]
        else:
            raise NotImplementedError(f"The primitive `{name}` has no C++ here; write the function without it.")
        return self.each(name, form, operands, kind)

    def each(self, name: str, form: str, operands: Sequence[Value], kind: str) -> Value:
        """The same for each number."""
        if name in ("max", "min") and kind == "double":
            form = form.replace(" ?", " || {0} != {0} ?")  # not a number stays that, as in JAX
        shape = np.broadcast_shapes(*(part.shape for part in operands))
        if count_of(shape) > FEW and not all(map(is_known, operands)):
            return self._each_in_loops(name, form, operands, kind, shape)
        spread = np.broadcast_arrays(*map(self.entries, operands))
        found = np.empty(shape, object)
        for place in np.ndindex(shape):
            found[place] = self.one(name, form, [part[place] for part in spread], kind)
        return found

    def _each_in_loops(self, name: str, form: str, operands: Sequence[Value], kind: str, shape) -> View:
        own = [kind] * len(operands) if name not in ("select_n", *COMPARISONS) else None
        views = []
        for position, part in enumerate(map(_without_repeats, operands)):
            if part.size == 1:
                views.append(self.entries(part).ravel()[0])
            else:
                otherwise = own[position] if own else ("bool" if name == "select_n" and position == 0 else "double")
                views.append(self.view(part, self._plain_type(part, otherwise)).broadcast(shape))
        if kind == "double" and any(map(self.is_wide, operands)):
            kind = WIDE
        into = self.new(shape, kind)
        names = self.loops(shape)
        texts = [part.at(names) if isinstance(part, View) else text_of(part) for part in views]
        if kind == WIDE and name == "select_n":
            texts[1:] = [f"(wide)({text})" for text in texts[1:]]
        text = form.format(*texts)
        self.put(f"{into.at(names)} = {f'(wide)({text})' if kind == WIDE else text};")
        self.close(len(names))
        return into

    def _plain_type(self, value: Value, otherwise: str) -> str:
        """That of the numbers of an array."""
        if isinstance(value, View):
            return value.kind
        kinds = {self.type_of(entry) for entry in value.ravel()}
        return kinds.pop() if len(kinds) == 1 else otherwise

    def one(self, name: str, form: str, parts: list, kind: str):
        """One number: its variable, or what it is known to be."""
        simpler = _simpler(name, parts)
        if simpler is not None:
            return simpler
        texts = list(map(text_of, parts))
        if kind == "double" and any(isinstance(part, str) and self.type_of(part) == WIDE for part in parts):
            kind = WIDE
            if name == "select_n":
                texts[1:] = [self.as_type(part, WIDE) for part in parts[1:]]
        return self.line(form.format(*texts), kind)

    def folded(self, name: str, value: Value, axes, kind: str) -> Value:
        """A reduction over some axes."""
        if value.size > FEW and not is_known(value):
            return self._folded_in_loops(name, self.view(value, kind), axes)
        value = self.entries(value)
        for axis in sorted(axes, reverse=True):
            parts = np.moveaxis(value, axis, 0)
            value = np.asarray(parts[0], object)
            for part in parts[1:]:
                value = self.each(name, BY_NUMBER[name], [value, np.asarray(part, object)], kind)
        return value

    def _folded_in_loops(self, name: str, value: View, axes) -> Value:
        kept = [axis for axis in range(value.ndim) if axis not in axes]
        into, form = self.new([value.shape[axis] for axis in kept], value.kind), BY_NUMBER[name]
        if name in ("max", "min") and value.kind == "double":
            form = form.replace(" ?", " || {0} != {0} ?")
        outer = self.loops(into.shape)
        total = self.name(value.kind, "s")
        neutral = {"add": "0", "mul": "1", "and": "true", "or": "false"}.get(name)
        first = dict.fromkeys(axes, "0") | dict(zip(kept, outer, strict=True))
        start = value.at([first[axis] for axis in range(value.ndim)]) if neutral is None else neutral
        self.put(f"{value.kind} {total} = ({value.kind})({start});")
        inner = self.loops([value.shape[axis] for axis in axes])
        place = dict(zip(axes, inner, strict=True)) | dict(zip(kept, outer, strict=True))
        self.put(f"{total} = {form.format(total, value.at([place[axis] for axis in range(value.ndim)]))};")
        self.close(len(inner))
        self.put(f"{into.at(outer)} = {total};")
        self.close(len(outer))
        return self.small(into)

    def product(self, left: Value, right: Value, numbers, kind: str) -> Value:
        """A product of matrices, vectors or batches of them."""
        along, batch = numbers
        kept = [
            [axis for axis in range(part.ndim) if axis not in (*own, *shared)]
            for part, own, shared in zip((left, right), along, batch, strict=True)
        ]
        shape = [left.shape[axis] for axis in (*batch[0], *kept[0])] + [right.shape[axis] for axis in kept[1]]
        lengths = [left.shape[axis] for axis in along[0]]

        def at(result, step):
            """The places of both factors, for that of a result and the summand's."""
            shared, own = result[: len(batch[0])], result[len(batch[0]) :]
            ends = own[: len(kept[0])], own[len(kept[0]) :]
            for part, axes, free, common, end in zip((left, right), along, kept, batch, ends, strict=True):
                place = dict(zip(axes, step, strict=True)) | dict(zip(free, end, strict=True))
                place |= dict(zip(common, shared, strict=True))
                yield tuple(place[axis] for axis in range(part.ndim))

        if count_of(shape) * count_of(lengths) > FEW:
            factors = self.view(left, kind), self.view(right, kind)
            into = self.new(shape, WIDE if WIDE in (factors[0].kind, factors[1].kind) else kind)
            every = self.name("int", "i")
            self.put(
                f"for (int {every} = 0; {every} < {into.size}; ++{every}) {into.base}[{every}] = ({into.kind})(0.0);"
            )
            # The sum outside: then the loop over the results is one of vectors.
            step, names = self.loops(lengths), self.loops(shape)
            texts = [factor.at(place) for factor, place in zip(factors, at(names, step), strict=True)]
            self.put(f"{into.at(names)} += {' * '.join(texts)};")
            self.close(len(step) + len(names))
            return self.small(into)
        left, right = self.entries(left), self.entries(right)
        found = np.empty(shape, object)
        for place in np.ndindex(*shape):
            total = 0.0
            for step in np.ndindex(*lengths):
                a, b = at(place, step)
                term = self.one("mul", BY_NUMBER["mul"], [left[a], right[b]], kind)
                total = self.one("add", BY_NUMBER["add"], [total, term], kind)
            found[place] = total
        return found

    def place(self, entry, most: int):
        """An index, kept between zero and the most, as JAX keeps it."""
        if not isinstance(entry, str):
            return min(max(int(entry), 0), most)
        return self.line(f"({entry} < 0 ? 0 : ({entry} > {most} ? {most} : (int)({entry})))", "int")

    # What loops and branches change.

    def changed(self, value: Value, kind: str) -> Value:
        """A variable, or a C array, that begins with this value."""
        if value.shape == ():
            found = self.name(kind, "w")
            self.put(f"{kind} {found} = {self.as_type(self.entries(value).item(), kind)};")
            return of_text(found)
        into = self.new(value.shape, kind)
        self.copy(value, into.base, kind)
        return self.small(into)

    def unset(self, shape, kind: str) -> Value:
        """The same, without a value yet."""
        if shape == ():
            found = self.name(kind, "w")
            self.put(f"{kind} {found};")
            return of_text(found)
        return self.small(self.new(shape, kind))

    def assign(self, targets: Sequence[Value], values: Sequence[Value]) -> None:
        """Give these variables and arrays their new values, all at once."""
        bases = {_base(target) for target in targets}
        moves = []
        for target, value in zip(targets, values, strict=True):
            if target.size == 0 or _same(target, value):
                continue
            # What is itself changed by this is copied before.
            if isinstance(value, View):
                if value.base in bases:
                    copied = self.new(value.shape, value.kind)
                    self.copy(value, copied.base, value.kind)
                    value = copied
            else:
                value = np.array([self._kept(entry, bases) for entry in value.ravel()], object).reshape(value.shape)
            moves.append((target, value))
        for target, value in moves:
            if target.shape == ():
                variable = target.item()
                kind = self.type_of(variable)
                self.put(f"{variable} = {self.as_type(self.entries(value).item(), kind)};")
            else:
                self.copy(value, _base(target), self.types[_base(target)])

    def _kept(self, entry, bases: set[str]):
        if not isinstance(entry, str) or entry.partition("[")[0] not in bases:
            return entry
        kind = self.type_of(entry)
        found = self.name(kind)
        self.put(f"const {kind} {found} = {entry};")
        return found


COMPARISONS = ("lt", "le", "gt", "ge", "eq", "ne", "is_finite")


def kind_of(aval) -> str:
    """The type in C++ of numbers of an array."""
    return "bool" if aval.dtype == jax.dtypes.float0 else TYPES[np.dtype(aval.dtype).name]


def text_of(entry) -> str:
    if isinstance(entry, str):
        return entry
    if isinstance(entry, bool):
        return "true" if entry else "false"
    if isinstance(entry, float) and not np.isfinite(entry):
        return "(0.0 / 0.0)" if np.isnan(entry) else "(1.0 / 0.0)" if entry > 0 else "(-1.0 / 0.0)"
    if isinstance(entry, int) and abs(entry) >= 2**31:
        return f"({entry}{'ull' if entry > 0 else 'll'})"
    return f"({entry!r})"


def _without_repeats(value: Value) -> Value:
    """The value with one entry along axes along which it has been broadcast."""
    if isinstance(value, View) or value.size == 0:
        return value
    if all(entry is value.flat[0] or _equal(entry, value.flat[0]) for entry in value.flat):
        return value[(slice(0, 1),) * value.ndim]
    return value[tuple(slice(0, 1) if stride == 0 else slice(None) for stride in value.strides)]


def _equal(one, other) -> bool:
    return type(one) is type(other) and one == other


def _converted(text: str, own: str, kind: str) -> str:
    return text if own == kind else f"({kind})({text})"


def _base(target: Value) -> str:
    if isinstance(target, View):
        return target.base
    return target.ravel()[0].partition("[")[0] if target.size else ""


def _same(target: Value, value: Value) -> bool:
    if isinstance(target, View) or isinstance(value, View):
        return isinstance(target, View) and isinstance(value, View) and target == value
    return target.shape == value.shape and target.ravel().tolist() == value.ravel().tolist()


def _is(entry, number: int) -> bool:
    return not isinstance(entry, str | bool) and entry == number


def _simpler(name: str, parts: list):
    """What follows from the parts that are known, if anything does. Zero times something counts as zero: what is not a number
    shows elsewhere.
    """
    if name == "select_n":
        which, first, second = parts
        if not isinstance(which, str):
            return second if which else first
        return first if _equal(first, second) else None
    if name in ("add", "add_any", "mul", "and", "or"):
        for own, other in (parts, parts[::-1]):
            if name in ("add", "add_any") and _is(own, 0):
                return other
            if name == "mul" and _is(own, 0):
                return own
            if name == "mul" and _is(own, 1):
                return other
            if isinstance(own, bool):
                return other if own == (name == "and") else own
    if (name == "sub" and _is(parts[1], 0)) or (name == "div" and _is(parts[1], 1)):
        return parts[0]
    if name in ("div", "neg") and _is(parts[0], 0):
        return parts[0]
    return None


def _of_known(equation, operands: list[Value]) -> list[Value]:
    values = [
        np.array(part.tolist(), atom.aval.dtype).reshape(part.shape)
        for part, atom in zip(operands, equation.invars, strict=True)
    ]
    name = equation.primitive.name
    if name in OF_NUMBERS:
        found = OF_NUMBERS[name](*values, equation.params)
    else:
        found = equation.primitive.bind(*map(jnp.asarray, values), **equation.params)
    return list(map(of_numbers, found if equation.primitive.multiple_results else [found]))


# Primitives with places that may be unknown, and others with rules of their own for one result.


def _dynamic_slice(writer: Writer, equation, operands, kind: str) -> Value:
    value, *starts = operands
    view, sizes = writer.view(value, kind), equation.params["slice_sizes"]
    return writer.small(_from(writer, view, starts, sizes))


def _from(writer: Writer, view: View, starts, sizes) -> View:
    known, unknown = view.offset[0], list(view.offset[1:])
    for start, size, own, stride in zip(starts, sizes, view.shape, view.strides, strict=True):
        at = writer.place(writer.entries(start).item(), own - size)
        if isinstance(at, str):
            unknown += [f"{at} * {stride}" if stride != 1 else at] * (stride != 0)
        else:
            known += at * stride
    return View(view.base, (known, *unknown), tuple(sizes), view.strides, view.kind)


def _dynamic_update_slice(writer: Writer, equation, operands, kind: str) -> Value:
    value, update, *starts = operands
    kind = WIDE if writer.is_wide(value) or writer.is_wide(update) else kind
    into = writer.new(value.shape, kind)
    writer.copy(value, into.base, kind)
    part = _from(writer, into, starts, update.shape)
    for place, entry in np.ndenumerate(writer.entries(update)):
        writer.put(f"{part.at(place)} = {writer.as_type(entry, kind)};")
    return writer.small(into)


def _gather(writer: Writer, equation, operands, kind: str) -> Value:
    value, places = operands
    if is_known(places):
        return _moved_to(equation, [writer.entries(value)], places)
    numbers, sizes = equation.params["dimension_numbers"], equation.params["slice_sizes"]
    if numbers.operand_batching_dims:
        raise NotImplementedError("Numbers taken from each part of a batch have no C++ here.")
    view, places = writer.view(value, kind), writer.entries(places)
    kept = [axis for axis in range(view.ndim) if axis not in numbers.collapsed_slice_dims]
    found = np.empty(equation.outvars[0].aval.shape, object)
    parts = {}
    for batch in np.ndindex(places.shape[:-1]):
        starts = [of_numbers(0)] * view.ndim
        for position, axis in enumerate(numbers.start_index_map):
            starts[axis] = np.asarray(places[(*batch, position)], object)
        part = _from(writer, view, starts, sizes)
        parts[batch] = part.selected(part.offset, kept)
    for place in np.ndindex(found.shape):
        batch = tuple(at for axis, at in enumerate(place) if axis not in numbers.offset_dims)
        found[place] = parts[batch].at([place[axis] for axis in numbers.offset_dims])
    return found


def _scatter(writer: Writer, equation, operands, kind: str) -> Value:
    value, places, update = operands
    if is_known(places):
        return _moved_to(equation, [writer.entries(value), writer.entries(update)], places)
    return _put_at(writer, equation, operands, kind, "=")


def _scatter_add(writer: Writer, equation, operands, kind: str) -> Value:
    value, places, update = operands
    if not is_known(places):
        return _put_at(writer, equation, operands, kind, "+=")
    value, update = writer.entries(value), writer.entries(update)
    numbers = np.arange(1, update.size + 1).reshape(update.shape)
    places = np.array(places.tolist(), np.int32).reshape(places.shape)
    put = np.asarray(
        jax.lax.scatter(
            np.zeros(value.shape, numbers.dtype), places, numbers, equation.params["dimension_numbers"]
        )
    )
    found = value.copy()
    for place in zip(*np.nonzero(put), strict=True):
        more = update.ravel()[put[place] - 1]
        found[place] = writer.one("add", BY_NUMBER["add"], [value[place], more], kind)
    return found


def _put_at(writer: Writer, equation, operands, kind: str, how: str) -> Value:
    value, places, update = operands
    numbers = equation.params["dimension_numbers"]
    if places.size != len(numbers.scatter_dims_to_operand_dims):
        raise NotImplementedError("Numbers put at several unknown places have no C++ here; put them one by one.")
    kind = WIDE if writer.is_wide(value) or writer.is_wide(update) else kind
    into = writer.new(value.shape, kind)
    writer.copy(value, into.base, kind)
    starts = [of_numbers(0)] * len(value.shape)
    sizes = [1 if axis in numbers.inserted_window_dims else size for axis, size in enumerate(value.shape)]
    for at, axis in zip(writer.entries(places).ravel(), numbers.scatter_dims_to_operand_dims, strict=True):
        starts[axis] = np.asarray(at, object)
    kept = [axis for axis in range(len(value.shape)) if axis not in numbers.inserted_window_dims]
    part = _from(writer, into, starts, sizes)
    part = part.selected(part.offset, kept)
    for place, entry in np.ndenumerate(writer.entries(update)):
        writer.put(f"{part.at(place)} {how} {writer.as_type(entry, kind)};")
    return writer.small(into)


def _moved_to(equation, moving: list[np.ndarray], places: np.ndarray) -> np.ndarray:
    """Where the entries of operands go: the numbers of entries are moved in their stead."""
    entries, numbers = [], []
    for part in moving:
        numbers.append(np.arange(len(entries), len(entries) + part.size).reshape(part.shape))
        entries += list(part.ravel())
    places = np.array(places.tolist(), np.int32).reshape(places.shape)
    params = dict(equation.params)
    if "fill_value" in params:
        params["fill_value"] = None
    found = equation.primitive.bind(*map(jnp.asarray, [numbers[0], places, *numbers[1:]]), **params)
    return np.asarray(np.array([*entries, None], object)[np.asarray(found)], object)


def _concatenate(writer: Writer, equation, operands, kind: str) -> Value:
    axis = equation.params["dimension"]
    kind = WIDE if any(map(writer.is_wide, operands)) else kind
    into, start = writer.new(equation.outvars[0].aval.shape, kind), 0
    for part in operands:
        if part.size:
            writer.copy(part, into.base, kind, f"{start * into.strides[axis]}", into.strides)
        start += part.shape[axis]
    return into


def _reshape(writer: Writer, equation, operands, kind: str) -> Value:
    (value,) = operands
    shape = equation.params["new_sizes"]
    found = reshaped(value, shape)
    if found is None:
        into = writer.new(value.shape, value.kind)
        writer.copy(value, into.base, value.kind)
        found = into._replace(shape=tuple(shape), strides=natural(shape))
    return writer.small(found)


def _best_place(sign: str) -> Callable:
    def of(writer: Writer, equation, operands, kind: str) -> Value:
        (axis,) = equation.params["axes"]
        parts = np.moveaxis(writer.entries(operands[0]), axis, 0)
        found = np.empty(parts.shape[1:], object)
        for place in np.ndindex(found.shape):
            best, at = parts[(0, *place)], 0
            for i in range(1, len(parts)):
                own = parts[(i, *place)]
                better = writer.line(f"{text_of(own)} {sign} {text_of(best)}", "bool")
                at = writer.line(f"({better} ? {i} : {text_of(at)})", kind)
                best = writer.line(f"({better} ? {text_of(own)} : {text_of(best)})", writer.type_of(own))
            found[place] = at
        return found

    return of


def _sort(writer: Writer, equation, operands, kind: str) -> Value:
    if len(operands) != 1 or operands[0].ndim != 1 or writer.is_wide(operands[0]):
        raise NotImplementedError("Only one row of numbers without tangents is sorted in C++ here.")
    into = writer.new(operands[0].shape, kind)
    writer.copy(operands[0], into.base, kind)
    base, own, at, x = into.base, writer.name("int", "i"), writer.name("int", "i"), writer.name(kind, "x")
    writer.open(f"for (int {own} = 1; {own} < {into.size}; ++{own})")
    writer.put(f"const {kind} {x} = {base}[{own}];")
    writer.put(f"int {at} = {own} - 1;")
    writer.put(f"for (; {at} >= 0 && {base}[{at}] > {x}; --{at}) {base}[{at} + 1] = {base}[{at}];")
    writer.put(f"{base}[{at} + 1] = {x};")
    writer.close()
    return writer.small(into)


def _running(name: str) -> Callable:
    def of(writer: Writer, equation, operands, kind: str) -> Value:
        axis, backwards = equation.params["axis"], equation.params["reverse"]
        parts = list(np.moveaxis(writer.entries(operands[0]), axis, 0))[:: -1 if backwards else 1]
        found = [np.asarray(parts[0], object)]
        for part in parts[1:]:
            found.append(
                writer.entries(
                    writer.each(name, BY_NUMBER[name], [found[-1], np.asarray(part, object)], kind)
                )
            )
        return np.moveaxis(np.stack(found[:: -1 if backwards else 1]), 0, axis)

    return of


def _same_bits(writer: Writer, equation, operands, kind: str) -> Value:
    own, value = kind_of(equation.invars[0].aval), writer.entries(operands[0])
    found = np.empty(value.shape, object)
    for place, entry in np.ndenumerate(value):
        found[place] = writer.line(f"__builtin_bit_cast({kind}, {writer.line(text_of(entry), own)})", kind)
    return found


WITH_PLACES: dict[str, Callable] = {
    "dynamic_slice": _dynamic_slice,
    "dynamic_update_slice": _dynamic_update_slice,
    "gather": _gather,
    "scatter": _scatter,
    "scatter-add": _scatter_add,
    "concatenate": _concatenate,
    "reshape": _reshape,
    "expand_dims": _reshape,
    "argmax": _best_place(">"),
    "argmin": _best_place("<"),
    "sort": _sort,
    "bitcast_convert_type": _same_bits,
    "dot_general": lambda writer, equation, operands, kind: writer.product(
        *operands, equation.params["dimension_numbers"], kind
    ),
}
WITH_PLACES |= {name: _running(of) for name, of in RUNNING.items()}
WITH_PLACES |= {
    name: lambda writer, equation, operands, kind, of=of: writer.folded(
        of, operands[0], equation.params["axes"], kind
    )
    for name, of in FOLDED.items()
}


# Loops and branches.


def _while(writer: Writer, equation, operands) -> list[Value]:
    condition, body = equation.params["cond_jaxpr"], equation.params["body_jaxpr"]
    asked = operands[: equation.params["cond_nconsts"]]
    fixed = operands[len(asked) :][: equation.params["body_nconsts"]]
    begin = operands[len(asked) + len(fixed) :]
    kinds, _ = _types_carried(writer, body.jaxpr, fixed, begin, [], equation.outvars)
    carry = [writer.changed(value, kind) for value, kind in zip(begin, kinds, strict=True)]
    writer.open("for (;;)")
    (going,) = writer.run(condition.jaxpr, condition.consts, [*asked, *carry])
    writer.put(f"if (!({text_of(writer.entries(going).item())})) break;")
    writer.assign(carry, writer.run(body.jaxpr, body.consts, [*fixed, *carry]))
    writer.close()
    return carry


def _scan(writer: Writer, equation, operands) -> list[Value]:
    shapes = [variable.aval.shape for variable in equation.outvars[equation.params["num_carry"] :]]
    return scan(writer, equation, operands, str(equation.params["length"]), lambda k, kind: writer.new(shapes[k], kind))


def scan(writer: Writer, equation, operands, length: str, rows_of: Callable[[int, str], View]) -> list[Value]:
    """A loop along arrays, of a length that may be a variable; `rows_of` gives the array for each of its rows of results, by
    number and type.
    """
    params, body = equation.params, equation.params["jaxpr"]
    fixed, begin = operands[: params["num_consts"]], operands[params["num_consts"] :][: params["num_carry"]]
    along = operands[len(fixed) + len(begin) :]
    kinds, wide = _types_carried(writer, body.jaxpr, fixed, begin, along, equation.outvars[: len(begin)])
    along = [
        writer.view(value, kind_of(atom.aval))
        for value, atom in zip(along, equation.invars[len(fixed) + len(begin) :], strict=True)
    ]
    carry = [writer.changed(value, kind) for value, kind in zip(begin, kinds, strict=True)]
    rows = [
        rows_of(k, WIDE if wide[len(begin) + k] else kind_of(variable.aval))
        for k, variable in enumerate(equation.outvars[len(begin) :])
    ]
    own = writer.name("int", "i")
    writer.open(f"for (int {own} = 0; {own} < {length}; ++{own})")
    at = writer.line(f"{length} - 1 - {own}", "int") if params["reverse"] else own

    def row(view: View) -> Value:
        offset = (*view.offset, f"{at} * {view.strides[0]}")
        return writer.small(view.selected(offset, range(1, view.ndim)))

    found = writer.run(body.jaxpr, body.consts, [*fixed, *carry, *map(row, along)])
    for view, value in zip(rows, found[len(begin) :], strict=True):
        start = " + ".join([*view.offset[1:], f"{at} * {view.strides[0]}", str(view.offset[0])])
        writer.copy(value, view.base, view.kind, start, view.strides[1:])
    writer.assign(carry, found[: len(begin)])
    writer.close()
    return [*carry, *map(writer.small, rows)]


def _cond(writer: Writer, equation, operands) -> list[Value]:
    index, *rest = operands
    branches, which = equation.params["branches"], writer.entries(index).item()
    last = len(branches) - 1
    if not isinstance(which, str):
        chosen = branches[min(max(int(which), 0), last)]
        return writer.run(chosen.jaxpr, chosen.consts, rest)
    flags = list(map(writer.is_wide, rest))
    wide = [any(each) for each in zip(*(moved(branch.jaxpr, flags) for branch in branches), strict=True)]
    found = [
        writer.unset(variable.aval.shape, WIDE if is_wide else kind_of(variable.aval))
        for variable, is_wide in zip(equation.outvars, wide, strict=True)
    ]
    for k, branch in enumerate(branches):
        test = f"if ({which} <= 0)" if k == 0 else f"else if ({which} == {k})" if k < last else "else"
        writer.open(test)
        writer.assign(found, writer.run(branch.jaxpr, branch.consts, rest))
        writer.close()
    return found


def _solved(writer: Writer, equation, operands) -> list[Value]:
    """`custom_linear_solve`, by the solution that it was given."""
    lengths, solve = equation.params["const_lengths"], equation.params["jaxprs"].solve
    ends = np.cumsum(lengths).tolist()
    place = list(lengths._fields).index("solve")
    own = operands[ends[place] - lengths.solve : ends[place]]
    return writer.run(solve.jaxpr, solve.consts, [*own, *operands[ends[-1] :]])


OWN: dict[str, Callable] = {"while": _while, "scan": _scan, "cond": _cond, "custom_linear_solve": _solved}


def _types_carried(writer: Writer, body: Jaxpr, fixed, begin, along, variables) -> tuple[list[str], list[bool]]:
    """The types of what a loop carries, and which of the body's results are wide."""
    wide = list(map(writer.is_wide, begin))
    wide, after = _carried(body, list(map(writer.is_wide, fixed)), wide, list(map(writer.is_wide, along)))
    kinds = [WIDE if is_wide else kind_of(variable.aval) for is_wide, variable in zip(wide, variables, strict=True)]
    return kinds, after


def _carried(body: Jaxpr, fixed: list[bool], begin: list[bool], along: list[bool]) -> tuple[list[bool], list[bool]]:
    """Which of the numbers that a loop carries are wide, from its first turn or a later one, and which of its results."""
    while True:
        after = moved(body, [*fixed, *begin, *along])
        more = [one or other for one, other in zip(begin, after[: len(begin)], strict=True)]
        if more == begin:
            return begin, after
        begin = more


def moved(jaxpr: Jaxpr, wide: Sequence[bool]) -> list[bool]:
    """Which results of a traced function are wide if these of its operands are: real numbers that depend on one."""
    moves = dict(zip(jaxpr.invars, wide, strict=True))

    def reads(atom) -> bool:
        return not isinstance(atom, Literal) and moves.get(atom, False)

    for equation in jaxpr.eqns:
        flags, name, params = list(map(reads, equation.invars)), equation.primitive.name, equation.params
        if name == "while":
            asked, fixed = params["cond_nconsts"], params["body_nconsts"]
            begin = flags[asked + fixed :]
            found, _ = _carried(params["body_jaxpr"].jaxpr, flags[asked:][:fixed], begin, [])
        elif name == "scan":
            fixed, carried = params["num_consts"], params["num_carry"]
            begin, after = _carried(
                params["jaxpr"].jaxpr, flags[:fixed], flags[fixed:][:carried], flags[fixed + carried :]
            )
            found = [*begin, *after[carried:]]
        elif name == "cond":
            ways = (moved(branch.jaxpr, flags[1:]) for branch in params["branches"])
            found = [any(each) for each in zip(*ways, strict=True)]
        elif name not in OWN and isinstance(called := within(params), ClosedJaxpr):
            found = moved(called.jaxpr, flags)
        else:
            found = [any(flags)] * len(equation.outvars)
        for variable, is_wide in zip(equation.outvars, found, strict=True):
            moves[variable] = is_wide and jnp.issubdtype(variable.aval.dtype, jnp.inexact)
    return list(map(reads, jaxpr.outvars))
