"""Many trajectories, each followed until its verdict is known.

A *lane* is one trajectory of a batch (`lane`). `jax.vmap` makes of it a group of lanes that differ in the history of their
load only and share everything else, and a second `jax.vmap` makes that a tile of groups. After each round of steps the
decided lanes leave, the others close ranks, and the tiles are filled anew: work is spent only where the verdict is open.

Where many lanes share a structure, an ensemble finds the limit cycle that they may come to (`attractor`).
"""

import time
import warnings
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from tqdm.auto import tqdm

from ..contact import Mechanics
from ..foundation.compiling import compiled
from ..foundation.interrupts import noted
from ..linear.linearisation import linear_sliding
from ..model.scene import Scene
from ..simulation.energy import exchanged
from ..steppers.base import AbstractStepper
from ..steppers.event_exact import EventExact
from ..steppers.windowed import MATRIX_ROWS, Windowed
from ..verdicts import ensemble as attractors
from ..verdicts import recurrence as orbits
from ..verdicts.ensemble import Attractor
from ..verdicts.sliding_proof import SlidingModes, sliding_modes
from ..verdicts.sticking_proof import Wedge, wedge
from ..verdicts.verdict import Verdict
from .lane import LOOK_EVERY, Course, Lane, begin, conclude, look, measured_from_rest, released, step
from .packed import Packed, packed
from .tiles import MANY, in_tiles, workers

# Lanes of a group that stand side by side in a tile: enough to fill a vector unit and to make matrix products pay.
SIDE_BY_SIDE = 16
# What a lane that shares nothing costs, in lanes that stand side by side.
COST_OF_STANDING_ALONE = 4
# Rounds after which lanes want to know their limit cycle, and lanes of a group for which it is worth the work.
KNOWN_FROM = 4
WORTH_KNOWING = 32
# Ensembles that are followed at once: what is kept of them takes memory, some 0.1 MB each.
ENSEMBLES = 128
# Looks at a lane's verdict while its time grows e-fold.
LOOKS = 8
# What a ledger leaves of a lane, see `energy`; `kick_energy` is that of the vibration when the kick ends.
ENERGIES = (
    "stick_work",
    "slide_work",
    "interface_work",
    "damping_work",
    "load_work",
    "kick_work",
    "impact_loss",
    "kick_energy",
    "energy_residual",
    "energy_exchanged",
)
# Lanes taken from a grid are not that close to a boundary; they need not be watched as long.
SPAN_SHARE = 4
# Steps that a lane may take: 10⁵ cycles with their events, and some hours of work for a map of them.
MOST_STEPS = 2**21
# How often what is finished is handed out to be kept, s: seldom enough to cost nothing, often enough to lose little.
KEEP_EVERY = 2.0
# Parameters that lanes of one group may differ in: the load's history, which leaves the mechanics alone.
HISTORY = ("p", "duration", "start")


class Shared(eqx.Module):
    """What the lanes of a group have in common, worked out once."""

    values: Float[Array, " k"]  # the parameters that are not history
    mechanics: Mechanics
    prepared: Any  # the stepper's own, see `AbstractStepper.prepare`
    modes: SlidingModes
    wedge: Wedge
    attractor: Attractor


class Outcome(NamedTuple):
    """What is known of each lane at its end; arrays over lanes."""

    verdict: np.ndarray
    amplitude: np.ndarray  # m/s
    decided_at: np.ndarray  # s
    events: np.ndarray
    last_event: np.ndarray  # s
    energy: dict[str, np.ndarray]  # lines of the ledger by name, J; empty where not asked for


class Batch(NamedTuple):
    """What all lanes of a run have in common, and how they are computed."""

    scene: Scene
    method: AbstractStepper | Windowed
    resolution: orbits.Resolution
    names: tuple[str, ...]  # parameters that make groups
    history: tuple[str, ...]  # those of the load's history
    energy: bool
    width: int  # lanes of a group side by side
    many: bool  # so many that code which runs faster repays what it takes to compile
    pool: ThreadPoolExecutor


def run_to_verdict(
    scene: Scene,
    values: dict[str, np.ndarray],
    method: AbstractStepper,
    *,
    t_max: float,
    memory: float,
    max_steps: int = MOST_STEPS,
    progress: bool | None,
    label: str,
    lingering: bool = False,
    known: Outcome | None = None,
    keep: Callable[[Outcome], None] | None = None,
    energy: bool = False,
) -> Outcome:
    """Follow one lane for each row of `values` (equally long arrays of parameters by name) until its verdict.

    `lingering` says that the lanes were chosen to lie so close to a boundary that they stay with an unstable cycle for
    long: then an orbit has to return for longer before it counts. `energy` asks for the ledger of each lane at its end.

    `known` is what an earlier run of the same lanes has finished; those are not run again. `keep` is handed everything that is
    finished, every few seconds and at the end.

    Interrupted by the user, it returns what is decided by then; the rest is `Verdict.NOT_RUN`.
    """
    resolution = method.resolution
    if not lingering:
        resolution = eqx.tree_at(lambda r: r.span, resolution, np.asarray(resolution.span) // SPAN_SHARE)
    total = len(next(iter(values.values())))
    outcome = Outcome(
        verdict=np.full(total, Verdict.NOT_RUN, np.int8),
        amplitude=np.full(total, np.nan),
        decided_at=np.full(total, np.nan),
        events=np.zeros(total, np.int32),
        last_event=np.full(total, np.nan),
        energy={name: np.full(total, np.nan) for name in ENERGIES} if energy else {},
    )
    if known is not None:
        outcome = jax.tree.map(np.array, known)
    already = int(np.sum(outcome.verdict != Verdict.NOT_RUN))
    bar = tqdm(
        total=total, initial=already, desc=label, unit="lane", disable=None if progress is None else not progress
    )
    kept, new = time.monotonic(), 0

    def finished(count: int) -> None:
        nonlocal kept, new
        bar.update(count)
        new += count
        if signals:
            raise KeyboardInterrupt
        if keep is not None and new > 0 and time.monotonic() - kept >= KEEP_EVERY:
            keep(outcome)
            kept, new = time.monotonic(), 0

    distinct, group = _groups(values)
    company = np.bincount(group)[group]
    # The same in all rounds and blocks, because products of other shapes round differently.
    in_rows = np.sum(-(-np.bincount(group) // SIDE_BY_SIDE)) * SIDE_BY_SIDE
    width = SIDE_BY_SIDE if in_rows <= COST_OF_STANDING_ALONE * total else 1
    # Blocks that are filled group by group share the most.
    order = np.argsort(group, kind="stable")
    block = max(1, int(memory // bytes_per_lane(scene, sharing=total / len(distinct))))
    batch = Batch(
        scene=scene,
        method=method if energy else in_bulk(method, scene),
        resolution=resolution,
        names=tuple(name for name in values if name not in HISTORY),
        history=tuple(name for name in values if name in HISTORY),
        energy=energy,
        width=width,
        many=total >= MANY,
        pool=ThreadPoolExecutor(max_workers=workers()),
    )
    with noted() as signals, bar, batch.pool:
        try:
            for start in range(0, total, block):
                chosen = order[start : start + block]
                if np.any(outcome.verdict[chosen] == Verdict.NOT_RUN):
                    rows = {name: column[chosen] for name, column in values.items()}
                    _run_block(batch, rows, company[chosen], t_max, max_steps, outcome, chosen, finished)
        except KeyboardInterrupt:
            open_lanes = int(np.sum(outcome.verdict == Verdict.NOT_RUN))
            warnings.warn(
                f"Interrupted: {open_lanes} of {total} lanes have no verdict and are labelled {Verdict.NOT_RUN.value}.",
                stacklevel=2,
            )
        finally:
            if keep is not None:
                keep(outcome)
    return outcome


def in_bulk(method: AbstractStepper, scene: Scene) -> AbstractStepper | Windowed:
    """The stepper that does the same for many lanes in less time, where there is one."""
    return Windowed() if method == EventExact() and scene.friction.constant else method


def bytes_per_lane(scene: Scene, sharing: float) -> int:
    """Memory that a lane takes where `sharing` lanes make a group, its part of a step's intermediate results included."""
    n = scene.structure.size
    m = 2 * (n - 1)
    own = 8 * ((3 + attractors.SEEN) * 2 * n + 60)
    modes = 8 * (m * m + 3 * m + 2 * n + 8) + 16 * (m * m + 4 * m)
    prepared = 8 * MATRIX_ROWS * (2 * n + 2) * 4 * (n + 1)
    attractor = 8 * attractors.KEPT * 2 * n
    return int(own + 3 * (modes + prepared + attractor) / sharing)


def _groups(values: dict[str, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """The distinct rows of parameters that are not history, and the row that each lane belongs to."""
    own = [column for name, column in values.items() if name not in HISTORY]
    if not own:
        count = len(next(iter(values.values())))
        return np.zeros((1, 0)), np.zeros(count, int)
    distinct, group = np.unique(np.stack(own, axis=-1), axis=0, return_inverse=True)
    return distinct, group.ravel()


def _run_block(
    batch: Batch, values, company: np.ndarray, t_max: float, max_steps: int, outcome: Outcome, index: np.ndarray, report
) -> None:
    """Lanes that fit in memory together; writes the outcomes of those not run yet at `index`.

    `company` says how many lanes of the whole run are in a lane's group.
    """
    distinct, group = _groups(values)
    shared = _shared(batch, distinct)
    columns = np.stack([np.zeros(len(index)), *(values[name] for name in batch.history)], axis=-1)[:, 1:]
    # What lanes share is worked out for finished ones too: the rest is then the same as without an interruption.
    pending = np.flatnonzero(outcome.verdict[index] == Verdict.NOT_RUN)
    lanes = _begun(batch, shared, group[pending], columns[pending])
    done = 0
    while True:
        _, now = lanes.tree
        verdict = now.verdict
        if done >= max_steps:
            verdict = np.where((verdict == Verdict.UNDECIDED) & (now.t < t_max), Verdict.STEP_FAILURE, verdict)
            now = eqx.tree_at(lambda lane: lane.verdict, now, verdict.astype(np.int8))
        finished = (verdict != Verdict.UNDECIDED) | (now.t >= t_max)
        _record(outcome, index[pending[finished]], jax.tree.map(lambda leaf, done=finished: leaf[done], now))
        report(int(finished.sum()))
        if finished.all():
            return
        pending, lanes = pending[~finished], lanes.closed_up(np.flatnonzero(~finished))
        if done == KNOWN_FROM * batch.method.round:
            many = pending[company[pending] >= WORTH_KNOWING]
            groups, first = np.unique(group[many], return_index=True)
            for start in range(0, len(groups), ENSEMBLES):
                part = slice(start, start + ENSEMBLES)
                _find_attractors(batch, shared, groups[part], columns[many[first[part]]], report)
        # Lanes that have taken long may take longer: looks at their verdicts grow rarer, in proportion.
        steps = min(max(batch.method.round, done // LOOKS), max(max_steps - done, 1))
        looks = -(-steps // LOOK_EVERY)
        _follow(batch, shared, group[pending], lanes, looks)
        done += looks * LOOK_EVERY


def _find_attractors(batch: Batch, shared: Packed, groups: np.ndarray, columns: np.ndarray, report) -> None:
    """Writes the limit cycles of these groups into what they share, where their ensembles meet on one.

    `columns` are those of any lane of each group.
    """
    structure, members = batch.scene.structure, len(attractors.RELEASES)
    cycles, slowest_decay = shared.tree.attractor, shared.tree.modes.slowest_decay
    own, columns = np.repeat(groups, members), np.repeat(columns, members, axis=0)
    running, moving = np.arange(len(own)), np.ones(len(own), bool)
    lanes = _begun(batch, shared, own, columns, np.tile(attractors.RELEASES, len(groups)))
    most = max(attractors.TESTS)
    deviations = np.full((most, len(own), 2 * structure.size), np.nan)
    peaks, times = np.full((most, len(own)), np.nan), np.full((most, len(own)), np.nan)
    looks = 0

    def cycle_of(k: int):
        mine = slice(k * members, (k + 1) * members)
        ensemble = attractors.Ensemble(deviations[:looks, mine], peaks[:looks, mine], times[:looks, mine], moving[mine])
        return attractors.met(ensemble, slowest_decay[groups[k]])

    while len(running) and looks < most:
        report(0)
        lanes.tree[1].orbit.peak[:] = 0.0
        _follow(batch, shared, own[running], lanes, attractors.SEEN)
        _, now = lanes.tree
        recent = slice(looks, looks + attractors.SEEN)
        deviations[recent, running] = np.moveaxis(now.approach.seen, 1, 0)[::-1]
        peaks[recent, running], times[recent, running] = now.orbit.peak, now.t
        looks += attractors.SEEN
        moving[running] = (now.verdict == Verdict.UNDECIDED) | (now.verdict == Verdict.LIMIT_CYCLE)
        over = ~moving[running]
        if looks in attractors.TESTS:
            open_ = np.unique(running // members)
            for k, cycle in zip(open_, batch.pool.map(cycle_of, open_), strict=True):
                if cycle is not None:
                    cycles.crossings[groups[k]], cycles.amplitude[groups[k]] = cycle
            over |= cycles.known[own[running]]
        running, lanes = running[~over], lanes.closed_up(np.flatnonzero(~over))


def _record(outcome: Outcome, index: np.ndarray, lanes: Lane) -> None:
    verdict = np.asarray(lanes.verdict)
    amplitude = np.where(verdict == Verdict.LIMIT_CYCLE, lanes.orbit.amplitude, np.nan)
    outcome.amplitude[index] = np.where(verdict == Verdict.SLIDING, 0.0, amplitude)
    outcome.decided_at[index] = np.where(verdict >= 0, lanes.t, np.nan)
    outcome.events[index] = lanes.events
    outcome.last_event[index] = lanes.last_event
    if lanes.account is not None:
        ledger = lanes.account.ledger
        lines = {**ledger.work.lines("work"), "impact_loss": ledger.impact, "energy_residual": ledger.worst}
        lines["energy_exchanged"] = exchanged(ledger)
        lines["kick_energy"] = lanes.account.vibration
        for name, line in outcome.energy.items():
            line[index] = lines[name]
    # Last, and in one go: a lane with a verdict is complete, whenever an interrupt comes.
    outcome.verdict[index] = verdict


def _shared(batch: Batch, distinct: np.ndarray) -> Packed:
    """`Shared` of each row of `distinct`, packed."""
    size, parts = 64, []
    for start in range(0, len(distinct), size):
        # Filled up with copies, so that one size is compiled.
        rows = np.minimum(np.arange(start, start + size), len(distinct) - 1)
        part = jax.tree.map(np.asarray, _prepared(batch.scene, batch.method, batch.names, distinct[rows]))
        parts.append(jax.tree.map(lambda leaf, start=start: leaf[: len(distinct) - start], part))
    modes = sliding_modes(jax.tree.map(lambda *leaves: np.concatenate(leaves), *(linear for _, _, linear, _ in parts)))
    numbers = form = None
    for start in range(0, len(distinct), size):
        # One by one into place, because they are large: they are never there twice.
        mechanics, prepared, _, wedges = parts.pop(0)
        rows = slice(start, min(start + size, len(distinct)))
        unknown = attractors.unknown(rows.stop - start, 2 * batch.scene.structure.size)
        own_modes = jax.tree.map(lambda leaf, rows=rows: leaf[rows], modes)
        part = packed(Shared(distinct[rows], mechanics, prepared, own_modes, wedges, unknown))
        numbers = np.empty((len(distinct), part.numbers.shape[-1])) if numbers is None else numbers
        numbers[rows], form = part.numbers, part.form
    return Packed(numbers, form)


@compiled
def _prepared(scene: Scene, method: AbstractStepper | Windowed, names: tuple[str, ...], values):
    def one(row):
        own = _with(scene, names, row)
        mechanics = measured_from_rest(own)
        return mechanics, method.prepare(mechanics), linear_sliding(own), wedge(own)

    return jax.vmap(one)(values)


def _begun(batch: Batch, shared: Packed, group: np.ndarray, columns: np.ndarray, releases=None) -> Packed:
    """Lanes at their beginning, each with its history; those that are released (from these multiples of their final load)
    after all kicks.
    """
    releases = np.full(len(group), np.nan) if releases is None else releases

    def function(*tile):
        return _begin_tile(batch.scene, batch.names, batch.history, batch.energy, *tile)

    return in_tiles(function, shared, group, packed((columns, releases)), batch.width, batch.pool)


def _follow(batch: Batch, shared: Packed, group: np.ndarray, lanes: Packed, looks: int) -> None:
    """Lanes `looks` looks further, in place."""
    follow_tile = _follow_tile_of_many if batch.many else _follow_tile

    def function(*tile):
        return follow_tile(
            batch.scene, batch.method, batch.resolution, batch.names, batch.history, np.int32(looks), *tile
        )

    in_tiles(function, shared, group, lanes, batch.width, batch.pool, in_place=True)


@compiled
def _begin_tile(scene, names, history, energy: bool, shared: Packed, lanes: Packed) -> Packed:
    def group(shared, columns, releases):
        own = _with(scene, names, shared.values)

        def one(row, release):
            lane = begin(_with(own, history, row), shared.mechanics, shared.modes, energy)
            return released(own, shared.modes, lane, release)

        return jax.vmap(one)(columns, releases)

    columns, releases = lanes.tree
    return packed((columns, jax.vmap(group)(shared.tree, columns, releases)), row_axes=2)


def _followed(scene, method, resolution, names, history, looks, shared: Packed, lanes: Packed) -> Packed:
    columns, begun = lanes.tree
    everything = shared.tree

    def of_lanes(function):
        """A function of a course and of what is one lane's, for all lanes of the tile."""

        def of_group(shared, columns, *own):
            scene_of_group = _with(scene, names, shared.values)

            def of_lane(row, *own):
                course = Course(
                    _with(scene_of_group, history, row),
                    method,
                    resolution,
                    shared.mechanics,
                    shared.prepared,
                    shared.modes,
                    shared.wedge,
                    shared.attractor,
                )
                return function(course, *own)

            return jax.vmap(of_lane)(columns, *own)

        return lambda *own: jax.vmap(of_group)(everything, columns, *own)

    # Loops about lanes side by side, not lanes side by side in loops: JAX traces the body of a loop that it has to
    # vectorise several times.
    a_step, a_look, concluded = of_lanes(step), of_lanes(look), of_lanes(conclude)

    def until_look(_, carry):
        lanes, reached = carry
        lanes = jax.lax.fori_loop(0, LOOK_EVERY, lambda _, lanes: a_step(lanes), lanes)
        return a_look(lanes, reached)

    none = jnp.zeros(begun.t.shape, bool)
    after, reached = jax.lax.fori_loop(0, looks, until_look, (begun, none))
    return packed((columns, concluded(begun.t, after, reached)), row_axes=2)


_follow_tile, _follow_tile_of_many = compiled(_followed), eqx.filter_jit(_followed)


def _with(scene: Scene, names: tuple[str, ...], row) -> Scene:
    return scene.replace(**{name: row[i] for i, name in enumerate(names)})
