"""Is what a fit leaves noise? Its size against the noise that was stated or measured, and its likeness from block to block.

A wrong model shows in either. Both are compared with their own scatter: the mean square of N normal numbers scatters by
sqrt(2/N), a correlation of N of them by 1/sqrt(N). So long recordings find out small errors of a model.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.special import gammaincc

from .noise import ESTIMATE_ERROR

# In standard deviations of their own scatter: from here on chance is not the reason.
UNLIKELY = 5.0
# Lags that are looked at together; blocks are so short that a vibration stays in this window for about a period.
LAGS = 16
IMPROBABLE = 1e-6


class WhatIsLeft(NamedTuple):
    """What a fit leaves, in units of the noise."""

    misfit: float  # sum of squares per degree of freedom
    larger: bool  # than the noise can be
    smaller: bool  # than the noise is said to be: then it was estimated too large
    correlation: float  # of neighbouring blocks, the channel and recording where it is the least likely by chance
    correlated: bool  # so much that it is not white noise

    @property
    def is_noise(self) -> bool:
        """Whether noise alone explains it."""
        return not (self.larger or self.correlated)

    def __str__(self) -> str:
        said = [f"{np.sqrt(self.misfit):.3g} times as large as the noise"]
        if self.correlated:
            said.append(f"alike from block to block (correlation {self.correlation:.2g})")
        return ", ".join(said)


def what_is_left(squares: float, freedom: int, waveforms: list[Float[np.ndarray, "B k"]], stated: bool) -> WhatIsLeft:
    """Sum of squared residuals with its degrees of freedom, and the waveforms of those recordings that are compared by one."""
    misfit = squares / freedom
    # The estimate's error is one of a standard deviation, so twice that of a square.
    scatter = np.hypot(np.sqrt(2.0 / freedom), 0.0 if stated else 2 * ESTIMATE_ERROR)
    found = [_likeness(column) for left in waveforms for column in left.T]
    correlation, correlated = max(found, key=lambda one: (one[1], abs(one[0])), default=(0.0, False))
    return WhatIsLeft(
        misfit=misfit,
        larger=bool(misfit > 1 + UNLIKELY * scatter),
        smaller=bool(misfit < 1 - UNLIKELY * scatter),
        correlation=correlation,
        correlated=correlated,
    )


def exceeds_noise(means: Float[np.ndarray, "B k"], sigma: Float[np.ndarray, " k"]) -> bool:
    """Whether what was recorded is anything but white noise of this size around a constant."""
    scaled = (means - means.mean(axis=0)) / sigma
    found = what_is_left(float(np.sum(scaled**2)), scaled.size - scaled.shape[1], [scaled], stated=False)
    return not found.is_noise


def _likeness(left: Float[np.ndarray, " B"]) -> tuple[float, bool]:
    """Correlation of neighbouring blocks, and whether it, or those of all lags together (Ljung and Box 1978), is no chance."""
    count, power = len(left), float(np.sum(left**2))
    if power == 0:
        return 0.0, False
    lags = min(LAGS, count // 4)
    alike = np.array([np.sum(left[k:] * left[:-k]) for k in range(1, lags + 1)]) / power
    together = count * (count + 2) * np.sum(alike**2 / (count - np.arange(1, lags + 1)))
    by_chance = gammaincc(0.5 * lags, 0.5 * together)
    return float(alike[0]), bool(abs(alike[0]) * np.sqrt(count) > UNLIKELY or by_chance < IMPROBABLE)
