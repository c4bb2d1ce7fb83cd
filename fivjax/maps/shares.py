"""Shares and their confidence intervals."""

import numpy as np


def wilson(successes, total: int, z: float = 1.959963984540054) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A share and its interval by E. B. Wilson (1927), of 95 % unless `z` says otherwise."""
    share = np.asarray(successes) / total
    middle = (share + z**2 / (2 * total)) / (1 + z**2 / total)
    half = z * np.sqrt(share * (1 - share) / total + z**2 / (4 * total**2)) / (1 + z**2 / total)
    return share, np.maximum(middle - half, 0.0), np.minimum(middle + half, 1.0)
