"""Taylor coefficients of a JAX function of one number, by the arithmetic of truncated series.

The function is traced, and its primitives are applied to series. Loops and branches run on whole series: which way they go is
decided by the values at the centre. So at a kink the coefficients are those of one of its two sides.
"""

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend.core import Jaxpr, Literal
from jaxtyping import Array

from .jaxprs import carried_dependence, dependent_results, of_scan, within


class Series(NamedTuple):
    """A number, or an array, that depends on the function's argument: its Taylor coefficients, from the value on."""

    terms: tuple[Array, ...]


def taylor_coefficients(function: Callable, x: Array, order: int) -> list[Array]:
    """The Taylor coefficients of a function of one number about `x`, from the value to that of this order.

    **Raises:** `NotImplementedError`, as a sentence, for a primitive without a rule.
    """
    none = jnp.zeros_like(x)
    (found,) = _through(function, Series((x, jnp.ones_like(x), *[none] * (order - 1))))
    return list(found.terms) if isinstance(found, Series) else [jnp.asarray(found), *[none] * order]


def composed(outer: Sequence[Array], inner: Sequence[Array], powers: list[Array]) -> Array:
    """The next Taylor coefficient of a composition f(u(t)), from the coefficients of f about u(0) and those of u up to the
    same order (at least one).

    `powers` holds the coefficients of $(u - u(0))^k$, k = 1, 2, …, that are known (at first none), and is added to.
    """
    f = jnp.stack(outer[1:])
    if not powers:
        powers.append(jnp.zeros_like(f))
    first = jnp.zeros_like(f[:1])
    # From the powers k - 1, of which only that of k = 1, the zeroth one, begins with a constant.
    before = [jnp.concatenate([first + (1 if m == 0 else 0), power[:-1]]) for m, power in enumerate(powers)]
    last = len(inner) - 1
    powers.append(sum((inner[j] * before[last - j] for j in range(2, last + 1)), inner[1] * before[last - 1]))
    return jnp.sum(f * powers[-1], axis=0)


def _through(function: Callable, *parts: Series) -> list:
    # Not the function itself, which may be a module: JAX would look for a name in it.
    closed = jax.make_jaxpr(lambda *values: function(*values))(*(part.terms[0] for part in parts))
    return _run(closed.jaxpr, closed.consts, list(parts), len(parts[0].terms))


def _run(jaxpr: Jaxpr, consts, given, length: int) -> list:
    known = dict(zip(jaxpr.constvars, consts, strict=True)) | dict(zip(jaxpr.invars, given, strict=True))

    def read(atom):
        return atom.val if isinstance(atom, Literal) else known[atom]

    for equation in jaxpr.eqns:
        found = _applied(equation, [read(atom) for atom in equation.invars], length)
        known.update(zip(equation.outvars, found, strict=True))
    return [read(atom) for atom in jaxpr.outvars]


def _applied(equation, operands: list, length: int) -> list:
    primitive, params, name = equation.primitive, equation.params, equation.primitive.name
    if name in LOOPS:
        return LOOPS[name](params, operands, length)
    called = within(params)
    if called is not None:
        return _run(called.jaxpr, called.consts, operands, length)
    real = any(jnp.issubdtype(variable.aval.dtype, jnp.inexact) for variable in equation.outvars)
    if not real or not any(isinstance(part, Series) for part in operands):
        found = primitive.bind(*map(_value, operands), **params)
        return list(found) if primitive.multiple_results else [found]
    if any(jnp.issubdtype(variable.aval.dtype, jnp.complexfloating) for variable in equation.outvars):
        raise NotImplementedError("Complex numbers have no Taylor series here. Write the function without them.")
    if name in LINEAR:
        return _linear(primitive, params, operands, LINEAR[name], length)
    if name == "pow" and not isinstance(operands[1], Series):
        return [Series(_constant_power(operands[0].terms, operands[1]))]
    terms = [_terms(part, length) for part in operands]
    if name in ("mul", "dot_general"):
        left, right = terms
        return [Series(_product(left, right, lambda a, b: primitive.bind(a, b, **params)))]
    if name in BY_DERIVATIVE:
        (u,) = terms
        (slope,) = _through(BY_DERIVATIVE[name], Series(u))
        return [Series(_integrated(primitive.bind(u[0], **params), u, _terms(slope, length)))]
    if name in BY_ITSELF:
        return [Series(_by_itself(primitive.bind(terms[0][0], **params), terms[0], *BY_ITSELF[name]))]
    if name in RULES:
        return [Series(tuple(RULES[name](*terms, **{key: params[key] for key in USED.get(name, ())})))]
    raise NotImplementedError(
        f"The primitive `{name}` of JAX has no Taylor series here. Write the function without it."
    )


def _value(part):
    return part.terms[0] if isinstance(part, Series) else part


def _terms(part, length: int) -> tuple[Array, ...]:
    if isinstance(part, Series):
        return part.terms
    part = jnp.asarray(part)
    return (part, *[jnp.zeros_like(part)] * (length - 1))


def _linear(primitive, params, operands: list, values: Sequence[int], length: int) -> list:
    """Of primitives that are linear in some operands together: in these `values`, by place, or in all."""
    places = values or range(len(operands))
    terms = {place: _terms(operands[place], length) for place in places}
    rows = []
    for k in range(length):
        if k == 1 and params.get("fill_value") is not None:
            # What is outside of a table does not change.
            params = {**params, "fill_value": 0}
        parts = [terms[i][k] if i in terms else _value(part) for i, part in enumerate(operands)]
        found = primitive.bind(*parts, **params)
        rows.append(found if primitive.multiple_results else [found])
    return [Series(own) for own in zip(*rows, strict=True)]


def _product(a: Sequence[Array], b: Sequence[Array], multiply: Callable = jnp.multiply) -> tuple[Array, ...]:
    def term(k: int) -> Array:
        total = multiply(a[0], b[k])
        for j in range(1, k + 1):
            total = total + multiply(a[j], b[k - j])
        return total

    return tuple(map(term, range(len(a))))


def _quotient(a: Sequence[Array], b: Sequence[Array]) -> tuple[Array, ...]:
    found: list[Array] = []
    for k, own in enumerate(a):
        found.append((own - sum(b[j] * found[k - j] for j in range(1, k + 1))) / b[0])
    return tuple(found)


def _integrated(value: Array, u: Sequence[Array], slope: Sequence[Array]) -> tuple[Array, ...]:
    """v with v' = s u', from its value and the series of s."""
    return (value, *(jnp.asarray(sum(j * u[j] * slope[k - j] for j in range(1, k + 1))) / k for k in range(1, len(u))))


def _by_itself(value: Array, u: Sequence[Array], a: float, b: float, c: float) -> tuple[Array, ...]:
    """v with v' = (a + b v + c v²) u', from its value."""
    v, slope = [value], [a + b * value + c * value * value]
    for k in range(1, len(u)):
        v.append(sum(j * u[j] * slope[k - j] for j in range(1, k + 1)) / k)
        slope.append(b * v[k] + (c * sum(v[i] * v[k - i] for i in range(k + 1)) if c else 0.0))
    return tuple(v)


def _pair(values: tuple[Array, Array], u: Sequence[Array], sign: float) -> tuple[list[Array], list[Array]]:
    """The series of sine and cosine (sign -1), or of their hyperbolic relatives (sign 1)."""
    sine, cosine = [values[0]], [values[1]]
    for k in range(1, len(u)):
        sine.append(sum(j * u[j] * cosine[k - j] for j in range(1, k + 1)) / k)
        cosine.append(sign * sum(j * u[j] * sine[k - j] for j in range(1, k + 1)) / k)
    return sine, cosine


def _power(u: Sequence[Array], exponent: Array | float) -> tuple[Array, ...]:
    found = [u[0] ** exponent]
    for k in range(1, len(u)):
        found.append(sum((exponent * j - (k - j)) * u[j] * found[k - j] for j in range(1, k + 1)) / (k * u[0]))
    return tuple(found)


def _whole_power(u: Sequence[Array], y: int) -> tuple[Array, ...]:
    one = (jnp.ones_like(u[0]), *[jnp.zeros_like(u[0])] * (len(u) - 1))
    if y < 0:
        return _quotient(one, _whole_power(u, -y))
    found = one
    for digit in f"{y:b}":
        found = _product(found, found)
        found = _product(found, u) if digit == "1" else found
    return found


def _any_power(u: Sequence[Array], exponent: Sequence[Array]) -> tuple[Array, ...]:
    (logarithm,) = _through(jnp.log, Series(tuple(u)))
    inner = _product(exponent, logarithm.terms)
    return _by_itself(jnp.exp(inner[0]), inner, 0.0, 1.0, 0.0)


def _constant_power(u: Sequence[Array], exponent) -> tuple[Array, ...]:
    """Where the base is zero, there is a series for whole exponents only, and no derivative by the exponent (which has a
    logarithm in it).
    """
    if not isinstance(exponent, jax.core.Tracer):
        values = np.unique(exponent)
        if len(values) == 1 and values[0] == np.round(values[0]) and abs(values[0]) < 64:
            return _whole_power(u, int(values[0]))
    zero = u[0] == 0
    found = _power((jnp.where(zero, 1.0, u[0]), *u[1:]), exponent)
    # There u is t times a series, and its power that of this series, shifted by the exponent.
    fixed = jax.lax.stop_gradient(exponent)
    rest = _power((jnp.where(zero, u[1], 1.0), *u[2:], jnp.zeros_like(u[0])), fixed)
    whole = (fixed >= 0) & (fixed == jnp.round(fixed))
    at_zero = []
    for k in range(len(u)):
        shifted = sum(jnp.where(fixed == m, rest[k - m], 0.0) for m in range(k + 1))
        at_zero.append(jnp.where(whole, shifted, jnp.where(fixed > k, 0.0, jnp.nan)))
    return tuple(jnp.where(zero, _not_along(own, exponent), other) for own, other in zip(at_zero, found, strict=True))


@jax.custom_jvp
def _not_along(value: Array, parameter: Array) -> Array:
    """A value that has no derivative by a parameter."""
    return value + 0.0 * parameter


@_not_along.defjvp
def _(primals, tangents):
    moved, along = tangents
    return _not_along(*primals), jnp.where(along == 0, moved, jnp.nan)


def _chosen(first, a: Sequence[Array], b: Sequence[Array]) -> list[Array]:
    return [jnp.where(first, own, other) for own, other in zip(a, b, strict=True)]


def _clipped(low, u, high) -> list[Array]:
    return _chosen(u[0] < low[0], low, _chosen(u[0] > high[0], high, u))


def _extreme(u: Sequence[Array], axes, choose) -> list[Array]:
    best = choose(u[0], axis=axes, keepdims=True) == u[0]
    # Of equal ones the mean.
    return [jnp.sum(jnp.where(best, own, 0.0), axis=axes) / jnp.sum(best, axis=axes) for own in u]


def _flat(values: Array, u: Sequence[Array]) -> list[Array]:
    return [values, *map(jnp.zeros_like, u[1:])]


# By name: the places of the operands in which a primitive is linear; in all together, where none are named.
# fmt: off
LINEAR: dict[str, tuple[int, ...]] = dict.fromkeys([
    "add", "add_any", "sub", "neg", "copy", "copy_p", "reshape", "broadcast_in_dim", "squeeze", "expand_dims", "slice",
    "transpose", "rev", "reduce_sum", "cumsum", "convert_element_type", "reduce_precision", "concatenate", "stack", "unstack",
    "split", "pad", "real", "optimization_barrier", "device_put", "stop_gradient",
], ())
# fmt: on
LINEAR |= {
    "gather": (0,),
    "dynamic_slice": (0,),
    "dynamic_update_slice": (0, 1),
    "scatter": (0, 2),
    "scatter-add": (0, 2),
}
# Functions by their derivatives.
BY_DERIVATIVE: dict[str, Callable] = {
    "log": lambda x: 1 / x,
    "log1p": lambda x: 1 / (1 + x),
    "expm1": jnp.exp,
    "atan": lambda x: 1 / (1 + x * x),
    "asin": lambda x: jax.lax.rsqrt((1 - x) * (1 + x)),
    "acos": lambda x: -jax.lax.rsqrt((1 - x) * (1 + x)),
    "asinh": lambda x: jax.lax.rsqrt(1 + x * x),
    "acosh": lambda x: jax.lax.rsqrt((x - 1) * (x + 1)),
    "atanh": lambda x: 1 / ((1 - x) * (1 + x)),
    "erf": lambda x: 2 / math.sqrt(math.pi) * jnp.exp(-x * x),
    "erfc": lambda x: -2 / math.sqrt(math.pi) * jnp.exp(-x * x),
}
# Functions v with v' = a + b v + c v².
BY_ITSELF = {
    "exp": (0.0, 1.0, 0.0),
    "tanh": (1.0, 0.0, -1.0),
    "tan": (1.0, 0.0, 1.0),
    "logistic": (0.0, 1.0, -1.0),
}
RULES: dict[str, Callable] = {
    "div": _quotient,
    "square": lambda u: _product(u, u),
    "integer_pow": _whole_power,
    "pow": _any_power,
    "sqrt": lambda u: _power(u, 0.5),
    "rsqrt": lambda u: (1 / jnp.sqrt(u[0]), *_power(u, -0.5)[1:]),
    "cbrt": lambda u: [
        jnp.cbrt(u[0]),
        *(jnp.cbrt(u[0]) * term for term in _power([u[0] / u[0], *(t / u[0] for t in u[1:])], 1 / 3)[1:]),
    ],
    "exp2": lambda u: _by_itself(jnp.exp2(u[0]), u, 0.0, math.log(2.0), 0.0),
    "sin": lambda u: _pair((jnp.sin(u[0]), jnp.cos(u[0])), u, -1.0)[0],
    "cos": lambda u: _pair((jnp.sin(u[0]), jnp.cos(u[0])), u, -1.0)[1],
    "sinh": lambda u: _pair((jnp.sinh(u[0]), jnp.cosh(u[0])), u, 1.0)[0],
    "cosh": lambda u: _pair((jnp.sinh(u[0]), jnp.cosh(u[0])), u, 1.0)[1],
    "abs": lambda u: _chosen(u[0] >= 0, u, [-term for term in u]),
    "max": lambda a, b: _chosen(a[0] >= b[0], a, b),
    "min": lambda a, b: _chosen(a[0] <= b[0], a, b),
    "clamp": _clipped,
    "rem": lambda u, by: [
        jax.lax.rem(u[0], by[0]),
        *(own - jnp.trunc(u[0] / by[0]) * other for own, other in zip(u[1:], by[1:], strict=True)),
    ],
    "reduce_max": lambda u, axes: _extreme(u, axes, jnp.max),
    "reduce_min": lambda u, axes: _extreme(u, axes, jnp.min),
    "sign": lambda u: _flat(jnp.sign(u[0]), u),
    "floor": lambda u: _flat(jnp.floor(u[0]), u),
    "ceil": lambda u: _flat(jnp.ceil(u[0]), u),
    "round": lambda u: _flat(jnp.round(u[0]), u),
}
# Parameters of primitives that their rules take.
USED = {"integer_pow": ("y",), "reduce_max": ("axes",), "reduce_min": ("axes",)}


def _as_series(parts: Sequence, moving: Sequence[bool], length: int) -> list:
    return [Series(_terms(part, length)) if moves else part for part, moves in zip(parts, moving, strict=True)]


def _select(params, operands: list, length: int) -> list:
    which, *cases = operands
    if not any(isinstance(case, Series) for case in cases):
        return [jax.lax.select_n(which, *cases)]
    terms = [_terms(case, length) for case in cases]
    return [Series(tuple(jax.lax.select_n(which, *(case[k] for case in terms)) for k in range(length)))]


def _scan(params, operands: list, length: int) -> list:
    constants, carried = of_scan(params)
    body = params["jaxpr"]
    fixed, begin, along = operands[:constants], operands[constants:][:carried], operands[constants + carried :]
    moving, ends = carried_dependence(body.jaxpr, _flags(fixed), _flags(begin), _flags(along))

    def step(carry, x):
        found = _as_series(_run(body.jaxpr, body.consts, [*fixed, *carry, *x], length), ends, length)
        return _as_series(found[:carried], moving, length), found[carried:]

    begin = _as_series(begin, moving, length)
    last, rows = jax.lax.scan(
        step, begin, along, length=params["length"], reverse=params["reverse"], unroll=params["unroll"]
    )
    return [*last, *rows]


def _while(params, operands: list, length: int) -> list:
    of_condition, of_body = params["cond_nconsts"], params["body_nconsts"]
    condition, body = params["cond_jaxpr"], params["body_jaxpr"]
    asked, fixed, begin = operands[:of_condition], operands[of_condition:][:of_body], operands[of_condition + of_body :]
    moving, _ = carried_dependence(body.jaxpr, _flags(fixed), _flags(begin), [])

    def going(carry):
        return _run(condition.jaxpr, condition.consts, list(map(_value, [*asked, *carry])), length)[0]

    def step(carry):
        return _as_series(_run(body.jaxpr, body.consts, [*fixed, *carry], length), moving, length)

    return jax.lax.while_loop(going, step, _as_series(begin, moving, length))


def _cond(params, operands: list, length: int) -> list:
    index, *rest = operands
    ends = [
        any(flags)
        for flags in zip(*(dependent_results(branch.jaxpr, _flags(rest)) for branch in params["branches"]), strict=True)
    ]

    def way(branch):
        return lambda parts: _as_series(_run(branch.jaxpr, branch.consts, parts, length), ends, length)

    return jax.lax.switch(index, [way(branch) for branch in params["branches"]], rest)


LOOPS: dict[str, Callable] = {"scan": _scan, "while": _while, "cond": _cond, "select_n": _select}


def _flags(parts: Sequence) -> list[bool]:
    return [isinstance(part, Series) for part in parts]
