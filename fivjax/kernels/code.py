"""The code of a kernel: a JAX function of one trajectory, in C++, with what its arrays hold."""

import dataclasses
import functools
import re
from collections.abc import Callable, Sequence
from itertools import chain, compress, pairwise, starmap
from typing import NamedTuple

import jax
import numpy as np
from jax.interpreters import partial_eval

from ..foundation.argument_forms import Form
from ..foundation.jaxprs import CODE_ONCE, of_scan
from ..foundation.plain_trees import from_text, structure_to_text
from ..foundation.precision import own_settings
from . import cpp_calls, cpp_elimination, cpp_loops, cpp_places, cpp_reductions
from .cpp_arrays import Value, View, count_of, has_known_numbers, natural
from .cpp_lanes import ADDING, OF_LANES, REALS
from .cpp_numbers import WIDE, converted, kind_of
from .cpp_writer import Writer

# Everything that is known of primitives, together.
RULES = cpp_places.RULES | cpp_reductions.RULES | cpp_loops.RULES
RULES |= {name: cpp_reductions.within_bits(RULES[name]) for name in ADDING}


class Slot(NamedTuple):
    """Where an array is in a row of numbers."""

    start: int
    shape: tuple[int, ...]
    dtype: str

    @property
    def size(self) -> int:
        return count_of(self.shape)

    def of(self, numbers, count: int | None = None, after: int = 0):
        """The array, in such rows of numbers, or so many of it, one after the other; so many more axes come after its own."""
        repeated, shape = (1, self.shape) if count is None else (count, (count, *self.shape))
        axis = numbers.ndim - after - 1
        part = numbers[(*[slice(None)] * axis, slice(self.start * repeated, (self.start + self.size) * repeated))]
        found = part.reshape((*numbers.shape[:axis], *shape, *numbers.shape[axis + 1 :]))
        return found.astype(self.dtype, copy=False)


@dataclasses.dataclass(frozen=True)
class KernelSource:
    """A kernel's code, and what its arrays hold: values, then their tangents, None for what is no real number."""

    structures: tuple  # of the function's results
    source: str
    ends: tuple[Slot, ...]
    rows: tuple[Slot, ...]
    end_dots: tuple[Slot | None, ...]
    row_dots: tuple[Slot | None, ...]

    @functools.cached_property
    def widths(self) -> tuple[int, int, int, int]:
        """How many numbers each of these rows has, at least one."""
        ends, rows, end_dots, row_dots = (
            max(sum(place.size for place in places if place), 1)
            for places in (self.ends, self.rows, self.end_dots, self.row_dots)
        )
        return ends, rows, end_dots, row_dots


def traced_source(
    function: Callable, form: Form, wide: tuple[bool, ...], shared: int = 0, lanes: bool = False
) -> tuple:
    """A `KernelSource`, in plain values, of a function of a form's arguments and of instants; with tangents along those of its
    arrays that are `wide`. So many of the first arrays are `shared` by the trajectories of a group. `lanes` is whether it is
    for several lanes side by side, without tangents.
    """
    like = [jax.ShapeDtypeStruct(*array) for array in form.arrays]
    instants = jax.ShapeDtypeStruct((2,), np.dtype("float64"))

    structures = []

    def values(arrays, instants):
        found = function(form.args(arrays), instants)
        structures.append([structure_to_text(jax.tree.structure(part)) for part in found])
        return tuple(tuple(jax.tree.leaves(part)) for part in found)

    def with_tangents(arrays, dots, instants):
        return jvp_along(lambda arrays: values(arrays, instants), arrays, wide, dots)

    moving = list(compress(like, wide))
    with own_settings():
        if moving:
            traced, shapes = jax.make_jaxpr(with_tangents, return_shape=True)(like, moving, instants)
            (ends, rows), (end_dots, row_dots) = shapes
        else:
            traced, (ends, rows) = jax.make_jaxpr(values, return_shape=True)(like, instants)
            end_dots, row_dots = (), ()
        # What is asked for: no more is written.
        jaxpr, _ = partial_eval.dce_jaxpr(traced.jaxpr, [True] * len(traced.jaxpr.outvars), instantiate=True)
        lengths = np.cumsum([len(jax.tree.leaves(part)) for part in (ends, rows, end_dots)])
        of_kernel = _WriterOfKernel(jaxpr, shared, len(like), lengths, lanes)
        # Numbers that are known are computed now, whatever is being traced around this.
        with jax.ensure_compile_time_eval():
            source = of_kernel.source(traced.consts)
    return structures[-1], source, _slots(ends), _slots(rows, 1), _slots(end_dots), _slots(row_dots, 1)


def jvp_along(function: Callable, arrays: Sequence, wide: Sequence[bool], dots: Sequence) -> tuple:
    """What a function finds of a list of arrays, and the tangents of that along those of the arrays that are `wide`: None where
    a result is no real number.
    """

    def of(some):
        remaining = iter(some)
        return function([next(remaining) if is_wide else array for array, is_wide in zip(arrays, wide, strict=True)])

    found, moved = jax.jvp(of, (list(compress(arrays, wide)),), (list(dots),))
    return found, jax.tree.map(lambda dot: None if dot.dtype == jax.dtypes.float0 else dot, moved)


def with_slopes(function: Callable, args: tuple, instants) -> tuple:
    """The results of a function, each with its derivative along a direction: `args` are the function's own and the parts of the
    direction, one for each array of these, None where it is zero.
    """
    (form, arrays), wide = Form.of(args[0]), [dot is not None for dot in args[1]]
    found = jvp_along(lambda arrays: function(form.args(arrays), instants), arrays, wide, list(compress(args[1], wide)))
    return tuple(zip(*found, strict=True))


def form_with_slopes(form: Form, wide: Sequence[bool]) -> Form:
    """The form of the arguments of `with_slopes`, for a direction along these arrays."""
    arrays = [np.zeros(*array) for array in form.arrays]
    return Form.of(
        (form.args(arrays), tuple(np.zeros(a.shape) if w else None for a, w in zip(arrays, wide, strict=True)))
    )[0]


def source_from_plain(plain: tuple) -> KernelSource:
    """A `KernelSource` from its plain values."""
    structures, *rest = plain
    return KernelSource(tuple(map(from_text, structures)), *rest)


def _slots(avals, leading: int = 0) -> tuple[Slot | None, ...]:
    """Where arrays are that lie one after the other; those of one row each, where rows are their leading axis."""
    found, start = [], 0
    for aval in avals:
        own = None if aval is None else Slot(start, tuple(aval.shape)[leading:], np.dtype(aval.dtype).name)
        start += own.size if own else 0
        found.append(own)
    return tuple(found)


class _WriterOfKernel:
    """Writes a traced function whose results are at the end, and in rows: values, and tangents."""

    def __init__(self, jaxpr, shared: int, given: int, lengths, lanes: bool):
        self.jaxpr, self.shared, self.given = jaxpr, shared, given
        # Of the results: those at the end, those in rows, and the tangents of both.
        self.parts = list(starmap(slice, pairwise([0, *lengths, None])))
        _, self.rows, _, self.row_dots = (jaxpr.outvars[part] for part in self.parts)
        self.kind = REALS if lanes else "double"
        names = ("shared", "given", "instants", "rows")
        types = {**dict.fromkeys(names, self.kind), "dots": WIDE, "row_dots": WIDE}
        calls = cpp_elimination.CALLS | dict.fromkeys(CODE_ONCE, cpp_calls.called)
        self.writer = Writer(RULES, calls, types, lanes)

    def source(self, consts) -> str:
        writer, jaxpr = self.writer, self.jaxpr
        *numbers, instants = jaxpr.invars
        loops = [equation for equation in jaxpr.eqns if instants in equation.invars]
        if len(loops) > 1 or any(loop.primitive.name != "scan" for loop in loops):
            raise NotImplementedError(
                "A kernel's function must go along its instants by one `scan`, and use them nowhere else."
            )
        shared, given, dots = numbers[: self.shared], numbers[self.shared : self.given], numbers[self.given :]
        own = (_given(writer, name, own) for name, own in (("shared", shared), ("given", given), ("dots", dots)))
        begin = [*chain(*own), View("instants", (0,), (2,), (1,), self.kind)]

        def applied(equation, operands: list[Value]) -> list[Value]:
            if equation in loops:
                return cpp_loops.scan(writer, equation, operands, "count", functools.partial(self._rows_of, equation))
            return writer.applied(equation, operands)

        found = writer.run(jaxpr, consts, begin, applied)
        ends, rows, end_dots, row_dots = (found[part] for part in self.parts)
        along = {variable for loop in loops for variable in loop.outvars[of_scan(loop.params)[1] :]}
        for variable, value in zip((*self.rows, *self.row_dots), (*rows, *row_dots), strict=True):
            # Tangents that do not depend on what is perturbed are zero, as their array is from the start.
            if variable not in along and not (has_known_numbers(value) and not np.any(value)):
                raise NotImplementedError("Rows of a kernel's function must be results of its `scan`.")
        for name, values, kind in (("ends", ends, self.kind), ("end_dots", end_dots, WIDE)):
            for start, entry in enumerate(chain(*(writer.entries(value).ravel() for value in values))):
                writer.put(f"{name}[{start}] = {writer.as_type(entry, kind)};")
        return _loaded(writer.source, {"shared": shared, "given": given}) if writer.lanes else writer.source

    def _rows_of(self, loop, k: int, kind: str) -> View:
        """Where the loop's rows of results with this number are written."""
        variable = loop.outvars[of_scan(loop.params)[1] + k]
        for name, variables in (("rows", self.rows), ("row_dots", self.row_dots)):
            sizes = [count_of(own.aval.shape[1:]) for own in variables]
            # One result may be asked for twice, but is written once.
            for place, own in enumerate(variables):
                if own is variable:
                    shape = own.aval.shape[1:]
                    # All rows of one result lie side by side.
                    start = (0, f"count * {sum(sizes[:place])}")
                    return View(name, start, (2, *shape), (sizes[place], *natural(shape)), self.writer.types[name])
        return self.writer.new(variable.aval.shape, kind)


def _given(writer: Writer, base: str, variables) -> list[Value]:
    """Arrays that are given, from one row of numbers in double precision."""
    found, start = [], 0
    for variable in variables:
        shape, kind = variable.aval.shape, kind_of(variable.aval, writer.lanes)
        view = View(base, (start,), shape, natural(shape), writer.types[base])
        start += view.size
        if kind == "double":
            found.append(writer.small(view))
        else:
            own = OF_LANES[kind] if writer.lanes else kind
            typed = [writer.line(converted(entry, view.kind, own), own) for entry in view.entries().ravel()]
            found.append(np.array(typed, object).reshape(shape))
    return found


def _loaded(source: str, arrays: dict[str, Sequence]) -> str:
    """The code with what it reads of the lanes' rows put side by side before: single numbers, or all of a row if it goes
    through parts of it by loops.
    """
    before = []
    for name, variables in arrays.items():
        places = sorted({int(place) for place in re.findall(rf"\b{name}\[(\d+)\]", source)})
        before += [f"const {REALS} {name}_{place} = {name}[{place}];" for place in places]
        source = re.sub(rf"\b{name}\[(\d+)\]", rf"{name}_\1", source)
        if re.search(rf"\b{name}\b", source):
            count = sum(count_of(variable.aval.shape) for variable in variables)
            before.append(f"{REALS} {name}_all[{count}];")
            before.append(f"for (int i = 0; i < {count}; ++i) {name}_all[i] = {name}[i];")
            source = re.sub(rf"\b{name}\b", f"{name}_all", source)
    return "\n".join([*before, source])
