"""Many trajectories followed together: begun, followed round by round, concluded.

`jax.vmap` makes of one trajectory a row of them that share a group, and a second `jax.vmap` makes that a block of rows.
After each round of steps the decided ones leave and the undecided ones are compacted: work is spent only where the
verdict is open.
"""

import functools
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np

from ..foundation.kept_programs import kept
from ..verdicts.ensemble import SEEN
from ..verdicts.verdict import Verdict
from . import attractors
from .at_last import Narrow, fates
from .attractors import Attractors, Follower
from .blocks import BLOCK_OF_SEVERAL, in_blocks
from .captures import CROSSINGS, MORE_CROSSINGS, Cycle, captured, distinct, is_new, stable_cycles
from .conclusion import STEPS_PER_LOOK, conclude, distance_to_torus, look, may_be_concluded
from .flattened import Flattened, flatten
from .kernels import Kernels, Looks
from .progress import Setting, begin, placed, released, step
from .results import CHAOTIC, NO_ATTRACTOR, Ended, Verdicts, record
from .section import ReturnMaps
from .sharing import Batch, Shared, grouped, shared_by, with_values
from .tori import Torus, followed_on

# Rounds after which the attractors of the groups of those that are undecided are computed.
KNOWN_FROM = 4
# Those that are undecided later ask for a cycle of their own, each time after so many times the steps.
OWN_FROM, OWN_AGAIN = 16, 2
# Rounds from which on cycles of many crossings are tried, too: locked tori, whose neighbours are followed for long anyway.
MORE_FROM = 64
# Ensembles that are followed at once: what is kept of them takes memory, some 0.1 MB each.
ENSEMBLES = 128
# How long trajectories are followed unless told: at least so many seconds, and so many periods of the slowest mode.
LEAST_TIME, LEAST_PERIODS = 20.0, 2000.0
# Where a cycle is known that attracts slowly: for so many of its time constants, but not for more periods than so many.
TIME_CONSTANTS, MOST_PERIODS = 12.0, 20000.0
# Trajectories that kernels have followed and that are asked for a verdict at a time.
CONCLUDED = 256
# Looks at a trajectory's verdict while its time grows e-fold.
LOOKS = 8


def follow_all(
    batch: Batch,
    values: dict[str, np.ndarray],
    states: tuple[str, ...],
    known: dict[bytes, Attractors],
    t_max: float | None,
    max_steps: int,
    verdicts: Verdicts,
    index: np.ndarray,
    report: Callable[[int], None],
) -> None:
    """Follow trajectories that fit in memory together; writes the results of those not run yet at `index`.

    `states` are the names of `values` that are initial displacements and velocities.

    `known` has the attractors of groups, by the group's parameters, and gets those that are found; `report` is told how many
    have ended.
    """
    distinct, group = grouped(values, states)
    shared = shared_by(batch, distinct)
    columns = np.stack([np.zeros(len(index)), *(values[name] for name in (*batch.history, *states))], axis=-1)[:, 1:]
    # What trajectories share is worked out for finished ones too: the rest is then the same as without an interruption.
    pending = np.flatnonzero(verdicts.pending[index])
    trajectories = _begun(batch, shared, group[pending], columns[pending])
    kernels = Kernels(shared, batch.pool) if batch.by_kernel else None
    basins = Basins(batch, shared, kernels, distinct, group)
    known_from = KNOWN_FROM * batch.method.round
    own_from = OWN_FROM * batch.method.round
    limit = np.maximum(LEAST_TIME, LEAST_PERIODS * shared.tree.modes.slowest_period) if t_max is None else t_max
    limit = np.broadcast_to(limit, len(distinct))
    done = 0
    while True:
        _, now = trajectories.tree
        verdict = np.array(now.verdict)
        if t_max is None:
            in_time = now.t - now.skipped < np.maximum(limit, basins.settled_by)[group[pending]]
        else:
            in_time = now.t < limit[group[pending]]
        if done >= max_steps:
            verdict = np.where((verdict == Verdict.UNDECIDED) & in_time, Verdict.STEP_FAILURE, verdict)
        which = np.full(len(pending), -1)
        if done > known_from:
            which = basins.entered(pending, now, (verdict == Verdict.UNDECIDED) & in_time)
            verdict[which >= 0] = Verdict.LIMIT_CYCLE
        finished = (verdict != Verdict.UNDECIDED) | ~in_time
        late = finished & (verdict == Verdict.UNDECIDED)
        # Who says how long to follow says which motions count.
        chaotic, at_last = basins.at_last(pending, now, late, proving=t_max is None, report=report)
        verdict[list(at_last)] = Verdict.LIMIT_CYCLE
        ended = Ended(verdict, *basins.described(pending, verdict, which, chaotic, at_last))
        chosen = np.flatnonzero(finished)
        record(verdicts, index[pending[finished]], *(_rows(part, chosen) for part in (now, ended)))
        report(int(finished.sum()))
        if finished.all():
            return
        pending, trajectories = pending[~finished], trajectories.compacted(np.flatnonzero(~finished))
        if done == known_from:
            basins.search(np.unique(group[pending]), columns, known, report)
        elif done >= own_from:
            crossings = CROSSINGS if done < MORE_FROM * batch.method.round else MORE_CROSSINGS
            basins.search_alone(pending, trajectories.tree[1], columns, crossings, report)
            own_from = OWN_AGAIN * done
        # Trajectories that have taken long may take longer: looks at their verdicts grow rarer, in proportion.
        steps = min(max(batch.method.round, done // LOOKS), max(max_steps - done, 1))
        looks = -(-steps // STEPS_PER_LOOK)
        _follow(batch, kernels, shared, group[pending], trajectories, looks)
        done += looks * STEPS_PER_LOOK


def _rows(tree, chosen: np.ndarray):
    return jax.tree.map(lambda leaf: np.asarray(leaf)[chosen], tree)


class Basins:
    """The attractors of the groups that are followed together, and which trajectories have entered where they capture."""

    def __init__(
        self, batch: Batch, shared: Flattened, kernels: Kernels | None, distinct: np.ndarray, group: np.ndarray
    ):
        self.batch, self.shared, self.kernels, self.distinct, self.group = batch, shared, kernels, distinct, group
        self.follower = Follower(_begun, functools.partial(_observed, batch, kernels))
        self.maps: ReturnMaps | None = None
        self.cycles: list[Cycle] = []
        self.of_group: dict[int, list[int]] = {}  # places in `cycles`
        self.torus = shared.tree.attractor  # views: what is written here is written there
        self.torus_period = np.full(len(distinct), np.nan)
        self.settled_by = np.zeros(len(distinct))  # s
        # Those of each group when the time of its trajectories is over.
        self.cycles_at_last: dict[int, list[Cycle]] = {}
        self.tori_at_last: dict[int, list[Narrow]] = {}

    def search(self, groups: np.ndarray, columns: np.ndarray, known: dict[bytes, Attractors], report) -> None:
        """Finds the attractors of these groups, where they are not `known`."""
        self.maps = ReturnMaps(self.batch, self.shared, self.kernels)
        keys = [row.tobytes() for row in self.distinct]
        _, first = np.unique(self.group, return_index=True)
        unknown = np.array([g for g in groups if keys[g] not in known], int)
        for start in range(0, len(unknown), ENSEMBLES):
            part = unknown[start : start + ENSEMBLES]
            given = columns[first[part]]
            found = attractors.search(self.batch, self.shared, self.maps, self.follower, part, given, report)
            known.update((keys[g], one) for g, one in zip(part, found, strict=True))
        for g in groups:
            one = known[keys[g]]
            self.of_group[int(g)] = []
            self._add(g, one.cycles)
            self._know_torus(g, one)

    def search_alone(self, pending: np.ndarray, now, columns: np.ndarray, crossings: int, report) -> None:
        """Finds attractors from where a few trajectories of each group are that have taken long: cycles of up to so many
        `crossings`, and tori.
        """
        latest = np.array(now.crossing)
        asks = np.all(np.isfinite(latest), axis=1) & (now.events > 0)
        if not np.any(asks) or self.maps is None:
            return
        group = self.group[pending]
        picked = distinct(self.maps.weights * np.where(asks[:, None], latest, 0.0), group, asks)
        led_to_one = np.zeros(len(picked), bool)
        at = attractors.section_of(now).rows(picked)
        known = {g: self._cycles_of(g) for g in self.of_group}
        for g, rows, cycle in stable_cycles(self.maps, group[picked], at, known, crossings):
            led_to_one[rows] = True
            if is_new(self.maps, cycle, self._cycles_of(g)):
                self._add(g, [cycle])
        # Motions on a locked torus take long to close in on its cycle: nothing else need be sought for them.
        locked = [any(len(cycle.points) > CROSSINGS for cycle in self._cycles_of(g)) for g in group[picked]]
        alone = picked[~led_to_one & (self.torus.amplitude[group[picked]] == 0) & ~np.array(locked)]
        groups, first = np.unique(group[alone], return_index=True)
        chosen = alone[first]
        for start in range(0, len(groups), ENSEMBLES):
            part = slice(start, start + ENSEMBLES)
            near = latest[chosen[part]]
            given = columns[pending[chosen[part]]]
            cycles = [self._cycles_of(g) for g in groups[part]]
            found = attractors.search(
                self.batch, self.shared, self.maps, self.follower, groups[part], given, report, near, cycles
            )
            for g, one, before in zip(groups[part], found, cycles, strict=True):
                self._add(g, one.cycles[len(before) :])
                self._know_torus(g, one)

    def _cycles_of(self, g: int) -> list[Cycle]:
        return [self.cycles[place] for place in self.of_group[g]]

    def _add(self, g: int, cycles: list[Cycle]) -> None:
        self.of_group[int(g)] += range(len(self.cycles), len(self.cycles) + len(cycles))
        self.cycles += cycles
        for cycle in cycles:
            constants = TIME_CONSTANTS * cycle.period / (1 - cycle.multiplier)
            most = MOST_PERIODS * self.shared.tree.modes.slowest_period[g]
            self.settled_by[g] = max(self.settled_by[g], min(constants, most))

    def _know_torus(self, g: int, found: Attractors) -> None:
        """From now on trajectories of the group are compared with its torus, if one was found."""
        if found.torus is not None:
            self.torus.crossings[g], self.torus.amplitude[g] = found.torus.states, found.torus.amplitude
            self.torus_period[g] = found.torus.period

    def entered(self, pending: np.ndarray, now, undecided: np.ndarray) -> np.ndarray:
        """The place in `cycles` of the cycle that each trajectory is captured by, or -1."""
        if self.maps is None or not self.cycles:
            return np.full(len(pending), -1)
        latest = np.array(now.crossing)
        usable = undecided & np.all(np.isfinite(latest), axis=1)
        rows_of: dict[int, list[int]] = {}
        rows = np.flatnonzero(usable)
        rows = rows[np.argsort(self.group[pending[rows]], kind="stable")]
        mine = self.group[pending[rows]]
        for g, places in self.of_group.items():
            here = rows[np.searchsorted(mine, g) : np.searchsorted(mine, g, side="right")]
            for place in places if len(here) else ():
                rows_of[place] = list(here)
        places = sorted(rows_of)
        known = [(np.array(rows_of[place], int), self.cycles[place]) for place in places]
        which = captured(self.maps, self.group[pending], attractors.section_of(now), latest, known)
        return np.where(which >= 0, np.array([*places, -1])[which], -1)

    def at_last(
        self, pending: np.ndarray, now, late: np.ndarray, proving: bool, report
    ) -> tuple[np.ndarray, dict[int, Cycle | Torus]]:
        """Of trajectories whose time is over: which are chaotic, and, if that is to be proved, the attractors that others have
        come to.
        """
        chaotic = np.zeros(len(pending), bool)
        asks = np.flatnonzero(late & np.isfinite(now.crossing).all(axis=1) & (now.events > 0))
        if self.maps is None or not len(asks):
            return chaotic, {}
        group, at = self.group[pending[asks]], attractors.section_of(now).rows(asks)
        if not proving:
            chaotic[asks] = followed_on(self.maps, group, at).chaotic
            return chaotic, {}
        cycles = {int(g): self.cycles_at_last.setdefault(int(g), self._cycles_of(g)) for g in np.unique(group)}
        found = fates(self.maps, group, at, cycles, self.tori_at_last, report)
        chaotic[asks] = found.chaotic
        return chaotic, {int(row): one for row, one in zip(asks, found.attractor, strict=True) if one is not None}

    def described(self, pending: np.ndarray, verdict: np.ndarray, which: np.ndarray, chaotic: np.ndarray, at_last):
        """Kind, amplitude, period and multiplier of each one's attractor."""
        torus = (verdict == Verdict.LIMIT_CYCLE) & (which < 0)
        group = self.group[pending]
        amplitude = np.where(torus, self.torus.amplitude[group], np.nan)
        period = np.where(torus, self.torus_period[group], np.nan)
        multiplier = np.full(len(pending), np.nan)
        known = {row: self.cycles[which[row]] for row in np.flatnonzero(which >= 0)} | at_last
        for row, one in known.items():
            amplitude[row], period[row] = one.amplitude, one.period
            torus[row] = isinstance(one, Torus)
            multiplier[row] = np.nan if torus[row] else one.multiplier
        on_cycle = (verdict == Verdict.LIMIT_CYCLE) & ~torus
        kind = np.where(torus, 1, np.where(on_cycle, 0, np.where(chaotic, CHAOTIC, NO_ATTRACTOR))).astype(np.int8)
        return kind, amplitude, period, multiplier


def _begun(batch: Batch, shared: Flattened, group: np.ndarray, columns: np.ndarray, releases=None) -> Flattened:
    """Trajectories at their beginning, each with its history; those that are released (from these multiples of their final
    load) after all kicks.
    """
    releases = np.full(len(group), np.nan) if releases is None else releases

    def function(*block):
        return _begin_block(batch.scene, batch.names, batch.history, batch.states, batch.energy, batch.by_kernel, *block)

    return in_blocks(function, shared, group, flatten((columns, releases)), batch.width, batch.pool, size=_block(batch))


def _follow(
    batch: Batch, kernels: Kernels | None, shared: Flattened, group: np.ndarray, trajectories: Flattened, looks: int
) -> None:
    """Trajectories `looks` looks further, in place."""
    if kernels is not None:
        _follow_by_kernel(batch, kernels, shared, group, trajectories, looks)
        return
    follow_block = _follow_block_of_many if batch.many else _follow_block

    def function(*block):
        return follow_block(batch.scene, batch.method, batch.names, batch.history, np.int32(looks), *block)

    in_blocks(function, shared, group, trajectories, batch.width, batch.pool, in_place=True, size=_block(batch))


def _follow_by_kernel(
    batch: Batch, kernels: Kernels, shared: Flattened, group, trajectories, looks: int, recorded: bool = False
) -> Looks:
    after, reached, record = kernels.follow(group, trajectories, looks, recorded)
    before = trajectories.tree[1]
    began = np.array(before.t)
    # While its mode changes again and again, nothing can be proved of a trajectory.
    asks = np.flatnonzero(reached | may_be_concluded(shared, group, before, after.tree[1]))
    trajectories.numbers[:] = after.numbers
    if not len(asks):
        return record

    def function(*block):
        return _conclude_block(batch.scene, batch.method, batch.names, batch.history, *block)

    rows = flatten((*_rows(after.tree, asks), began[asks], reached[asks]))
    # They are few of each group, and what they share is little.
    concluded = in_blocks(function, kernels.for_conclusions, group[asks], rows, 1, batch.pool, size=CONCLUDED)
    trajectories.numbers[asks] = concluded.numbers
    return record


def _observed(
    batch: Batch, kernels: Kernels | None, shared: Flattened, group: np.ndarray, trajectories: Flattened, looks: int
) -> Looks:
    """Trajectories `looks` looks further, in place; and what was seen of them."""
    if kernels is not None:
        return _follow_by_kernel(batch, kernels, shared, group, trajectories, looks, recorded=True)
    parts = []
    for start in range(0, looks, SEEN):
        _follow(batch, None, shared, group, trajectories, min(SEEN, looks - start))
        now = trajectories.tree[1]
        each = np.ones((1, SEEN))
        # As of the last of these looks: enough to tell whether there were any since the looks before.
        parts.append(Looks(now.approach.seen[:, ::-1].copy(), now.t[:, None] * each, now.events[:, None] * each))
    return Looks(*(np.concatenate(part, axis=1) for part in zip(*parts, strict=True)))


def _block(batch: Batch) -> int | None:
    return BLOCK_OF_SEVERAL if len(batch.scene.structure.contacts) > 1 else None


@kept
def _begin_block(
    scene, names, history, states, energy: bool, for_kernel: bool, shared: Flattened, trajectories: Flattened
) -> Flattened:
    def group(shared, columns, releases):
        own = with_values(scene, names, shared.values)

        def one(row, release):
            scene = with_values(own, history, row)
            begun = placed(
                begin(scene, shared.mechanics, shared.modes, energy, for_kernel), scene, shared, states, row[len(history) :]
            )
            return released(own, shared.modes, begun, release)

        return jax.vmap(one)(columns, releases)

    columns, releases = trajectories.tree
    return flatten((columns, jax.vmap(group)(shared.tree, columns, releases)), row_axes=2)


def _followed(scene, method, names, history, looks, shared: Flattened, trajectories: Flattened) -> Flattened:
    columns, begun = trajectories.tree
    everything = shared.tree
    of_all = functools.partial(_of_all, scene, method, names, history, everything, columns)
    # Loops about trajectories side by side, not trajectories side by side in loops: JAX traces the body of a loop that it
    # has to vectorise several times.
    a_step, a_distance, a_look, concluded = map(of_all, (step, distance_to_torus, look, conclude))
    known, nothing = jnp.any(everything.attractor.known), jnp.full(begun.t.shape, jnp.inf, begun.t.dtype)

    def until_look(_, carry):
        now, reached = carry
        now = jax.lax.fori_loop(0, STEPS_PER_LOOK, lambda _, now: a_step(now), now)
        # Until a torus is known, which is seldom, there is no distance to compute.
        return a_look(now, jax.lax.cond(known, a_distance, lambda _: nothing, now), reached)

    none = jnp.zeros(begun.t.shape, bool)
    after, reached = jax.lax.fori_loop(0, looks, until_look, (begun, none))
    return flatten((columns, concluded(begun.t, after, reached)), row_axes=2)


_follow_block, _follow_block_of_many = kept(_followed), kept(_followed, quickly_compiled=False)


@kept
def _conclude_block(scene, method, names, history, shared: Flattened, trajectories: Flattened) -> Flattened:
    columns, after, began, reached = trajectories.tree
    values, mechanics, modes, drift = shared.tree
    everything = Shared(values, mechanics, None, modes, drift, None, None, None)  # pyright: ignore[reportArgumentType]
    concluded = _of_all(scene, method, names, history, everything, columns, conclude)
    return flatten((columns, concluded(began, after, reached)), row_axes=2)


def _of_all(scene, method, names, history, everything, columns, function):
    """A function of a setting and of what is one trajectory's, for all trajectories of a block."""
    def of_group(shared, columns, *own):
        scene_of_group = with_values(scene, names, shared.values)

        def of_one(row, *own):
            setting = Setting(
                with_values(scene_of_group, history, row),
                method,
                shared.mechanics,
                shared.prepared,
                shared.modes,
                shared.drift,
                shared.attractor,
            )
            return function(setting, *own)

        return jax.vmap(of_one)(columns, *own)

    return lambda *own: jax.vmap(of_group)(everything, columns, *own)
