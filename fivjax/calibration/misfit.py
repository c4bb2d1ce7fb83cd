r"""How far a scene is from a recording: residuals in units of the measuring noise, for each regime.

| regime | far from the answer (`coarse`) | near it (`compared`) |
|---|---|---|
| sliding (`waveform_misfit`) | poles and shapes in the characteristic equation | waveform, initial state projected out |
| kick (`waveform_misfit`) | the same, if the recording ends in a small motion | waveform, through every event |
| limit cycle (`cycle_misfit`) | harmonics, roughly | harmonics, fractions of time |

The coarse residuals have no neighbouring period to fall into. The waveform is compared over windows that grow.
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

# What stands for a motion that is not finite: bad enough never to be chosen, small enough to square.
HOPELESS = 1e12
# A kick's time offset is moved in units of this, in s.
OFFSET_UNIT = 1e-3


class Compared(NamedTuple):
    """A scene beside a recording."""

    residual: Float[Array, " r"]  # in standard deviations of the noise
    model: Float[Array, "B k"]  # block means that the scene gives; NaN where it gives none
    # For a cycle that is a guess: by how much it does not close, and its status after one period.
    unclosed: Float[Array, " c"]
    contact: Contact | None


class AbstractMisfit(eqx.Module):
    """One recording beside the scene it is to be explained by. Times are s after the recording's first sample."""

    # Standard deviations of the block means, by channel.
    sigma: eqx.AbstractVar[Float[Array, " k"]]
    known: eqx.AbstractVar[dict[str, Array]]
    # Linear unknowns that the residual solves for itself, beside the parameters (variable projection).
    projected: eqx.AbstractVar[int]

    def coarse(self, scene: Scene) -> Float[Array, " c"]:
        """Residuals that lead to the right period from afar; may be empty."""
        return jnp.zeros(0)

    @abc.abstractmethod
    def compared(self, scene: Scene, own, share: Float[Array, ""]) -> Compared:
        """The scene beside the first `share` of the recording. What is the recording's `own`: the time offset of a kick
        (s), a guess of the cycle."""


def sliding_frequencies(scene: Scene, recording: Recording) -> Float[np.ndarray, " m"]:
    """Of the sliding modes that vibrate, in Hz, under what is known of a run."""
    modes = np.linalg.eigvals(np.asarray(linear_sliding(scene.replace(**recording.known)).matrix))
    modes = np.abs(modes.imag) / (2 * np.pi)
    return modes[modes > 0]


def window(edges, share) -> Float[Array, " B"]:
    """1 for the blocks that end within the first `share` of the recording, 0 for the others."""
    # In whole blocks; the last of them carries the tolerance of a rounding.
    return jnp.where(edges[1:] <= share * edges[-1] * (1 + 1e-9), 1.0, 0.0)


def finite(residual):
    """The residuals, with `HOPELESS` ones where there are none."""
    good: Bool[Array, " r"] = jnp.isfinite(residual)
    return jnp.where(good, jnp.clip(jnp.where(good, residual, 0.0), -HOPELESS, HOPELESS), HOPELESS)
