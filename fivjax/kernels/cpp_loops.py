"""Loops and branches as C++, and which of the numbers that they carry are tangents."""

from collections.abc import Callable, Sequence

import numpy as np
from jax.extend.core import Jaxpr

from ..foundation.jaxprs import carried_dependence, dependent_results, of_scan, solution
from .cpp_arrays import Value, View, of_text
from .cpp_lanes import TRUTHS, WHOLES
from .cpp_numbers import WIDE, base_of, kind_of, same, text_of
from .cpp_writer import Writer


def _while(writer: Writer, equation, operands) -> list[Value]:
    condition, body = equation.params["cond_jaxpr"], equation.params["body_jaxpr"]
    asked = operands[: equation.params["cond_nconsts"]]
    fixed = operands[len(asked) :][: equation.params["body_nconsts"]]
    begin = operands[len(asked) + len(fixed) :]
    kinds, _ = _types_carried(writer, body.jaxpr, fixed, begin, [], equation.outvars)
    carry = [variable_from(writer, value, kind) for value, kind in zip(begin, kinds, strict=True)]
    before, where = writer.going, None
    if writer.lanes:
        writer.going = where = writer.name(TRUTHS, "m")
        writer.put(f"{TRUTHS} {where} = {before};")
    writer.open("for (;;)")
    (going,) = writer.run(condition.jaxpr, condition.consts, [*asked, *carry])
    if where is None:
        writer.put(f"if (!({text_of(writer.entries(going).item())})) break;")
    else:
        writer.put(f"{where} = {where} & {writer.as_type(writer.entries(going).item(), TRUTHS)};")
        writer.put(f"if (!any({where})) break;")
    assign(writer, carry, writer.run(body.jaxpr, body.consts, [*fixed, *carry]), where)
    writer.close()
    writer.going = before
    return carry


def _scan(writer: Writer, equation, operands) -> list[Value]:
    _, carried = of_scan(equation.params)
    shapes = [variable.aval.shape for variable in equation.outvars[carried:]]
    return scan(writer, equation, operands, str(equation.params["length"]), lambda k, kind: writer.new(shapes[k], kind))


def scan(writer: Writer, equation, operands, length: str, rows_of: Callable[[int, str], View]) -> list[Value]:
    """A loop along arrays, of a length that may be a variable; `rows_of` gives the array for each of its rows of results, by
    number and type.
    """
    params, body = equation.params, equation.params["jaxpr"]
    shared, carried = of_scan(params)
    fixed, begin = operands[:shared], operands[shared:][:carried]
    along = operands[len(fixed) + len(begin) :]
    kinds, wide = _types_carried(writer, body.jaxpr, fixed, begin, along, equation.outvars[: len(begin)])
    along = [
        writer.view(value, kind_of(atom.aval))
        for value, atom in zip(along, equation.invars[len(fixed) + len(begin) :], strict=True)
    ]
    carry = [variable_from(writer, value, kind) for value, kind in zip(begin, kinds, strict=True)]
    rows = [
        rows_of(k, _wider(writer, kind_of(variable.aval), wide[len(begin) + k]))
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
    assign(writer, carry, found[: len(begin)])
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
    wide = [any(each) for each in zip(*(dependent_results(branch.jaxpr, flags) for branch in branches), strict=True)]
    found = [
        unset_variable(writer, variable.aval.shape, _wider(writer, kind_of(variable.aval), is_wide))
        for variable, is_wide in zip(equation.outvars, wide, strict=True)
    ]
    if writer.lanes:
        return _branches_of_lanes(writer, branches, writer.as_type(which, WHOLES), rest, found)
    for k, branch in enumerate(branches):
        test = f"if ({which} <= 0)" if k == 0 else f"else if ({which} == {k})" if k < last else "else"
        writer.open(test)
        assign(writer, found, writer.run(branch.jaxpr, branch.consts, rest))
        writer.close()
    return found


def _branches_of_lanes(writer: Writer, branches, which: str, rest, found: list[Value]) -> list[Value]:
    """Each branch that any of the lanes takes, for these."""
    before, last = writer.going, len(branches) - 1
    for k, branch in enumerate(branches):
        test = f"({which} <= 0)" if k == 0 else f"({which} == {k})" if k < last else f"({which} >= {last})"
        writer.going = writer.line(f"{before} & {test}", TRUTHS)
        writer.open(f"if (any({writer.going}))")
        assign(writer, found, writer.run(branch.jaxpr, branch.consts, rest), writer.going)
        writer.close()
    writer.going = before
    return found


def _solved(writer: Writer, equation, operands) -> list[Value]:
    """`custom_linear_solve`, by the solution that it was given."""
    solve, given = solution(equation.params, operands)
    return writer.run(solve.jaxpr, solve.consts, given)


RULES: dict[str, Callable] = {"while": _while, "scan": _scan, "cond": _cond, "custom_linear_solve": _solved}


def _types_carried(writer: Writer, body: Jaxpr, fixed, begin, along, variables) -> tuple[list[str], list[bool]]:
    """The types of what a loop carries, and which of the body's results are wide."""
    wide = list(map(writer.is_wide, begin))
    wide, after = carried_dependence(body, list(map(writer.is_wide, fixed)), wide, list(map(writer.is_wide, along)))
    kinds = [_wider(writer, kind_of(variable.aval), own) for own, variable in zip(wide, variables, strict=True)]
    return kinds, after


def _wider(writer: Writer, kind: str, is_wide: bool) -> str:
    """The type of what a loop or branch changes; if that depends on the lane, so does all of it."""
    if writer.lanes:
        return writer.widened(kind)
    return WIDE if is_wide else kind


# ------------------------------------------------------------------------------------ what loops and branches change


def variable_from(writer: Writer, value: Value, kind: str) -> Value:
    """A variable, or a C array, that begins with this value."""
    if value.shape == ():
        found = writer.name(kind, "w")
        writer.put(f"{kind} {found} = {writer.as_type(writer.entries(value).item(), kind)};")
        return of_text(found)
    into = writer.new(value.shape, kind)
    writer.copy(value, into.base, kind)
    return writer.small(into)


def unset_variable(writer: Writer, shape, kind: str) -> Value:
    """The same, without a value yet."""
    if shape == ():
        found = writer.name(kind, "w")
        writer.put(f"{kind} {found}{f' = ({kind})(0)' if writer.lanes else ''};")
        return of_text(found)
    return writer.small(writer.new(shape, kind))


def assign(writer: Writer, targets: Sequence[Value], values: Sequence[Value], where: str | None = None) -> None:
    """Give these variables and arrays their new values, all at once; those of lanes `where` that holds, if it is said."""
    bases = {base_of(target) for target in targets}
    moves = []
    for target, value in zip(targets, values, strict=True):
        if target.size == 0 or same(target, value):
            continue
        # What is itself changed by this is copied before.
        if isinstance(value, View):
            if value.base in bases:
                copied = writer.new(value.shape, value.kind)
                writer.copy(value, copied.base, value.kind)
                value = copied
        else:
            value = np.array([_kept(writer, entry, bases) for entry in value.ravel()], object).reshape(value.shape)
        moves.append((target, value))
    for target, value in moves:
        if target.shape == ():
            variable = target.item()
            kind = writer.type_of(variable)
            writer.set(variable, writer.as_type(writer.entries(value).item(), kind), where)
        else:
            writer.copy(value, base_of(target), writer.types[base_of(target)], where=where)


def _kept(writer: Writer, entry, bases: set[str]):
    if not isinstance(entry, str) or entry.partition("[")[0] not in bases:
        return entry
    kind = writer.type_of(entry)
    found = writer.name(kind)
    writer.put(f"const {kind} {found} = {entry};")
    return found
