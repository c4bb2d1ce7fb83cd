"""Calls that are calls in C++, too: written out at each of them, their code would take long to compile."""

from collections.abc import Iterable

from ..foundation.jaxprs import within
from .cpp_arrays import Value, View, natural
from .cpp_fused import fused
from .cpp_numbers import kind_of
from .cpp_writer import Writer


def called(writer: Writer, equation, operands: list[Value]) -> list[Value]:
    """The results of a function that has its code once. Of tangents, and of lanes side by side, it is written out."""
    traced = within(equation.params)
    assert traced is not None
    if writer.lanes or any(map(writer.is_wide, operands)):
        return writer.run(traced.jaxpr, traced.consts, operands)
    name = _function(writer, equation.params["name"], traced)
    found = [writer.new(own.aval.shape, kind_of(own.aval)) for own in equation.outvars]
    given = [_natural(writer, *of) for of in zip(operands, equation.invars, strict=True)]
    writer.put(f"{name}({', '.join('&' + view.at([0] * view.ndim) for view in (*given, *found))});")
    return list(map(writer.small, found))


def _natural(writer: Writer, value: Value, variable) -> View:
    """The numbers one after the other."""
    kind = kind_of(variable.aval)
    view = writer.view(value, kind)
    if view.strides == natural(view.shape) and view.kind == kind:
        return view
    own = writer.new(view.shape, kind)
    writer.copy(view, own.base, kind)
    return own


def _function(writer: Writer, name: str, traced) -> str:
    """The name of the function in C++ of addresses of arguments and results."""
    takes = list(_places("x", traced.jaxpr.invars))
    gives = list(_places("y", traced.jaxpr.outvars))
    own = Writer(writer.rules, writer.calls, {view.base: view.kind for view in (*takes, *gives)}, lanes=False)
    # Of all, so that one that this calls has a name of its own.
    own.functions = writer.functions
    for value, view in zip(own.run(traced.jaxpr, traced.consts, list(map(own.small, takes))), gives, strict=True):
        own.copy(value, view.base, view.kind)
    told = ", ".join(
        [*(f"const {view.kind}* {view.base}" for view in takes), *(f"{view.kind}* {view.base}" for view in gives)]
    )
    body = "\n".join(fused([*own.before, *own.lines]))
    text = f"[&]({told}) __attribute__((noinline)) {{\n{body}\n}};"
    for known, has in writer.functions.items():
        if has == f"const auto {known} = {text}":
            return known
    name = f"{name}_{len(writer.functions)}"
    writer.functions[name] = f"const auto {name} = {text}"
    return name


def _places(prefix: str, variables) -> Iterable[View]:
    for number, variable in enumerate(variables):
        shape = variable.aval.shape
        yield View(f"{prefix}{number}", (0,), shape, natural(shape), kind_of(variable.aval))
