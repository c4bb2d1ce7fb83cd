"""Primitives whose places in arrays may be unknown until the code runs, and others that move or reduce arrays, as C++."""

from collections.abc import Callable

import numpy as np
from jax.lax import GatherScatterMode

from ..foundation.numpy_primitives import gathered_places, scattered_places
from .cpp_arrays import Value, View, count_of, has_known_numbers, natural, of_numbers, reshaped
from .cpp_lanes import KINDS, OF_LANES, TRUTHS, WHOLES
from .cpp_numbers import BY_NUMBER, fill_of, kind_of
from .cpp_writer import FEW, Writer

CHOICE = "({0} ? {2} : {1})"


def _dynamic_slice(writer: Writer, equation, operands, kind: str) -> Value:
    value, *starts = operands
    view, sizes = writer.view(value, kind), equation.params["slice_sizes"]
    return writer.small(_from(writer, view, starts, sizes))


def _from(writer: Writer, view: View, starts, sizes) -> Value:
    part, at = _part(writer, view, starts, sizes)
    if at is None:
        return part
    # Of few places one is chosen in less time than numbers are gathered.
    few = 4
    ways = [
        own - size + 1 for start, size, own in zip(starts, sizes, view.shape, strict=True) if _differs(writer, start)
    ]
    if len(ways) == 1 and ways[0] <= few and part.size <= FEW:
        return _chosen(writer, view, starts, sizes, ways[0])
    # The lanes' numbers from different places, side by side.
    into = writer.new(part.shape, OF_LANES.get(part.kind, part.kind))
    for place in np.ndindex(part.shape):
        writer.put(f"{into.at(place)} = picked({part.base}, {_address(part, at, place)});")
    return into


def _differs(writer: Writer, start) -> bool:
    """Whether a place differs from lane to lane."""
    entry = writer.entries(start).item()
    return isinstance(entry, str) and writer.type_of(entry) in KINDS


def _chosen(writer: Writer, view: View, starts, sizes, ways: int) -> np.ndarray:
    """The part of an array from one of so few places on, which differs from lane to lane."""
    (at,) = (writer.entries(start).item() for start in starts if _differs(writer, start))
    parts = []
    for way in range(ways):
        own = [of_numbers(way) if _differs(writer, start) else start for start in starts]
        parts.append(_from(writer, view, own, sizes).entries())
    kind, found = writer.widened(view.kind), parts[-1]
    for way in reversed(range(ways - 1)):
        here, choice = writer.line(f"{at} <= ({WHOLES})({way})", TRUTHS), np.empty(found.shape, object)
        for place in np.ndindex(found.shape):
            choice[place] = writer.one("select_n", CHOICE, [here, found[place], parts[way][place]], kind)
        found = choice
    return found


def _part(writer: Writer, view: View, starts, sizes) -> tuple[View, str | None]:
    """The part of an array from these places on; if they differ from lane to lane, without what they add to the address, and
    that.
    """
    known, unknown, of_lanes = view.offset[0], list(view.offset[1:]), []
    for start, size, own, stride in zip(starts, sizes, view.shape, view.strides, strict=True):
        at = writer.place(writer.entries(start).item(), own - size)
        if isinstance(at, str):
            into = of_lanes if writer.type_of(at) in KINDS else unknown
            into += [f"{at} * {stride}" if stride != 1 else at] * (stride != 0)
        else:
            known += at * stride
    part = View(view.base, (known, *unknown), tuple(sizes), view.strides, view.kind)
    return part, writer.line(" + ".join(of_lanes), WHOLES) if of_lanes else None


def _address(part: View, at: str, place) -> str:
    """That of a number of a part of an array, for each lane."""
    _, _, index = part.at(place).partition("[")
    return f"{at} + ({WHOLES})({index[:-1]})"


def _put(writer: Writer, into: View, starts, update, axes, how: str) -> None:
    """Numbers into the part of an array from these places on, along these axes."""
    kind = into.kind
    part, at = _part(writer, into, starts, update.shape if axes is None else _sizes(into, update, axes))
    part = part if axes is None else part.selected(part.offset, axes)
    for place, entry in np.ndenumerate(writer.entries(update)):
        own = writer.as_type(entry, kind)
        if at is None:
            writer.put(f"{part.at(place)} {how} {own};")
        else:
            writer.put(f"{'put' if how == '=' else 'add'}({part.base}, {_address(part, at, place)}, {own});")


def _sizes(into: View, update: Value, axes: list[int]) -> list[int]:
    return [update.shape[axes.index(axis)] if axis in axes else 1 for axis in range(into.ndim)]


def _dynamic_update_slice(writer: Writer, equation, operands, kind: str) -> Value:
    value, update, *starts = operands
    into = _copied(writer, operands, value, kind)
    _put(writer, into, starts, update, None, "=")
    return writer.small(into)


def _copied(writer: Writer, operands, value: Value, kind: str) -> View:
    """A copy of an array, into which others of the operands are put."""
    kind = writer.widened(kind) if any(map(writer.is_wide, operands)) else kind
    into = writer.new(value.shape, kind)
    writer.copy(value, into.base, kind)
    return into


def _gather(writer: Writer, equation, operands, kind: str) -> Value:
    value, places = operands
    if has_known_numbers(places):
        found = gathered_places(value.shape, places, equation.params)
        if found is None:
            raise NotImplementedError("Places outside of an array have no C++ here; keep the indices within it.")
        return np.asarray(writer.entries(value).ravel()[found], object)
    numbers, sizes = equation.params["dimension_numbers"], equation.params["slice_sizes"]
    view, places = writer.view(value, kind), writer.entries(places)
    one_of_each = (*numbers.collapsed_slice_dims, *numbers.operand_batching_dims)
    kept = [axis for axis in range(view.ndim) if axis not in one_of_each]
    found = np.empty(equation.outvars[0].aval.shape, object)
    parts, within, fill = {}, {}, None
    if equation.params["mode"] == GatherScatterMode.FILL_OR_DROP:
        fill = fill_of(equation)
    for batch in np.ndindex(places.shape[:-1]):
        starts = [of_numbers(0)] * view.ndim
        for axis, of_batch in zip(numbers.operand_batching_dims, numbers.start_indices_batching_dims, strict=True):
            starts[axis] = of_numbers(batch[of_batch])
        for position, axis in enumerate(numbers.start_index_map):
            starts[axis] = np.asarray(places[(*batch, position)], object)
        parts[batch] = _from(writer, view, starts, sizes)
        if fill is not None:
            within[batch] = _is_within(writer, starts, np.subtract(view.shape, sizes).tolist())
    for place in np.ndindex(found.shape):
        batch = tuple(at for axis, at in enumerate(place) if axis not in numbers.offset_dims)
        own = dict(zip(kept, (place[axis] for axis in numbers.offset_dims), strict=True))
        index = tuple(own.get(axis, 0) for axis in range(view.ndim))
        part = parts[batch]
        found[place] = part.at(index) if isinstance(part, View) else part[index]
        if fill is not None:
            found[place] = writer.one("select_n", CHOICE, [within[batch], fill, found[place]], kind)
    return found


def _is_within(writer: Writer, starts, most: list[int]):
    """Whether all places of a part are those of the array."""
    held = True
    for start, last in zip(starts, most, strict=True):
        entry = writer.entries(start).item()
        for name, end in (("ge", 0), ("le", last)):
            if isinstance(entry, str):
                own = writer.one(name, BY_NUMBER[name], [entry, end], "bool")
                held = own if held is True else writer.one("and", BY_NUMBER["and"], [held, own], "bool")
            elif not (entry >= end if name == "ge" else entry <= end):
                return False
    return held


def _scatter(writer: Writer, equation, operands, kind: str) -> Value:
    if has_known_numbers(operands[1]):
        return _at_known(writer, equation, operands, lambda before, own: own)
    return _put_at(writer, equation, operands, kind, "=")


def _scatter_add(writer: Writer, equation, operands, kind: str) -> Value:
    if not has_known_numbers(operands[1]):
        return _put_at(writer, equation, operands, kind, "+=")
    return _at_known(
        writer, equation, operands, lambda before, own: writer.one("add", BY_NUMBER["add"], [before, own], kind)
    )


def _at_known(writer: Writer, equation, operands, put: Callable) -> np.ndarray:
    value, places, update = operands
    found, update_entries = writer.entries(value).ravel().copy(), writer.entries(update).ravel()
    for place, own in scattered_places(value.shape, places, update.shape, equation.params):
        found[place] = put(found[place], update_entries[own])
    return found.reshape(value.shape)


def _put_at(writer: Writer, equation, operands, kind: str, how: str) -> Value:
    value, places, update = operands
    numbers = equation.params["dimension_numbers"]
    if places.size != len(numbers.scatter_dims_to_operand_dims):
        raise NotImplementedError("Numbers put at several unknown places have no C++ here; put them one by one.")
    into = _copied(writer, operands, value, kind)
    starts = [of_numbers(0)] * len(value.shape)
    for at, axis in zip(writer.entries(places).ravel(), numbers.scatter_dims_to_operand_dims, strict=True):
        starts[axis] = np.asarray(at, object)
    kept = [axis for axis in range(len(value.shape)) if axis not in numbers.inserted_window_dims]
    window = [update.shape[axis] for axis in numbers.update_window_dims]
    if len(window) != len(update.shape):
        update = writer.entries(update).reshape(window)
    if equation.params["mode"] == GatherScatterMode.FILL_OR_DROP:
        update = _dropped_outside(writer, into, starts, _sizes(into, update, kept), update, kind, how)
    _put(writer, into, starts, update, kept, how)
    return writer.small(into)


def _dropped_outside(writer: Writer, into: View, starts, sizes: list[int], update: Value, kind: str, how: str) -> Value:
    """What is put into a part of an array, where the part is not within it: what is there."""
    within = _is_within(writer, starts, np.subtract(into.shape, sizes).tolist())
    if within is True:
        return update
    found, there = writer.entries(update).copy(), np.full(update.shape, 0, object)
    if how == "=":
        there = writer.entries(_from(writer, into, starts, sizes)).reshape(update.shape)
    for place, new in np.ndenumerate(found):
        found[place] = writer.one("select_n", CHOICE, [within, there[place], new], kind)
    return found


def _concatenate(writer: Writer, equation, operands, kind: str) -> Value:
    axis = equation.params["dimension"]
    kind = writer.widened(kind) if any(map(writer.is_wide, operands)) else kind
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
        # What is no number is the best, as in JAX.
        is_better = f"(({{1}} == {{1}}) & !({{0}} {'<=' if sign == '>' else '>='} {{1}}))"
        (axis,) = equation.params["axes"]
        parts = np.moveaxis(writer.entries(operands[0]), axis, 0)
        found = np.empty(parts.shape[1:], object)
        wide = writer.lanes and writer.is_wide(operands[0])
        truth, number, real = (
            writer.widened(own) if wide else own for own in ("bool", kind, kind_of(equation.invars[0].aval))
        )
        for place in np.ndindex(found.shape):
            best, at = parts[(0, *place)], 0
            for i in range(1, len(parts)):
                own = parts[(i, *place)]
                better = writer.one("gt" if sign == ">" else "lt", is_better, [own, best], truth)
                at = writer.one("select_n", CHOICE, [better, at, i], number)
                best = writer.one("select_n", CHOICE, [better, best, own], real)
            found[place] = at
        return found

    return of


def _sort(writer: Writer, equation, operands) -> list[Value]:
    """By insertion, which is stable; what belongs to the keys is moved with them, and what is no number comes last."""
    if operands[0].ndim != 1 or equation.params["num_keys"] != 1:
        raise NotImplementedError("Only rows of numbers are sorted in C++ here, by one key.")
    of_lanes = writer.lanes and any(map(writer.is_wide, operands))
    kinds = [
        writer.widened(kind_of(variable.aval)) if of_lanes or writer.is_wide(part) else kind_of(variable.aval)
        for part, variable in zip(operands, equation.outvars, strict=True)
    ]
    rows = [writer.new(part.shape, kind) for part, kind in zip(operands, kinds, strict=True)]
    for row, part in zip(rows, operands, strict=True):
        writer.copy(part, row.base, row.kind)
    own, at = writer.name("int", "i"), writer.name("int", "i")
    if of_lanes:
        _sort_lanes(writer, rows, own, at)
        return list(map(writer.small, rows))
    kept = [writer.name(kind, "x") for kind in kinds]
    writer.open(f"for (int {own} = 1; {own} < {rows[0].size}; ++{own})")
    for row, name in zip(rows, kept, strict=True):
        writer.put(f"const {row.kind} {name} = {row.base}[{own}];")
    moves = " ".join(f"{row.base}[{at} + 1] = {row.base}[{at}];" for row in rows)
    writer.put(f"int {at} = {own} - 1;")
    other = f"{rows[0].base}[{at}]"
    is_later = f"({other} > {kept[0]} || ({other} != {other} && {kept[0]} == {kept[0]}))"
    writer.put(f"for (; {at} >= 0 && {is_later}; --{at}) {{ {moves} }}")
    for row, name in zip(rows, kept, strict=True):
        writer.put(f"{row.base}[{at} + 1] = {name};")
    writer.close()
    return list(map(writer.small, rows))


def _sort_lanes(writer: Writer, rows: list[View], own: str, at: str) -> None:
    """The same for lanes side by side: neighbours change places where they must, until none can."""
    writer.open(f"for (int {own} = {rows[0].size} - 1; {own} > 0; --{own})")
    writer.open(f"for (int {at} = 0; {at} < {own}; ++{at})")
    later = writer.name(TRUTHS)
    one, other = (f"{rows[0].base}[{place}]" for place in (at, f"{at} + 1"))
    writer.put(f"const {TRUTHS} {later} = ({one} > {other}) | (({one} != {one}) & ({other} == {other}));")
    for row in rows:
        first, second = f"{row.base}[{at}]", f"{row.base}[{at} + 1]"
        kept = writer.name(row.kind, "x")
        writer.put(f"const {row.kind} {kept} = {first};")
        writer.put(f"{first} = ({later} ? {second} : {kept});")
        writer.put(f"{second} = ({later} ? {kept} : {second});")
    writer.close(2)


def _same_bits(writer: Writer, equation, operands, kind: str) -> Value:
    own, value = kind_of(equation.invars[0].aval), writer.entries(operands[0])
    if writer.lanes:
        own, kind = OF_LANES[own], OF_LANES[kind]
    found = np.empty(value.shape, object)
    for place, entry in np.ndenumerate(value):
        same = writer.line(writer.as_type(entry, own), own)
        found[place] = writer.line(f"__builtin_bit_cast({kind}, {same})", kind)
    return found


def _product(writer: Writer, equation, operands, kind: str) -> Value:
    """A product of matrices, vectors or batches of them."""
    (left, right), (along, batch) = operands, equation.params["dimension_numbers"]
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
        factors = _by_columns(writer, writer.view(left, kind)), writer.view(right, kind)
        into = writer.new(shape, writer.widened(kind) if any(map(writer.is_wide, factors)) else kind)
        every = writer.name("int", "i")
        writer.put(
            f"for (int {every} = 0; {every} < {into.size}; ++{every}) {into.base}[{every}] = ({into.kind})(0.0);"
        )
        # The sum outside: then the loop over the results is one of vectors.
        step, names = writer.loops(lengths), writer.loops(shape)
        texts = [factor.at(place) for factor, place in zip(factors, at(names, step), strict=True)]
        writer.put(f"{into.at(names)} += {' * '.join(texts)};")
        writer.close(len(step) + len(names))
        return writer.small(into)
    left, right = writer.entries(left), writer.entries(right)
    found = np.empty(shape, object)
    for place in np.ndindex(*shape):
        total = 0.0
        for step in np.ndindex(*lengths):
            a, b = at(place, step)
            term = writer.one("mul", BY_NUMBER["mul"], [left[a], right[b]], kind)
            total = writer.one("add", BY_NUMBER["add"], [total, term], kind)
        found[place] = total
    return found


def _by_columns(writer: Writer, matrix: View) -> View:
    """A matrix that is given, so that the numbers of a column lie side by side, as a loop over results wants them."""

    def write() -> View:
        into = writer.new(matrix.shape[::-1], matrix.kind)
        writer.copy(matrix.selected(matrix.offset, (1, 0)), into.base, into.kind)
        return into

    if matrix.ndim != 2 or matrix.strides[0] <= matrix.strides[1] or not writer.is_known_before(matrix):
        return matrix
    columns = writer.once(("columns", matrix), [matrix], write)
    return columns.selected(columns.offset, (1, 0))


RULES: dict[str, Callable] = {
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
    "dot_general": _product,
}
