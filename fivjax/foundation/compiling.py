"""How functions are compiled: with fewer optimisations where a program runs for less time than it takes to compile.

That holds for most of what fivjax compiles. With fewer optimisations XLA compiles these programs in half the time, and they
run as fast; only the programs of large maps repay full optimisation.
"""

import functools
import os
from collections.abc import Callable
from typing import ParamSpec, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp

from .forking import refuse_if_forked
from .precision import is_known

P = ParamSpec("P")
R = TypeVar("R")

# Level 1 leaves out LLVM's costly optimisations. The fusion emitters are XLA's newer way to make kernels of fused operations;
# the older way compiles much faster where there are many of them. Level 0 would save another fifth, but with the older way it
# is wrong: in JAX 0.10 the derivative of minus a Hurwitz determinant was zero (`tests/linear/test_cea.py`).
COMPILED_QUICKLY = {"xla_backend_optimization_level": 1, "xla_cpu_use_fusion_emitters": False}


_ONE = jax.jit(lambda: jnp.ones((), bool))


def compiled(function: Callable[P, R]) -> Callable[P, R]:
    """`equinox.filter_jit`, with the compiler options `COMPILED_QUICKLY` on a CPU.

    Under a caller's transformation the function becomes part of the caller's program, which has the caller's options.
    """
    within = eqx.filter_jit(function)

    @functools.cache
    def alone():
        # `filter_jit` hands further arguments on to JAX, but its overloads do not say so.
        return eqx.filter_jit(function, compiler_options=quick_compiler_options())  # pyrefly: ignore[unexpected-keyword]

    @functools.wraps(function)
    def call(*args: P.args, **kwargs: P.kwargs) -> R:
        refuse_if_forked()
        return (within if transformed((args, kwargs)) else alone())(*args, **kwargs)

    return call


def power_of_4(count: int) -> int:
    """The smallest power of 4 at or above a count. Arrays padded to it have few different sizes, so few are compiled."""
    return 4 ** -(-(count - 1).bit_length() // 2)


def transformed(arguments) -> bool:
    """Whether a call is made under `jit`, `grad` or `vmap`."""
    # Inside `jit` even the result of known numbers is a tracer.
    return not (is_known(_ONE()) and all(map(is_known, jax.tree.leaves(arguments))))


@functools.cache
def quick_compiler_options() -> dict[str, int | bool]:
    """The options of `COMPILED_QUICKLY` that this machine's compiler knows and the user has not set."""
    if jax.default_backend() != "cpu":
        return {}
    return {name: value for name, value in COMPILED_QUICKLY.items() if _is_free(name, value)}


def _is_free(name: str, value: int | bool) -> bool:
    if name in os.environ.get("XLA_FLAGS", ""):
        return False
    try:
        jax.jit(lambda x: x, compiler_options={name: value}).lower(0.0).compile()
    except Exception:  # JAX does not document which one
        return False
    return True
