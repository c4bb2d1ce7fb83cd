"""How the samples of a recording follow from a motion: points or averages, through a low-pass if there is one.

A waveform is predicted block by block. A block holds samples; points are taken at their instants, averages between them, so
both are exact however few there are. Through a low-pass the motion is first averaged over steps much finer than the filter's
bandwidth, which keeps impulses and jumps whole, then filtered in the spectrum, and sampled.
"""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import scipy.fft
from jaxtyping import Array, Complex, Float, Int

from ..io.low_pass import bandwidth, memory
from ..io.recordings import Averaged, Channel, Recording


class Sampled(eqx.Module):
    """What is predicted of a motion for the blocks of one recording. Through a low-pass, blocks are the steps of a fine grid
    from before the recording to after it, so that the filter may ring.
    """

    lead: Float[Array, ""]  # when the first predicted block begins, s after the recording's first
    width: Float[Array, ""]  # of a predicted block, s
    response: Complex[Array, " f"] | None  # of the low-pass, for means over fine steps
    picked: Int[Array, "B p"] | None  # the fine steps in whose middles the samples are
    count: int = eqx.field(static=True)  # of predicted blocks
    per_block: int = eqx.field(static=True)  # points in each
    averages: bool = eqx.field(static=True)

    @property
    def filtered(self) -> bool:
        """Whether there is a filter, through which nothing jumps."""
        return self.response is not None

    def edges(self, begin: Float[Array, ""]) -> Float[Array, " edge"]:
        """The ends of the predicted blocks, for a recording whose first block begins at `begin` (s)."""
        return begin + self.lead + self.width * jnp.arange(self.count + 1)

    def of_blocks(self, predicted: Float[Array, "b *k"]) -> Float[Array, "B *k"]:
        """Means over the recording's blocks of samples, from those over the predicted blocks."""
        if self.response is None or self.picked is None:
            return predicted
        spectrum = jnp.fft.rfft(predicted, axis=0)
        response = self.response.reshape(-1, *[1] * (predicted.ndim - 1))
        return jnp.mean(jnp.fft.irfft(spectrum * response, self.count, axis=0)[self.picked], axis=1)

    def jumping(self, channels: tuple[Channel, ...], slopes: bool = False) -> tuple[np.ndarray, np.ndarray]:
        """Two masks over channels: whose samples (with `slopes`: whose rates of change) jump where an event passes that makes
        accelerations jump, and where one passes that makes velocities jump.
        """
        derivatives = np.array([channel.derivative for channel in channels]) - self.averages + slopes
        return (derivatives >= 2) & (not self.filtered), (derivatives >= 1) & (not self.filtered)


def sampled(recording: Recording, blocks: Averaged) -> Sampled:
    """How a recording's blocks are predicted."""
    count, width = len(blocks.means), float(blocks.edges[1] - blocks.edges[0])
    averages = recording.sampling == "averages"
    if recording.filter is None:
        return Sampled(jnp.zeros(()), jnp.asarray(width), None, None, count, blocks.per_block, averages)
    return _through(recording, blocks)


def _through(recording: Recording, blocks: Averaged) -> Sampled:
    # Fine steps per period of the highest frequency that a filter lets through.
    fine = 16
    # The most fine steps for one sample.
    finest = 64
    response, interval = recording.filter, 1 / recording.rate
    assert response is not None
    passed = bandwidth(response, finest * recording.rate / fine)
    # An odd number, so that the samples' instants are middles of fine steps.
    finer = 2 * int(np.clip(np.ceil(fine * passed * interval), 1, finest) // 2) + 1
    step = interval / finer
    ringing = int(np.ceil(memory(response, step) / step))
    samples = len(blocks.means) * blocks.per_block
    count = int(scipy.fft.next_fast_len(2 * ringing + samples * finer, real=True))
    frequencies = np.fft.rfftfreq(count, step)
    # A mean over a fine step is itself a low-pass, which is undone.
    factor = response(frequencies) / np.sinc(frequencies * step)
    if recording.sampling == "averages":
        factor = factor * np.sinc(frequencies * interval)
    middles = (ringing + finer // 2 + finer * np.arange(samples)).reshape(len(blocks.means), blocks.per_block)
    lead, width, response, picked = map(jnp.asarray, (-ringing * step, step, factor, middles))
    return Sampled(lead, width, response, picked, count, 1, True)
