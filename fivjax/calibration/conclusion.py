"""The result of a search: uncertainties, which parameters are identifiable, and whether the model fits."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..foundation.compiling import compiled
from .covariance import covariance_of
from .cycle_misfit import CycleMisfit
from .goodness_of_fit import ROUNDING, ResidualTests, exceeds_noise, residual_tests
from .parameters import FreeParameters
from .problem import Problem
from .result import FITTED, Calibration, FitOutcome
from .search import LEAST_KEPT, FitSearch
from .waveform_misfit import KickMisfit

# A cycle whose disturbances grow by more than this factor in a period is unstable.
UNSTABLE = 1.001


def concluded(search: FitSearch, identifiable_within: float) -> Calibration:
    """The result of a search."""
    best, size = search.best, search.problem.size
    problem = search.problem.without(best.left_out)
    # Without the rows of the regularisation, which is no longer active.
    found, jacobian = best.at.residual[:-size], best.at.jacobian[:-size]
    u = jnp.asarray(best.x[:size])
    estimates, slope = map(np.asarray, _values_and_slopes(problem.parameters, u))
    # Relative to the parameters, so that singular values are comparable: a change of 100 %, or of one millisecond of offset.
    whole = np.where(estimates == 0, problem.parameters.size, np.abs(estimates))
    scales = np.concatenate([whole / slope, np.ones(len(best.x) - size)])
    deviations, correlation, singular = covariance_of(jacobian * scales)
    models = [np.asarray(model) for model in best.at.about.models]
    left = _left(search, problem, found, models)
    outcome = _outcome(search, problem, left, models)
    if outcome is FitOutcome.CONVERGED and (left.smaller or not _stated(search.recordings)):
        # The residuals are noise, and tell its size better than the estimate that was made before the fit.
        deviations = deviations * np.sqrt(max(left.misfit, ROUNDING))
    identified = (deviations[:size] <= identifiable_within) & (outcome in FITTED)
    if outcome is not FitOutcome.CONVERGED:
        # Standard deviations hold for a right model at a minimum; elsewhere they are unknown.
        deviations = np.full_like(deviations, np.inf)
    offsets: list = [None] * len(problem.misfits)
    for k in search.moved:
        place, mine = problem.places[k].start, problem.misfits[k]
        assert isinstance(mine, KickMisfit)
        offset = float(problem.own(best.x)[k][0])
        offsets[k] = (offset, float(mine.offset_unit * deviations[place]))
    return Calibration(
        scene=problem.at(u),
        names=problem.parameters.names,
        estimates=estimates,
        deviations=deviations[:size] * whole,
        identified=identified,
        correlation=correlation[:size, :size],
        singular_values=singular,
        offsets=tuple(offsets),
        fitted=tuple(models),
        **_of_recordings(problem, search.recordings),
        left=left,
        evaluations=search.evaluations,
        outcome=outcome,
    )


def not_tried(problem: Problem, recordings, outcome: FitOutcome) -> Calibration:
    """The result where a fit would make no sense: no parameter has a value."""
    size, nan = problem.size, float("nan")
    means = [np.asarray(m.means) for m in problem.misfits]
    return Calibration(
        scene=problem.scene,
        names=problem.parameters.names,
        estimates=np.array([float(problem.scene.parameters[name]) for name in problem.parameters.names]),
        deviations=np.full(size, np.inf),
        identified=np.zeros(size, bool),
        correlation=np.eye(size),
        singular_values=np.zeros(problem.places[-1].stop),
        offsets=(None,) * len(means),
        fitted=tuple(np.full_like(part, np.nan) for part in means),
        **_of_recordings(problem, recordings),
        left=ResidualTests(nan, False, False, nan, False),
        evaluations=0,
        outcome=outcome,
    )


def _of_recordings(problem: Problem, recordings) -> dict[str, Any]:
    """What a result says of its recordings; the noise is the standard deviation of a block's mean, by channel."""
    return {
        "recordings": recordings,
        "t": tuple(np.asarray(mine.t) for mine in problem.misfits),
        "measured": tuple(np.asarray(mine.means) for mine in problem.misfits),
        "noise": tuple(np.median(np.asarray(mine.sigma), axis=0) for mine in problem.misfits),
    }


def _stated(recordings) -> bool:
    return all(r.noise is not None for r in recordings)


def _outcome(search: FitSearch, problem: Problem, left: ResidualTests, models) -> FitOutcome:
    # A model does not fit if it leaves more than this share of the signal's energy.
    most_left = 0.1
    if not _has_signal(search, problem, models):
        return FitOutcome.NO_SIGNAL
    if any(np.mean(np.asarray(m.kept)) < LEAST_KEPT for m in problem.misfits):
        return FitOutcome.TOO_SLOW
    if problem.cycles and not np.isfinite(search.best.at.cost):
        return FitOutcome.NO_CYCLE
    if np.isfinite(search.best.at.cost) and not left.is_noise and _share_left(problem, models) > most_left:
        return FitOutcome.DOES_NOT_FIT
    if not search.best.arrived:
        return FitOutcome.NOT_CONVERGED
    if search.growth > UNSTABLE:
        return FitOutcome.UNSTABLE
    return FitOutcome.CONVERGED if left.is_noise else FitOutcome.STRUCTURE_LEFT


def _left(search: FitSearch, problem: Problem, found: np.ndarray, models) -> ResidualTests:
    freedom = max(problem.numbers - len(search.best.x) - sum(m.projected for m in problem.misfits), 1)
    waveforms = []
    for mine, model in zip(problem.misfits, models, strict=True):
        scaled = (np.asarray(mine.means) - model) / np.asarray(mine.sigma)
        waveforms.append([column[kept > 0] for column, kept in zip(scaled.T, np.asarray(mine.kept).T, strict=True)])
    with np.errstate(invalid="ignore", over="ignore"):
        return residual_tests(float(found @ found), int(freedom), waveforms, _stated(search.recordings))


def _has_signal(search: FitSearch, problem: Problem, models) -> bool:
    """Whether any recording has more than noise in it, or a fit explains more energy than fitting noise would."""
    # There is a signal if a fit explains more than this energy per fitted number, in units of the noise variance.
    significant = 25.0
    for mine, model in zip(problem.misfits, models, strict=True):
        measured, sigma = np.asarray(mine.means), np.asarray(mine.sigma)
        before = measured - measured.mean(axis=0) if isinstance(mine, CycleMisfit) else measured
        with np.errstate(over="ignore", invalid="ignore"):
            explained = np.sum((before / sigma) ** 2) - np.sum(((measured - model) / sigma) ** 2)
        if explained > significant * (len(search.best.x) + mine.projected):
            return True
        if exceeds_noise(measured, sigma):
            return True
    return False


def _share_left(problem: Problem, models) -> float:
    """The share of the signal's energy (without that of the noise) that the fit leaves, for the recording with the largest."""
    shares = [0.0]
    for mine, model in zip(problem.misfits, models, strict=True):
        measured, kept = np.asarray(mine.means), np.asarray(mine.kept)
        weight, noise = kept / np.asarray(mine.sigma), np.sum(kept)
        before = measured - measured.mean(axis=0) if isinstance(mine, CycleMisfit) else measured
        with np.errstate(over="ignore", invalid="ignore"):
            energy, left = (np.sum((weight * part) ** 2) - noise for part in (before, measured - model))
        shares.append(left / energy if energy > 0 else 0.0)
    return float(max(shares))


@compiled
def _values_and_slopes(parameters: FreeParameters, u: Float[Array, " k"]):
    return parameters.values(u), jnp.diagonal(jax.jacfwd(parameters.values)(u))
