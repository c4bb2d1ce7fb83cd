"""A traced function computed by NumPy, equation by equation: for small functions of known values.

XLA takes longer to compile such a function than NumPy takes for a hundred calls.
"""

import functools
from collections import Counter, OrderedDict
from collections.abc import Callable
from typing import NamedTuple, ParamSpec, TypeVar

import jax
import numpy as np
from jax.extend.core import Jaxpr, Literal

from .argument_forms import Form
from .compiling import compiled, transformed
from .jaxprs import of_scan, solution, within
from .linear_solve import eliminated, is_elimination
from .numpy_primitives import function_of
from .precision import own_settings

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
            with own_settings():
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


class _Step(NamedTuple):
    """An equation, ready to be computed."""

    function: Callable  # of a list of operands, to its results
    reads: list[int]  # places of operands among all values
    writes: list[int]
    types: list[np.dtype]  # of results

    def taken(self, values: list) -> None:
        """Write the results among the values."""
        found = self.function([values[k] for k in self.reads])
        for own, result, kind in zip(self.writes, found, self.types, strict=True):
            values[own] = result if getattr(result, "dtype", None) == kind else np.asarray(result, kind)


class _Plan:
    """A traced function whose equations are looked up once, and not in each call: that takes longer than computing them. What
    follows from constants alone is computed once, too, and what is called is part of the plan.
    """

    def __init__(self, jaxpr: Jaxpr):
        self.values: list = []  # constants, at their places
        self.steps: list[_Step] = []
        self.made: dict = {}  # places of what is the same wherever it stands
        self.given = [self._new() for _ in (*jaxpr.constvars, *jaxpr.invars)]
        self.ends = self._ends_of(jaxpr, self.given)
        # Backwards, to leave out what nobody reads.
        read, steps = set(self.ends), []
        for step in reversed(self.steps):
            if not read.isdisjoint(step.writes):
                steps.append(step)
                read.update(step.reads)
        self.steps = steps[::-1]
        self.made.clear()

    def _new(self, value=None) -> int:
        self.values.append(value)
        return len(self.values) - 1

    def _ends_of(self, jaxpr: Jaxpr, given: list[int]) -> list[int]:
        """Places of what a traced function returns, from those of its constants and arguments."""
        places = dict(zip((*jaxpr.constvars, *jaxpr.invars), given, strict=True))

        def place(atom) -> int:
            if not isinstance(atom, Literal):
                return places[atom]
            value = np.asarray(atom.val, atom.aval.dtype)
            return self._once((value.dtype, value.shape, value.tobytes()), self._new, value)

        for equation in jaxpr.eqns:
            reads, called, name = list(map(place, equation.invars)), within(equation.params), equation.primitive.name
            if name == "custom_linear_solve":
                called, reads = solution(equation.params, reads)
            if called is not None and name not in LOOPS and not is_elimination(equation):
                consts = [self._new(np.asarray(const)) for const in called.consts]
                places.update(zip(equation.outvars, self._ends_of(called.jaxpr, [*consts, *reads]), strict=True))
                continue
            same = equation.primitive, tuple(equation.params.items()), tuple(reads)
            writes = self._once(same, self._computed, equation, reads)
            places.update(zip(equation.outvars, writes, strict=True))
        return list(map(place, jaxpr.outvars))

    def _computed(self, equation, reads: list[int]) -> list[int]:
        """Places of an equation's results: they are computed now from what is constant, else by a step."""
        writes = [self._new() for _ in equation.outvars]
        types = [np.dtype(variable.aval.dtype) for variable in equation.outvars]
        step = _Step(_function_of(equation), reads, writes, types)
        if all(self.values[own] is not None for own in reads):
            step.taken(self.values)
        else:
            self.steps.append(step)
        return writes

    def _once(self, same, make: Callable, *of):
        """What is made for this, or was when the same was met before."""
        try:
            return self.made[same] if same in self.made else self.made.setdefault(same, make(*of))
        except TypeError:  # some parameters of primitives cannot be compared
            return make(*of)

    def __call__(self, given) -> list:
        values = self.values.copy()
        for own, value in zip(self.given, given, strict=True):
            values[own] = value
        for step in self.steps:
            step.taken(values)
        return [values[own] for own in self.ends]


_plan_of = functools.cache(_Plan)


def _run(jaxpr: Jaxpr, consts, given) -> list:
    return _plan_of(jaxpr)([*map(np.asarray, consts), *given])


def _function_of(equation) -> Callable:
    if is_elimination(equation):
        return lambda sides: (eliminated(*sides, xp=np),)
    name = equation.primitive.name
    return functools.partial(LOOPS[name], equation.params) if name in LOOPS else function_of(equation)


def _while(params, operands: list) -> list:
    condition, body = params["cond_jaxpr"], params["body_jaxpr"]
    asked = operands[: params["cond_nconsts"]]
    fixed = operands[len(asked) :][: params["body_nconsts"]]
    carry = operands[len(asked) + len(fixed) :]
    # In a batch each has its own condition, and stays as it is once that is not met.
    while np.any(goes := np.asarray(_run(condition.jaxpr, condition.consts, [*asked, *carry])[0])):
        after = _run(body.jaxpr, body.consts, [*fixed, *carry])
        carry = after if np.all(goes) else [_where(goes, *pair) for pair in zip(after, carry, strict=True)]
    return carry


def _where(goes: np.ndarray, after, before) -> np.ndarray:
    after = np.asarray(after)
    return np.where(goes.reshape(goes.shape + (1,) * (after.ndim - goes.ndim)), after, before)


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


LOOPS: dict[str, Callable] = {"while": _while, "scan": _scan, "cond": _cond}
