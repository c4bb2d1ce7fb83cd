"""Many trajectories followed together: begun, followed round by round, concluded.

After each round of steps the decided ones leave and the undecided ones are compacted: work is spent only where the
verdict is open.
"""

import functools
from collections.abc import Callable

import jax
import numpy as np

from ..verdicts.verdict import Verdict
from . import attractors
from .at_last import Narrow, fates
from .attractors import Attractors, Follower
from .captures import CROSSINGS, MORE_CROSSINGS, Cycle, captured, distinct, is_new, stable_cycles
from .conclusion import STEPS_PER_LOOK
from .flattened import Flattened
from .following import begun, follow, observed
from .kernels import Kernels
from .results import CHAOTIC, NO_ATTRACTOR, Ended, Verdicts, record
from .section import ReturnMaps
from .sharing import Batch, grouped, shared_by
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
    trajectories = begun(batch, shared, group[pending], columns[pending])
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
        follow(batch, kernels, shared, group[pending], trajectories, looks)
        done += looks * STEPS_PER_LOOK


def _rows(tree, chosen: np.ndarray):
    return jax.tree.map(lambda leaf: np.asarray(leaf)[chosen], tree)


class Basins:
    """The attractors of the groups that are followed together, and which trajectories have entered where they capture."""

    def __init__(
        self, batch: Batch, shared: Flattened, kernels: Kernels | None, distinct: np.ndarray, group: np.ndarray
    ):
        self.batch, self.shared, self.kernels, self.distinct, self.group = batch, shared, kernels, distinct, group
        self.follower = Follower(begun, functools.partial(observed, batch, kernels))
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
