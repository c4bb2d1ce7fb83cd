"""Double precision inside fivjax, without touching the caller's JAX settings.

JAX computes in single precision unless the user turns `jax_enable_x64` on. Contact dynamics near a stability limit
needs more: the two modes differ by 0.03 Hz in 68 Hz. So each public function of fivjax runs inside JAX's own
`enable_x64` context, which ends with the call: the caller's settings are never touched.

Two consequences are dealt with here:

- what a user builds (scenes) holds float64 *JAX* arrays, which keep their precision under `jax.grad` and `jax.vmap`;
- what a user gets back (trajectories, eigenvalues) holds *NumPy* arrays when its values are known, because JAX would
  round a float64 array to float32 in the first operation outside the context. Under a transformation of the caller's
  the values are not known yet, and stay JAX's.
"""

import contextlib
import functools
from collections.abc import Callable, Generator
from typing import NamedTuple, ParamSpec, TypeVar

import jax
import jax.core
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from .forking import refuse_if_forked

P = ParamSpec("P")
R = TypeVar("R")
# Arrays that a user gets back: NumPy's where values are known, JAX's under a transformation; see above.
Returned = Array | np.ndarray


@contextlib.contextmanager
def own_settings() -> Generator[None]:
    """Double precision, and arrays of any rank and type together, whatever the caller has set. Each thread has settings of its
    own.
    """
    with jax.enable_x64(True), jax.numpy_rank_promotion("allow"), jax.numpy_dtype_promotion("standard"):
        yield


def in_double_precision(function: Callable[P, R]) -> Callable[P, R]:
    """`function`, run with double precision available; results stay as they are."""

    @functools.wraps(function)
    def wrapped(*args: P.args, **kwargs: P.kwargs) -> R:
        refuse_if_forked()
        with own_settings():
            return function(*args, **kwargs)

    return wrapped


def returning_numpy(function: Callable[P, R]) -> Callable[P, R]:
    """`function`, run with double precision available; arrays whose values are known come back as NumPy arrays."""

    @functools.wraps(function)
    def wrapped(*args: P.args, **kwargs: P.kwargs) -> R:
        refuse_if_forked()
        with own_settings():
            return jax.tree.map(known_to_numpy, function(*args, **kwargs))

    return wrapped


def known_to_numpy(leaf):
    """A NumPy array for a JAX array with values; anything else (a tracer, say) unchanged."""
    if isinstance(leaf, jax.Array) and not isinstance(leaf, jax.core.Tracer):
        # 0-d arrays become NumPy scalars, which print as numbers and do arithmetic in float64.
        return np.asarray(leaf)[()]
    return leaf


class _Double(NamedTuple):
    """A JAX array on its way through a pickle, which would bring it back in single precision."""

    numbers: np.ndarray


def state_for_pickle(self) -> dict:
    """The fields of a module, as its `__getstate__`: in a pickle, and in a copy, its JAX arrays keep their precision."""

    def kept(leaf):
        known = isinstance(leaf, jax.Array) and is_known(leaf)
        return _Double(np.asarray(leaf)) if known else leaf

    return {name: jax.tree.map(kept, value) for name, value in vars(self).items()}


def state_from_pickle(self, state: dict) -> None:
    """The fields again, as its `__setstate__`."""

    def is_double(leaf) -> bool:
        return isinstance(leaf, _Double)

    def restored(leaf):
        return jnp.asarray(leaf.numbers) if is_double(leaf) else leaf

    with own_settings():
        for name, value in state.items():
            object.__setattr__(self, name, jax.tree.map(restored, value, is_leaf=is_double))


def is_known(value) -> bool:
    """Whether a value, or all of a nested list, can be looked at now (under `jit`, `grad` and `vmap` it cannot)."""
    if isinstance(value, list | tuple):
        return all(map(is_known, value))
    return not isinstance(value, jax.core.Tracer)


def is_differentiated_in_reverse(value) -> bool:
    """Whether this value is traced by `jax.grad`, `jax.vjp` or `jax.linearize`, as far as a tracer tells."""
    # The tracer's class is not public. In a version of JAX that calls it otherwise, JAX's own error comes instead of ours.
    while isinstance(value, jax.core.Tracer):
        if type(value).__name__ == "LinearizeTracer":
            return True
        value = getattr(value, "primal", getattr(value, "val", None))
    return False


def refusing_reverse_in_single_precision(function: Callable[P, R]) -> Callable[P, R]:
    """`function`, refused under reverse-mode derivatives in a single-precision program, where JAX cannot take them.

    JAX transposes the double-precision code after the call, outside the context that makes double precision available.
    """

    @functools.wraps(function)
    def wrapped(*args: P.args, **kwargs: P.kwargs) -> R:
        if not jax.config.jax_enable_x64 and any(map(is_differentiated_in_reverse, jax.tree.leaves((args, kwargs)))):
            raise TypeError(
                "Reverse derivatives (`jax.grad`, `jax.vjp`) of a simulation need double precision around them. Write "
                "`with jax.enable_x64(True):` around the call of `jax.grad`, or use `jax.jacfwd` or `fivjax.derivatives`."
            )
        return function(*args, **kwargs)

    return wrapped


def real_if_real(leaf):
    """Real numbers and arrays of them as `real` returns them; anything else (integers, strings) unchanged."""
    is_real = isinstance(leaf, float) or (hasattr(leaf, "dtype") and jnp.issubdtype(leaf.dtype, jnp.floating))
    return real(leaf) if is_real else leaf


def real(value) -> Array:
    """`value` as a float64 JAX array, also where a caller in single precision handed over float32."""
    # JAX may share the memory of NumPy's arrays, which their owner may change later.
    return jnp.asarray(value.copy() if isinstance(value, np.ndarray) else value, dtype=jnp.float64)
