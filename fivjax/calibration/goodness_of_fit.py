"""Whether the residuals of a fit are noise: their size relative to the given or estimated noise, and their autocorrelation.

A wrong model shows in at least one of them. Both are compared with their own scatter: the mean square of N normal numbers has a
standard deviation of sqrt(2/N), a correlation of N of them one of 1/sqrt(N). So long recordings reveal small errors of a model.
"""

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.special import gammaincc

from .noise import ESTIMATE_ERROR

# Deviations of more than this many standard deviations are not explained by chance.
UNLIKELY = 5.0
# Number of lags tested together, in blocks; about a period of a vibration.
LAGS = 16
IMPROBABLE = 1e-6
# What is left of a recording without noise is rounding.
ROUNDING = 1e-6


class ResidualTests(NamedTuple):
    """The residuals of a fit, in units of the noise."""

    misfit: float  # sum of squares per degree of freedom
    larger: bool  # whether they are larger than the noise can be
    smaller: bool  # whether they are smaller than the noise can be: then it was estimated too large
    correlation: float  # of neighbouring blocks, in the channel and recording where it is least likely by chance
    correlated: bool  # whether they are too correlated for white noise

    @property
    def is_noise(self) -> bool:
        """Whether noise alone explains the residuals."""
        return not (self.larger or self.correlated)

    def __str__(self) -> str:
        said = [f"{np.sqrt(self.misfit):.3g} times as large as the noise"]
        if self.correlated:
            said.append(f"alike from block to block (correlation {self.correlation:.2g})")
        return ", ".join(said)


def residual_tests(
    squares: float, freedom: int, waveforms: Iterable[Iterable[Float[np.ndarray, " B"]]], stated: bool
) -> ResidualTests:
    """The tests, from the sum of squared residuals and its degrees of freedom, and from the residual waveforms of recordings,
    one for each channel; `stated`: whether the noise was given.
    """
    # Where the noise is estimated from the recording, so little of its power may be the estimate's own: a waveform without
    # noise bends from sample to sample.
    of_estimate = 1e-2
    misfit = squares / freedom
    # The relative error of a variance is twice that of a standard deviation.
    scatter = np.hypot(np.sqrt(2.0 / freedom), 0.0 if stated else 2 * ESTIMATE_ERROR)
    columns = [np.asarray(column) for left in waveforms for column in left if len(column) > 3]
    # Beside a stated noise, what is left of N blocks may be alike if its power is less than a share 1/N: parameters are off by
    # less than their standard deviations.
    found = [_likeness(one) for one in columns if np.mean(one**2) > (1 / len(one) if stated else of_estimate)]
    correlation, correlated = max(found, key=lambda one: (one[1], abs(one[0])), default=(0.0, False))
    return ResidualTests(
        misfit=misfit,
        larger=bool(misfit > 1 + UNLIKELY * scatter),
        smaller=bool(misfit < 1 - UNLIKELY * scatter),
        correlation=correlation,
        correlated=correlated,
    )


def exceeds_noise(means: Float[np.ndarray, "B k"], sigma: Float[np.ndarray, "*B k"]) -> bool:
    """Whether a recording is more than white noise of this size around a constant."""
    scaled = (means - means.mean(axis=0)) / sigma
    found = residual_tests(float(np.sum(scaled**2)), scaled.size - scaled.shape[1], [scaled.T], stated=False)
    return not found.is_noise


def _likeness(left: Float[np.ndarray, " B"]) -> tuple[float, bool]:
    """The correlation of neighbouring blocks; and whether it, or that of all lags together (Ljung and Box 1978), is
    significant.
    """
    count, power = len(left), float(np.sum(left**2))
    if power == 0:
        return 0.0, False
    lags = min(LAGS, count // 4)
    alike = np.array([np.sum(left[k:] * left[:-k]) for k in range(1, lags + 1)]) / power
    together = count * (count + 2) * np.sum(alike**2 / (count - np.arange(1, lags + 1)))
    by_chance = gammaincc(0.5 * lags, 0.5 * together)
    return float(alike[0]), bool(abs(alike[0]) * np.sqrt(count) > UNLIKELY or by_chance < IMPROBABLE)
