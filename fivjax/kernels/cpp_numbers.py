"""Numbers in C++ code that is being written: their types, the text of arithmetic, and what is known of it beforehand."""

from collections.abc import Sequence

import jax
import numpy as np

from ..foundation.numpy_primitives import function_of
from . import cpp_lanes
from .cpp_arrays import Value, View, of_numbers

# Types in C++. What is wide is declared by the kernel: so many numbers in double precision.
WIDE = "wide"
TYPES = {
    "float64": "double",
    "bool": "bool",
    "int32": "int",
    "int8": "signed char",
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
    "asinh": "({0} < 0.0 ? -1.0 : 1.0)"
    " * __builtin_log1p(wp::abs({0}) + wp::abs({0}) / (1.0 / wp::abs({0}) + wp::sqrt(1.0 + 1.0 / ({0} * {0}))))",
    "acosh": "__builtin_log1p({0} - 1.0 + wp::sqrt({0} - 1.0) * wp::sqrt({0} + 1.0))",
    "atanh": "({0} < 0.0 ? -0.5 : 0.5) * __builtin_log1p(2.0 * wp::abs({0}) / (1.0 - wp::abs({0})))",
    "logistic": "1.0 / (1.0 + wp::exp(-{}))",
    "floor": "wp::floor({})",
    "ceil": "wp::ceil({})",
    "max": "({0} > {1} ? {0} : {1})",
    "min": "({0} < {1} ? {0} : {1})",
    # The upper bound counts where the lower one is above it.
    "clamp": "(({1} > {2}) | ({0} > {2}) ? {2} : ({1} < {0} ? {0} : {1}))",
    "lt": "{} < {}",
    "le": "{} <= {}",
    # Searches in tables compare so; they differ for what is no number only.
    "lt_to": "{} < {}",
    "le_to": "{} <= {}",
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
# Of whole numbers, one by one and side by side, where what holds is -1: as in JAX by zero, which would end the process.
WHOLE_QUOTIENT = "({1} == 0 ? -1 : {0} / {1})", "(({1} == 0) | ({0} / ({1} - ({1} == 0))))"
WHOLE_REMAINDER = "({1} == 0 ? {0} : {0} % {1})", "((({1} == 0) & {0}) | ({0} % ({1} - ({1} == 0))))"
# Real numbers that become whole ones of a type, between the least and the most, and what is no number zero, as in JAX: beyond
# them C++ has nothing.
WITHIN_WHOLE = {
    kind: f"({{0}} != {{0}} ? REAL(0) : ({{0}} > REAL({most}) ? REAL({most}) : "
    f"({{0}} < REAL({least}) ? REAL({least}) : {{0}})))"
    for kind, least, most in (
        ("signed char", -128.0, 127.0),
        ("int", -(2.0**31), 2.0**31 - 1),
        ("long long", -(2.0**63), 2.0**63 - 1024),
        ("unsigned", 0.0, 2.0**32 - 1),
        ("unsigned long long", 0.0, 2.0**64 - 2048),
    )
}
# What leaves each number as it is.
SAME = ("copy", "copy_p", "stop_gradient", "optimization_barrier")
COMPARISONS = ("lt", "le", "lt_to", "le_to", "gt", "ge", "eq", "ne", "is_finite")


def kind_of(aval, of_lanes: bool = False) -> str:
    """The type in C++ of numbers of an array.

    **Raises:** `NotImplementedError` where there is none, as of numbers in single precision; side by side also for numbers
    without a sign, because vectors compare, divide and carry over as numbers with one.
    """
    if aval.dtype == jax.dtypes.float0:
        return "bool"
    name = np.dtype(aval.dtype).name
    if name not in TYPES or (of_lanes and TYPES[name] not in cpp_lanes.OF_LANES):
        raise NotImplementedError(f"Numbers of type `{name}` have no C++ here; write the function without them.")
    return TYPES[name]


def text_of(entry) -> str:
    if isinstance(entry, str):
        return entry
    if isinstance(entry, bool):
        return "true" if entry else "false"
    if isinstance(entry, float) and not np.isfinite(entry):
        return "(0.0 / 0.0)" if np.isnan(entry) else "(1.0 / 0.0)" if entry > 0 else "(-1.0 / 0.0)"
    if isinstance(entry, int) and abs(entry) >= 2**31:
        return f"({entry}{'ull' if entry >= 2**63 else 'll'})"
    return f"({entry!r})"


def form_for(name: str, form: str, own: str, of_lanes: bool) -> tuple[str, str]:
    """The form of a primitive for numbers of a type, and this type, or that of all lanes' numbers."""
    kind = cpp_lanes.OF_LANES.get(own, own) if of_lanes else own
    form = _form_for(name, form, kind)
    return (cpp_lanes.within_bits(form, own) if of_lanes and name in cpp_lanes.GOING_BEYOND else form), kind


def form_before_conversion(own: str, kind: str, of_lanes: bool) -> str | None:
    """What a number of a type is put through before it becomes one of another type, if anything."""
    if own == "double" and kind in WITHIN_WHOLE:
        return WITHIN_WHOLE[kind].replace("REAL", f"({cpp_lanes.REALS if of_lanes else 'double'})")
    longer = cpp_lanes.LONGER.get(kind, 0) > cpp_lanes.LONGER.get(own, 0)
    return cpp_lanes.within_bits("{}", kind) if of_lanes and longer and own not in ("double", "bool") else None


def _form_for(name: str, form: str, kind: str) -> str:
    # Of two, the larger or smaller is no number where the first is none, as in JAX.
    if name == "not" and kind not in ("bool", *cpp_lanes.KINDS):
        return "~{}"
    if name == "abs" and kind not in ("double", WIDE, cpp_lanes.REALS):
        return f"({{0}} < ({kind})(0) ? -{{0}} : {{0}})"
    if name in ("max", "min") and kind == cpp_lanes.REALS:
        return cpp_lanes.BY_NUMBER[name]
    if name in ("max", "min") and kind == cpp_lanes.TRUTHS:
        # What holds is less than zero, as a number.
        return BY_NUMBER["or" if name == "max" else "and"]
    return form.replace(" ?", " || {0} != {0} ?") if name in ("max", "min") and kind == "double" else form


def types_of_operands(name: str, types: Sequence[str], kind: str) -> list[str]:
    """Those that operands have if the result is of lanes side by side."""
    if name == "select_n":
        return [cpp_lanes.TRUTHS, *[kind] * (len(types) - 1)]
    own = next((found for found in types if found in cpp_lanes.KINDS), kind)
    # What holds is less than zero, as a number.
    own = cpp_lanes.WHOLES if own == cpp_lanes.TRUTHS and name not in ("eq", "ne") else own
    return [own if name in COMPARISONS else kind] * len(types)


def without_repeats(value: Value) -> Value:
    """The value with one entry along axes along which it has been broadcast."""
    if isinstance(value, View) or value.ndim == 0 or value.size == 0:
        return value
    if all(entry is value.flat[0] or equal(entry, value.flat[0]) for entry in value.flat):
        return value[(slice(0, 1),) * value.ndim]
    return value[tuple(slice(0, 1) if stride == 0 else slice(None) for stride in value.strides)]


def equal(one, other) -> bool:
    # Zero has a sign.
    return type(one) is type(other) and one == other and str(one) == str(other)


def converted(text: str, own: str, kind: str) -> str:
    """The text of a number of one type as one of another."""
    if kind in cpp_lanes.KINDS:
        return cpp_lanes.converted(text, own, kind)
    return text if own == kind else f"({kind})({text})"


def base_of(target: Value) -> str:
    if isinstance(target, View):
        return target.base
    return target.ravel()[0].partition("[")[0] if target.size else ""


def same(target: Value, value: Value) -> bool:
    if isinstance(target, View) or isinstance(value, View):
        return isinstance(target, View) and isinstance(value, View) and target == value
    return target.shape == value.shape and target.ravel().tolist() == value.ravel().tolist()


def _is(entry, number: int) -> bool:
    return not isinstance(entry, str | bool) and entry == number


def simpler(name: str, parts: list, kind: str):
    """What follows for a number of this type from the parts that are known, if anything does. Zero times something counts as
    zero: what is not a number shows elsewhere.
    """
    if name == "select_n":
        which, first, second = parts
        if not isinstance(which, str):
            return second if which else first
        return first if equal(first, second) else None
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
    if name == "sub" and isinstance(parts[0], str) and parts[0] == parts[1]:
        return 0.0 if kind in ("double", WIDE, cpp_lanes.REALS) else 0
    if (name == "sub" and _is(parts[1], 0)) or (name == "div" and _is(parts[1], 1)):
        return parts[0]
    if name in ("div", "neg") and _is(parts[0], 0):
        return parts[0]
    return None


def of_known(equation, operands: list[Value]) -> list[Value]:
    values = [
        np.array(part.tolist(), atom.aval.dtype).reshape(part.shape)
        for part, atom in zip(operands, equation.invars, strict=True)
    ]
    # As in JAX, what is no number comes without a warning.
    with np.errstate(all="ignore"):
        return list(map(of_numbers, function_of(equation)(values)))


def fill_of(equation):
    """The number that JAX gives for places outside of an array."""
    value, dtype = equation.params["fill_value"], equation.outvars[0].aval.dtype
    if value is not None:
        return dtype.type(value).item()
    if np.issubdtype(dtype, np.floating):
        return float("nan")
    if np.issubdtype(dtype, np.bool_):
        return True
    limits = np.iinfo(dtype)
    return int(limits.min if limits.min < 0 else limits.max)
