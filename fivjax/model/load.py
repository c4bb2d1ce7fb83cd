"""The load that presses the structure onto the belt: piecewise constant in time.

A load gives its value and the instants where it jumps, so that every step ends at a jump and none is differentiated across
one.
"""

import abc
from itertools import pairwise

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..foundation import arguments
from ..foundation.digits import apart
from ..foundation.precision import in_double_precision, is_known, real, state_for_pickle, state_from_pickle
from .printing import as_call


class AbstractLoad(eqx.Module):
    """A load: what the steppers ask of one, and what they rely on.

    - `load(t)` is constant between its jumps: `force` before the first, `final` after the last.
    - `jumps` are in order.

    A scene checks this where values are known, and holds the load's numbers in double precision. Fields are the load's
    parameters; what `replace` and maps change must be a field that the constructor takes by the same name.

    **Example:**

        >>> isinstance(scene.load, fj.AbstractLoad)
        True

    `docs/extending.md` shows how to write a load of your own.
    """

    __getstate__, __setstate__ = state_for_pickle, state_from_pickle

    # Before the first jump, in N: a run starts from sliding equilibrium under this load.
    force: eqx.AbstractVar[Float[Array, ""]]

    @property
    @abc.abstractmethod
    def jumps(self) -> Float[Array, " k"]:
        """Instants where the load jumps, in s, in order."""

    @property
    @abc.abstractmethod
    def final(self) -> Float[Array, ""]:
        """The load after its last jump, in N."""

    @abc.abstractmethod
    def __call__(self, t: Float[Array, ""]) -> Float[Array, ""]:
        """The load at an instant that is not a jump, in N."""

    def check(self) -> None:
        """Refuse a load that breaks its contract, where its values are known."""
        name, jumps, force, final = type(self).__name__, self.jumps, self.force, self.final
        # A load of one's own may have numbers that these do not tell of.
        if not all(map(is_known, (jumps, force, final, *jax.tree.leaves(self)))):
            return
        jumps = np.asarray(jumps)
        if jumps.ndim != 1 or not np.all(np.isfinite(jumps)) or np.any(np.diff(jumps) < 0):
            raise ValueError(
                f"The jumps of the load `{name}` must be finite instants in order, but are {jumps.tolist()}."
            )
        ends = [min([0.0, *jumps]) - 1.0, *jumps, max([0.0, *jumps]) + 1.0]
        between = [
            [float(self(jnp.asarray(a + share * (b - a)))) for share in (0.01, 0.5, 0.99)] for a, b in pairwise(ends)
        ]
        for values, (begin, end) in zip(between, pairwise(ends), strict=True):
            if begin < end and not np.ptp(values) <= 1e-12 * np.max(np.abs(values)):
                least, most = apart(min(values), max(values))
                earlier, later = apart(begin, end)
                raise ValueError(
                    f"The load `{name}` must be constant between its jumps, but is between {least} N and {most} N from "
                    f"{earlier} s to {later} s."
                )
        for what, promised, found in (("force", force, between[0][1]), ("final", final, between[-1][1])):
            if not np.isclose(found, float(promised), rtol=1e-12, atol=0):
                when = "before its first jump" if what == "force" else "after its last jump"
                is_, wanted = apart(found, promised)
                raise ValueError(f"The load `{name}` must be `{what}` {when}, but is {is_} N instead of {wanted} N.")

    def __repr__(self) -> str:
        return as_call(type(self).__name__, vars(self))


class ConstantLoad(AbstractLoad):
    """A load `force` (N) that never changes.

    From steady sliding nothing then happens: it is an exact fixed point. Where it is unstable, a map moves off it by one unit
    of rounding, and its verdict is that of a small perturbation; `decided_at` then means little.

    **Raises:** `ValueError` if it is negative or not finite.

    **Example:**

        >>> quiet = fj.Scene(structure, fj.Coulomb(0.2), belt_speed=3.0, load=fj.ConstantLoad(100.0))
    """

    force: Float[Array, ""]

    @in_double_precision
    def __init__(self, force=100.0):
        arguments.real_number("force", force, minimum=0)
        self.force = real(force)

    @property
    def jumps(self) -> Float[Array, " k"]:
        # In the precision of the force, whatever that of the caller is, and nothing that depends on it.
        return jnp.zeros_like(self.force, shape=(0,))

    @property
    def final(self) -> Float[Array, ""]:
        return self.force

    def check(self) -> None:
        """Nothing is left to check: it keeps its promises by the way it is made."""

    def __call__(self, t: Float[Array, ""]) -> Float[Array, ""]:
        return self.force


class Pulse(AbstractLoad):
    r"""A kick: the load is raised from `force` to `p * force` for `duration` (Eq. 14, Fig. 8).

    The paper waits 40 s before the kick. Sliding equilibrium is an exact fixed point, so the wait changes nothing and
    the default `start` is 0. With `p` = 1, or `duration` = 0, there is no kick: see `ConstantLoad`. A derivative by `start` = 0
    is that towards later kicks; by `duration` = 0 none is worked out.

    **Arguments:** `force` in N, the factor `p` without unit, `duration` and `start` in s.

    **Raises:** `ValueError` if any of them is negative or not finite.

    **Example:**

        >>> kick = fj.Pulse(force=100.0, p=1.2)
        >>> [float(instant) for instant in kick.jumps]  # s
        [0.0, 0.1]
    """

    force: Float[Array, ""]
    p: Float[Array, ""]
    duration: Float[Array, ""]
    start: Float[Array, ""]

    @in_double_precision
    def __init__(self, force=100.0, p=1.2, duration=0.1, start=0.0):
        for name, value in {"force": force, "p": p, "duration": duration, "start": start}.items():
            arguments.real_number(name, value, minimum=0)
        self.force, self.p, self.duration, self.start = map(real, (force, p, duration, start))

    @property
    def jumps(self) -> Float[Array, " k"]:
        return jnp.stack([self.start, self.start + self.duration])

    @property
    def final(self) -> Float[Array, ""]:
        return self.force

    def check(self) -> None:
        """Nothing is left to check: it keeps its promises by the way it is made."""

    def __call__(self, t: Float[Array, ""]) -> Float[Array, ""]:
        kicked = (t >= self.start) & (t < self.start + self.duration)
        return jnp.where(kicked, self.p * self.force, self.force)


def next_jump(load: AbstractLoad, t: Float[Array, ""]) -> Float[Array, ""]:
    """The first jump of the load after an instant (s); infinite where there is none."""
    return jnp.min(jnp.where(load.jumps > t, load.jumps, jnp.inf), initial=jnp.inf)


def load_from(load: AbstractLoad, t: Float[Array, ""]) -> Float[Array, ""]:
    """The load (N) from an instant (s) up to its next jump."""
    until = next_jump(load, t)
    return load(jnp.where(jnp.isfinite(until), 0.5 * (t + until), t + 1.0))
