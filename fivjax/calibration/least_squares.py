r"""Nonlinear least squares from several starts at once: optimistix's Levenberg–Marquardt, one step at a time.

What is fitted is compiled once, as one function of a batch of starts that gives residuals and their Jacobians. Inside the
solver's own loop it would be traced and compiled several times over, which takes longer than the fit. So the solver is
handed, step by step, the tangent of the residuals at the point that it wants to know about; a step asks for no more.

It ends where statistics says: where the residuals have no share left, in units of the noise, along any combination of the
parameters that the data tell (the relative offset of Bates and Watts 1981). A combination that changes the residuals by
less than the noise when a parameter changes e-fold is not told, and where it ends up means nothing.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array, Bool, Float

from ..foundation.compiling import compiled
from ..foundation.precision import in_double_precision

# Damping relative to the slopes at the start: where it begins, and where nothing can be gained any more.
FIRST_DAMPING, MOST_DAMPING = 0.03, 1e12
# Slopes below this share of the largest are damped as if they were that large: next to nothing tells those parameters.
LEAST_SCALE = 1e-3
# No step is longer in any one unknown: a factor of e.
LONGEST_STEP = 1.0
# Singular values, in noise per unit of the unknowns, below which a combination is not told.
TOLD = 1.0
# Starts that will stay this much worse than one that has arrived, as the slopes say, are given up.
HOPELESSLY_WORSE = 25.0
# Steps that gain less than the least share of what the slopes promise are taken back; above the good one, less is damped.
LEAST_GAIN, GOOD_GAIN = 1e-3, 0.75

# How long it goes on is decided here, so its own tolerances are none.
_SOLVER = eqx.tree_at(
    lambda solver: solver.search,
    optx.LevenbergMarquardt(rtol=0.0, atol=0.0),
    optx.ClassicalTrustRegion(low_cutoff=LEAST_GAIN, high_cutoff=GOOD_GAIN),
)
# In reverse, a Jacobian is kept as a matrix; forward, it would be a program, of which no two batches share one.
_OPTIONS, _TAGS = {"jac": "bwd"}, frozenset()


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


class _Tangents(NamedTuple):
    """Residuals to first order: as many of them as there are unknowns, and one for what these cannot change.

    In units in which all unknowns change the residuals alike at the start.
    """

    residual: Float[Array, "s j+1"]
    jacobian: Float[Array, "s j+1 j"]


@in_double_precision
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
    at = tried = evaluate(x, about)
    scale = np.stack([_scale(jacobian) for jacobian in at.jacobian])
    state = _begun(x * scale)
    open_, steps = np.ones(len(x), bool), 0
    while True:
        before, tangents = state, _tangents(tried, scale)
        state = _stepped(x * scale, _refused(tangents, ~open_), before)
        taken = np.asarray(state.num_accepted_steps > before.num_accepted_steps)
        x, at = np.where(taken[:, None], np.asarray(before.y_eval) / scale, x), _where(taken, tried, at)
        # What lies too far away is refused unseen, until it is near enough.
        while np.any(far := open_ & np.any(np.abs(state.y_eval / scale - x) > LONGEST_STEP, axis=1)):
            state = _where(far, _stepped(x * scale, _refused(tangents, far), state), state)
        cost = at.cost
        left, gain = np.transpose([_left(r, j) for r, j in zip(at.residual, at.jacobian, strict=True)])
        freedom = max(at.residual.shape[1] - x.shape[1], 1)
        arrived = np.isfinite(cost) & (left <= tolerance * np.maximum(1.0, np.sqrt(cost / freedom)))
        best = np.min(np.where(arrived, cost, np.inf), initial=np.inf)
        damping = 1 / np.asarray(state.search_state.step_size)
        open_ = np.isfinite(cost) & ~arrived & (damping < MOST_DAMPING) & (cost - gain < best + HOPELESSLY_WORSE)
        if not np.any(open_) or steps == most_steps:
            return Minima(x, at, arrived, steps)
        tried = evaluate(np.where(open_[:, None], np.asarray(state.y_eval) / scale, x), at.about)
        steps += 1


def _tangent(z, args):
    """The residuals as the solver sees them: only where it asks for them, so at the tangents' own point."""
    point, residual, jacobian = args
    return residual + jacobian @ (z - point), None


@compiled
def _begun(z: Float[Array, "s j"]):
    """The solver's state before it knows anything of these points."""
    size = z.shape[1]

    def one(z):
        args = z, jnp.zeros(size + 1), jnp.zeros((size + 1, size))
        shapes = jax.eval_shape(lambda: args[1]), None
        state = _SOLVER.init(_tangent, z, args, _OPTIONS, *shapes, _TAGS)
        return eqx.tree_at(lambda s: s.search_state.step_size, state, jnp.asarray(1 / FIRST_DAMPING))

    return jax.vmap(one)(z)


@compiled
def _stepped(z: Float[Array, "s j"], tangents: _Tangents, state):
    """The solver's state once it knows the residuals where it wanted to; `z` are the best points so far."""

    def one(z, tangents, state):
        args = state.y_eval, tangents.residual, tangents.jacobian
        _, state, _ = _SOLVER.step(_tangent, z, args, _OPTIONS, state, _TAGS)
        return state

    return jax.vmap(one)(z, tangents, state)


def _tangents(at: Evaluated, scale: Float[np.ndarray, "s j"]) -> _Tangents:
    count, size = scale.shape
    residuals, jacobians = np.full((count, size + 1), np.inf), np.zeros((count, size + 1, size))
    for i, (residual, jacobian) in enumerate(zip(at.residual, at.jacobian, strict=True)):
        if np.all(np.isfinite(residual)) and np.all(np.isfinite(jacobian)):
            turned, upper = np.linalg.qr(jacobian / scale[i])
            shares, rows = turned.T @ residual, len(upper)
            residuals[i] = 0.0
            residuals[i, :rows] = shares
            residuals[i, size] = np.linalg.norm(residual - turned @ shares)
            jacobians[i, :rows] = upper
    return _Tangents(residuals, jacobians)


def _refused(tangents: _Tangents, those: Bool[np.ndarray, " s"]) -> _Tangents:
    """The solver takes back a step to where the residuals are infinite, and damps more."""
    return tangents._replace(residual=np.where(those[:, None], np.inf, tangents.residual))


def _scale(jacobian: Float[np.ndarray, "r j"]) -> Float[np.ndarray, " j"]:
    slopes = np.linalg.norm(jacobian, axis=0)
    largest = np.max(slopes)
    return np.maximum(slopes, LEAST_SCALE * largest) if largest > 0 else np.ones_like(slopes)


def _left(residual, jacobian) -> tuple[float, float]:
    """What residuals have along the combinations that are told; and their squares along all of them, which one undamped
    step would remove if the residuals were linear."""
    if not (np.all(np.isfinite(residual)) and np.all(np.isfinite(jacobian))):
        return np.inf, 0.0
    left, singular, _ = np.linalg.svd(jacobian, full_matrices=False)
    shares = left.T @ residual
    told = singular > TOLD
    return float(np.linalg.norm(shares[told])), float(np.sum(shares**2))


def _where(taken: Bool[np.ndarray, " s"], new, old):
    def chosen(new, old):
        return np.where(taken.reshape(taken.shape + (1,) * (np.ndim(new) - 1)), new, old)

    return jax.tree.map(chosen, new, old)
