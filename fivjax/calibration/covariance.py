"""Standard deviations and correlations of parameters, and which of them go together."""

import numpy as np
from jaxtyping import Float

# Parameters with a larger correlation go together: one may change much if the other follows.
TOGETHER = 0.9


def covariance_of(jacobian: Float[np.ndarray, "r j"]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    r"""Standard deviations, correlations and singular values from $(J^T J)^{-1}$; the deviations are infinite for parameters
    that have a share in a direction along which the residuals do not change."""
    _, singular, directions = np.linalg.svd(jacobian, full_matrices=False)
    # Singular values below rounding count as zero. Parameters without a share in such a direction keep their deviation.
    kept = np.maximum(singular, max(1e-12 * singular[0], 1e-100))
    shares = np.where(np.abs(directions) < 1e-9, 0.0, directions)
    covariance = (shares / kept[:, None] ** 2).T @ shares
    deviations = np.sqrt(np.diagonal(covariance))
    with np.errstate(invalid="ignore", divide="ignore"):
        correlation = np.nan_to_num(covariance / np.outer(deviations, deviations))
    deviations = np.where(deviations > 1e9, np.inf, deviations)
    return deviations, correlation, singular


def combinations(names: tuple[str, ...], correlation: Float[np.ndarray, "k k"]) -> list[tuple[tuple[str, ...], float]]:
    """Groups of parameters whose correlations exceed `TOGETHER`, with the largest correlation (by size) of each group."""
    alike = np.abs(correlation) >= TOGETHER
    reach = np.linalg.matrix_power(alike.astype(float) + np.eye(len(names)), len(names)) > 0
    groups = []
    for k in range(len(names)):
        members = np.flatnonzero(reach[k])
        if len(members) > 1 and members[0] == k:
            part = correlation[np.ix_(members, members)] - np.eye(len(members))
            groups.append((tuple(names[i] for i in members), float(part.ravel()[np.argmax(np.abs(part))])))
    return groups
