"""Time offsets of recordings: scanned before a fit, and tried again whole periods earlier and later after it."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..foundation.compiling import compiled
from .initial_guesses import state_matrices
from .problem import Problem
from .samples import Sampled
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
    assert isinstance(mine, KickMisfit)
    edges, means, sigma = map(np.asarray, (mine.edges, mine.means, mine.sigma))
    step = (edges[1] - edges[0]) / OFFSETS_PER_BLOCK
    shifts = int(np.ceil((high - low) / step)) + 1
    # Averages over parts of blocks, whatever the samples are: to look for an offset they are close enough.
    parts = shifts - 1 + OFFSETS_PER_BLOCK * len(means)
    finer = Sampled(jnp.zeros(()), jnp.asarray(step), None, None, parts, 1, True)
    ends = [max(1, int(share * len(means))) - 1 for share in windows[::-1]]
    cost = np.empty((len(points), len(windows), shifts))
    for i, point in enumerate(points):
        found = np.asarray(_responses(problem, k, jnp.asarray(point), finer, jnp.asarray(low)))
        sums = np.concatenate([np.zeros((1, found.shape[1])), np.cumsum(found, axis=0)])
        over = (sums[OFFSETS_PER_BLOCK:] - sums[:-OFFSETS_PER_BLOCK]) / OFFSETS_PER_BLOCK
        for shift in range(shifts):
            model = over[shift::OFFSETS_PER_BLOCK][: len(means)]
            cost[i, :, shift] = np.cumsum(np.sum(((means - model) / sigma) ** 2, axis=1))[ends]
    best = np.argmin(np.where(np.isfinite(cost), cost, np.inf), axis=-1)
    return np.minimum(step * best, high - low) / float(mine.offset_unit)


def periods_aside(
    problem: Problem, k: int, bounds: tuple[float, float], x: np.ndarray
) -> tuple[list[np.ndarray], float]:
    """Points like `x` with the offset of recording k changed by whole periods, where the bounds allow it; and half a period.

    A vibration is similar to itself a period later, so these may be better minima.
    """
    place, mine = problem.places[k].start, problem.misfits[k]
    assert isinstance(mine, KickMisfit)
    unit = float(mine.offset_unit)
    period = _period(problem, x[: problem.size]) / unit
    shifted = np.tile(x, (len(WHOLE_PERIODS), 1))
    shifted[:, place] += period * np.array(WHOLE_PERIODS)
    offsets = bounds[0] + unit * shifted[:, place]
    return list(shifted[(bounds[0] <= offsets) & (offsets <= bounds[1])]), 0.5 * period


@compiled
def _responses(problem: Problem, which: int, u: Float[Array, " k"], sampled: Sampled, begin: Float[Array, ""]):
    mine = problem.misfits[which]
    return mine.response(problem.at(u), (begin, None), sampled).means


def _period(problem: Problem, u: Float[np.ndarray, " k"]) -> float:
    """The period of the least damped mode of steady sliding, s; 0 if none vibrates."""
    (matrix,) = state_matrices(problem.parameters, problem.scene, jnp.asarray(u[None]))
    eigenvalues = np.linalg.eigvals(np.asarray(matrix))
    vibrating = eigenvalues[eigenvalues.imag > 0]
    return 2 * np.pi / float(vibrating[np.argmax(vibrating.real)].imag) if len(vibrating) else 0.0
