r"""The difference between a scene and a recording: residuals in units of the noise, for each regime.

| regime | far from the answer (`coarse`) | near it (`compared`) |
|---|---|---|
| sliding (`waveform_misfit`) | poles and shapes in the characteristic equation | waveform, initial state projected out |
| kick (`waveform_misfit`) | the same, if the recording ends in a small motion | waveform, through every event |
| limit cycle (`cycle_misfit`) | harmonics, roughly | harmonics, fractions of time |

The coarse residuals have no false minima a period away. The waveform is compared over windows of growing length.
"""

import abc
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from ..contact import Contact
from ..io.recordings import Recording
from ..linear.linearisation import linear_sliding
from ..model.scene import Scene

# The residual of a motion that is not finite: large enough never to be chosen, small enough to be squared.
HOPELESS = 1e12
# The unit of a kick's time offset, in s.
OFFSET_UNIT = 1e-3


class Compared(NamedTuple):
    """A scene compared with a recording."""

    residual: Float[Array, " r"]  # in standard deviations of the noise
    model: Float[Array, "B k"]  # block means of the scene; NaN where there are none
    # For a guess of a cycle: the difference after one period, and the contact mode then.
    unclosed: Float[Array, " c"]
    contact: Contact | None


class AbstractMisfit(eqx.Module):
    """One recording, to be compared with scenes. Times are in s after the recording's first sample."""

    # Standard deviations of the block means, by channel.
    sigma: eqx.AbstractVar[Float[Array, " k"]]
    known: eqx.AbstractVar[dict[str, Array]]
    # Number of linear unknowns, besides the parameters, that are eliminated in the residual (variable projection).
    projected: eqx.AbstractVar[int]

    def coarse(self, scene: Scene) -> Float[Array, " c"]:
        """Residuals for parameters that are far from the answer; may be empty."""
        return jnp.zeros(0)

    @abc.abstractmethod
    def compared(self, scene: Scene, own, share: Float[Array, ""]) -> Compared:
        """The scene compared with the first `share` of the recording. `own`: the time offset of a kick (s), or a guess of the
        cycle."""


def sliding_frequencies(scene: Scene, recording: Recording) -> Float[np.ndarray, " m"]:
    """Frequencies of the sliding modes, in Hz, with the parameters known for a run."""
    modes = np.linalg.eigvals(np.asarray(linear_sliding(scene.replace(**recording.known)).matrix))
    modes = np.abs(modes.imag) / (2 * np.pi)
    return modes[modes > 0]


def window(edges, share) -> Float[Array, " B"]:
    """1 for the blocks that end within the first `share` of the recording, 0 for the others."""
    # In whole blocks, with a tolerance for rounding.
    return jnp.where(edges[1:] <= share * edges[-1] * (1 + 1e-9), 1.0, 0.0)


def finite(residual):
    """The residuals, with `HOPELESS` in place of those that are not finite."""
    good: Bool[Array, " r"] = jnp.isfinite(residual)
    return jnp.where(good, jnp.clip(jnp.where(good, residual, 0.0), -HOPELESS, HOPELESS), HOPELESS)
