r"""The difference between a scene and a recording: residuals in units of the noise, for each regime.

| regime | far from the answer (`coarse`) | near it (`compared`) |
|---|---|---|
| sliding (`waveform_misfit`) | poles and shapes in the characteristic equation | waveform, initial state projected out |
| kick (`waveform_misfit`) | the same, if the recording ends in a small motion | waveform, through every event |
| limit cycle (`cycle_misfit`) | harmonics, roughly | frequency, one period's waveform, fractions of time |

The coarse residuals have no false minima a period away. The waveform is compared over windows of growing length.

Where a contact changes its mode accelerations jump, and where it lands velocities do. A sample next to such an instant says on
which side of it the instant lies and has no derivative, so it is left out (`kept`). Which those are is told by the scene at the
start of a fit (`touched`), and held while it runs (`search`).
"""

import abc
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from ..contact import Contact
from ..linear.linearisation import sliding_rates
from ..model.scene import Scene

# The residual of a motion that is not finite: large enough never to be chosen, small enough to be squared.
HOPELESS = 1e12


class Compared(NamedTuple):
    """A scene compared with a recording."""

    residual: Float[Array, " r"]  # in standard deviations of the noise
    model: Float[Array, "B k"]  # of the scene, for the same blocks as `means`; NaN where there are none
    touched: Bool[
        Array, "B k"
    ]  # blocks that would jump if an instant at which the contact changes were a little different
    # For a guess of a cycle: the difference after one period, and the contact mode then.
    unclosed: Float[Array, " c"]
    contact: Contact | None


class AbstractMisfit(eqx.Module):
    """One recording, to be compared with scenes. Times are in s after the recording's first sample."""

    # What is compared: means over blocks, their standard deviations, and the times of their middles.
    means: eqx.AbstractVar[Float[Array, "B k"]]
    sigma: eqx.AbstractVar[Float[Array, "B k"]]
    t: eqx.AbstractVar[Float[Array, " B"]]
    kept: eqx.AbstractVar[Float[Array, "B k"]]  # 1, or 0 for blocks that are left out
    known: eqx.AbstractVar[dict[str, Array]]
    # Number of unknowns of this recording alone, beside the parameters: a time offset, or a state.
    unknowns: eqx.AbstractVar[int]
    # Number of linear unknowns that are eliminated in the residual (variable projection).
    projected: eqx.AbstractVar[int]

    @property
    def numbers(self) -> Float[Array, ""]:
        """The number of measured numbers that are compared."""
        return jnp.sum(self.kept)

    def own(self, x: Float[Array, " u"]):
        """What the recording's own unknowns say: the time offset (s), or a state."""
        return x

    def coarse(self, scene: Scene) -> Float[Array, " c"]:
        """Residuals for parameters that are far from the answer; may be empty."""
        return jnp.zeros(0)

    def first(self, scene: Scene) -> Float[np.ndarray, " u"]:
        """Where the search for the own unknowns begins."""
        return np.zeros(self.unknowns)

    @abc.abstractmethod
    def compared(self, scene: Scene, own, share: Float[Array, ""]) -> Compared:
        """The scene compared with the first `share` of the recording. `own`: what the method of that name gives; for a limit
        cycle a pair of a guess of the cycle and that."""


def sliding_frequencies(scene: Scene) -> Float[np.ndarray, " m"]:
    """Frequencies of the sliding modes, in Hz."""
    modes = np.abs(sliding_rates(scene).imag) / (2 * np.pi)
    return modes[modes > 0]


def window(edges, share) -> Float[Array, " B"]:
    """1 for the blocks that end within the first `share` of the recording, 0 for the others."""
    # In whole blocks, with a tolerance for rounding.
    return jnp.where(edges[1:] <= share * edges[-1] * (1 + 1e-9), 1.0, 0.0)


def finite(residual):
    """The residuals, with `HOPELESS` in place of those that are not finite."""
    good: Bool[Array, " r"] = jnp.isfinite(residual)
    return jnp.where(good, jnp.clip(jnp.where(good, residual, 0.0), -HOPELESS, HOPELESS), HOPELESS)
