"""A traced function computed by NumPy, equation by equation: for small functions of known values.

XLA takes longer to compile such a function than NumPy takes for a hundred calls.
"""

import functools
from collections import Counter, OrderedDict
from collections.abc import Callable
from typing import ParamSpec, TypeVar

import jax
import numpy as np
from jax.extend.core import Jaxpr, Literal

from .compiling import compiled, transformed
from .jaxprs import of_scan, solution, within
from .kernel_text import Form
from .numpy_primitives import applied

# Calls after which it is compiled, and results that are kept in case they are asked for again.
REPAID, LATEST = 100, 16

P = ParamSpec("P")
R = TypeVar("R")


def by_numpy(function: Callable[P, R]) -> Callable[P, R]:
    """`compiled`, but the first calls with known values are computed by NumPy; results are then arrays of NumPy."""
    otherwise = compiled(function)
    traced: dict = {}
    calls: Counter = Counter()
    # The latest results: one call of the library asks for the same of a scene several times.
    latest: OrderedDict = OrderedDict()

    @functools.wraps(function)
    def call(*args: P.args, **kwargs: P.kwargs) -> R:
        if transformed((args, kwargs)):
            return otherwise(*args, **kwargs)
        form, arrays = Form.of((args, kwargs))
        key = form, *(np.asarray(array).tobytes() for array in arrays)
        if key in latest:
            return jax.tree.map(_copied, latest[key])
        calls[form] += 1
        if calls[form] > REPAID:
            return otherwise(*args, **kwargs)
        if form not in traced:
            with jax.enable_x64(True):
                like = [jax.ShapeDtypeStruct(*array) for array in form.arrays]
                structures = []

                def flat(arrays):
                    own, named = form.args(arrays)
                    leaves, structure = jax.tree.flatten(function(*own, **named))  # pyright: ignore[reportCallIssue]
                    structures.append(structure)
                    return leaves

                traced[form] = jax.make_jaxpr(flat)(like), structures[-1]
        closed, structure = traced[form]
        given = [np.asarray(leaf, array.dtype) for leaf, array in zip(arrays, form.arrays, strict=True)]
        # As in JAX, what is no number comes without a warning.
        with np.errstate(all="ignore"):
            found = _run(closed.jaxpr, closed.consts, given)
        # Numbers are NumPy's own, which Python's functions take.
        latest[key] = jax.tree.unflatten(structure, [leaf[()] for leaf in found])
        if len(latest) > LATEST:
            latest.popitem(last=False)
        return jax.tree.map(_copied, latest[key])

    return call


def _copied(leaf):
    return leaf.copy() if isinstance(leaf, np.ndarray) else leaf


def _run(jaxpr: Jaxpr, consts, given) -> list:
    known = dict(zip(jaxpr.constvars, map(np.asarray, consts), strict=True))
    known |= dict(zip(jaxpr.invars, given, strict=True))

    def read(atom):
        return np.asarray(atom.val, atom.aval.dtype) if isinstance(atom, Literal) else known[atom]

    for equation in jaxpr.eqns:
        results = _applied(equation, list(map(read, equation.invars)))
        for variable, result in zip(equation.outvars, results, strict=True):
            known[variable] = np.asarray(result, variable.aval.dtype)
    return list(map(read, jaxpr.outvars))


def _applied(equation, operands: list) -> list:
    primitive, params = equation.primitive, equation.params
    name = primitive.name
    if name in LOOPS:
        return LOOPS[name](params, operands)
    called = within(params)
    if called is not None:
        return _run(called.jaxpr, called.consts, operands)
    return applied(equation, operands)


def _while(params, operands: list) -> list:
    condition, body = params["cond_jaxpr"], params["body_jaxpr"]
    asked = operands[: params["cond_nconsts"]]
    fixed = operands[len(asked) :][: params["body_nconsts"]]
    carry = operands[len(asked) + len(fixed) :]
    while _run(condition.jaxpr, condition.consts, [*asked, *carry])[0]:
        carry = _run(body.jaxpr, body.consts, [*fixed, *carry])
    return carry


def _scan(params, operands: list) -> list:
    body, length = params["jaxpr"], params["length"]
    shared, carried = of_scan(params)
    fixed, carry = operands[:shared], operands[shared:][:carried]
    along, rows = operands[len(fixed) + len(carry) :], []
    for k in range(length)[:: -1 if params["reverse"] else 1]:
        found = _run(body.jaxpr, body.consts, [*fixed, *carry, *(array[k] for array in along)])
        rows.append(found[len(carry) :])
        carry = found[: len(carry)]
    rows = rows[:: -1 if params["reverse"] else 1]
    shapes = [np.zeros((0, *variable.aval.shape)) for variable in body.jaxpr.outvars[len(carry) :]]
    return [*carry, *(map(np.stack, zip(*rows, strict=True)) if rows else shapes)]


def _cond(params, operands: list) -> list:
    index, *rest = operands
    branch = params["branches"][int(np.clip(int(index), 0, len(params["branches"]) - 1))]
    return _run(branch.jaxpr, branch.consts, rest)


def _solved(params, operands: list) -> list:
    solve, given = solution(params, operands)
    return _run(solve.jaxpr, solve.consts, given)


LOOPS: dict[str, Callable] = {"while": _while, "scan": _scan, "cond": _cond, "custom_linear_solve": _solved}
