r"""Levenberg–Marquardt for several starts at once.

What is fitted is compiled once, as one function of a batch of starts that gives residuals and their Jacobians; everything
else is a few small matrices, on the host. Inside a compiled loop the same function would have to be traced several times
over, which takes longer than the fit.

It ends where statistics says: where the residuals have no share left, in units of the noise, along any combination of the
parameters that the data tell (the relative offset of Bates and Watts 1981). A combination that changes the residuals by
less than the noise when a parameter changes e-fold is not told, and where it ends up means nothing.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Bool, Float

# Damping: where it starts, relative to the largest slopes, and where nothing can be gained any more.
FIRST_DAMPING, MOST_DAMPING = 0.03, 1e12
# No step is longer in any one unknown: a factor of e.
LONGEST_STEP = 1.0
# Steps that gain less than this share of what the slopes promise are taken back.
LEAST_GAIN = 1e-3
# Singular values, in noise per unit of the unknowns, below which a combination is not told.
TOLD = 1.0
# Starts that will stay this much worse than one that has arrived, as the slopes say, are given up.
HOPELESSLY_WORSE = 25.0


class Evaluated(NamedTuple):
    """A batch of points: residuals in units of the noise (infinite where there is none), and what else belongs to them."""

    residual: Float[np.ndarray, "s r"]
    jacobian: Float[np.ndarray, "s r j"]
    about: Any  # a tree of arrays with the batch in front; handed back to the next evaluation

    @property
    def cost(self) -> Float[np.ndarray, " s"]:
        """Sums of squares."""
        with np.errstate(invalid="ignore", over="ignore"):
            squares = np.sum(self.residual**2, axis=1)
        return np.where(np.isfinite(squares), squares, np.inf)


class Minima(NamedTuple):
    """Where each start ended."""

    x: Float[np.ndarray, "s j"]
    at: Evaluated
    arrived: Bool[np.ndarray, " s"]
    steps: int


def minimise(
    evaluate: Callable[[np.ndarray, Any], Evaluated],
    starts: Float[np.ndarray, "s j"],
    about: Any,
    tolerance: float,
    most_steps: int,
) -> Minima:
    """From each start, to where the residuals have less than `tolerance` standard deviations left along what is told.

    `evaluate` takes points and what came with the ones before; `most_steps` counts evaluations after the first.
    """
    x = np.array(starts, float)
    at = evaluate(x, about)
    count = len(x)
    damping, growth = np.full(count, FIRST_DAMPING), np.full(count, 2.0)
    scale = np.zeros_like(x)
    arrived, steps = np.zeros(count, bool), 0
    while True:
        cost = at.cost
        left, gain = np.transpose([_left(r, j) for r, j in zip(at.residual, at.jacobian, strict=True)])
        freedom = max(at.residual.shape[1] - x.shape[1], 1)
        arrived = np.isfinite(cost) & (left <= tolerance * np.maximum(1.0, np.sqrt(cost / freedom)))
        best = np.min(np.where(arrived, cost, np.inf), initial=np.inf)
        open_ = np.isfinite(cost) & ~arrived & (damping < MOST_DAMPING) & (cost - gain < best + HOPELESSLY_WORSE)
        if not np.any(open_) or steps == most_steps:
            return Minima(x, at, arrived, steps)
        promised = np.zeros(count)
        moved = x.copy()
        for i in np.flatnonzero(open_):
            scale[i] = np.maximum(scale[i], np.linalg.norm(at.jacobian[i], axis=0))
            step, damping[i] = _step(at.residual[i], at.jacobian[i], scale[i], damping[i])
            moved[i] += step
            promised[i] = cost[i] - np.sum((at.residual[i] + at.jacobian[i] @ step) ** 2)
        tried = evaluate(moved, at.about)
        steps += 1
        better = np.where(open_, cost, 0.0) - np.where(open_, tried.cost, 0.0)
        share = better / np.maximum(promised, 1e-300)
        taken = open_ & (share > LEAST_GAIN)
        # Nielsen 1999: less damping where the slopes kept their promise, ever more where they did not.
        eased = damping * np.maximum(1 / 3, 1 - (2 * np.clip(share, 0, 1) - 1) ** 3)
        damping = np.where(taken, eased, np.where(open_, damping * growth, damping))
        growth = np.where(taken, 2.0, np.where(open_, 2 * growth, growth))
        x = np.where(taken[:, None], moved, x)
        at = _where(taken, tried, at)


def _step(residual, jacobian, scale, damping: float) -> tuple[np.ndarray, float]:
    """The damped step, and the damping that kept it short enough."""
    left, singular, right = np.linalg.svd(jacobian / _positive(scale), full_matrices=False)
    shares = left.T @ residual
    while True:
        # What is divided by the scale has singular values of order one.
        step = -(right.T @ (shares * singular / (singular**2 + damping))) / _positive(scale)
        if np.max(np.abs(step)) <= LONGEST_STEP or damping >= MOST_DAMPING:
            return step, damping
        damping *= 4.0


def _left(residual, jacobian) -> tuple[float, float]:
    """What residuals have along the combinations that are told; and their squares along all of them, which one undamped
    step would remove if the residuals were linear."""
    if not (np.all(np.isfinite(residual)) and np.all(np.isfinite(jacobian))):
        return np.inf, 0.0
    left, singular, _ = np.linalg.svd(jacobian, full_matrices=False)
    shares = left.T @ residual
    told = singular > TOLD
    return float(np.linalg.norm(shares[told])), float(np.sum(shares**2))


def _positive(scale):
    return np.where(scale > 0, scale, 1.0)


def _where(taken: Bool[np.ndarray, " s"], new, old):
    def chosen(new, old):
        return np.where(taken.reshape(taken.shape + (1,) * (np.ndim(new) - 1)), new, old)

    return jax.tree.map(chosen, new, old)
