"""A measured limit cycle beside that of a scene: frequency, harmonics, and fractions of time in the statuses.

Those of the recording are fitted to all of its samples, with errors from its noise (`harmonics`); those of the scene are exact,
from one closed period (`shooting`).
"""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..io.recordings import Averaged, Channel, Recording, averaged
from ..model.scene import Scene
from ..steppers.base import AbstractStepper
from .harmonics import beating, fitted_harmonics, taper, without_lines
from .misfit import AbstractMisfit, Compared, sliding_frequencies
from .noise import noise_of_means
from .shooting import Cycle, around, settled, unclosed

MOST_HARMONICS = 8
# The smallest and the largest number of blocks per period: many, because contact after a landing may be short.
CYCLE_BLOCKS = (28, 48)
# The number of periods that is enough to resolve the lines of the spectrum.
CYCLE_PERIODS = 30
# Units of residuals for rough guesses: of the frequency, relative; of lines, as shares of the largest; of fractions of time.
ROUGH_FREQUENCY, ROUGH_LINES, ROUGH_FRACTIONS = 1e-3, 0.05, 0.05
# Errors by aliasing of high lines: in the fitted lines, relative to the largest; and in the frequency, relative.
FOLDED, FOLDED_FREQUENCY = 1e-4, 1e-7
# A vibration beats if the sidebands of its fundamental are larger than this, relative to it.
BEATS = 0.01


class CycleMisfit(AbstractMisfit):
    """A limit cycle, compared by its harmonics and, if they were measured, its fractions of time in the statuses."""

    means: Float[Array, "B k"]
    sigma: Float[Array, " k"]
    known: dict[str, Array]
    measured: Float[Array, " h"]
    whitening: Float[Array, "h h"]
    fractions: Float[
        Array, "2 2"
    ]  # sticking, detached; value and standard deviation, which is infinite if not measured
    method: AbstractStepper
    width: Float[Array, ""]  # of a block, s
    fundamental: Float[Array, "2"]  # measured, of the first channel, at the first block's middle: cosine and sine
    harmonic_part: Float[Array, "B k"]  # the harmonics in the measured means
    beating: Float[Array, ""]  # relative size of the sidebands
    count: int = eqx.field(static=True)
    channels: tuple[Channel, ...] = eqx.field(static=True)
    projected: int = eqx.field(static=True, default=0)

    @property
    def frequency(self) -> Float[Array, ""]:
        """The measured frequency, in Hz."""
        return self.measured[0]

    def settled(self, scene: Scene) -> Cycle:
        """A guess of the limit cycle on which the scene settles."""
        return settled(scene.replace(**self.known), self.method, self.frequency)

    def compared(self, scene, own: Cycle, share):
        scene = scene.replace(**self.known)
        after = around(scene, self.method, own, self.count)
        lines = self._averaged(after.lines, own.period)
        found = _referred(1 / own.period, lines)
        times = self.fractions[:, 0] - after.fractions
        exactly = jnp.concatenate([self.whitening @ (self.measured - found), times / self.fractions[:, 1]])
        size = self.measured[1]
        error = jnp.full(found.shape, ROUGH_LINES * size).at[0].set(ROUGH_FREQUENCY * self.measured[0])
        rough = times / jnp.maximum(self.fractions[:, 1], ROUGH_FRACTIONS)
        roughly = jnp.concatenate([(self.measured - found) / error, rough])
        residual = jnp.where(share < 1, roughly, exactly)
        return Compared(residual, self._in_time(lines, own.period), unclosed(scene, own, after), after.contact)

    def _averaged(self, lines, period):
        """Fourier coefficients of the channels' means over blocks."""
        orders = jnp.arange(1, self.count + 1)
        columns = []
        for quantity, coordinate in self.channels:
            rate = 2j * jnp.pi * orders / period if quantity == "acceleration" else 1.0
            columns.append(rate * lines[:, coordinate] * jnp.sinc(orders * self.width / period))
        return jnp.stack(columns, axis=1)

    def _in_time(self, lines, period):
        """The waveform of these coefficients over the blocks of the recording, in phase with it."""
        orders = jnp.arange(1, self.count + 1)
        phase = jnp.angle(self.fundamental[0] - 1j * self.fundamental[1]) - jnp.angle(lines[0, 0])
        turns = 2 * jnp.pi * self.width / period * jnp.arange(self.means.shape[0])[:, None] + phase
        return (jnp.exp(1j * turns * orders) @ lines).real


def _referred(frequency, found):
    """`harmonics.referred`, written so that JAX can differentiate it."""
    size = jnp.sqrt(found[0, 0].real ** 2 + found[0, 0].imag ** 2)
    turned = found * (found[0, 0].conj() / size) ** jnp.arange(1, found.shape[0] + 1)[:, None]
    rest = turned.ravel()[1:]
    return jnp.concatenate([jnp.stack([frequency, size]), rest.real, rest.imag])


def misfit_of_cycle(recording: Recording, blocks: Averaged, method: AbstractStepper, scene: Scene) -> CycleMisfit:
    """A recording of a limit cycle, averaged over blocks, ready to be compared."""
    width = float(blocks.edges[1] - blocks.edges[0])
    sigma = noise_of_means(recording, blocks)
    lowest, highest = _searched(scene, recording)
    frequency = fitted_harmonics(blocks.means, width, 1, lowest, highest, sigma).frequency
    count = int(np.clip(0.3 / (width * frequency), 1, MOST_HARMONICS))
    lowest, highest = 0.6 * frequency, 1.6 * frequency
    frequency = fitted_harmonics(blocks.means, width, count, lowest, highest, sigma).frequency
    left, lines = without_lines(blocks.means, width, frequency, count)
    if recording.noise is None:
        # With few samples per period, differences contain signal; then the residuals of the harmonics are the better bound.
        sigma = np.minimum(sigma, np.sqrt(np.sum(left**2, axis=0) / max(len(left) - 2 * count - 1, 1)))
    measured = fitted_harmonics(blocks.means, width, count, lowest, highest, sigma)
    fractions = np.array([value or (0.0, np.inf) for value in (recording.sticking, recording.detached)])
    of_samples = sigma * np.sqrt(blocks.per_block)
    folded = np.full(len(measured.values), FOLDED * measured.values[1])
    folded[0] = FOLDED_FREQUENCY * measured.frequency
    return CycleMisfit(
        means=jnp.asarray(blocks.means),
        sigma=jnp.asarray(sigma),
        known={name: jnp.asarray(value) for name, value in recording.known.items()},
        measured=jnp.asarray(measured.values),
        whitening=jnp.asarray(np.linalg.inv(np.linalg.cholesky(measured.covariance + np.diag(folded**2)))),
        fractions=jnp.asarray(fractions),
        method=method,
        width=jnp.asarray(width),
        fundamental=jnp.asarray([lines[0, 0].real, -lines[0, 0].imag]),
        harmonic_part=jnp.asarray(blocks.means - left - (blocks.means - left).mean(axis=0)),
        beating=jnp.asarray(beating(recording.values, 1 / recording.rate, frequency, of_samples)),
        count=count,
        channels=recording.channels,
    )


def cycle_rate(recording: Recording, scene: Scene) -> float:
    """Blocks per second for a limit cycle: a number per period for which aliases of averaging lie between its lines."""
    blocks = averaged(recording, 16 * sliding_frequencies(scene, recording).max())
    width = float(blocks.edges[1] - blocks.edges[0])
    frequency = fitted_harmonics(
        blocks.means, width, 1, *_searched(scene, recording), noise_of_means(recording, blocks)
    ).frequency
    samples = recording.rate / frequency
    choices = np.arange(max(1, int(samples / CYCLE_BLOCKS[1])), max(2, int(samples / CYCLE_BLOCKS[0]) + 1))
    return recording.rate / float(choices[np.argmin([_folded(samples / choice) for choice in choices])])


def _folded(per_period: float) -> float:
    """How much of the lines around each multiple of the block rate appears in the fitted lines, in units of a flat spectrum.

    Averaging over r blocks per period leaves, in the line h, a share h/(m r) of the lines near m times the block rate; the
    taper suppresses aliases far enough from the line.
    """
    m = np.arange(1, 13)
    aside = np.abs(m * per_period - np.round(m * per_period)) * CYCLE_PERIODS
    t = np.linspace(0, 1, 401)
    weight = taper(len(t))
    seen = np.abs(np.exp(2j * np.pi * np.outer(aside, t)) @ weight) / weight.sum()
    return float(np.sum(seen * MOST_HARMONICS / (m * per_period)))


def _searched(scene: Scene, recording: Recording) -> tuple[float, float]:
    """The range (Hz) in which the fundamental is sought: around the sliding modes, because a guess with a spring wrong by 30 %
    has a frequency wrong by 16 %.
    """
    modes = sliding_frequencies(scene, recording)
    return 0.6 * modes.min(), 1.6 * modes.max()
