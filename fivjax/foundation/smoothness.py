"""Whether a JAX function is certain to have no kinks."""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend.core import Jaxpr, Literal
from jaxtyping import Array, Bool

from .jaxprs import of_scan, within
from .precision import is_known

# Primitives that are smooth wherever their values and derivatives are finite, and those that only move numbers.
# fmt: off
SMOOTH = frozenset({
    "add", "add_any", "sub", "mul", "neg", "square", "exp", "exp2", "expm1", "sin", "cos", "atan", "sinh", "cosh",
    "tanh", "asinh", "atanh", "logistic", "erf", "erfc", "erf_inv", "reduce_sum", "cumsum", "cumprod", "dot_general",
    "copy", "copy_p", "broadcast_in_dim", "reshape", "squeeze", "expand_dims", "slice", "concatenate", "stack",
    "unstack", "split", "transpose", "rev", "pad", "optimization_barrier", "device_put",
})
# Their results choose; whether that makes a kink is seen where they are used.
COMPARISONS = frozenset({"eq", "ne", "lt", "le", "gt", "ge", "is_finite", "and", "or", "not", "xor"})
# Where all operands are above zero, or none is below, so is the result.
KEEPING = frozenset({
    "add", "add_any", "mul", "div", "square", "integer_pow", "sqrt", "rsqrt", "cbrt", "abs", "expm1", "log1p", "atan",
    "sinh", "tanh", "asinh", "erf", "reduce_sum", "copy", "copy_p", "broadcast_in_dim", "reshape", "squeeze",
    "expand_dims", "slice", "concatenate", "stack", "transpose", "rev", "convert_element_type",
    "optimization_barrier", "device_put",
})
# Those of which the result passes zero nowhere if no operand does.
OF_FACTORS = frozenset({
    "mul", "div", "neg", "square", "integer_pow", "pow", "sqrt", "rsqrt", "cbrt", "abs", "copy", "copy_p", "reshape",
    "broadcast_in_dim", "squeeze", "expand_dims", "convert_element_type",
})
# fmt: on
Truth = Bool[Array, ""] | np.bool_
YES, NO = np.bool_(True), np.bool_(False)


class _Value(NamedTuple):
    """What is known of a number in a function, for all its arguments: of numbers that are traced, as traced truths."""

    moves: bool  # whether it depends on the arguments
    above: Truth  # whether it is above zero
    not_below: Truth
    passes: Truth  # whether it may pass zero when the arguments move


def _unknown(moves: bool) -> _Value:
    return _Value(moves, NO, NO, np.bool_(moves))


def is_smooth(function: Callable, *like) -> Truth:
    """Whether a function is certain to have no kinks in any of its arguments, where these are above zero and its values finite.

    It has none if it is made of smooth primitives alone. One that chooses by its argument, clips, takes a size, or takes a root
    or the inverse of what may be zero may have some. Where that depends on numbers that are traced, so is the answer.
    """
    # Not the function itself, which may be a module: JAX would look for a name in it.
    traced = jax.make_jaxpr(lambda *parts: function(*parts))(*like)
    values = [_Value(True, YES, YES, NO)] * len(traced.jaxpr.invars)
    return _smooth(traced.jaxpr, values, list(map(_fixed, traced.consts)))[1]


def _fixed(number) -> _Value:
    """A number that does not move."""
    if not np.size(number) or not jnp.issubdtype(jnp.result_type(number), jnp.floating):
        return _unknown(False)
    lowest = np.min(np.asarray(number)) if is_known(number) else jnp.min(number)
    return _Value(False, lowest > 0, lowest >= 0, NO)


def _smooth(jaxpr: Jaxpr, values: Sequence[_Value], constants: Sequence[_Value] = ()) -> tuple[list[_Value], Truth]:
    """What is known of the results, and whether all that happens on the way to operands that move is smooth."""
    known = dict(zip(jaxpr.invars, values, strict=True))
    known.update(zip(jaxpr.constvars, constants, strict=False))

    def read(atom) -> _Value:
        return _fixed(atom.val) if isinstance(atom, Literal) else known.get(atom, _unknown(False))

    smooth = YES
    for equation in jaxpr.eqns:
        operands, name = list(map(read, equation.invars)), equation.primitive.name
        moves, called = any(one.moves for one in operands), within(equation.params)
        ends = [_unknown(moves)] * len(equation.outvars)
        if moves and name in ("scan", "while"):
            flags, own = _looped(equation.params, [one.moves for one in operands])
            ends, smooth = list(map(_unknown, flags)), smooth & own
        elif moves and name == "cond" and not operands[0].moves:
            for branch in equation.params["branches"]:
                smooth = smooth & _smooth(branch.jaxpr, operands[1:])[1]
        elif called is not None and name not in ("scan", "while"):
            ends, own = _smooth(called.jaxpr, operands, list(map(_fixed, called.consts)))
            smooth = smooth & own if moves else smooth
        else:
            ends = [_result(equation, operands, moves)] * len(equation.outvars)
            smooth = smooth & _is_smooth_step(equation, operands) if moves else smooth
        known.update(zip(equation.outvars, ends, strict=True))
    return list(map(read, jaxpr.outvars)), smooth


def _is_smooth_step(equation, operands: list[_Value]) -> Truth:
    """Whether a primitive makes no kink of operands that move."""
    name, first, last = equation.primitive.name, operands[0], operands[-1]
    if name == "select_n":
        return np.bool_(not first.moves)
    if name == "convert_element_type":
        kinds = [equation.invars[0].aval.dtype, equation.outvars[0].aval.dtype]
        return np.bool_(all(jnp.issubdtype(kind, jnp.inexact) for kind in kinds))
    # |u| is also the root of u², and tanh(1/u) jumps.
    if name in ("sqrt", "rsqrt", "cbrt", "abs", "sign", "log"):
        return ~first.passes
    if name == "div":
        return ~last.passes
    if name == "integer_pow":
        return YES if equation.params["y"] >= 0 else ~first.passes
    if name == "pow":
        return first.above if last.moves else ~first.passes
    if name == "log1p":
        return first.not_below
    if name in ("lgamma", "digamma"):
        return first.above
    return np.bool_(name in SMOOTH or name in COMPARISONS)


def _result(equation, operands: list[_Value], moves: bool) -> _Value:
    """What is known of what a primitive computes of these."""
    name, above, not_below = equation.primitive.name, NO, NO
    if name in ("exp", "exp2", "logistic", "cosh"):
        above = YES
    elif name == "pow":
        above = operands[0].above
    elif name in KEEPING and jnp.issubdtype(equation.outvars[0].aval.dtype, jnp.floating):
        above, not_below = YES, YES
        for one in operands:
            above, not_below = above & one.above, not_below & one.not_below
        if name in ("add", "add_any"):
            above = not_below & (operands[0].above | operands[-1].above)
    even = name in ("square", "abs") or (name == "integer_pow" and equation.params["y"] % 2 == 0)
    if even or (name == "mul" and equation.invars[0] is equation.invars[1]):
        not_below = YES
    passes = ~above if moves else NO
    if moves and name in OF_FACTORS:
        zero = NO
        for one in operands:
            zero = zero | one.passes
        passes = passes & zero
    return _Value(moves, above, above | not_below, passes)


def _looped(params, flags: list[bool]) -> tuple[list[bool], Truth]:
    """The same for a loop: what its turns carry may depend on the operands from a later turn on."""
    if "body_jaxpr" in params:
        asked, flags = flags[: params["cond_nconsts"]], flags[params["cond_nconsts"] :]
        body, fixed, condition = params["body_jaxpr"], params["body_nconsts"], params["cond_jaxpr"]
        carried = len(flags) - fixed
    else:
        (fixed, carried), body, condition, asked = of_scan(params), params["jaxpr"], None, []
    while True:
        ends, smooth = _moving(body.jaxpr, flags)
        begin = flags[fixed:][:carried]
        after = [one or other for one, other in zip(begin, ends, strict=False)]
        if after == begin:
            break
        flags = [*flags[:fixed], *after, *flags[fixed + carried :]]
    if condition is not None:
        # A number of turns that depends on the operands may make kinks.
        smooth = smooth & (not _moving(condition.jaxpr, [*asked, *after])[0][0])
    return [*after, *ends[carried:]], smooth


def _moving(jaxpr: Jaxpr, flags: list[bool]) -> tuple[list[bool], Truth]:
    """Which results of a loop's turn move, where these operands do, and whether all that happens to them is smooth."""
    ends, smooth = _smooth(jaxpr, list(map(_unknown, flags)))
    return [one.moves for one in ends], smooth
