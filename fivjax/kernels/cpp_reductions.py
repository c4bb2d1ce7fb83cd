"""Reductions of arrays and running totals as C++."""

import functools
from collections.abc import Callable

import numpy as np

from . import cpp_lanes
from .cpp_arrays import Value, View, has_known_numbers
from .cpp_lanes import KINDS, TRUTHS
from .cpp_numbers import BY_NUMBER, converted, form_for
from .cpp_writer import FEW, Writer

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


def folded(writer: Writer, name: str, value: Value, axes, kind: str) -> Value:
    """A reduction over some axes."""
    if value.size > FEW and not has_known_numbers(value):
        return _in_loops(writer, name, writer.view(value, kind), axes)
    entries = writer.entries(value)
    for axis in sorted(axes, reverse=True):
        parts: list = [np.asarray(part, object) for part in np.moveaxis(entries, axis, 0)]
        # By pairs, which do not wait for one another.
        while len(parts) > 1:
            pairs = zip(parts[::2], parts[1::2], strict=False)
            last = parts[len(parts) // 2 * 2 :]
            parts = [*(writer.each(name, BY_NUMBER[name], list(pair), kind) for pair in pairs), *last]
        entries = parts[0]
    return entries


def _in_loops(writer: Writer, name: str, value: View, axes) -> Value:
    write = functools.partial(_written_in_loops, writer, name, value, axes)
    return writer.small(writer.once((name, value, tuple(axes)), [value], write))


def _written_in_loops(writer: Writer, name: str, value: View, axes) -> View:
    kept = [axis for axis in range(value.ndim) if axis not in axes]
    into = writer.new([value.shape[axis] for axis in kept], value.kind)
    form, _ = form_for(name, BY_NUMBER[name], value.kind, False)
    outer = writer.loops(into.shape)
    total = writer.name(value.kind, "s")
    neutral = {"add": "0", "mul": "1", "and": "true", "or": "false"}.get(name)
    if name == "and" and value.kind not in ("bool", TRUTHS):
        neutral = "~0"
    if neutral is not None and value.kind in KINDS:
        neutral = converted(neutral, "int" if neutral == "~0" else "bool", value.kind)
    first = dict.fromkeys(axes, "0") | dict(zip(kept, outer, strict=True))
    start = value.at([first[axis] for axis in range(value.ndim)]) if neutral is None else neutral
    writer.put(f"{value.kind} {total} = ({value.kind})({start});")
    inner = writer.loops([value.shape[axis] for axis in axes])
    place = dict(zip(axes, inner, strict=True)) | dict(zip(kept, outer, strict=True))
    writer.put(f"{total} = {form.format(total, value.at([place[axis] for axis in range(value.ndim)]))};")
    writer.close(len(inner))
    writer.put(f"{into.at(outer)} = {total};")
    writer.close(len(outer))
    return into


def within_bits(rule: Callable) -> Callable:
    """A rule whose sums of lanes side by side begin again at the other end where one lane's numbers do."""

    def of(writer: Writer, equation, operands, kind: str) -> Value:
        found = rule(writer, equation, operands, kind)
        if not (writer.lanes and kind in cpp_lanes.LONGER and writer.is_wide(found)):
            return found
        return writer.each("", cpp_lanes.within_bits("{}", kind), [found], kind)

    return of


def _running(name: str) -> Callable:
    def of(writer: Writer, equation, operands, kind: str) -> Value:
        axis, backwards = equation.params["axis"], equation.params["reverse"]
        parts = list(np.moveaxis(writer.entries(operands[0]), axis, 0))[:: -1 if backwards else 1]
        found = [np.asarray(parts[0], object)]
        for part in parts[1:]:
            found.append(
                writer.entries(writer.each(name, BY_NUMBER[name], [found[-1], np.asarray(part, object)], kind))
            )
        return np.moveaxis(np.stack(found[:: -1 if backwards else 1]), 0, axis)

    return of


RULES: dict[str, Callable] = {name: _running(of) for name, of in RUNNING.items()}
RULES |= {
    name: lambda writer, equation, operands, kind, of=of: folded(writer, of, operands[0], equation.params["axes"], kind)
    for name, of in FOLDED.items()
}
