"""The noise of a recording: stated by the user, or read off where no signal is. Never off what a fit leaves.

What a fit leaves is as large as the fit is bad; measured in units of itself, every fit would look good. So the noise is
estimated before anything is fitted, in two ways:

- third differences of neighbouring samples: nothing is left of a vibration that is sampled many times a period, and the
  median passes over the jumps of its impacts;
- the quieter part of the spectrum: nothing is there of a vibration that has lines, however sparse its samples are.

Any signal only adds to either, so the smaller one is taken. Both suppose that the noise is white up to the sampling rate.
"""

import numpy as np
from jaxtyping import Float

from ..io.recordings import Averaged, Recording
from .harmonics import taper

# The part of the spectrum taken for quiet: its lowest quarter, whose upper end is this share of the mean power of white noise.
QUIET = 0.25
QUIET_POWER = -np.log1p(-QUIET)
# How well the standard deviation of the noise is known, relative, where it is estimated.
ESTIMATE_ERROR = 0.03
# A recording without any noise would leave rounding to be fitted: the least noise, relative to the signal.
LEAST_NOISE = 1e-6


def noise_of_means(recording: Recording, blocks: Averaged) -> Float[np.ndarray, " k"]:
    """Standard deviations of block means by channel, for white noise."""
    sigma = estimated_noise(recording.values) if recording.noise is None else recording.noise
    least = LEAST_NOISE * np.sqrt(np.mean(blocks.means**2, axis=0)) + 1e-300
    return np.maximum(sigma / np.sqrt(blocks.per_block), least)


def estimated_noise(samples: Float[np.ndarray, "T k"]) -> Float[np.ndarray, " k"]:
    """Standard deviations of single samples by channel, from where no signal is."""
    return np.maximum(np.minimum(_between_samples(samples), _between_lines(samples)), _rounding(samples))


def _between_samples(samples):
    differences = np.abs(np.diff(samples, 3, axis=0))
    # The third difference of white noise has 1 + 9 + 9 + 1 times its variance; 0.6745 is the median of |normal|.
    return np.median(differences, axis=0) / (0.6745 * np.sqrt(20.0))


def _between_lines(samples):
    weight = taper(len(samples))[:, None]
    centred = samples - samples.mean(axis=0)
    power = np.abs(np.fft.rfft(centred * weight, axis=0)) ** 2 / np.sum(weight**2)
    return np.sqrt(np.quantile(power[1:], QUIET, axis=0) / QUIET_POWER)


def _rounding(samples):
    """What a sensor or a file with few digits adds: samples that lie on a grid are off by up to half its step."""
    steps = [np.diff(np.unique(column)) for column in samples.T]
    return np.array([step.min() / np.sqrt(12.0) if step.size else 0.0 for step in steps])
