"""Plans of traced functions: the steps by which NumPy computes them, each with the places of what it reads and writes.

A plan is made once, because it takes longer to look an equation up than to compute it. It is plain (numbers, text, lists), so
that it can be kept for later processes. Only an equation that NumPy has no function for is left to JAX, as it is.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from jax.extend.core import ClosedJaxpr, Jaxpr, Literal

from .jaxprs import of_scan, solution, within
from .linear_solve import eliminated, is_elimination
from .numpy_primitives import function_named, function_of, has_case, plain_parameters

ELIMINATION = "elimination"


class NoSuchCase(Exception):
    """NumPy has no function for some values: an index is outside of its array."""


class _Equation(NamedTuple):
    """An equation, ready to be computed."""

    function: Callable  # of a list of operands, to its results
    reads: list[int]  # places of operands among all values
    writes: list[int]
    types: list[np.dtype]  # of results

    @classmethod
    def of(cls, equation, params: dict, reads: list[int], writes: list[int], types: list[str]) -> "_Equation":
        """An equation, ready, from itself or from the name of its primitive and its parameters."""
        return cls(_function(equation, params), reads, writes, [np.dtype(kind) for kind in types])

    def taken(self, values: list) -> None:
        """Write the results among the values."""
        found = self.function([values[k] for k in self.reads])
        if found is None:
            raise NoSuchCase
        for own, result, kind in zip(self.writes, found, self.types, strict=True):
            values[own] = result if getattr(result, "dtype", None) == kind else np.asarray(result, kind)


class NumpyPlan:
    """A function of a list of arrays, by a plan as `numpy_plan_of` gives it."""

    def __init__(self, plan: dict[str, Any]):
        self.given, self.ends = plan["given"], plan["ends"]
        self.values: list = [None] * plan["size"]
        for place, kind, shape, content in plan["constants"]:
            self.values[place] = np.frombuffer(bytes.fromhex(content), kind).reshape(shape)
        self.steps = [_Equation.of(*step) for step in plan["steps"]]
        # After each step, the places that nobody reads any more: memory that is used again is faster than new memory.
        read, self.over = set(self.ends), []
        for step in reversed(self.steps):
            over = {*step.reads, *step.writes} - read
            read |= over
            self.over.append([own for own in over if self.values[own] is None])
        self.over.reverse()

    def __call__(self, given) -> list:
        values = self.values.copy()
        for own, value in zip(self.given, given, strict=True):
            values[own] = value
        for step, over in zip(self.steps, self.over, strict=True):
            step.taken(values)
            for own in over:
                values[own] = None
        return [values[own] for own in self.ends]


def numpy_plan_of(traced: ClosedJaxpr) -> dict[str, Any]:
    """The plan of a traced function. What follows from constants alone is computed now, what is the same wherever it stands is
    computed once, and what is called is part of the plan.
    """
    # As in JAX, what is no number comes without a warning.
    with np.errstate(all="ignore"):
        return _Planner(traced.jaxpr, traced.consts).plan()


class _Planner:
    def __init__(self, jaxpr: Jaxpr, consts):
        self.values: list = []  # constants, at their places
        self.steps: list[tuple] = []
        self.made: dict = {}  # places of what is the same wherever it stands
        own = [self._new(np.asarray(const)) for const in consts]
        self.given = [self._new() for _ in jaxpr.invars]
        self.ends = self._ends_of(jaxpr, [*own, *self.given])

    def plan(self) -> dict[str, Any]:
        # Backwards, to leave out what nobody reads.
        read, steps = set(self.ends), []
        for step in reversed(self.steps):
            _, _, reads, writes, _ = step
            if not read.isdisjoint(writes):
                steps.append(step)
                read.update(reads)
        constants = [
            (k, value.dtype.name, value.shape, np.ascontiguousarray(value).tobytes().hex())
            for k, value in enumerate(self.values)
            if value is not None and k in read
        ]
        whole = {"size": len(self.values), "given": self.given, "ends": self.ends}
        return {**whole, "constants": constants, "steps": steps[::-1]}

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
        types = [np.dtype(variable.aval.dtype).name for variable in equation.outvars]
        step = *_named(equation), reads, writes, types
        if all(self.values[own] is not None for own in reads):
            _Equation.of(*step).taken(self.values)
        else:
            self.steps.append(step)
        return writes

    def _once(self, same, make: Callable, *of):
        """What is made for this, or was when the same was met before."""
        try:
            return self.made[same] if same in self.made else self.made.setdefault(same, make(*of))
        except TypeError:  # some parameters of primitives cannot be compared
            return make(*of)


def _named(equation) -> tuple[Any, dict]:
    """The name by which a plan has an equation, and its parameters; the equation itself where it is left to JAX."""
    name, params = equation.primitive.name, equation.params
    if is_elimination(equation):
        return ELIMINATION, {}
    if name in LOOPS:
        return name, PARTS[name](params)
    params = plain_parameters(params)
    return (name, params) if has_case(name, params, [own.aval for own in equation.invars]) else (equation, {})


def _function(equation, params: dict) -> Callable:
    if not isinstance(equation, str):
        return function_of(equation)
    if equation == ELIMINATION:
        return lambda sides: (eliminated(*sides, xp=np),)
    if equation in LOOPS:
        return LOOPS[equation](params)
    if (found := function_named(equation, params)) is None:
        raise NoSuchCase
    return found


# ---------------------------------------------------------------------------------------------------------------- loops


def _parts_of_while(params) -> dict[str, Any]:
    return {
        "asked": params["cond_nconsts"],
        "fixed": params["body_nconsts"],
        "condition": numpy_plan_of(params["cond_jaxpr"]),
        "body": numpy_plan_of(params["body_jaxpr"]),
    }


def _while(parts: dict[str, Any]) -> Callable:
    condition, body = NumpyPlan(parts["condition"]), NumpyPlan(parts["body"])

    def run(operands: list) -> list:
        asked = operands[: parts["asked"]]
        fixed = operands[len(asked) :][: parts["fixed"]]
        carry = operands[len(asked) + len(fixed) :]
        # In a batch each has its own condition, and stays as it is once that is not met.
        while np.any(goes := np.asarray(condition([*asked, *carry])[0])):
            after = body([*fixed, *carry])
            carry = after if np.all(goes) else [_where(goes, *pair) for pair in zip(after, carry, strict=True)]
        return carry

    return run


def _where(goes: np.ndarray, after, before) -> np.ndarray:
    after = np.asarray(after)
    return np.where(goes.reshape(goes.shape + (1,) * (after.ndim - goes.ndim)), after, before)


def _parts_of_scan(params) -> dict[str, Any]:
    shared, carried = of_scan(params)
    shapes = [variable.aval.shape for variable in params["jaxpr"].jaxpr.outvars[carried:]]
    told = {"shared": shared, "carried": carried, "shapes": shapes}
    return {**told, "length": params["length"], "reverse": params["reverse"], "body": numpy_plan_of(params["jaxpr"])}


def _scan(parts: dict[str, Any]) -> Callable:
    body, shared, carried = NumpyPlan(parts["body"]), parts["shared"], parts["carried"]
    turns = range(parts["length"])[:: -1 if parts["reverse"] else 1]

    def run(operands: list) -> list:
        fixed, carry, along = operands[:shared], operands[shared:][:carried], operands[shared + carried :]
        rows = []
        for k in turns:
            found = body([*fixed, *carry, *(array[k] for array in along)])
            rows.append(found[carried:])
            carry = found[:carried]
        if not rows:
            return [*carry, *(np.zeros((0, *shape)) for shape in parts["shapes"])]
        rows = rows[:: -1 if parts["reverse"] else 1]
        return [*carry, *map(np.stack, zip(*rows, strict=True))]

    return run


def _parts_of_cond(params) -> dict[str, Any]:
    return {"branches": [numpy_plan_of(branch) for branch in params["branches"]]}


def _cond(parts: dict[str, Any]) -> Callable:
    branches = [NumpyPlan(branch) for branch in parts["branches"]]
    return lambda operands: branches[int(np.clip(int(operands[0]), 0, len(branches) - 1))](operands[1:])


PARTS: dict[str, Callable] = {"while": _parts_of_while, "scan": _parts_of_scan, "cond": _parts_of_cond}
LOOPS: dict[str, Callable] = {"while": _while, "scan": _scan, "cond": _cond}
