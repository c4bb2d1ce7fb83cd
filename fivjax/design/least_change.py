"""The smallest change within bounds that changes a linear quantity by a given amount."""

import numpy as np
from jaxtyping import Float
from scipy.optimize import brentq


def smallest_change(
    gradient: Float[np.ndarray, " k"], level: float, low: Float[np.ndarray, " k"], high: Float[np.ndarray, " k"]
) -> Float[np.ndarray, " k"]:
    """The vector r of least length with `gradient @ r == level` and `low <= r <= high`; the bounds must contain zero.

    It is the gradient times a factor, with each component clipped to its bounds. If no r within the bounds reaches the level,
    the one that comes closest is returned.
    """

    def at(factor: float) -> np.ndarray:
        return np.clip(factor * gradient, low, high)

    moving = gradient != 0
    if level == 0 or not np.any(moving):
        return np.zeros_like(gradient)
    sense = np.sign(level)
    # Beyond this factor every component is at its bound.
    reach = np.where(sense * gradient > 0, high, low)[moving] / gradient[moving]
    most = sense * float(np.max(np.abs(reach)))
    if abs(gradient @ at(most)) <= abs(level):
        return at(most)
    return at(brentq(lambda factor: gradient @ at(factor) - level, 0.0, most, xtol=1e-300, rtol=1e-14))
