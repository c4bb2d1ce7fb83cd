"""Whether a JAX function is certain to have no kinks."""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend.core import Jaxpr, Literal

from .jaxprs import of_scan, within
from .precision import is_known

# Primitives that are smooth wherever their values and derivatives are finite, and those that only move numbers.
# fmt: off
SMOOTH = frozenset({
    "add", "add_any", "sub", "mul", "div", "neg", "square", "integer_pow", "exp", "exp2", "expm1", "log", "log1p",
    "sin", "cos", "atan", "sinh", "cosh", "tanh", "asinh", "atanh", "logistic", "erf", "erfc", "erf_inv", "lgamma",
    "digamma", "reduce_sum", "cumsum", "cumprod", "dot_general", "copy", "copy_p", "broadcast_in_dim", "reshape",
    "squeeze", "expand_dims", "slice", "concatenate", "stack", "unstack", "split", "transpose", "rev", "pad",
    "optimization_barrier", "device_put",
})
# Those that are so where their first operand does not pass zero: |u| is also the root of u².
SMOOTH_BESIDE_ZERO = frozenset({"sqrt", "rsqrt", "cbrt", "pow", "abs", "sign"})
# Their results choose; whether that makes a kink is seen where they are used.
COMPARISONS = frozenset({"eq", "ne", "lt", "le", "gt", "ge", "is_finite", "and", "or", "not", "xor"})
# Where all operands are above zero, or none is below, so is the result.
KEEPING = frozenset({
    "add", "add_any", "mul", "div", "square", "integer_pow", "pow", "sqrt", "rsqrt", "cbrt", "abs", "expm1", "log1p", "atan",
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
BELOW, ZERO, ABOVE = -1, 0, 1


class _Value(NamedTuple):
    """What is known of a number in a function, for all its arguments."""

    moves: bool  # whether it depends on the arguments
    least: int = BELOW  # whether it is `ABOVE` zero, may be `ZERO` but not less, or may be `BELOW`
    passes_zero: bool = True  # whether it may, when the arguments move


def is_smooth(function: Callable, *like) -> bool:
    """Whether a function is certain to have no kinks in any of its arguments, where these are above zero and its values finite.

    It has none if it is made of smooth primitives alone. One that chooses by its argument, clips or takes a size may have some.
    """
    # Not the function itself, which may be a module: JAX would look for a name in it.
    traced = jax.make_jaxpr(lambda *parts: function(*parts))(*like)
    values = [_Value(True, ABOVE, False)] * len(traced.jaxpr.invars)
    return _smooth(traced.jaxpr, values, list(map(_fixed, traced.consts)))[1]


def _fixed(number) -> _Value:
    """A number that does not move."""
    if not is_known(number) or not np.size(number) or not jnp.issubdtype(jnp.result_type(number), jnp.floating):
        return _Value(False, BELOW, False)
    lowest = np.min(np.asarray(number))
    return _Value(False, ABOVE if lowest > 0 else ZERO if lowest == 0 else BELOW, False)


def _smooth(jaxpr: Jaxpr, values: Sequence[_Value], constants: Sequence[_Value] = ()) -> tuple[list[_Value], bool]:
    """What is known of the results, and whether all that happens on the way to operands that move is smooth."""
    known = dict(zip(jaxpr.invars, values, strict=True))
    known.update(zip(jaxpr.constvars, constants, strict=False))

    def read(atom) -> _Value:
        return _fixed(atom.val) if isinstance(atom, Literal) else known.get(atom, _Value(False, BELOW, False))

    smooth = True
    for equation in jaxpr.eqns:
        operands, name = list(map(read, equation.invars)), equation.primitive.name
        moves, called = any(one.moves for one in operands), within(equation.params)
        ends = [_Value(moves, passes_zero=moves)] * len(equation.outvars)
        if moves and name in ("scan", "while"):
            flags, own = _looped(equation.params, [one.moves for one in operands])
            ends, smooth = [_Value(flag, passes_zero=flag) for flag in flags], smooth & own
        elif moves and name == "cond" and not operands[0].moves:
            smooth &= all(_smooth(branch.jaxpr, operands[1:])[1] for branch in equation.params["branches"])
        elif called is not None and name not in ("scan", "while"):
            ends, own = _smooth(called.jaxpr, operands, list(map(_fixed, called.consts)))
            smooth &= own or not moves
        else:
            ends = [_result(equation, operands, moves)] * len(equation.outvars)
            smooth &= not moves or _is_smooth_step(equation, operands)
        known.update(zip(equation.outvars, ends, strict=True))
    return list(map(read, jaxpr.outvars)), smooth


def _is_smooth_step(equation, operands: list[_Value]) -> bool:
    """Whether a primitive makes no kink of operands that move."""
    name = equation.primitive.name
    if name == "select_n":
        return not operands[0].moves
    if name == "convert_element_type":
        kinds = [equation.invars[0].aval.dtype, equation.outvars[0].aval.dtype]
        return all(jnp.issubdtype(kind, jnp.inexact) for kind in kinds)
    if name in SMOOTH_BESIDE_ZERO:
        return not operands[0].passes_zero
    return name in SMOOTH or name in COMPARISONS


def _result(equation, operands: list[_Value], moves: bool) -> _Value:
    """What is known of what a primitive computes of these."""
    name, lowest = equation.primitive.name, min((one.least for one in operands), default=BELOW)
    least = BELOW
    if name in ("exp", "exp2", "logistic", "cosh"):
        least = ABOVE
    elif name in ("add", "add_any") and lowest >= ZERO:
        least = max(one.least for one in operands)
    elif name == "pow":
        # Also where the exponent is negative.
        least = operands[0].least if operands[0].least == ABOVE else BELOW
    elif name in KEEPING:
        least = lowest
    even = name == "square" or (name == "integer_pow" and equation.params["y"] % 2 == 0)
    if least == BELOW and (even or name == "abs" or (name == "mul" and equation.invars[0] is equation.invars[1])):
        least = ZERO
    kept = least == ABOVE or (name in OF_FACTORS and not any(one.passes_zero for one in operands))
    return _Value(moves, least, moves and not kept)


def _looped(params, flags: list[bool]) -> tuple[list[bool], bool]:
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
        smooth &= not _moving(condition.jaxpr, [*asked, *after])[0][0]
    return [*after, *ends[carried:]], smooth


def _moving(jaxpr: Jaxpr, flags: list[bool]) -> tuple[list[bool], bool]:
    """Which results of a loop's turn move, where these operands do, and whether all that happens to them is smooth."""
    ends, smooth = _smooth(jaxpr, [_Value(flag, passes_zero=flag) for flag in flags])
    return [one.moves for one in ends], smooth
