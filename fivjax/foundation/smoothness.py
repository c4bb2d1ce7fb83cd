"""Whether a JAX function is certain to have no kinks."""

from collections.abc import Callable, Sequence

import jax
import jax.numpy as jnp
from jax.extend.core import Jaxpr, Literal

from .jaxprs import of_scan, within

# Primitives that are smooth wherever their values and derivatives are finite, and those that only move numbers.
# fmt: off
SMOOTH = frozenset({
    "add", "add_any", "sub", "mul", "div", "neg", "square", "integer_pow", "pow", "sqrt", "rsqrt", "cbrt", "exp",
    "exp2", "expm1", "log", "log1p", "sin", "cos", "tan", "asin", "acos", "atan", "atan2", "sinh", "cosh", "tanh",
    "asinh", "acosh", "atanh", "logistic", "erf", "erfc", "erf_inv", "lgamma", "digamma", "reduce_sum", "cumsum",
    "cumprod", "dot_general", "copy", "copy_p", "broadcast_in_dim", "reshape", "squeeze", "expand_dims", "slice",
    "concatenate", "stack", "unstack", "split", "transpose", "rev", "pad", "optimization_barrier", "device_put",
})
# Their results choose; whether that makes a kink is seen where they are used.
COMPARISONS = frozenset({"eq", "ne", "lt", "le", "gt", "ge", "is_finite", "and", "or", "not", "xor"})
# fmt: on


def is_smooth(function: Callable, *like) -> bool:
    """Whether a function is certain to have no kinks, in any of its arguments, where its values are finite.

    It has none if it is made of smooth primitives alone. One that chooses by its argument, clips or takes a size may have some.
    """
    # Not the function itself, which may be a module: JAX would look for a name in it.
    jaxpr = jax.make_jaxpr(lambda *parts: function(*parts))(*like).jaxpr
    return _smooth(jaxpr, [True] * len(jaxpr.invars))[1]


def _smooth(jaxpr: Jaxpr, moving: Sequence[bool]) -> tuple[list[bool], bool]:
    """Which results depend on the operands that do, and whether all that happens to these on the way is smooth."""
    moves = dict(zip(jaxpr.invars, moving, strict=True))

    def reads(atom) -> bool:
        return not isinstance(atom, Literal) and moves.get(atom, False)

    smooth = True
    for equation in jaxpr.eqns:
        flags, name = list(map(reads, equation.invars)), equation.primitive.name
        ends, called = [any(flags)] * len(equation.outvars), within(equation.params)
        if any(flags) and name in ("scan", "while"):
            ends, own = _looped(equation.params, flags)
            smooth &= own
        elif any(flags) and name == "cond" and not flags[0]:
            smooth &= all(_smooth(branch.jaxpr, flags[1:])[1] for branch in equation.params["branches"])
        elif any(flags) and called is not None:
            ends, own = _smooth(called.jaxpr, flags)
            smooth &= own
        elif any(flags) and name == "select_n":
            smooth &= not flags[0]
        elif any(flags) and name == "convert_element_type":
            kinds = [equation.invars[0].aval.dtype, equation.outvars[0].aval.dtype]
            smooth &= all(jnp.issubdtype(kind, jnp.inexact) for kind in kinds)
        elif any(flags):
            smooth &= name in SMOOTH or name in COMPARISONS
        moves.update(zip(equation.outvars, ends, strict=True))
    return list(map(reads, jaxpr.outvars)), smooth


def _looped(params, flags: list[bool]) -> tuple[list[bool], bool]:
    """The same for a loop: what its turns carry may depend on the operands from a later turn on."""
    if "body_jaxpr" in params:
        asked, flags = flags[: params["cond_nconsts"]], flags[params["cond_nconsts"] :]
        body, fixed, condition = params["body_jaxpr"], params["body_nconsts"], params["cond_jaxpr"]
        carried = len(flags) - fixed
    else:
        (fixed, carried), body, condition, asked = of_scan(params), params["jaxpr"], None, []
    while True:
        ends, smooth = _smooth(body.jaxpr, flags)
        begin = flags[fixed:][:carried]
        after = [one or other for one, other in zip(begin, ends, strict=False)]
        if after == begin:
            break
        flags = [*flags[:fixed], *after, *flags[fixed + carried :]]
    if condition is not None:
        # A number of turns that depends on the operands may make kinks.
        smooth &= not _smooth(condition.jaxpr, [*asked, *after])[0][0]
    return [*after, *ends[carried:]], smooth
