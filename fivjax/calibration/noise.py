"""The noise of a recording: given by the user, or estimated from the recording, but never from the residuals of a fit.

Measured in units of their own size, the residuals of every fit would look good. So the noise is estimated before anything is
fitted, in two ways:

- third differences of neighbouring samples: they hardly contain a vibration that is sampled many times per period, and their
  median ignores the jumps of impacts;
- the quieter part of the spectrum: it contains nothing of a vibration with lines, even if there are few samples per period.

A signal can only add to both estimates, so the smaller one is taken. Both assume noise that is white up to half the sampling
rate.
"""

import numpy as np
from jaxtyping import Float

from ..io.recordings import Averaged, Recording

# The share of spectral lines that counts as quiet: the lowest quarter; and the power of white noise at its upper end, relative
# to the mean.
QUIET = 0.25
QUIET_POWER = -np.log1p(-QUIET)
# Relative error of an estimated standard deviation of the noise.
ESTIMATE_ERROR = 0.03
# The least noise, relative to the signal: without noise, rounding errors would be fitted.
LEAST_NOISE = 1e-6


def noise_of_means(recording: Recording, blocks: Averaged) -> Float[np.ndarray, " k"]:
    """Standard deviations of block means by channel, for white noise."""
    sigma = estimated_noise(recording.values) if recording.noise is None else recording.noise
    least = LEAST_NOISE * np.sqrt(np.mean(blocks.means**2, axis=0)) + 1e-300
    return np.maximum(sigma / np.sqrt(blocks.per_block), least)


def taper(count: int) -> Float[np.ndarray, " count"]:
    """A weight over evenly spaced instants whose spectrum falls off fast: below a thousandth from the fourth line on."""
    return np.hanning(count) ** 2


def estimated_noise(samples: Float[np.ndarray, "T k"]) -> Float[np.ndarray, " k"]:
    """Standard deviations of single samples by channel, estimated from the recording."""
    return np.maximum(np.minimum(from_third_differences(samples), _between_lines(samples)), rounding(samples))


def from_third_differences(samples: Float[np.ndarray, "T k"]) -> Float[np.ndarray, " k"]:
    """The standard deviation of white noise by channel: third differences hardly contain a waveform of many samples, and their
    median ignores its jumps.
    """
    # The third difference of white noise has 1 + 9 + 9 + 1 times its variance.
    return robust_deviation(np.diff(samples, 3, axis=0)) / np.sqrt(20.0)


def robust_deviation(values: Float[np.ndarray, "T k"]) -> Float[np.ndarray, " k"]:
    """The standard deviation of normal numbers about zero, by the median of their sizes: a few large ones hardly change it."""
    return np.median(np.abs(values), axis=0) / 0.6745


def _between_lines(samples):
    weight = taper(len(samples))[:, None]
    centred = samples - samples.mean(axis=0)
    power = np.abs(np.fft.rfft(centred * weight, axis=0)) ** 2 / np.sum(weight**2)
    return np.sqrt(np.quantile(power[1:], QUIET, axis=0) / QUIET_POWER)


def rounding(samples):
    """The rounding of a sensor or file with few digits: samples on a grid have errors of up to half its step."""
    steps = [np.diff(np.unique(column)) for column in samples.T]
    return np.array([step.min() / np.sqrt(12.0) if step.size else 0.0 for step in steps])
