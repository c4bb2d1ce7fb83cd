"""Time offsets of recordings: scanned before a fit, and tried again whole periods earlier and later after it."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..foundation.compiling import compiled
from .initial_guesses import state_matrices
from .least_squares import Minimum
from .misfit import OFFSET_UNIT
from .problem import Problem
from .waveform_misfit import KickMisfit

# Candidates with time offsets that are tried: two, with three offsets each.
KEPT_WITH_OFFSETS = 6
OFFSETS_PER_BLOCK = 4
# Numbers of periods by which the time offset of the best fit is changed, and how often this may be repeated.
WHOLE_PERIODS = (-2, -1, 1, 2)
MOST_ROUNDS = 4


def best_offsets(
    problem: Problem, k: int, bounds: tuple[float, float], points: list[np.ndarray], windows: tuple[float, ...]
) -> Float[np.ndarray, "candidate window"]:
    """For each point and window the offset at which recording k agrees best, in the units of the problem."""
    mine, (low, high) = problem.misfits[k], bounds
    edges, means, sigma = map(np.asarray, (mine.edges, mine.means, mine.sigma))
    step = (edges[1] - edges[0]) / OFFSETS_PER_BLOCK
    shifts = int(np.ceil((high - low) / step)) + 1
    instants = low + edges[0] + step * np.arange(shifts + OFFSETS_PER_BLOCK * len(means))
    ends = [max(1, int(share * len(means))) - 1 for share in windows[::-1]]
    cost = np.empty((len(points), len(windows), shifts))
    for i, point in enumerate(points):
        found = np.asarray(_integrals(problem, k, jnp.asarray(point), jnp.asarray(instants)))
        for shift in range(shifts):
            model = np.diff(found[shift::OFFSETS_PER_BLOCK][: len(edges)], axis=0) / (edges[1] - edges[0])
            cost[i, :, shift] = np.cumsum(np.sum(((means - model) / sigma) ** 2, axis=1))[ends]
    best = np.argmin(np.where(np.isfinite(cost), cost, np.inf), axis=-1)
    return np.minimum(step * best, high - low) / OFFSET_UNIT


def periods_aside(
    problem: Problem, k: int, bounds: tuple[float, float], x: np.ndarray
) -> tuple[list[np.ndarray], float]:
    """The points `x` with the offset of recording k changed by whole periods, where the bounds allow it; and half a period.

    A vibration is similar to itself a period later, so these may be better minima.
    """
    place = problem.size + int(np.sum(problem.moved[:k]))
    period = _period(problem, x[: problem.size]) / OFFSET_UNIT
    shifted = np.tile(x, (len(WHOLE_PERIODS), 1))
    shifted[:, place] += period * np.array(WHOLE_PERIODS)
    offsets = problem.references[k] + OFFSET_UNIT * shifted[:, place]
    return list(shifted[(bounds[0] <= offsets) & (offsets <= bounds[1])]), 0.5 * period


def slid_throughout(problem: Problem, best: Minimum) -> bool:
    """Whether the fitted responses are the same when contact events are taken into account."""
    for k, mine in enumerate(problem.misfits):
        if isinstance(mine, KickMisfit):
            instants = mine.edges + problem.offsets(best.x)[k]
            u = jnp.asarray(best.x[: problem.size])
            width = float(mine.edges[1] - mine.edges[0])
            integrals: np.ndarray = np.asarray(_integrals(problem, k, u, instants, eventful=True))
            found = np.diff(integrals, axis=0) / width
            # A tolerance for rounding; the effect of an event is much larger.
            if not np.allclose(found, best.at.about.models[k], rtol=0, atol=1e-6 * np.ptp(found)):
                return False
    return True


@compiled
def _integrals(problem: Problem, which: int, u: Float[Array, " k"], instants: Float[Array, " b"], eventful=False):
    return problem.misfits[which].integrals(problem.at(u), instants, eventful)


def _period(problem: Problem, u: Float[np.ndarray, " k"]) -> float:
    """The period of the least damped mode of steady sliding, s; 0 if none vibrates."""
    (matrix,) = state_matrices(problem.parameters, problem.scene, jnp.asarray(u[None]))
    eigenvalues = np.linalg.eigvals(np.asarray(matrix))
    vibrating = eigenvalues[eigenvalues.imag > 0]
    return 2 * np.pi / float(vibrating[np.argmax(vibrating.real)].imag) if len(vibrating) else 0.0
