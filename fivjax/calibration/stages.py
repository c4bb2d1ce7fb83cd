"""The stages of a calibration: from starts far off to the minimum, and everything that is wanted there.

What is compiled is one function of a batch of starts for each kind of residual (`_features`, `_compared`), with its whole
Jacobian in forward mode; optimistix moves the starts (`least_squares`). A limit cycle brings unknowns of its own, a state
on it and its period, and as many equations, that it closes. Newton's method solves them at every step, from where they
were at the last one, and the Jacobian follows them.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..contact import Contact, Status
from ..foundation.compiling import compiled
from ..io.recordings import Recording
from ..model.scene import Scene
from .cycle_misfit import CycleMisfit
from .least_squares import Evaluated, minimise
from .misfit import OFFSET_UNIT, AbstractMisfit, KickMisfit
from .parameters import FreeParameters
from .shooting import Cycle
from .starts import state_matrices

# Starts that go on from the features to the waveform; with time offsets to try, two with three each.
KEPT = 4
KEPT_WITH_OFFSETS = 6
WINDOWS = (0.15, 0.4, 1.0)
# Shares of the recording below this are far from the answer.
FAR = 1.0
# Where a fit stops: what is left along what the data tell, in standard deviations. Rounding of nearly parallel modes leaves
# a thousandth.
EARLY_TOLERANCE, FINAL_TOLERANCE = 0.1, 1e-2
MOST_STEPS = 60
# How far the features may pull a parameter from its start, as a factor of e: what they do not tell stays where it was.
LEASH = 0.7
OFFSETS_PER_BLOCK = 4
# Periods by which the time offset of what fits best is tried again, and how often it may move on from there.
WHOLE_PERIODS = (-2, -1, 1, 2)
MOST_ROUNDS = 4
# A cycle is closed when its next correction is this small, relative to its size: the one after that is rounding.
CLOSED = 1e-7
MOST_NEWTON_STEPS = 10


class Problem(eqx.Module):
    """Everything that the residuals of one fit need; all but names and shapes are arrays, so it compiles once."""

    scene: Scene
    parameters: FreeParameters
    misfits: tuple[AbstractMisfit, ...]
    references: Float[Array, " r"]  # time offsets that the moved ones are measured from, s
    moved: tuple[bool, ...] = eqx.field(static=True)

    @property
    def size(self) -> int:
        """How many parameters are free; unknown time offsets come after them."""
        return len(self.parameters.names)

    def offsets(self, x) -> list:
        """Time offsets of all recordings, in s."""
        found, at = [], self.size
        for k, moved in enumerate(self.moved):
            found.append(self.references[k] + OFFSET_UNIT * x[at] if moved else self.references[k])
            at += moved
        return found

    def at(self, u) -> Scene:
        """The scene with these parameters."""
        return self.parameters.scene(self.scene, u)

    @property
    def cycles(self) -> list[CycleMisfit]:
        return [m for m in self.misfits if isinstance(m, CycleMisfit)]


class Minimum(NamedTuple):
    """Where a fit ended."""

    x: Float[np.ndarray, " j"]
    residual: Float[np.ndarray, " r"]
    jacobian: Float[np.ndarray, "r j"]
    models: list[Float[np.ndarray, "B k"]]
    arrived: bool
    growth: float  # largest multiplier of the cycles, in a period; 0 without any


class Stages:
    """The stages, one after the other."""

    def __init__(self, problem: Problem, starts: np.ndarray, recordings: tuple[Recording, ...]):
        self.problem, self.starts, self.recordings = problem, starts, recordings
        # Limit cycles have no window that grows: their features are compared first roughly, then to the noise.
        self.cycles_only = len(problem.cycles) == len(problem.misfits)
        self.windows = (WINDOWS[0], WINDOWS[-1]) if self.cycles_only else WINDOWS
        self.count = len(self.windows) + 4
        self.steps = 0

    def run(self):
        """Yields the name of each stage before it begins."""
        yield "features"
        candidates = self._screened() if self.cycles_only else self._from_features()
        yield "time offsets"
        candidates = self._with_offsets(candidates)
        for share in self.windows:
            yield f"waveform, {100 * share:.0f} %"
            candidates = self._waveform(candidates, share, EARLY_TOLERANCE if share < FAR else FINAL_TOLERANCE)
        yield "whole periods"
        self._other_periods()
        yield "noise and uncertainties"
        if self._estimate_noise():
            self._waveform(self.best.x[None], 1.0, FINAL_TOLERANCE)

    def _screened(self) -> np.ndarray:
        """The starts that come closest to the limit cycles. Far off, a scene may have none, and no derivative leads there."""
        cost = []
        for batch in self._batches(self.starts):
            cost.append(_Comparison(self.problem, batch, self.windows[0])(batch, None).cost)
        return self.starts[np.argsort(np.concatenate(cost)[: len(self.starts)], kind="stable")][:KEPT]

    def _from_features(self) -> np.ndarray:
        starts = jnp.asarray(self.starts)

        def evaluate(u, _):
            residual, jacobian = map(np.asarray, _features(self.problem, jnp.asarray(u), starts))
            return Evaluated(residual, jacobian, None)

        found = minimise(evaluate, self.starts, None, EARLY_TOLERANCE, MOST_STEPS)
        self.steps += found.steps
        best_first = found.x[np.argsort(found.at.cost, kind="stable")]
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

    def _batches(self, candidates: np.ndarray):
        """Always as many at a time, so that it compiles once; the last batch repeats itself."""
        count = KEPT_WITH_OFFSETS if any(self.problem.moved) else KEPT
        for begin in range(0, len(candidates), count):
            yield np.resize(candidates[begin : begin + count], (count, candidates.shape[1]))

    def _waveform(self, candidates: np.ndarray, share: float, tolerance: float) -> np.ndarray:
        (batch,) = self._batches(candidates)
        found = minimise(_Comparison(self.problem, batch, share), batch, None, tolerance, MOST_STEPS)
        self.steps += found.steps
        order = np.argsort(found.at.cost, kind="stable")
        best = order[0]
        about = jax.tree.map(lambda leaf: leaf[best], found.at.about)
        structure = self.problem.scene.structure
        where = structure.size + structure.tangential
        growth = max((_growth(system, where) for system in about.systems), default=0.0)
        self.best = Minimum(
            x=found.x[best],
            residual=found.at.residual[best],
            jacobian=found.at.jacobian[best],
            models=about.models,
            arrived=bool(found.arrived[best]),
            growth=growth,
        )
        return _distinct(found.x[order])

    def _other_periods(self) -> None:
        """Whether the recordings fit better some periods earlier or later: a vibration is much like itself a period on."""
        problem = self.problem
        for k in np.flatnonzero(problem.moved):
            place = problem.size + int(np.sum(problem.moved[:k]))
            low, high = self.recordings[k].offset
            for _ in range(MOST_ROUNDS):
                x = self.best.x
                period = _period(problem, x[: problem.size]) / OFFSET_UNIT
                shifted = np.tile(x, (len(WHOLE_PERIODS), 1))
                shifted[:, place] += period * np.array(WHOLE_PERIODS)
                offsets = problem.references[k] + OFFSET_UNIT * shifted[:, place]
                # The best one stays among them, so it never gets worse.
                tried = np.concatenate([x[None], shifted[(low <= offsets) & (offsets <= high)]])
                self._waveform(tried, 1.0, FINAL_TOLERANCE)
                if abs(self.best.x[place] - x[place]) <= 0.5 * period:
                    break

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


class _Comparison:
    """Scenes beside the first `share` of the recordings, for a batch of points that set out at x0."""

    def __init__(self, problem: Problem, x0: np.ndarray, share: float):
        self.problem, self.x0, self.share = problem, jnp.asarray(x0), jnp.asarray(share)

    def __call__(self, x: np.ndarray, about: "_About | None") -> Evaluated:
        problem, points = self.problem, jnp.asarray(x)
        if about is None:
            cycles = _settled(problem, points) if problem.cycles else ()
        else:
            cycles = _predicted(problem, points, jax.tree.map(jnp.asarray, about))
        for _ in range(MOST_NEWTON_STEPS):
            found = _compared(problem, points, self.x0, self.share, cycles)
            cycles = found.about.cycles
            closed = np.asarray(found.correction) <= CLOSED
            # What is not finite will not close any more.
            if np.all(closed | ~np.isfinite(found.correction)):
                break
        residual, jacobian, about = jax.tree.map(np.asarray, (found.residual, found.jacobian, found.about))
        good = closed & np.all(np.isfinite(residual), axis=1) & np.all(np.isfinite(jacobian), axis=(1, 2))
        return Evaluated(np.where(good[:, None], residual, np.inf), np.where(good[:, None, None], jacobian, 0.0), about)


class _About(NamedTuple):
    """What belongs to a point beside its residuals."""

    x: Float[Array, " j"]
    cycles: tuple[Cycle, ...]
    follow: tuple[Float[Array, "2n j"], ...]  # how the unknowns of each cycle follow the parameters
    systems: tuple[Float[Array, "2n 2n"], ...]  # how what does not close follows the unknowns
    models: list[Float[Array, "B k"]]


class _Compared(NamedTuple):
    residual: Float[Array, " r"]
    jacobian: Float[Array, "r j"]
    correction: Float[Array, ""]  # of the cycles, the largest, relative; infinite where one changed its status
    about: _About


@compiled
def _compared(problem: Problem, x: Float[Array, "s j"], x0, share, cycles: tuple[Cycle, ...]) -> _Compared:
    return jax.vmap(lambda x, x0, cycles: _compared_one(problem, x, x0, share, cycles))(x, x0, cycles)


def _compared_one(problem: Problem, x: Float[Array, " j"], x0, share, cycles: tuple[Cycle, ...]) -> _Compared:
    size, count = len(x), 2 * problem.scene.structure.size
    tangential = problem.scene.structure.tangential

    def beside(unknowns):
        x, own = unknowns[:size], list(problem.offsets(unknowns[:size]))
        places = [k for k, m in enumerate(problem.misfits) if isinstance(m, CycleMisfit)]
        for i, k in enumerate(places):
            own[k] = cycles[i].at(unknowns[size + i * count : size + (i + 1) * count], tangential)
        scene = problem.at(x[: problem.size])
        found = [m.compared(scene, o, share) for m, o in zip(problem.misfits, own, strict=True)]
        # Far from the answer the features of a limit cycle alone may leave a parameter untold.
        leash = jnp.where(share < FAR, (x - x0)[: problem.size] / LEASH, 0.0)
        residual = jnp.concatenate([*(one.residual for one in found), leash])
        unclosed = [found[k].unclosed for k in places]
        contacts = [found[k].contact for k in places]
        return jnp.concatenate([residual, *unclosed]), (residual, unclosed, contacts, [one.model for one in found])

    unknowns = jnp.concatenate([x, *(cycle.unknowns(tangential) for cycle in cycles)])
    slopes, (residual, unclosed, contacts, models) = jax.jacfwd(beside, has_aux=True)(unknowns)
    rows = residual.shape[0]
    jacobian, correction = slopes[:rows, :size], jnp.zeros(())
    corrected, follow, systems = [], [], []
    for i, (cycle, gap, contact) in enumerate(zip(cycles, unclosed, contacts, strict=True)):
        own = slice(rows + i * count, rows + (i + 1) * count), slice(size + i * count, size + (i + 1) * count)
        systems.append(slopes[own])
        solved = jnp.linalg.solve(systems[-1], jnp.concatenate([slopes[own[0], :size], gap[:, None]], axis=1))
        follow.append(-solved[:, :-1])
        # The parameters move the cycle, too; and to first order the residuals are those of the closed one.
        towards = slopes[:rows, own[1]]
        jacobian = jacobian + towards @ follow[-1]
        residual = residual - towards @ solved[:, -1]
        better, moved = _corrected(problem, cycle, -solved[:, -1], gap, contact)
        corrected.append(better)
        correction = jnp.maximum(correction, moved)
    about = _About(x, tuple(corrected), tuple(follow), tuple(systems), models)
    return _Compared(residual, jacobian, correction, about)


def _corrected(problem: Problem, cycle: Cycle, step, gap, contact: Contact) -> tuple[Cycle, Float[Array, ""]]:
    """The cycle after a step of Newton's method, and how large that was; or one period later, where its status changed."""
    structure, n = problem.scene.structure, len(step) // 2
    held = cycle.contact.status != Status.DETACH
    constrained = jnp.array([structure.normal, n + structure.normal])
    # On the belt the normal coordinate is zero, not only but for rounding.
    step = jnp.where(held, step.at[constrained].set(-cycle.y[constrained]), step)
    sizes = [jnp.full(n, jnp.max(jnp.abs(part))) for part in (cycle.y[:n], cycle.y[n:])]
    sizes = jnp.concatenate(sizes).at[n + structure.tangential].set(cycle.period)
    better = cycle.at(cycle.unknowns(structure.tangential) + step, structure.tangential)
    changed = contact.status != cycle.contact.status
    later = Cycle(cycle.y + gap, contact, cycle.period)
    # A period that went astray is none.
    astray = (better.period < 0.5 * cycle.period) | (better.period > 2 * cycle.period)
    better = eqx.tree_at(lambda c: c.period, better, jnp.where(astray, jnp.nan, better.period))
    chosen = jax.tree.map(lambda a, b: jnp.where(changed, a, b), later, better)
    moved = jnp.where(changed, jnp.inf, jnp.max(jnp.abs(step) / sizes))
    return chosen, jnp.where(astray & ~changed, jnp.nan, moved)


@compiled
def _settled(problem: Problem, x: Float[Array, "s j"]) -> tuple[Cycle, ...]:
    return jax.vmap(lambda x: tuple(m.settled(problem.at(x[: problem.size])) for m in problem.cycles))(x)


@compiled
def _predicted(problem: Problem, x: Float[Array, "s j"], about: _About) -> tuple[Cycle, ...]:
    tangential = problem.scene.structure.tangential

    def followed(x, about):
        moved = x - about.x
        return tuple(
            cycle.at(cycle.unknowns(tangential) + follow @ moved, tangential)
            for cycle, follow in zip(about.cycles, about.follow, strict=True)
        )

    return jax.vmap(followed)(x, about)


def _period(problem: Problem, u: Float[np.ndarray, " k"]) -> float:
    """Of the least damped vibration of steady sliding, s; 0 where none is there."""
    (matrix,) = state_matrices(problem.parameters, problem.scene, jnp.asarray(u[None]))
    eigenvalues = np.linalg.eigvals(np.asarray(matrix))
    vibrating = eigenvalues[eigenvalues.imag > 0]
    return 2 * np.pi / float(vibrating[np.argmax(vibrating.real)].imag) if len(vibrating) else 0.0


def _growth(system: Float[np.ndarray, "2n 2n"], where: int) -> float:
    """The largest factor by which a disturbance of a cycle grows from one return to the next (its Floquet multipliers)."""
    rest = np.delete(np.arange(len(system)), where)
    # A disturbed state comes back later; the period is what brings the tangential velocity back.
    period = system[:, where]
    carried = (system + np.eye(len(system)))[:, rest]
    with np.errstate(all="ignore"):
        returned = (carried - np.outer(period, carried[where] / period[where]))[rest]
    # Where no cycle was closed, none lasts.
    return float(np.max(np.abs(np.linalg.eigvals(returned)))) if np.all(np.isfinite(returned)) else np.inf


@compiled
def _features(problem: Problem, u: Float[Array, "s k"], u0: Float[Array, "s k"]):
    def coarse(u, u0):
        scene = problem.at(u)
        found = jnp.concatenate([*(m.coarse(scene) for m in problem.misfits), (u - u0) / LEASH])
        return found, found

    jacobian, residual = jax.vmap(jax.jacfwd(coarse, has_aux=True))(u, u0)
    return residual, jacobian


@compiled
def _integrals(problem: Problem, which: int, u: Float[Array, "s k"], instants: Float[Array, " b"], eventful=False):
    mine = problem.misfits[which]
    return jax.vmap(lambda u: mine.integrals(problem.at(u), instants, eventful))(u)


def _distinct(candidates: np.ndarray) -> np.ndarray:
    """Without those that repeat one before them."""
    kept = []
    for candidate in candidates:
        if not any(np.allclose(candidate, other, atol=1e-2) for other in kept):
            kept.append(candidate)
    return np.array(kept)
