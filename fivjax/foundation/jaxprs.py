"""Parts of what JAX traces, whichever version of JAX has traced it."""

import functools
from collections.abc import Sequence

import jax
import numpy as np
from jax.extend.core import ClosedJaxpr, Jaxpr


def within(params) -> ClosedJaxpr | None:
    """The traced function that an equation calls once, if it calls one."""
    for name in ("jaxpr", "call_jaxpr", "fun_jaxpr"):
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
