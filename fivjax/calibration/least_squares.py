r"""Nonlinear least squares by SciPy's trust region, with one evaluation for residuals and Jacobian.

It ends where statistics says: where a step gains nothing that counts in units of the noise. A minimum has been reached if
the residuals have no share left along any combination of the parameters that the data tell (the relative offset of Bates
and Watts 1981). A combination that changes the residuals by less than the noise when a parameter changes e-fold is not
told, and where it ends up means nothing.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

# Singular values, in noise per unit of the unknowns, below which a combination is not told.
TOLD = 1.0
# No step is longer in any one unknown, a factor of e for most parameters: what lies farther off is refused unseen.
LONGEST_STEP = 1.0
# A step may end this much farther from the minimum than was asked for, in standard deviations: SciPy looks at gains.
SLACK = 10.0


class Evaluated(NamedTuple):
    """One point: residuals in units of the noise (infinite where there are none), and what else belongs to it."""

    residual: Float[np.ndarray, " r"]
    jacobian: Float[np.ndarray, "r j"]
    about: Any = None  # handed on to the next evaluation

    @property
    def cost(self) -> float:
        """Sum of squares."""
        with np.errstate(invalid="ignore", over="ignore"):
            squares = float(np.sum(self.residual**2))
        return squares if np.isfinite(squares) else np.inf


class Minimum(NamedTuple):
    """Where a minimisation ended."""

    x: Float[np.ndarray, " j"]
    at: Evaluated
    arrived: bool
    evaluations: int


def minimise(
    evaluate: Callable[[np.ndarray, Any], Evaluated],
    x0: Float[np.ndarray, " j"],
    about: Any,
    tolerance: float,
    most_evaluations: int,
) -> Minimum:
    """From `x0` to where the residuals have about `tolerance` standard deviations left along what is told.

    `evaluate` takes a point, and what belongs to the best one before it (`about` at first). Unknowns should be of order one.
    """
    from scipy.optimize import least_squares

    x0 = np.asarray(x0, float)
    best = tried = evaluate(x0, about)
    if not np.isfinite(best.cost):
        return Minimum(x0, best, False, 1)
    last = stayed = np.zeros_like(x0)

    def residual(moved):
        nonlocal tried, last
        if np.any(np.abs(moved - stayed) > LONGEST_STEP):
            return np.full_like(best.residual, np.inf)
        if not np.array_equal(moved, last):
            tried, last = evaluate(x0 + moved, best.about), np.array(moved)
        return tried.residual

    def jacobian(moved):
        # SciPy asks for it only where it stays.
        nonlocal best, stayed
        residual(moved)
        best, stayed = tried, last
        return best.jacobian

    freedom = max(best.residual.size - x0.size, 1)

    def has_arrived(slack=1.0):
        return _left(best) <= slack * tolerance * max(1.0, np.sqrt(best.cost / freedom))

    if has_arrived():
        return Minimum(x0, best, True, 1)

    def stop_on_arrival(_):
        if has_arrived():
            raise StopIteration

    found = least_squares(
        residual,
        np.zeros_like(x0),
        jacobian,
        method="trf",
        # A gain relative to all that is left, which is one per degree of freedom where the fit is good.
        ftol=tolerance**2 / freedom,
        xtol=1e-12,
        gtol=None,
        max_nfev=most_evaluations,
        callback=stop_on_arrival,
    )
    return Minimum(x0 + stayed, best, bool(has_arrived(SLACK)), int(found.nfev))


def _left(at: Evaluated) -> float:
    """What residuals have along the combinations that are told."""
    left, singular, _ = np.linalg.svd(at.jacobian, full_matrices=False)
    return float(np.linalg.norm((left.T @ at.residual)[singular > TOLD]))
