"""How functions are compiled: so that the first call does not take longer than the work.

Most of what fivjax compiles runs for less time than XLA takes to compile it with all its might. Told to think less, XLA
compiles in half the time what then runs as fast; only a large map repays the rest.
"""

import functools
import os
from collections.abc import Callable
from typing import ParamSpec, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp

from .precision import is_known

P = ParamSpec("P")
R = TypeVar("R")

# The level leaves out what LLVM does beyond the obvious. The emitters are XLA's newer way to make kernels of fused
# operations; the older one is quicker by far where there are many of them.
LESS_THOUGHT = {"xla_backend_optimization_level": 1, "xla_cpu_use_fusion_emitters": False}


def compiled(function: Callable[P, R]) -> Callable[P, R]:
    """`equinox.filter_jit`, compiled with `LESS_THOUGHT` on a CPU.

    Under a caller's transformation it is part of what the caller compiles.
    """
    within = eqx.filter_jit(function)

    @functools.cache
    def alone():
        # What it hands on to JAX is not in the types of its overloads.
        return eqx.filter_jit(function, compiler_options=less_thought())  # pyright: ignore[reportCallIssue]

    @functools.wraps(function)
    def call(*args: P.args, **kwargs: P.kwargs) -> R:
        return (within if transformed((args, kwargs)) else alone())(*args, **kwargs)

    return call


def computed_once(function, like):
    """`function()`, computed once and kept.

    XLA on a CPU repeats arithmetic in every kernel that wants its result, so long chains with many results cost their
    square. A loop that runs once is a border over which it repeats nothing; the sevenfold speed of maps is owed to it.
    `like` has the structure and types of the result. Elsewhere the loop would be a border over which nothing is fused: there
    it is left out.
    """
    if jax.default_backend() != "cpu":
        return jax.tree.map(lambda new, old: new.astype(old.dtype), function(), like)
    once = jnp.ones_like(jax.tree.leaves(like)[0], bool).ravel()[0]

    def body(carry):
        return jnp.zeros_like(once), jax.tree.map(lambda new, old: new.astype(old.dtype), function(), carry[1])

    return jax.lax.while_loop(lambda carry: carry[0], body, (once, like))[1]


def power_of_4(count: int) -> int:
    """The next one at or above a count: arrays filled up to it have few sizes, so not each of them is compiled."""
    return 4 ** -(-(count - 1).bit_length() // 2)


def transformed(arguments) -> bool:
    # Inside `jit`, what is computed of known numbers is not known either.
    return not (is_known(jnp.add(1, 1)) and all(map(is_known, jax.tree.leaves(arguments))))


@functools.cache
def less_thought() -> dict[str, int | bool]:
    """What of `LESS_THOUGHT` this machine's compiler knows, and the user has not set."""
    if jax.default_backend() != "cpu":
        return {}
    return {name: value for name, value in LESS_THOUGHT.items() if _is_free(name, value)}


def _is_free(name: str, value: int | bool) -> bool:
    if name in os.environ.get("XLA_FLAGS", ""):
        return False
    try:
        jax.jit(lambda x: x, compiler_options={name: value}).lower(0.0).compile()
    except Exception:  # which one is not said anywhere
        return False
    return True
