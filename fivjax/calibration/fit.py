r"""Parameters of a scene from recordings, with uncertainties.

Least squares in stages, so that no start ends a period beside the truth:

1. from several starts at once, features: poles and shapes of small motions, fundamentals of limit cycles (`misfit`);
2. for a kick at an unknown instant, the time offsets at which the responses found so far agree with the recording;
3. waveforms over windows that grow, and all harmonics of limit cycles, from the best few;
4. once the noise is known from what is left, the last fit again.

Every stage (`stages`) is a Levenberg–Marquardt minimisation with forward-mode Jacobians, exact through contact events, all
starts in one batch. The covariance is $(J^T J)^{-1}$ at the end, J the Jacobian of the residuals in units of the
noise. Its singular values say which combinations of parameters the data tell: a parameter whose standard deviation
exceeds a stated share of itself is reported as *not identifiable*, not as a number.
"""

import enum
from collections.abc import Iterable, Mapping, Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import xarray as xr
from jaxtyping import Array, Bool, Float
from tqdm.auto import tqdm

from ..foundation import arguments
from ..foundation.compiling import compiled
from ..foundation.precision import in_double_precision
from ..io.datasets import labelled
from ..io.recordings import Averaged, Recording, averaged
from ..linear.linearisation import linear_sliding
from ..model.scene import Scene, sliding_equilibrium
from ..steppers.base import AbstractStepper
from ..steppers.event_exact import EventExact
from .cycle_misfit import BEATS, CycleMisfit, cycle_misfit, cycle_rate
from .misfit import OFFSET_UNIT, misfit
from .parameters import FreeParameters
from .stages import Problem, Stages
from .starts import hypercube, vibrating

# Scenes looked at for one that vibrates much as the limit cycle that was measured.
SCREENED = 32
# Blocks per period of the highest sliding mode of the scene that the fit starts from.
BLOCKS_PER_PERIOD = 16
# A signal counts if it carries more than so much energy per fitted number, in units of the noise.
SIGNIFICANT = 25.0
# Residuals this much alike from one block to the next are not noise.
STRUCTURE = 0.25
# Disturbances of a cycle that grow by more than this a period: it would not last.
UNSTABLE = 1.001


class Outcome(enum.StrEnum):
    """How a calibration ended, as a sentence."""

    CONVERGED = "converged"
    NOT_CONVERGED = "not converged: the last fit ran out of steps; start closer, free fewer parameters or set bounds"
    NO_SIGNAL = "no signal: what was recorded does not stand out of the noise, so it tells nothing about the parameters"
    BEATS = (
        "not fitted: a recording of a limit cycle does not repeat, it beats or has not settled, so it has no harmonics to "
        "compare; record it later or with a slower belt, or record how it starts, as a kick or as sliding"
    )
    UNSTABLE = (
        "not stable: the limit cycle that fits best would not last in this scene, so it is not what was measured; start "
        "closer, or free what differs from the scene"
    )
    STRUCTURE_LEFT = "converged, but what is left is not noise: the scene cannot explain all of the recording"


# Outcomes that end at a minimum; of the others no parameter is told.
FITTED = (Outcome.CONVERGED, Outcome.STRUCTURE_LEFT)


class Calibration(eqx.Module):
    """A fitted scene, and how far to trust it.

    Parameters that the data do not tell have NaN as value and uncertainty; the scene holds what the fit ended with.
    """

    scene: Scene
    names: tuple[str, ...] = eqx.field(static=True)
    estimates: Float[np.ndarray, " k"]  # all of them, also those that are not identifiable
    deviations: Float[np.ndarray, " k"]  # standard deviations, in the parameters' own units
    identified: Bool[np.ndarray, " k"]
    correlation: Float[np.ndarray, "k k"]
    singular_values: Float[
        np.ndarray, " j"
    ]  # of the Jacobian in units of noise per whole parameter; time offsets included
    offsets: tuple[tuple[float, float] | None, ...]  # value and standard deviation, s; None where there is none
    recordings: tuple[Recording, ...]
    t: tuple[np.ndarray, ...]  # middle of the blocks, s after the recording's first sample
    measured: tuple[np.ndarray, ...]  # block means, (B, k)
    fitted: tuple[np.ndarray, ...]
    noise: tuple[np.ndarray, ...]  # standard deviation of a block mean, by channel
    misfit: float  # sum of squared residuals per degree of freedom; 1 where only noise is left
    steps: int
    outcome: Outcome = eqx.field(static=True)

    @property
    def converged(self) -> bool:
        """Whether the optimiser arrived."""
        return self.outcome in FITTED

    @property
    def values(self) -> dict[str, float]:
        """The parameters, NaN where they are not identifiable, and all of them where no fit was found."""
        return self._by_name(self.estimates)

    @property
    def uncertainty(self) -> dict[str, float]:
        """Their standard deviations, NaN where they are not identifiable."""
        return self._by_name(self.deviations)

    @property
    def identifiable(self) -> dict[str, bool]:
        """Whether the data tell each parameter."""
        return dict(zip(self.names, map(bool, self.identified), strict=True))

    @property
    def residuals(self) -> tuple[np.ndarray, ...]:
        """Measured less fitted block means, by recording."""
        return tuple(m - f for m, f in zip(self.measured, self.fitted, strict=True))

    @property
    def untold(self) -> str:
        """What stands in place of a parameter without a value."""
        return "not identifiable" if self.converged or self.outcome is Outcome.NO_SIGNAL else "not told"

    def _by_name(self, array):
        return {
            name: float(value) if told else float("nan")
            for name, value, told in zip(self.names, array, self.identified, strict=True)
        }

    def __str__(self) -> str:
        said = [f"{self.outcome}; misfit {self.misfit:.3g} per degree of freedom"]
        for name in self.names:
            if self.identifiable[name]:
                said.append(f"  {name:<12}{self.values[name]:>14.6g} ± {self.uncertainty[name]:.2g}")
            else:
                said.append(f"  {name:<12}{self.untold:>16}")
        for k, offset in enumerate(self.offsets):
            if offset is not None:
                said.append(f"  offset of recording {k}: {offset[0]:.6g} ± {offset[1]:.2g} s")
        return "\n".join(said)

    def to_dataset(self) -> xr.Dataset:
        """Parameters with uncertainties, and data and fit of recording r over `t_r` and `channel_r`."""
        dataset = xr.Dataset(
            {
                "value": ("parameter", np.array(list(self.values.values()))),
                "uncertainty": ("parameter", np.array(list(self.uncertainty.values()))),
                "identifiable": ("parameter", self.identified),
                "estimate": ("parameter", self.estimates),
                "correlation": (("parameter", "other"), self.correlation),
                "singular_value": ("direction", self.singular_values),
            },
            coords={"parameter": list(self.names), "other": list(self.names)},
        )
        for k, recording in enumerate(self.recordings):
            dims = (f"t_{k}", f"channel_{k}")
            dataset[f"measured_{k}"] = (dims, self.measured[k])
            dataset[f"fitted_{k}"] = (dims, self.fitted[k])
            dataset = dataset.assign_coords(
                {dims[0]: self.t[k], dims[1]: [str(channel) for channel in recording.channels]}
            )
            dataset[f"measured_{k}"].attrs["regime"] = recording.regime
        dataset = labelled(dataset, self.scene)
        dataset.attrs.update(outcome=str(self.outcome), misfit=self.misfit)
        return dataset


@in_double_precision
def calibrate(
    scene: Scene,
    data: Recording | Sequence[Recording],
    free: Iterable[str],
    bounds: Mapping[str, tuple[float, float]] | None = None,
    *,
    starts: int = 8,
    spread: float = 0.3,
    seed: int = 0,
    rate: float | None = None,
    identifiable_within: float = 0.3,
    method: AbstractStepper | None = None,
    progress: bool = True,
) -> Calibration:
    """Parameters of a scene from one or several recordings.

        fit = fj.calibrate(scene, fj.Recording(t, {"acceleration 0": a}, "kick"), free=["mu", "c1", "k1"])
        print(fit)

    **Arguments:**

    - `scene`: what was measured, with a first guess of the free parameters; what is not free is taken as known.
    - `data`: a `Recording`, or several with what is known of each run.
    - `free`: names of parameters, any of `scene.parameters`.
    - `bounds`: pairs by name. Unless given, a parameter is kept positive (`theta` and `belt_speed` may be anything).
    - `starts`: how many, the scene's own first, the others within `spread` (relative) around it, drawn with `seed`; for
      limit cycles 32 at least, with sliding modes at the measured frequency.
    - `rate`: blocks per second that recordings are averaged over before they are compared; 16 per period of the scene's
      highest sliding mode unless given, 28 to 48 per period of a limit cycle. The model is averaged over the
      same blocks, exactly.
    - `identifiable_within`: the largest standard deviation, relative to the parameter, that still counts as knowing it.
    - `method`: how to step, `EventExact()` unless given. Gradients of `WhereSwitched` are wrong after contact events.

    **Returns:** a `Calibration`. Uncertainties are standard deviations for noise that is white and equal within a channel,
    estimated from the residuals unless the recording states it.

    **Raises:** `ValueError` or `TypeError`, as a sentence, for names, bounds or channels that do not fit the scene.
    """
    arguments.instance("scene", scene, Scene, "a Scene")
    recordings = (data,) if isinstance(data, Recording) else tuple(data) if isinstance(data, list | tuple) else data
    if not isinstance(recordings, tuple) or not recordings:
        raise TypeError(f"Argument `data` must be a Recording or a list of them, but is {arguments.describe(data)}.")
    for k, recording in enumerate(recordings):
        arguments.instance(f"data[{k}]", recording, Recording, "a Recording")
        _check_recording(scene, recording, k)
    parameters = FreeParameters(scene, free, bounds)
    for k, recording in enumerate(recordings):
        both = [name for name in parameters.names if name in recording.known]
        if both:
            raise ValueError(
                f"Parameter `{both[0]}` is free, but recording {k} states it as known. Drop one of the two."
            )
    if isinstance(starts, bool) or not isinstance(starts, int | np.integer) or starts < 1:
        raise ValueError(f"Argument `starts` must be a whole number of at least 1, but is {starts!r}.")
    arguments.real_number("spread", spread, above=0, maximum=0.9)
    arguments.real_number("identifiable_within", identifiable_within, above=0)
    method = EventExact() if method is None else method
    arguments.instance("method", method, AbstractStepper, "a stepper, such as EventExact()")
    if rate is not None:
        arguments.real_number("rate", rate, above=0)

    blocks = []
    for k, recording in enumerate(recordings):
        own = _rate(scene, recording) if rate is None else rate
        if round(recording.rate / own) > len(recording.t):
            raise ValueError(
                f"Recording {k} is too short: not one block at {own:g} per second. Raise `rate`, or record for longer."
            )
        blocks.append(averaged(recording, own))
    for k, block in enumerate(blocks):
        if len(block.means) < 2 * len(parameters.names) + 8:
            raise ValueError(
                f"Recording {k} is too short: {len(block.means)} blocks at {1 / np.diff(block.edges[:2])[0]:g} per second for "
                f"{len(parameters.names)} parameters. Raise `rate`, or record for longer."
            )
    moved = tuple(r.regime == "kick" and r.offset[0] < r.offset[1] for r in recordings)
    references = jnp.array([r.offset[0] for r in recordings])
    cycles = all(r.regime == "limit cycle" for r in recordings)
    kicked = any(r.regime == "kick" for r in recordings)
    # A response to a kick is first taken to slide throughout, which is quick to try and checked afterwards.
    for uneventful in (True, False) if kicked and scene.friction.constant else (False,):
        misfits = tuple(
            cycle_misfit(r, b, method, scene) if r.regime == "limit cycle" else misfit(r, b, method, scene, uneventful)
            for r, b in zip(recordings, blocks, strict=True)
        )
        problem = Problem(scene, parameters, misfits, references, moved)
        if any(cycle.beating > BEATS for cycle in problem.cycles):
            return _not_tried(problem, recordings, blocks, Outcome.BEATS)
        if cycles:
            frequencies = [float(cycle.frequency) for cycle in problem.cycles]
            begins = vibrating(parameters, scene, frequencies, max(int(starts), SCREENED), float(spread), seed)
        else:
            begins = hypercube(parameters, scene, int(starts), float(spread), seed)
        stages = Stages(problem, begins, recordings)
        with tqdm(total=stages.count, desc="calibrate", disable=None if progress else True) as bar:
            for stage in stages.run():
                bar.set_postfix_str(stage)
                bar.update()
        result = _result(stages, blocks, float(identifiable_within))
        # Noise alone is not explained any better by contact events.
        if not uneventful or result.outcome is Outcome.NO_SIGNAL:
            break
        if result.outcome is not Outcome.STRUCTURE_LEFT and stages.slid_throughout():
            break
    return result


def _result(stages: Stages, blocks, identifiable_within: float) -> Calibration:
    problem, best, size = stages.problem, stages.best, stages.problem.size
    # Without the rows of the leash, which is let go by then.
    found, jacobian = best.residual[:-size], best.jacobian[:-size]
    u = jnp.asarray(best.x[:size])
    estimates, slope = map(np.asarray, _values_and_slopes(problem.parameters, u))
    # In whole parameters, so that singular values compare: a change of 100 %, or of a millisecond of offset.
    whole = np.where(estimates == 0, problem.parameters.size, np.abs(estimates))
    scales = np.concatenate([whole / slope, np.ones(len(best.x) - size)])
    deviations, correlation, singular = _covariance(jacobian * scales)
    means = [np.asarray(block.means)[: len(model)] for block, model in zip(blocks, best.models, strict=True)]
    signal = _stands_out(stages)
    freedom = max(len(found) - len(best.x) - sum(m.fitted_by_elimination for m in problem.misfits), 1)
    misfit = float(found @ found) / freedom
    if not signal:
        outcome = Outcome.NO_SIGNAL
    elif not best.arrived:
        outcome = Outcome.NOT_CONVERGED
    elif best.growth > UNSTABLE:
        outcome = Outcome.UNSTABLE
    elif _structure_left(stages, means, misfit):
        outcome = Outcome.STRUCTURE_LEFT
    else:
        outcome = Outcome.CONVERGED
    offsets, at = [], size
    for moved, offset in zip(problem.moved, problem.offsets(best.x), strict=True):
        offsets.append((float(offset), float(OFFSET_UNIT * deviations[at])) if moved else None)
        at += moved
    return Calibration(
        scene=problem.at(u),
        names=problem.parameters.names,
        estimates=estimates,
        deviations=deviations[:size] * whole,
        # Deviations are those about a minimum; elsewhere they would promise what nobody has found.
        identified=(deviations[:size] <= identifiable_within) & (outcome in FITTED),
        correlation=correlation[:size, :size],
        singular_values=singular,
        offsets=tuple(offsets),
        recordings=stages.recordings,
        t=tuple(_middles(block)[: len(model)] for block, model in zip(blocks, best.models, strict=True)),
        measured=tuple(means),
        fitted=tuple(best.models),
        noise=tuple(np.asarray(m.sigma) for m in problem.misfits),
        misfit=misfit,
        steps=stages.steps,
        outcome=outcome,
    )


def _not_tried(problem: Problem, recordings, blocks, outcome: Outcome) -> Calibration:
    """The result of a fit that would mean nothing: no parameter is told."""
    size = problem.size
    return Calibration(
        scene=problem.scene,
        names=problem.parameters.names,
        estimates=np.array([float(problem.scene.parameters[name]) for name in problem.parameters.names]),
        deviations=np.full(size, np.inf),
        identified=np.zeros(size, bool),
        correlation=np.eye(size),
        singular_values=np.zeros(size + sum(problem.moved)),
        offsets=tuple((float("nan"), float("inf")) if moved else None for moved in problem.moved),
        recordings=recordings,
        t=tuple(_middles(block) for block in blocks),
        measured=tuple(block.means for block in blocks),
        fitted=tuple(np.full_like(block.means, np.nan) for block in blocks),
        noise=tuple(np.asarray(m.sigma) for m in problem.misfits),
        misfit=float("nan"),
        steps=0,
        outcome=outcome,
    )


def _middles(block: Averaged) -> np.ndarray:
    return 0.5 * (block.edges[1:] + block.edges[:-1])


def _stands_out(stages: Stages) -> bool:
    """Whether any recording explains more energy than fitting noise would."""
    for mine, model in zip(stages.problem.misfits, stages.best.models, strict=True):
        if isinstance(mine, CycleMisfit):
            measured = np.asarray(mine.whitening @ mine.measured)
            explained = float(measured @ measured)
        else:
            means, sigma = np.asarray(mine.means), np.asarray(mine.sigma)
            explained = np.sum((means / sigma) ** 2) - np.sum(((means - model) / sigma) ** 2)
        if explained > SIGNIFICANT * (len(stages.best.x) + mine.fitted_by_elimination):
            return True
    return False


def _structure_left(stages: Stages, means, misfit: float) -> bool:
    misfits = stages.problem.misfits
    for mine, measured, model in zip(misfits, means, stages.best.models, strict=True):
        if isinstance(mine, CycleMisfit):
            continue
        left = measured - model
        alike = np.sum(left[1:] * left[:-1], axis=0) / np.maximum(np.sum(left**2, axis=0), 1e-300)
        if np.any(np.abs(alike) > STRUCTURE):
            return True
    # With a stated noise, or features of known error, the size of what is left says it as well.
    pairs = zip(stages.recordings, misfits, strict=True)
    stated = any(r.noise is not None or isinstance(m, CycleMisfit) for r, m in pairs)
    return stated and misfit > 2.0


@compiled
def _values_and_slopes(parameters: FreeParameters, u: Float[Array, " k"]):
    return parameters.values(u), jnp.diagonal(jax.jacfwd(parameters.values)(u))


def _covariance(jacobian: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Standard deviations, correlations and singular values; infinite deviations along directions that change nothing."""
    _, singular, directions = np.linalg.svd(jacobian, full_matrices=False)
    # What is below rounding is nothing. Parameters with no share in such a direction keep their own deviation.
    told = np.maximum(singular, max(1e-12 * singular[0], 1e-100))
    shares = np.where(np.abs(directions) < 1e-9, 0.0, directions)
    covariance = (shares / told[:, None] ** 2).T @ shares
    deviations = np.sqrt(np.diagonal(covariance))
    with np.errstate(invalid="ignore", divide="ignore"):
        correlation = np.nan_to_num(covariance / np.outer(deviations, deviations))
    deviations = np.where(deviations > 1e9, np.inf, deviations)
    return deviations, correlation, singular


def _rate(scene: Scene, recording: Recording) -> float:
    """Blocks per second that tell what the scene can do."""
    frequencies = np.abs(np.linalg.eigvals(np.asarray(linear_sliding(scene).matrix)).imag) / (2 * np.pi)
    rate = BLOCKS_PER_PERIOD * float(frequencies.max())
    return cycle_rate(recording, scene) if recording.regime == "limit cycle" else rate


def _check_recording(scene: Scene, recording: Recording, k: int) -> None:
    for name in recording.known:
        if name not in scene.parameters:
            raise ValueError(
                f"Recording {k} states a parameter `{name}` that the scene does not have; it has: "
                f"{', '.join(sorted(scene.parameters))}."
            )
    n, normal = scene.structure.size, scene.structure.normal
    for channel in recording.channels:
        if channel.coordinate >= n:
            raise ValueError(
                f"Recording {k} has a channel `{channel}`, but the structure's coordinates are 0 to {n - 1}."
            )
        if recording.regime == "sliding" and channel.coordinate == normal:
            raise ValueError(
                f"Recording {k} has a channel `{channel}`: the normal coordinate does not move while sliding."
            )
    sliding_equilibrium(scene.replace(**recording.known))
