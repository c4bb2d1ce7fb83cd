r"""Nonlinear least squares by SciPy's trust region method, with one evaluation for residuals and Jacobian.

It stops by a statistical criterion: when a step has no significant gain in units of the noise. A minimum has been reached if
the residuals have no component left along any identifiable combination of parameters (the relative offset of Bates and Watts
1981). A combination is not identifiable if it changes the residuals by less than the noise when a parameter changes by a factor
of e; its value at the end has no meaning.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

# A fit may end this many times farther from the minimum than `tolerance`, because SciPy's own criterion is the gain.
SLACK = 10.0


class Evaluated(NamedTuple):
    """The evaluation at one point: residuals in units of the noise (infinite if there are none), Jacobian, and further data."""

    residual: Float[np.ndarray, " r"]
    jacobian: Float[np.ndarray, "r j"]
    about: Any = None  # passed on to the next evaluation

    @property
    def cost(self) -> float:
        """The sum of squares."""
        with np.errstate(invalid="ignore", over="ignore"):
            squares = float(np.sum(self.residual**2))
        return squares if np.isfinite(squares) else np.inf


class Minimum(NamedTuple):
    """The end of a minimisation."""

    x: Float[np.ndarray, " j"]
    at: Evaluated
    arrived: bool
    evaluations: int
    left_out: Any = None  # what was not compared


def minimise(
    evaluate: Callable[[np.ndarray, Any], Evaluated],
    x0: Float[np.ndarray, " j"],
    about: Any,
    tolerance: float,
    most_evaluations: int,
    allowed: Callable[[np.ndarray], bool] = lambda _: True,
) -> Minimum:
    """The minimum reached from `x0`, at which identifiable combinations are within about `tolerance` standard deviations.

    `evaluate` takes a point, and the `about` of the best point before it (at first the argument `about`). Unknowns should be of
    order one. Steps to points that are not `allowed` are refused, as those that are too long: a shorter one is tried.
    """
    # The longest step in any one unknown (a factor of e for most parameters); longer ones are refused without evaluation.
    longest_step = 1.0
    from scipy.optimize import least_squares

    x0 = np.asarray(x0, float)
    best = tried = evaluate(x0, about)
    if not np.isfinite(best.cost):
        return Minimum(x0, best, False, 1)
    last = stayed = np.zeros_like(x0)

    def residual(moved):
        nonlocal tried, last
        if np.any(np.abs(moved - stayed) > longest_step) or not allowed(x0 + moved):
            return np.full_like(best.residual, np.inf)
        if not np.array_equal(moved, last):
            tried, last = evaluate(x0 + moved, best.about), np.array(moved)
        return tried.residual

    def jacobian(moved):
        # SciPy asks for the Jacobian only at points that it accepts.
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
        # The gain relative to the sum of squares, which is one per degree of freedom in a good fit.
        ftol=tolerance**2 / freedom,
        xtol=1e-12,
        gtol=None,
        max_nfev=most_evaluations,
        callback=stop_on_arrival,
    )
    return Minimum(x0 + stayed, best, bool(has_arrived(SLACK)), int(found.nfev))


def _left(at: Evaluated) -> float:
    """The component of the residuals along identifiable combinations."""
    # Singular values, in units of the noise per unit of the unknowns, below which a combination is not identifiable.
    told = 1.0
    left, singular, _ = np.linalg.svd(at.jacobian, full_matrices=False)
    return float(np.linalg.norm((left.T @ at.residual)[singular > told]))
