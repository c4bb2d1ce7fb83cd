"""A JAX function as C++, so that a kernel for one trajectory computes what the function says.

The function is traced, and its equations are written out one by one: arithmetic of a few numbers with a variable for each, of
many as loops over arrays; `while_loop`, `scan` and `cond` as loops and branches, of which one trajectory goes through one way,
where a batch under `vmap` computes all. What only moves numbers is carried out on their names.

A function may be traced through `jax.jvp`. Then some of what it is given are tangents, which are `wide`: several numbers side
by side, one for each direction. What depends on one is wide, too, and the rest is computed once for all directions.
"""

import re
from collections.abc import Callable, Mapping, Sequence
from itertools import count

import jax
import numpy as np
from jax.extend.core import Jaxpr, Literal

from ..foundation.jaxprs import within
from . import cpp_lanes
from .cpp_arrays import MOVING, MOVING_ENTRIES, Value, View, count_of, has_known_numbers, natural, of_numbers
from .cpp_fused import fused
from .cpp_lanes import KINDS, OF_LANES
from .cpp_numbers import (
    BY_NUMBER,
    COMPARISONS,
    SAME,
    WHOLE_QUOTIENT,
    WHOLE_REMAINDER,
    WIDE,
    converted,
    form_before_conversion,
    form_for,
    kind_of,
    of_known,
    simpler,
    text_of,
    types_of_operands,
    without_repeats,
)

# Arrays with more numbers are gone through by loops.
FEW = 40
# The arrays of a lane's own numbers and of its group's, which do not change.
GIVEN = ("given", "shared")


class Writer:
    """Code that is being written, equation by equation."""

    def __init__(
        self,
        rules: Mapping[str, Callable],
        calls: Mapping[str, Callable],
        types: Mapping[str, str],
        lanes: bool,
    ):
        """`rules` are functions that write primitives, `calls` those that write calls of functions, by name; `types` are those
        of the variables that the code is given. `lanes` is whether the code is for several lanes side by side (`cpp_lanes`).
        """
        self.lanes = lanes
        # Of the lanes side by side, which go through the code that is being written.
        self.going = cpp_lanes.ALL
        self.rules, self.calls = rules, calls
        self.lines: list[str] = []
        # The texts of functions that the code calls, by name.
        self.functions: dict[str, str] = {}
        self.types = dict(types)
        self._count = count()
        # Blocks that are open, each with what has been computed in it: the same text is the same number.
        self._blocks: list[dict] = [{}]
        # Code that comes before, what it has computed, and the arrays that are known there: at first what the code is given.
        self.before: list[str] = []
        self._once: dict = {}
        self._known_before = {name for name in GIVEN if name in self.types}

    # Lines.

    @property
    def source(self) -> str:
        return "\n".join([*self.functions.values(), *fused([*self.before, *self.lines])])

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

    def is_known_before(self, view: View) -> bool:
        """Whether an array follows from what the code is given."""
        return view.base in self._known_before and len(view.offset) == 1

    def once(self, key, views: Sequence[View], write: Callable[[], View]) -> View:
        """The array that `write` writes: if it follows from what the code is given, before all loops, and once for each key."""
        if not all(map(self.is_known_before, views)):
            return write()
        if key not in self._once:
            here = self.lines, self._blocks
            self.lines, self._blocks = self.before, [{}]
            found = self._once[key] = write()
            self.lines, self._blocks = here
            self._known_before.add(found.base)
        return self._once[key]

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
        return converted(text_of(entry), self.type_of(entry), kind)

    def is_wide(self, value: Value) -> bool:
        wide = KINDS if self.lanes else (WIDE,)
        if isinstance(value, View):
            return value.kind in wide
        return any(isinstance(entry, str) and self.type_of(entry) in wide for entry in value.ravel())

    def widened(self, kind: str) -> str:
        """The type of numbers that are wide, by that of one of them."""
        return OF_LANES.get(kind, kind) if self.lanes else WIDE

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
        kind = self.widened(kind) if self.is_wide(value) else kind
        entries = value.ravel().tolist()
        first = re.fullmatch(r"(\w+)\[(\d+)\]", str(entries[0])) if entries else None
        if first is not None and self.types[first[1]] == kind:
            start = int(first[2])
            if entries == [f"{first[1]}[{start + i}]" for i in range(len(entries))]:
                return View(first[1], (start,), value.shape, natural(value.shape), kind)
        key = kind, tuple(map(text_of, entries))
        base = self._computed(key)
        if base is None and has_known_numbers(value) and entries:
            base = self.name(kind, "a")
            self.put(f"static const {kind} {base}[{len(entries)}] = {{{', '.join(key[1])}}};")
            self._blocks[-1][key] = base
        if base is None:
            base = self.array(value.size, kind)
            self.copy(value, base, kind)
            self._blocks[-1][key] = base
        return View(base, (0,), value.shape, natural(value.shape), kind)

    def copy(
        self, value: Value, base: str, kind: str, start: str = "0", strides=None, where: str | None = None
    ) -> None:
        """All numbers into a C array; those of lanes `where` that holds, if it is said."""
        strides = natural(value.shape) if strides is None else strides
        into = View(base, (0,) if start == "0" else (0, start), value.shape, strides, kind)
        if isinstance(value, View) and value.size > FEW:
            names = self.loops(value.shape)
            self.set(into.at(names), converted(value.at(names), value.kind, kind), where)
            self.close(len(names))
            return
        entries = self.entries(value)
        for place in np.ndindex(value.shape):
            self.set(into.at(place), self.as_type(entries[place], kind), where)

    def set(self, target: str, text: str, where: str | None = None) -> None:
        """Give a variable another value; that of lanes `where` that holds, if it is said."""
        self.put(f"{target} = {text if where is None else f'({where} ? {text} : {target})'};")

    def new(self, shape, kind: str) -> View:
        """A view of a new C array."""
        return View(self.array(count_of(shape), kind), (0,), tuple(shape), natural(shape), kind)

    # Equations.

    def run(self, jaxpr: Jaxpr, consts, given: Sequence[Value], applied: Callable | None = None) -> list[Value]:
        """The results of a traced function, whose equations are written by `applied` if that is said."""
        known: dict = dict(zip(jaxpr.constvars, map(of_numbers, consts), strict=True))
        known.update(zip(jaxpr.invars, given, strict=True))

        def read(atom) -> Value:
            return of_numbers(atom.val) if isinstance(atom, Literal) else known[atom]

        for equation in jaxpr.eqns:
            results = (applied or self.applied)(equation, list(map(read, equation.invars)))
            known.update(zip(equation.outvars, results, strict=True))
        return list(map(read, jaxpr.outvars))

    def applied(self, equation, operands: list[Value]) -> list[Value]:
        primitive, params = equation.primitive, equation.params
        name = primitive.name
        if name in self.rules and primitive.multiple_results:
            return self.rules[name](self, equation, operands)
        called = within(params)
        if called is not None:
            own = self.calls.get(params.get("name"))
            return self.run(called.jaxpr, called.consts, operands) if own is None else own(self, equation, operands)
        if name in SAME:
            return operands
        if name in MOVING:
            found = MOVING[name](*operands, params)
            return list(map(self.small, found)) if primitive.multiple_results else [self.small(found)]
        if all(map(has_known_numbers, operands)) and sum(part.size for part in operands) < 4096:
            return of_known(equation, operands)
        kinds = [kind_of(variable.aval, self.lanes) for variable in equation.outvars]
        if name in MOVING_ENTRIES and not (name == "concatenate" and any(isinstance(x, View) for x in operands)):
            return [MOVING_ENTRIES[name](*map(self.entries, operands), params)]
        if name in self.rules:
            return [self.rules[name](self, equation, operands, kinds[0])]
        if name == "convert_element_type":
            own = kind_of(equation.invars[0].aval)
            if (form := form_before_conversion(own, kinds[0], self._any_wide_lanes(operands))) is not None:
                operands = [self.each(name, form, operands, own)]
        return [self.by_number(name, params, operands, kinds[0])]

    def by_number(self, name: str, params, operands: list[Value], kind: str) -> Value:
        if name == "select_n":
            which, *cases = operands
            if has_known_numbers(which) and which.size == 1:
                return cases[int(self.entries(which).item())]
            if len(cases) != 2:
                found = cases[0]
                for number, case in enumerate(cases[1:], 1):
                    here = self.each("ge", BY_NUMBER["ge"], [which, of_numbers(number)], "bool")
                    found = self.by_number(name, params, [here, found, case], kind)
                return found
            form = "({0} ? {2} : {1})"
        elif name == "convert_element_type" and self.lanes and self.is_wide(operands[0]):
            return self._converted_lanes(operands[0], OF_LANES[kind])
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
            real = "wp::fmod({}, {})" if self._any_wide_lanes(operands) else "__builtin_fmod({}, {})"
            form = real if kind == "double" else WHOLE_REMAINDER[self._any_wide_lanes(operands)]
        elif name == "div" and kind != "double":
            form = WHOLE_QUOTIENT[self._any_wide_lanes(operands)]
        elif name == "round":
            form = (
                "wp::round({})"
                if params["rounding_method"] == jax.lax.RoundingMethod.AWAY_FROM_ZERO
                else "wp::rint({})"
            )
        elif name in BY_NUMBER:
            form = self.form_of(name, operands)
        else:
            raise NotImplementedError(f"The primitive `{name}` has no C++ here; write the function without it.")
        return self.each(name, form, operands, kind)

    def form_of(self, name: str, operands: Sequence[Value]) -> str:
        """The text of a primitive that acts on each number."""
        own = cpp_lanes.BY_NUMBER if self._any_wide_lanes(operands) else {}
        return own.get(name, BY_NUMBER[name])

    def _any_wide_lanes(self, operands: Sequence[Value]) -> bool:
        return self.lanes and any(map(self.is_wide, operands))

    def _converted_lanes(self, value: Value, kind: str) -> Value:
        if isinstance(value, View):
            if value.kind == kind:
                return value
            into = self.new(value.shape, kind)
            self.copy(value, into.base, kind)
            return self.small(into)
        found = [self.line(self.as_type(entry, kind), kind) for entry in value.ravel()]
        return np.array(found, object).reshape(value.shape)

    def each(self, name: str, form: str, operands: Sequence[Value], kind: str) -> Value:
        """The same for each number."""
        form, kind = form_for(name, form, kind, self._any_wide_lanes(operands))
        shape = np.broadcast_shapes(*(part.shape for part in operands))
        if count_of(shape) > FEW and not all(map(has_known_numbers, operands)):
            return self._each_in_loops(name, form, operands, kind, shape)
        spread = np.broadcast_arrays(*map(self.entries, operands))
        found = np.empty(shape, object)
        for place in np.ndindex(shape):
            found[place] = self.one(name, form, [part[place] for part in spread], kind)
        return found

    def _each_in_loops(self, name: str, form: str, operands: Sequence[Value], kind: str, shape) -> View:
        own = [kind] * len(operands) if name not in ("select_n", *COMPARISONS) else None
        views = []
        for position, part in enumerate(map(without_repeats, operands)):
            if part.size == 1:
                views.append(self.entries(part).ravel()[0])
            else:
                otherwise = own[position] if own else ("bool" if name == "select_n" and position == 0 else "double")
                views.append(self.view(part, self._plain_type(part, otherwise)).broadcast(shape))
        if kind == "double" and any(map(self.is_wide, operands)):
            kind = WIDE
        types = [part.kind if isinstance(part, View) else self.type_of(part) for part in views]
        wanted = types_of_operands(name, types, kind)

        def write() -> View:
            into = self.new(shape, kind)
            names = self.loops(shape)
            texts = [part.at(names) if isinstance(part, View) else text_of(part) for part in views]
            if kind in KINDS:
                texts = list(map(converted, texts, types, wanted))
            if kind == WIDE and name == "select_n":
                texts[1:] = [f"(wide)({text})" for text in texts[1:]]
            text = form.format(*texts)
            self.put(f"{into.at(names)} = {f'(wide)({text})' if kind == WIDE else text};")
            self.close(len(names))
            return into

        # Variables may have been computed in a loop.
        if any(isinstance(part, str) for part in views):
            return write()
        arrays = [part for part in views if isinstance(part, View)]
        # Numbers by their texts: 0.0 is not -0.0.
        told = (part if isinstance(part, View) else text_of(part) for part in views)
        return self.once((name, form, kind, shape, *told), arrays, write)

    def _plain_type(self, value: Value, otherwise: str) -> str:
        """That of the numbers of an array."""
        if isinstance(value, View):
            return value.kind
        kinds = {self.type_of(entry) for entry in value.ravel()}
        return kinds.pop() if len(kinds) == 1 else otherwise

    def one(self, name: str, form: str, parts: list, kind: str):
        """One number: its variable, or what it is known to be."""
        known = simpler(name, parts, kind)
        if known is not None:
            return known
        texts = list(map(text_of, parts))
        if kind == "double" and any(isinstance(part, str) and self.type_of(part) == WIDE for part in parts):
            kind = WIDE
            if name == "select_n":
                texts[1:] = [self.as_type(part, WIDE) for part in parts[1:]]
        types = list(map(self.type_of, parts))
        if self.lanes and any(own in KINDS for own in types):
            kind = OF_LANES.get(kind, kind)
            wanted = types_of_operands(name, types, kind)
            texts = list(map(self.as_type, parts, wanted))
        return self.line(form.format(*texts), kind)

    def place(self, entry, most: int):
        """An index, kept between zero and the most, as JAX keeps it."""
        if not isinstance(entry, str):
            return min(max(int(entry), 0), most)
        if (kind := self.type_of(entry)) in KINDS:
            least, last = (converted(str(end), "int", kind) for end in (0, most))
            return self.line(f"({entry} < {least} ? {least} : ({entry} > {last} ? {last} : {entry}))", kind)
        return self.line(f"({entry} < 0 ? 0 : ({entry} > {most} ? {most} : (int)({entry})))", "int")
