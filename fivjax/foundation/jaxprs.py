"""Parts of what JAX traces, whichever version of JAX has traced it."""

import functools
import weakref
from collections.abc import Callable, Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend.core import ClosedJaxpr, Jaxpr, Literal

# What depends on what in traced functions, while these are there: loops inside loops are asked again and again.
_known_dependence: weakref.WeakKeyDictionary[Jaxpr, dict[tuple[bool, ...], list[bool]]] = weakref.WeakKeyDictionary()

# The names of functions `with_code_once`.
CODE_ONCE: set[str] = set()


def with_code_once(function: Callable) -> Callable:
    """`jax.jit` of a function that kernels do not write out at each call (`cpp_calls`), as it is long."""
    CODE_ONCE.add(function.__name__)
    return jax.jit(function)


def within(params) -> ClosedJaxpr | None:
    """The traced function that an equation calls once, if it calls one."""
    # That of a reduction is for two numbers.
    if "dimensions" in params or "window_dimensions" in params:
        return None
    for name in ("jaxpr", "call_jaxpr", "fun_jaxpr", "call"):
        part = params.get(name)
        # Newer versions have one class for both.
        if isinstance(part, ClosedJaxpr):
            return part
        if isinstance(part, Jaxpr):
            return ClosedJaxpr(part, ())
    # A primitive of newer versions that stands for others.
    return None if (standing := params.get("_prim")) is None else _expanded(standing, tuple(standing.in_avals_flat))


@functools.cache
def _expanded(primitive, avals: tuple) -> ClosedJaxpr:
    def expand(*args):
        return jax.tree.leaves(primitive.expand(*jax.tree.unflatten(primitive.in_tree, args)))

    return jax.make_jaxpr(expand)(*avals)


def is_rounded_to_single(jaxpr: Jaxpr) -> bool:
    """Whether a traced function computes anything in less than double precision on the way."""
    for equation in jaxpr.eqns:
        kinds = [jnp.finfo(one.aval.dtype) for one in equation.outvars if jnp.issubdtype(one.aval.dtype, jnp.inexact)]
        parts = jax.tree.leaves(
            list(equation.params.values()), is_leaf=lambda one: isinstance(one, ClosedJaxpr | Jaxpr)
        )
        inner = [getattr(one, "jaxpr", one) for one in parts if isinstance(one, ClosedJaxpr | Jaxpr)]
        if any(kind.eps > 1e-15 for kind in kinds) or any(map(is_rounded_to_single, inner)):
            return True
    return False


def of_scan(params) -> tuple[int, int]:
    """How many operands all turns of a `scan` share, and how many numbers it carries from turn to turn."""
    if "num_consts" in params:
        return params["num_consts"], params["num_carry"]
    shared, carried, _ = params["ft_in"].unpack()
    return len(shared), len(carried)


def solution(params, operands: Sequence) -> tuple[ClosedJaxpr, list]:
    """The traced function by which an equation `custom_linear_solve` is solved, and its operands."""
    lengths, solve = params["const_lengths"], params["jaxprs"].solve
    ends = np.cumsum(lengths).tolist()
    end = ends[list(lengths._fields).index("solve")]
    return solve, [*operands[end - lengths.solve : end], *operands[ends[-1] :]]


def dependent_results(jaxpr: Jaxpr, given: Sequence[bool]) -> list[bool]:
    """Which results of a traced function depend on those of its operands that are `given`, as real numbers do: an integer or a
    choice does not change with a small change of a real number.
    """
    known, flags = _known_dependence.setdefault(jaxpr, {}), tuple(map(bool, given))
    if flags not in known:
        known[flags] = _dependent_results(jaxpr, flags)
    return known[flags]


def carried_dependence(
    body: Jaxpr, fixed: list[bool], begin: list[bool], along: list[bool]
) -> tuple[list[bool], list[bool]]:
    """Which of the numbers that a loop carries depend on what is given, from its first turn or a later one; and which results
    of its body.
    """
    while True:
        after = dependent_results(body, [*fixed, *begin, *along])
        more = [one or other for one, other in zip(begin, after[: len(begin)], strict=True)]
        if more == begin:
            return begin, after
        begin = more


def _dependent_results(jaxpr: Jaxpr, given: Sequence[bool]) -> list[bool]:
    depends = dict(zip(jaxpr.invars, given, strict=True))

    def reads(atom) -> bool:
        return not isinstance(atom, Literal) and depends.get(atom, False)

    for equation in jaxpr.eqns:
        flags, name, params = list(map(reads, equation.invars)), equation.primitive.name, equation.params
        if name == "while":
            asked, fixed = params["cond_nconsts"], params["body_nconsts"]
            begin = flags[asked + fixed :]
            found, _ = carried_dependence(params["body_jaxpr"].jaxpr, flags[asked:][:fixed], begin, [])
        elif name == "scan":
            fixed, carried = of_scan(params)
            body, begin = params["jaxpr"].jaxpr, flags[fixed:][:carried]
            begin, after = carried_dependence(body, flags[:fixed], begin, flags[fixed + carried :])
            found = [*begin, *after[carried:]]
        elif name == "cond":
            ways = (dependent_results(branch.jaxpr, flags[1:]) for branch in params["branches"])
            found = [any(each) for each in zip(*ways, strict=True)]
        elif name != "custom_linear_solve" and isinstance(called := within(params), ClosedJaxpr):
            found = dependent_results(called.jaxpr, flags)
        else:
            found = [any(flags)] * len(equation.outvars)
        for variable, does in zip(equation.outvars, found, strict=True):
            depends[variable] = does and jnp.issubdtype(variable.aval.dtype, jnp.inexact)
    return list(map(reads, jaxpr.outvars))
