"""The load that presses the structure onto the belt: piecewise constant in time.

A load says its value and the instants where it jumps, so that no step straddles a jump and no derivative is taken
through one.
"""

import abc

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..foundation import arguments
from ..foundation.precision import in_double_precision, real
from .printing import as_call


class AbstractLoad(eqx.Module):
    """What the steppers ask of a load."""

    # Before any jump: the load whose sliding equilibrium a run starts from.
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

    def __repr__(self) -> str:
        return as_call(type(self).__name__, vars(self))


class ConstantLoad(AbstractLoad):
    """A load `force` (N) that never changes.

    **Raises:** `ValueError` if it is negative or not finite.
    """

    force: Float[Array, ""]

    @in_double_precision
    def __init__(self, force=100.0):
        arguments.real_number("force", force, minimum=0)
        self.force = real(force)

    @property
    def jumps(self) -> Float[Array, " k"]:
        return jnp.zeros((0,), self.force.dtype)

    @property
    def final(self) -> Float[Array, ""]:
        return self.force

    def __call__(self, t: Float[Array, ""]) -> Float[Array, ""]:
        return self.force


class Pulse(AbstractLoad):
    r"""A kick: the load is raised from `force` to `p * force` for `duration` (Eq. 14, Fig. 8).

    The paper waits 40 s before the kick. Sliding equilibrium is an exact fixed point, so the wait changes nothing and
    the default `start` is 0.

    **Arguments:** `force` in N, the factor `p` without unit, `duration` and `start` in s.

    **Raises:** `ValueError` if any of them is negative or not finite.
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

    def __call__(self, t: Float[Array, ""]) -> Float[Array, ""]:
        kicked = (t >= self.start) & (t < self.start + self.duration)
        return jnp.where(kicked, self.p * self.force, self.force)
