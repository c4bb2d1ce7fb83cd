"""The result of a search: uncertainties, which parameters are identifiable, and whether the model fits."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..foundation.compiling import compiled
from ..io.recordings import Averaged
from .covariance import covariance_of
from .cycle_misfit import CycleMisfit
from .goodness_of_fit import WhatIsLeft, exceeds_noise, what_is_left
from .misfit import OFFSET_UNIT
from .parameters import FreeParameters
from .problem import Problem
from .result import FITTED, Calibration, FitOutcome
from .search import Search

# There is a signal if a fit explains more than this energy per fitted number, in units of the noise variance.
SIGNIFICANT = 25.0
# A model does not fit if it leaves more than this share of the signal's energy.
MOST_LEFT = 0.1
# A cycle whose disturbances grow by more than this factor in a period is unstable.
UNSTABLE = 1.001


def concluded(search: Search, blocks: list[Averaged], identifiable_within: float) -> Calibration:
    """The result of a search."""
    problem, best, size = search.problem, search.best, search.problem.size
    # Without the rows of the regularisation, which is no longer active.
    found, jacobian = best.at.residual[:-size], best.at.jacobian[:-size]
    u = jnp.asarray(best.x[:size])
    estimates, slope = map(np.asarray, _values_and_slopes(problem.parameters, u))
    # Relative to the parameters, so that singular values are comparable: a change of 100 %, or of one millisecond of offset.
    whole = np.where(estimates == 0, problem.parameters.size, np.abs(estimates))
    scales = np.concatenate([whole / slope, np.ones(len(best.x) - size)])
    deviations, correlation, singular = covariance_of(jacobian * scales)
    models = [np.asarray(model) for model in best.at.about.models]
    means = [np.asarray(block.means)[: len(model)] for block, model in zip(blocks, models, strict=True)]
    left = _left(search, found, means, models)
    outcome = _outcome(search, left, means, models, found)
    identified = (deviations[:size] <= identifiable_within) & (outcome in FITTED)
    if outcome is not FitOutcome.CONVERGED:
        # Standard deviations hold for a right model at a minimum; elsewhere they are unknown.
        deviations = np.full_like(deviations, np.inf)
    elif left.smaller:
        # The estimated noise was larger than the residuals, so it is reduced to their size.
        deviations = deviations * np.sqrt(left.misfit)
    offsets, at = [], size
    for moved, offset in zip(problem.moved, problem.offsets(best.x), strict=True):
        offsets.append((float(offset), float(OFFSET_UNIT * deviations[at])) if moved else None)
        at += moved
    return Calibration(
        scene=problem.at(u),
        names=problem.parameters.names,
        estimates=estimates,
        deviations=deviations[:size] * whole,
        identified=identified,
        correlation=correlation[:size, :size],
        singular_values=singular,
        offsets=tuple(offsets),
        recordings=search.recordings,
        t=tuple(_middles(block)[: len(model)] for block, model in zip(blocks, models, strict=True)),
        measured=tuple(means),
        fitted=tuple(models),
        noise=tuple(np.asarray(m.sigma) for m in problem.misfits),
        left=left,
        evaluations=search.evaluations,
        outcome=outcome,
    )


def not_tried(problem: Problem, recordings, blocks: list[Averaged], outcome: FitOutcome) -> Calibration:
    """The result where a fit would make no sense: no parameter has a value."""
    size, nan = problem.size, float("nan")
    return Calibration(
        scene=problem.scene,
        names=problem.parameters.names,
        estimates=np.array([float(problem.scene.parameters[name]) for name in problem.parameters.names]),
        deviations=np.full(size, np.inf),
        identified=np.zeros(size, bool),
        correlation=np.eye(size),
        singular_values=np.zeros(size + sum(problem.moved)),
        offsets=tuple((nan, np.inf) if moved else None for moved in problem.moved),
        recordings=recordings,
        t=tuple(_middles(block) for block in blocks),
        measured=tuple(block.means for block in blocks),
        fitted=tuple(np.full_like(block.means, np.nan) for block in blocks),
        noise=tuple(np.asarray(m.sigma) for m in problem.misfits),
        left=WhatIsLeft(nan, False, False, nan, False),
        evaluations=0,
        outcome=outcome,
    )


def _outcome(search: Search, left: WhatIsLeft, means, models, found) -> FitOutcome:
    if not _has_signal(search, means, models):
        return FitOutcome.NO_SIGNAL
    if np.isfinite(search.best.at.cost) and not left.is_noise and _share_left(search, means, models) > MOST_LEFT:
        return FitOutcome.DOES_NOT_FIT
    if not search.best.arrived:
        return FitOutcome.NOT_CONVERGED
    if search.growth > UNSTABLE:
        return FitOutcome.UNSTABLE
    return FitOutcome.CONVERGED if left.is_noise else FitOutcome.STRUCTURE_LEFT


def _left(search: Search, found: np.ndarray, means, models) -> WhatIsLeft:
    misfits = search.problem.misfits
    freedom = max(len(found) - len(search.best.x) - sum(m.projected for m in misfits), 1)
    # A limit cycle is compared by its first harmonics, so its waveform has all higher ones as residuals: left out here.
    pairs = zip(misfits, means, models, strict=True)
    waveforms = [
        (measured - model) / np.asarray(m.sigma) for m, measured, model in pairs if not isinstance(m, CycleMisfit)
    ]
    stated = all(r.noise is not None for r in search.recordings)
    with np.errstate(invalid="ignore", over="ignore"):
        return what_is_left(float(found @ found), freedom, waveforms, stated)


def _has_signal(search: Search, means, models) -> bool:
    """Whether any recording has more than noise in it, or a fit explains more energy than fitting noise would."""
    for mine, measured, model in zip(search.problem.misfits, means, models, strict=True):
        if isinstance(mine, CycleMisfit):
            scaled = np.asarray(mine.whitening @ mine.measured)
            measured, explained = np.asarray(mine.means), float(scaled @ scaled)
        else:
            sigma = np.asarray(mine.sigma)
            explained = np.sum((measured / sigma) ** 2) - np.sum(((measured - model) / sigma) ** 2)
        if explained > SIGNIFICANT * (len(search.best.x) + mine.projected):
            return True
        if exceeds_noise(measured, np.asarray(mine.sigma)):
            return True
    return False


def _share_left(search: Search, means, models) -> float:
    """The share of the signal's energy (without that of the noise) that the fit leaves, for the recording with the largest."""
    shares = [0.0]
    for mine, measured, model in zip(search.problem.misfits, means, models, strict=True):
        sigma = np.asarray(mine.sigma)
        noise = 0.0
        if isinstance(mine, CycleMisfit):
            # Only the fitted harmonics count as signal.
            measured = np.asarray(mine.harmonic_part)
        else:
            noise = measured.shape[0] * measured.shape[1]
        energy, left = (np.sum((part / sigma) ** 2) - noise for part in (measured, measured - model))
        shares.append(left / energy if energy > 0 else 0.0)
    return float(max(shares))


def _middles(block: Averaged) -> np.ndarray:
    return 0.5 * (block.edges[1:] + block.edges[:-1])


@compiled
def _values_and_slopes(parameters: FreeParameters, u: Float[Array, " k"]):
    return parameters.values(u), jnp.diagonal(jax.jacfwd(parameters.values)(u))
