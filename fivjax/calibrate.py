r"""Parameters of a scene from recordings, with uncertainties.

Least squares in stages, so that no start ends a period beside the truth:

1. from several starts at once, features: poles and shapes of small motions, fundamentals of limit cycles (`misfit`);
2. for a kick at an unknown instant, the time offsets at which the responses found so far agree with the recording;
3. waveforms over windows that grow, and all harmonics of limit cycles, from the best few;
4. once the noise is known from what is left, the last fit again.

Every stage is a Levenberg–Marquardt minimisation by optimistix with forward-mode Jacobians, exact through contact events,
all starts in one batch. The covariance is $(J^T J)^{-1}$ at the end, J the Jacobian of the residuals in units of the
noise. Its singular values say which combinations of parameters the data tell: a parameter whose standard deviation
exceeds a stated share of itself is reported as *not identifiable*, not as a number.
"""

import enum
from collections.abc import Iterable, Mapping, Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
import xarray as xr
from jaxtyping import Array, Bool, Float, Int
from tqdm.auto import tqdm

from . import arguments
from .event_exact import EventExact
from .misfit import OFFSET_UNIT, AbstractMisfit, CycleMisfit, KickMisfit, cycle_rate, misfit
from .parameters import FreeParameters
from .precision import in_double_precision
from .results import labelled
from .scene import Scene, sliding_equilibrium
from .signals import Recording, averaged
from .sliding import linear_sliding
from .steppers import AbstractStepper

# Scenes looked at, without derivatives, for one that vibrates much as the limit cycle that was measured.
SCREENED = 32
# Blocks per period of the highest sliding mode of the scene that the fit starts from.
BLOCKS_PER_PERIOD = 16
# Starts that go on from the features to the waveform; with time offsets to try, two with three each.
KEPT = 4
KEPT_WITH_OFFSETS = 6
WINDOWS = (0.15, 0.4, 1.0)
# Shares of the recording below this are far from the answer.
FAR = 1.0
# Where a fit stops: changes of every residual, in standard deviations of the noise, and of the parameters' logarithms.
EARLY_TOLERANCE, FINAL_TOLERANCE, ANY = 1e-2, 1e-5, 1e30
MOST_STEPS = 40
# How far the features may pull a parameter from its start, as a factor of e: what they do not tell stays where it was.
LEASH = 0.7
# A signal counts if it carries more than so much energy per fitted number, in units of the noise.
SIGNIFICANT = 25.0
# Residuals this much alike from one block to the next are not noise.
STRUCTURE = 0.25
OFFSETS_PER_BLOCK = 4


class Outcome(enum.StrEnum):
    """How a calibration ended, as a sentence."""

    CONVERGED = "converged"
    NOT_CONVERGED = "not converged: the last fit ran out of steps; start closer, free fewer parameters or set bounds"
    NO_SIGNAL = "no signal: what was recorded does not stand out of the noise, so it tells nothing about the parameters"
    STRUCTURE_LEFT = "converged, but what is left is not noise: the scene cannot explain all of the recording"


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
        return self.outcome in (Outcome.CONVERGED, Outcome.STRUCTURE_LEFT)

    @property
    def values(self) -> dict[str, float]:
        """The parameters, NaN where they are not identifiable."""
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
                said.append(f"  {name:<12}{'not identifiable':>16}")
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
    - `starts`: how many, the scene's own first, the others within `spread` (relative) around it, drawn with `seed`.
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
    begins = _starts(parameters, scene, max(int(starts), SCREENED) if cycles else int(starts), float(spread), seed)
    kicked = any(r.regime == "kick" for r in recordings)
    # A response to a kick is first taken to slide throughout, which is quick to try and checked afterwards.
    for uneventful in (True, False) if kicked and scene.friction.constant else (False,):
        misfits = tuple(misfit(r, b, method, scene, uneventful) for r, b in zip(recordings, blocks, strict=True))
        fit = _Fit(_Problem(scene, parameters, misfits, references, moved), begins, recordings)
        with tqdm(total=fit.stages, desc="calibrate", disable=None if progress else True) as bar:
            for stage in fit.run():
                bar.set_postfix_str(stage)
                bar.update()
        result = fit.result(blocks, float(identifiable_within))
        # Noise alone is not explained any better by contact events.
        if not uneventful or result.outcome is Outcome.NO_SIGNAL:
            break
        if result.outcome is not Outcome.STRUCTURE_LEFT and fit.slid_throughout():
            break
    return result


class _Problem(eqx.Module):
    """Everything that the residuals of one fit need; all but names and shapes are arrays, so it compiles once."""

    scene: Scene
    parameters: FreeParameters
    misfits: tuple[AbstractMisfit, ...]
    references: Float[Array, " r"]  # time offsets that the moved ones are measured from, s
    moved: tuple[bool, ...] = eqx.field(static=True)

    @property
    def size(self) -> int:
        return len(self.parameters.names)

    def offsets(self, x) -> list:
        """Time offsets of all recordings, in s."""
        found, at = [], self.size
        for k, moved in enumerate(self.moved):
            found.append(self.references[k] + OFFSET_UNIT * x[at] if moved else self.references[k])
            at += moved
        return found

    def coarse(self, u, u0):
        scene = self.parameters.scene(self.scene, u)
        return jnp.concatenate([*(m.coarse(scene) for m in self.misfits), (u - u0) / LEASH]), []

    def residual(self, x, x0, share):
        scene = self.parameters.scene(self.scene, x[: self.size])
        found = [m.residual(scene, offset, share) for m, offset in zip(self.misfits, self.offsets(x), strict=True)]
        # Far from the answer the features of a limit cycle alone may leave a parameter untold.
        leash = jnp.where(share < FAR, (x - x0)[: self.size] / LEASH, 0.0)
        return jnp.concatenate([*(residual for residual, _ in found), leash]), [model for _, model in found]


@eqx.filter_custom_jvp
def _coarse(u, problem: _Problem, u0):
    return problem.coarse(u, u0)


@_coarse.def_jvp
def _(primals, tangents):
    u, problem, u0 = primals
    found, models, along = _with_dense_jacobian(lambda u: problem.coarse(u, u0), u, tangents[0])
    return (found, models), (along, models)


@eqx.filter_custom_jvp
def _waveform(x, problem: _Problem, x0, share):
    return problem.residual(x, x0, share)


@_waveform.def_jvp
def _(primals, tangents):
    x, problem, x0, share = primals
    found, models, along = _with_dense_jacobian(lambda x: problem.residual(x, x0, share), x, tangents[0])
    # Models are looked at, not fitted.
    return (found, models), (along, jax.tree.map(jnp.zeros_like, models))


def _with_dense_jacobian(function, x, tangent):
    """Residuals, models, and the residuals' derivative along `tangent`, by way of the whole Jacobian.

    The optimiser linearises the residuals and applies that to each unit vector. Left to itself JAX would keep what a
    linearisation needs of every step of the simulation; pure forward mode keeps nothing, and compiles four times faster.
    """

    def twice(x):
        found, models = function(x)
        return found, (found, models)

    jacobian, (found, models) = jax.jacfwd(twice, has_aux=True)(x)
    return found, models, jacobian @ tangent


class _Minimum(eqx.Module):
    """Where a minimisation ended, with everything that is wanted there, so that nothing is computed or compiled anew."""

    x: Float[Array, " j"]
    cost: Float[Array, ""]
    residual: Float[Array, " r"]
    jacobian: Float[Array, "r j"]
    models: list[Float[Array, "B k"]]
    arrived: Bool[Array, ""]
    steps: Int[Array, ""]


def _minimise(function, start, *args, tolerance) -> _Minimum:
    def with_models(x, args):
        residual, models = function(x, *args)
        return residual, jax.lax.stop_gradient(models)

    solver = optx.LevenbergMarquardt(rtol=tolerance, atol=tolerance)
    solution = optx.least_squares(with_models, solver, start, args, has_aux=True, max_steps=MOST_STEPS, throw=False)
    there = solution.state.f_info
    return _Minimum(
        x=solution.value,
        cost=jnp.sum(there.residual**2),
        residual=there.residual,
        jacobian=there.jac.as_matrix(),
        models=solution.aux,
        arrived=solution.result == optx.RESULTS.successful,
        steps=solution.stats["num_steps"],
    )


@eqx.filter_jit
def _fit_features(problem: _Problem, starts: Float[Array, "s k"]):
    found = jax.vmap(lambda u0: _minimise(_coarse, u0, problem, u0, tolerance=1e-3))(starts)
    return found.x, found.cost, found.steps


@eqx.filter_jit
def _fit_waveform(problem: _Problem, starts: Float[Array, "s j"], share: Float[Array, ""], tolerance: Float[Array, ""]):
    return jax.vmap(lambda x0: _minimise(_waveform, x0, problem, x0, share, tolerance=tolerance))(starts)


@eqx.filter_jit
def _integrals(problem: _Problem, which: int, u: Float[Array, "s k"], instants: Float[Array, " b"], eventful=False):
    mine = problem.misfits[which]
    return jax.vmap(lambda u: mine.integrals(problem.parameters.scene(problem.scene, u), instants, eventful))(u)


class _Fit:
    """The stages, one after the other."""

    def __init__(self, problem: _Problem, starts: np.ndarray, recordings: tuple[Recording, ...]):
        self.problem, self.starts, self.recordings = problem, starts, recordings
        # Limit cycles have no window that grows: their features are compared first roughly, then to the noise.
        self.cycles = all(isinstance(m, CycleMisfit) for m in problem.misfits)
        self.windows = (WINDOWS[0], WINDOWS[-1]) if self.cycles else WINDOWS
        self.stages = len(self.windows) + 3
        self.steps = 0

    def run(self):
        """Yields the name of each stage before it begins."""
        yield "features"
        candidates = self._screened() if self.cycles else self._from_features()
        yield "time offsets"
        candidates = self._with_offsets(candidates)
        for share in self.windows:
            yield f"waveform, {100 * share:.0f} %"
            candidates = self._waveform(candidates, share, EARLY_TOLERANCE if share < FAR else FINAL_TOLERANCE)
        yield "noise and uncertainties"
        if self._estimate_noise():
            self._waveform(candidates[:1], 1.0, FINAL_TOLERANCE)

    def _screened(self) -> np.ndarray:
        """The starts that come closest to the limit cycles. Far off, a scene may have none, and no derivative leads there."""
        # A fit that may stop at once, so that nothing new is compiled.
        return self._waveform(self.starts, self.windows[0], ANY)

    def _from_features(self) -> np.ndarray:
        found, cost, steps = map(np.asarray, _fit_features(self.problem, jnp.asarray(self.starts)))
        self.steps += int(steps.max())
        best_first = found[np.argsort(np.where(np.isfinite(cost), cost, np.inf), kind="stable")]
        return _distinct(np.concatenate([best_first, self.starts]))[:KEPT]

    def _with_offsets(self, candidates: np.ndarray) -> np.ndarray:
        """The candidates with the time offsets at which each agrees best over all of the recording, or its beginning."""
        if not any(self.problem.moved):
            return candidates
        chosen = candidates[: KEPT_WITH_OFFSETS // len(WINDOWS)]
        offsets = np.stack(
            [self._offsets(k, chosen) for k, moved in enumerate(self.problem.moved) if moved], axis=-1
        )  # (candidate, window, recording)
        every = np.repeat(chosen[:, None, :], len(WINDOWS), axis=1)
        return np.concatenate([every, offsets], axis=-1).reshape(-1, chosen.shape[1] + offsets.shape[-1])

    def _offsets(self, k: int, chosen: np.ndarray) -> np.ndarray:
        """For each candidate and window the best offset of recording k, in units of the problem."""
        mine, (low, high) = self.problem.misfits[k], self.recordings[k].offset
        edges, means, sigma = map(np.asarray, (mine.edges, mine.means, mine.sigma))
        step = (edges[1] - edges[0]) / OFFSETS_PER_BLOCK
        shifts = int(np.ceil((high - low) / step)) + 1
        instants = low + edges[0] + step * np.arange(shifts + OFFSETS_PER_BLOCK * len(means))
        found = np.asarray(_integrals(self.problem, k, jnp.asarray(chosen), jnp.asarray(instants)))
        cost = np.empty((len(chosen), len(WINDOWS), shifts))
        ends = [max(1, int(share * len(means))) for share in WINDOWS[::-1]]
        for i, shift in np.ndindex(len(chosen), shifts):
            model = np.diff(found[i, shift::OFFSETS_PER_BLOCK][: len(edges)], axis=0) / (edges[1] - edges[0])
            squares = np.cumsum(np.sum(((means - model) / sigma) ** 2, axis=1))
            cost[i, :, shift] = squares[[end - 1 for end in ends]]
        best = np.argmin(np.where(np.isfinite(cost), cost, np.inf), axis=-1)
        return np.minimum(step * best, high - low) / OFFSET_UNIT

    def _waveform(self, candidates: np.ndarray, share: float, tolerance: float) -> np.ndarray:
        # Always as many at a time, so that it compiles once.
        count = KEPT_WITH_OFFSETS if any(self.problem.moved) else KEPT
        found = []
        for begin in range(0, len(candidates), count):
            padded = jnp.asarray(np.resize(candidates[begin : begin + count], (count, candidates.shape[1])))
            batch = _fit_waveform(self.problem, padded, jnp.asarray(share), jnp.asarray(tolerance))
            self.steps += int(batch.steps.max())
            found.append(jax.tree.map(np.asarray, batch))
        found = jax.tree.map(lambda *leaves: np.concatenate(leaves), *found)
        order = np.argsort(np.where(np.isfinite(found.cost), found.cost, np.inf), kind="stable")
        self.best = jax.tree.map(lambda leaf: leaf[order[0]], found)
        return found.x[order][:count]

    def _estimate_noise(self) -> bool:
        """Puts the noise that is left in place of the assumed one; whether that changed anything."""
        models = self.best.models
        changed = False
        for k, (recording, model) in enumerate(zip(self.recordings, models, strict=True)):
            mine = self.problem.misfits[k]
            if recording.noise is not None or isinstance(mine, CycleMisfit):
                continue
            left = np.asarray(mine.means) - np.asarray(model)
            # Every fitted number takes its share of the noise away with it; the amplitudes of a small motion count.
            free = len(self.best.x) / len(models) + (len(model) > 0) * mine.fitted_by_elimination
            sigma = np.sqrt(np.sum(left**2, axis=0) / max(len(left) - free / left.shape[1], 1.0))
            sigma = np.where(np.isfinite(sigma) & (sigma > 0), sigma, np.asarray(mine.sigma))
            self.problem = eqx.tree_at(lambda p, k=k: p.misfits[k].sigma, self.problem, jnp.asarray(sigma))
            changed = True
        return changed

    def result(self, blocks, identifiable_within: float) -> Calibration:
        problem, size = self.problem, self.problem.size
        # Without the rows of the leash, which is let go by then.
        found, jacobian, models = self.best.residual[:-size], self.best.jacobian[:-size], self.best.models
        u = jnp.asarray(self.best.x[:size])
        estimates, slope = map(np.asarray, _values_and_slopes(problem.parameters, u))
        # In whole parameters, so that singular values compare: a change of 100 %, or of a millisecond of offset.
        whole = np.where(estimates == 0, problem.parameters.size, np.abs(estimates))
        scales = np.concatenate([whole / slope, np.ones(len(self.best.x) - size)])
        deviations, correlation, singular = _covariance(jacobian * scales)
        means = [np.asarray(block.means)[: len(model)] for block, model in zip(blocks, models, strict=True)]
        signal = self._stands_out(models)
        identified = (deviations[:size] <= identifiable_within) & signal
        freedom = max(len(found) - len(self.best.x) - sum(m.fitted_by_elimination for m in problem.misfits), 1)
        misfit = float(found @ found) / freedom
        if not signal:
            outcome = Outcome.NO_SIGNAL
        elif not self.best.arrived:
            outcome = Outcome.NOT_CONVERGED
        elif self._structure_left(means, models, misfit):
            outcome = Outcome.STRUCTURE_LEFT
        else:
            outcome = Outcome.CONVERGED
        offsets, at = [], size
        for moved, offset in zip(problem.moved, problem.offsets(self.best.x), strict=True):
            offsets.append((float(offset), float(OFFSET_UNIT * deviations[at])) if moved else None)
            at += moved
        return Calibration(
            scene=problem.parameters.scene(problem.scene, u),
            names=problem.parameters.names,
            estimates=estimates,
            deviations=deviations[:size] * whole,
            identified=identified,
            correlation=correlation[:size, :size],
            singular_values=singular,
            offsets=tuple(offsets),
            recordings=self.recordings,
            t=tuple(0.5 * (b.edges[1:] + b.edges[:-1])[: len(m)] for b, m in zip(blocks, models, strict=True)),
            measured=tuple(means),
            fitted=tuple(models),
            noise=tuple(np.asarray(m.sigma) for m in problem.misfits),
            misfit=misfit,
            steps=self.steps,
            outcome=outcome,
        )

    def slid_throughout(self) -> bool:
        """Whether the fitted responses are the same when contact events are looked for."""
        problem = self.problem
        for k, mine in enumerate(problem.misfits):
            if isinstance(mine, KickMisfit):
                instants = mine.edges + problem.offsets(self.best.x)[k]
                u = jnp.asarray(self.best.x[None, : problem.size])
                width = float(mine.edges[1] - mine.edges[0])
                found = np.diff(np.asarray(_integrals(problem, k, u, instants, eventful=True))[0], axis=0) / width
                # Rounding of both ways; an event leaves a trace that is larger by far.
                if not np.allclose(found, self.best.models[k], rtol=0, atol=1e-6 * np.ptp(found)):
                    return False
        return True

    def _stands_out(self, models) -> bool:
        """Whether any recording explains more energy than fitting noise would."""
        for mine, model in zip(self.problem.misfits, models, strict=True):
            if isinstance(mine, CycleMisfit):
                measured = np.asarray(mine.whitening @ mine.measured)
                explained = float(measured @ measured)
            else:
                means, sigma = np.asarray(mine.means), np.asarray(mine.sigma)
                explained = np.sum((means / sigma) ** 2) - np.sum(((means - model) / sigma) ** 2)
            if explained > SIGNIFICANT * (len(self.best.x) + mine.fitted_by_elimination):
                return True
        return False

    def _structure_left(self, means, models, misfit: float) -> bool:
        for mine, measured, model in zip(self.problem.misfits, means, models, strict=True):
            if isinstance(mine, CycleMisfit):
                continue
            left = measured - model
            alike = np.sum(left[1:] * left[:-1], axis=0) / np.maximum(np.sum(left**2, axis=0), 1e-300)
            if np.any(np.abs(alike) > STRUCTURE):
                return True
        # With a stated noise, or features of known error, the size of what is left says it as well.
        pairs = zip(self.recordings, self.problem.misfits, strict=True)
        stated = any(r.noise is not None or isinstance(m, CycleMisfit) for r, m in pairs)
        return stated and misfit > 2.0


@eqx.filter_jit
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


def _distinct(candidates: np.ndarray) -> np.ndarray:
    """Without those that repeat one before them."""
    kept = []
    for candidate in candidates:
        if not any(np.allclose(candidate, other, atol=1e-2) for other in kept):
            kept.append(candidate)
    return np.array(kept)


def _rate(scene: Scene, recording: Recording) -> float:
    """Blocks per second that tell what the scene can do."""
    frequencies = np.abs(np.linalg.eigvals(np.asarray(linear_sliding(scene).matrix)).imag) / (2 * np.pi)
    rate = BLOCKS_PER_PERIOD * float(frequencies.max())
    return cycle_rate(recording, scene) if recording.regime == "limit cycle" else rate


def _starts(parameters: FreeParameters, scene: Scene, count: int, spread: float, seed: int) -> np.ndarray:
    """The scene's own values, then others around them: a Latin hypercube."""
    own = np.array([float(scene.parameters[name]) for name in parameters.names])
    rng = np.random.default_rng(seed)
    strata = np.stack([rng.permutation(count - 1) for _ in own], axis=1) + rng.random((count - 1, len(own)))
    factors = 1 + spread * (2 * strata / max(count - 1, 1) - 1)
    return np.array([parameters.unbounded(values) for values in (own, *(own * factors))])


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
