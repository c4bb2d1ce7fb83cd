"""Many trajectories followed together: begun, followed round by round, concluded.

After each round of steps the decided ones leave and the undecided ones are compacted: work is spent only where the
verdict is open.
"""

from collections.abc import Callable

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Bool, Float, Int

from ..attractors.cycles import CROSSINGS, MORE_CROSSINGS, Cycle, distinct
from ..attractors.known import Attractors, add_cycles, add_tori, come_to
from ..attractors.long_run import fates
from ..attractors.parting import followed_on
from ..attractors.search import TOGETHER, search_groups
from ..attractors.tori import TUBES, Torus
from ..foundation.flattened import Flattened
from ..section.by_kernel import section_kernels
from ..section.return_maps import INTERPOLATED, ROUNDED, ReturnMaps, Section
from ..steppers.event_exact import EventExact
from ..verdicts.verdict import Verdict
from .conclusion import bounds
from .following import begun, compile_conclusions, follow
from .groups import Batch, grouped, shared_by
from .halfway import Halfway, Log, NoLog
from .matrix_kernels import Kernels, begin_building
from .progress import Progress
from .results import CHAOTIC, NO_ATTRACTOR, Ended, Verdicts, record
from .series_kernels import SeriesKernels

# Rounds after which the attractors of the groups of those that are undecided are computed.
KNOWN_FROM = 4
# Those that are undecided later ask for a cycle of their own, each time after so many times the steps.
OWN_FROM, OWN_AGAIN = 16, 2
# Rounds from which on cycles of many crossings are tried, too: locked tori, whose neighbours are followed for long anyway.
MORE_FROM = 64
# How long trajectories are followed unless told: at least so many seconds, and so many periods of the slowest mode.
LEAST_TIME, LEAST_PERIODS = 20.0, 2000.0
# Where a cycle is known that attracts slowly: for so many of its time constants, but not for more periods than so many.
TIME_CONSTANTS, MOST_PERIODS = 12.0, 20000.0
# Looks at a trajectory's verdict while its time grows e-fold.
LOOKS = 5


def follow_all(
    batch: Batch,
    values: dict[str, np.ndarray],
    seeding: Float[np.ndarray, "r k"],
    states: tuple[str, ...],
    known: dict[bytes, Attractors],
    t_max: float | None,
    max_steps: int,
    verdicts: Verdicts,
    index: np.ndarray,
    report: Callable[[int], None],
    log: Log | None = None,
) -> None:
    """Follow trajectories that fit in memory together; writes the results of those not run yet at `index`.

    `seeding` has the parameters of the group whose attractors seed the search in the group of each.

    `states` are the names of `values` that are initial displacements and velocities.

    `known` has the attractors of groups, by the group's parameters, and gets those that are found; `report` is told how many
    have ended. `log` keeps the state between rounds, and has the one from which an interrupted run goes on; for this the
    trajectories must be all those of `verdicts`.
    """
    log = NoLog() if log is None else log
    of_groups, group = grouped(values, states)
    of_groups, seeds = with_seeding(of_groups, seeding[np.unique(group, return_index=True)[1]])
    if batch.by_kernel:
        begin_building(batch)
    shared = shared_by(batch, of_groups)
    columns = np.stack([np.zeros(len(index)), *(values[name] for name in (*batch.history, *states))], axis=-1)[:, 1:]
    # What trajectories share is worked out for finished ones too: the rest is then the same as without an interruption.
    pending = np.flatnonzero(verdicts.pending(index))
    trajectories = begun(batch, shared, group[pending], columns[pending])
    if (batch.by_kernel or batch.by_series) and len(pending):
        compile_conclusions(batch, shared, trajectories)
    kernels = kernels_for(batch, shared)
    basins = Basins(batch, shared, kernels, of_groups, group, seeds)
    known_from = KNOWN_FROM * batch.method.round
    own_from = OWN_FROM * batch.method.round
    limit = np.maximum(LEAST_TIME, LEAST_PERIODS * shared.tree.modes.slowest_period) if t_max is None else t_max
    limit = np.broadcast_to(limit, len(of_groups))
    done = 0
    if (earlier := log.last()) is not None:
        done, own_from, pending = earlier.done, earlier.own_from, earlier.pending
        trajectories = Flattened(earlier.numbers, trajectories.form)
        basins.go_on(earlier)
        known.update(earlier.known)
        for whole, own in zip(jax.tree.leaves(verdicts), jax.tree.leaves(earlier.verdicts), strict=True):
            whole[:] = own
        report(len(index) - len(pending))

    def state() -> Halfway:
        return basins.halfway(done, own_from, verdicts, pending, trajectories.numbers, known)

    while True:
        _, now = trajectories.tree
        verdict = np.array(now.verdict)
        if t_max is None:
            in_time = now.t - now.skipped < np.maximum(limit, basins.settled_by)[group[pending]]
        else:
            in_time = now.t < limit[group[pending]]
        entered: dict[int, Cycle | Torus] = {}
        if done > known_from:
            entered = basins.entered(pending, now, (verdict == Verdict.UNDECIDED) & in_time)
            verdict[list(entered)] = Verdict.LIMIT_CYCLE
        if done >= max_steps:
            # Only now: their last steps may have led them to an attractor.
            verdict = np.where((verdict == Verdict.UNDECIDED) & in_time, Verdict.STEP_FAILURE, verdict)
        finished = (verdict != Verdict.UNDECIDED) | ~in_time
        late = finished & (verdict == Verdict.UNDECIDED)
        # Who says how long to follow says which motions count.
        chaotic, at_last, sliding, now = basins.at_last(pending, now, late, proving=t_max is None, report=report)
        verdict[list(at_last)], verdict[sliding] = Verdict.LIMIT_CYCLE, Verdict.SLIDING
        ended = Ended(verdict, *_described(len(pending), entered | at_last, chaotic))
        chosen = np.flatnonzero(finished)
        record(verdicts, index[pending[finished]], *(_rows(part, chosen) for part in (now, ended)))
        pending, trajectories = pending[~finished], trajectories.compacted(np.flatnonzero(~finished))
        # A run that begins here comes to the same: it finds nothing more to conclude.
        log.note(state(), at_once=done == known_from or done >= own_from)
        report(int(finished.sum()))
        if not len(pending):
            return
        if done == known_from:
            basins.search(np.unique(group[pending]), known, report, lambda: log.note(state()))
        elif done >= own_from:
            crossings = CROSSINGS if done < MORE_FROM * batch.method.round else MORE_CROSSINGS
            basins.search_alone(pending, trajectories.tree[1], crossings, report)
            own_from = OWN_AGAIN * done
        # Trajectories that have taken long may take longer: looks at their verdicts grow rarer, in proportion.
        steps = min(max(batch.method.round, done // LOOKS), max(max_steps - done, 1))
        log.moving()
        follow(batch, kernels, shared, group[pending], trajectories, steps)
        done += steps


def kernels_for(batch: Batch, shared: Flattened) -> Kernels | SeriesKernels | None:
    """The kernels that follow the trajectories of a batch, if any do."""
    if batch.by_kernel:
        return Kernels(shared, batch.pool)
    return SeriesKernels(batch, shared) if batch.by_series else None


def with_seeding(
    of_groups: Float[np.ndarray, "g k"], seeding: Float[np.ndarray, "g k"]
) -> tuple[Float[np.ndarray, "more k"], Int[np.ndarray, " g"]]:
    """The parameters of groups, followed by those of other groups that seed some of them; and which one seeds each."""
    place = {row.tobytes(): g for g, row in enumerate(of_groups)}
    more: list[np.ndarray] = []
    for row in seeding:
        if row.tobytes() not in place:
            place[row.tobytes()] = len(place)
            more.append(row)
    seeds = np.array([place[row.tobytes()] for row in seeding], int)
    return np.concatenate([of_groups, np.array(more).reshape(len(more), of_groups.shape[1])]), seeds


def _rows(tree, chosen: np.ndarray):
    return jax.tree.map(lambda leaf: np.asarray(leaf)[chosen], tree)


def _later(now: Progress, rows: Int[np.ndarray, " r"], time: Float[np.ndarray, " r"], events: Int[np.ndarray, " r"]):
    """These trajectories after so much more time (s) and so many more events. When the last of them was is not known."""
    t, total, last_event = (np.array(part) for part in (now.t, now.events, now.last_event))
    t[rows] += time
    total[rows] += events
    last_event[rows[events > 0]] = np.nan
    return eqx.tree_at(lambda now: (now.t, now.events, now.last_event), now, (t, total, last_event))


def _described(count: int, attractor: dict[int, Cycle | Torus], chaotic: np.ndarray):
    """Kind, amplitude, period, multiplier, reach and contraction of the attractor of each of so many trajectories."""
    kind = np.where(chaotic, CHAOTIC, NO_ATTRACTOR).astype(np.int8)
    amplitude, period, multiplier, reach, contraction = np.full((5, count), np.nan)
    for row, one in attractor.items():
        kind[row] = isinstance(one, Torus)
        amplitude[row], period[row], reach[row], contraction[row] = (
            one.amplitude,
            one.period,
            one.reach,
            one.contraction,
        )
        multiplier[row] = one.multiplier if isinstance(one, Cycle) else np.nan
    return kind, amplitude, period, multiplier, reach, contraction


class Basins:
    """The attractors of the groups that are followed together, and which trajectories have entered where they capture."""

    def __init__(
        self,
        batch: Batch,
        shared: Flattened,
        kernels: Kernels | SeriesKernels | None,
        of_groups: np.ndarray,
        group: np.ndarray,
        seeds: Int[np.ndarray, " g"],
    ):
        self.batch, self.shared, self.kernels, self.of_groups, self.group = batch, shared, kernels, of_groups, group
        self.seeds = seeds
        self.maps: ReturnMaps | None = None
        self.known: dict[int, Attractors] = {}
        # Those of each group when the time of its trajectories is over.
        self.known_at_last: dict[int, Attractors] = {}
        self.settled_by = np.zeros(len(of_groups))  # s
        self.most_time = MOST_PERIODS * np.asarray(shared.tree.modes.slowest_period)  # for which cycles are waited, s

    def _return_maps(self) -> ReturnMaps:
        tree = self.shared.tree
        exact = self.kernels is not None or isinstance(self.batch.method, EventExact)
        known_to = ROUNDED if exact else INTERPOLATED
        structure = self.batch.scene.structure
        kernels = self.kernels.of_section if isinstance(self.kernels, SeriesKernels) else self.kernels
        # Return maps are exact whatever follows the trajectories.
        if kernels is None:
            kernels = section_kernels(self.batch.scene, tree.mechanics, tree.longest_return, self.batch.pool)
        return ReturnMaps(structure, tree.mechanics, tree.longest_return, kernels, self.batch.pool, known_to)

    def halfway(self, done: int, own_from: int, verdicts: Verdicts, pending, numbers, known) -> Halfway:
        """The state of the job, with what is known of attractors by now."""
        mine, last = ({g: one.copy() for g, one in of.items()} for of in (self.known, self.known_at_last))
        return Halfway(done, own_from, verdicts, pending, numbers, self.settled_by.copy(), dict(known), mine, last)

    def go_on(self, earlier: Halfway) -> None:
        """Go on from that state."""
        self.known, self.known_at_last = dict(earlier.of_groups), dict(earlier.at_last)
        self.settled_by = earlier.settled_by
        if self.known:
            self.maps = self._return_maps()

    def search(self, groups: np.ndarray, known: dict[bytes, Attractors], report, keep) -> None:
        """Finds the attractors of these groups, where they are not `known`; `keep` is called when some are found."""
        self.maps = self._return_maps()
        keys = [row.tobytes() for row in self.of_groups]
        seeds = {int(g): int(self.seeds[g]) for g in groups if keys[g] not in known}
        found = {g: known[keys[g]] for g in {*seeds, *seeds.values()} if keys[g] in known}

        def add(groups: list[int]) -> None:
            known.update((keys[g], found[g]) for g in groups)
            keep()

        equilibrium = np.asarray(self.shared.tree.modes.linear.equilibrium)
        search_groups(self.maps, equilibrium, seeds, found, report, add)
        for g in groups:
            # Without what trajectories find by themselves.
            self.known[int(g)] = known[keys[g]].copy()
            self._wait_for_cycles(int(g))

    def search_alone(self, pending: np.ndarray, now, crossings: int, report) -> None:
        """Finds attractors from where a few trajectories of each group are that have taken long: cycles of up to so many
        `crossings`, and tori.
        """
        asks = self._may_be_captured(now)
        if not np.any(asks) or self.maps is None:
            return
        group = self.group[pending]
        picked = distinct(self.maps.weights * np.array(now.crossing), group, asks)
        at, own = section_of(now).rows(picked), group[picked]
        near = add_cycles(self.maps, own, at, self.known, crossings)
        alone = np.flatnonzero(~near & ~np.array([self.known[g].locked for g in own]))
        alone = alone[np.unique(own[alone], return_index=True)[1]]
        for start in range(0, len(alone), TOGETHER):
            part = alone[start : start + TOGETHER]
            add_tori(self.maps, own[part], at.rows(part), self.known, report, TUBES)
        for g in np.unique(own).tolist():
            self._wait_for_cycles(g)

    def _wait_for_cycles(self, g: int) -> None:
        """From now on trajectories of the group have the time that its known cycles take to attract."""
        for cycle in self.known[g].cycles:
            constants = TIME_CONSTANTS * cycle.period / (1 - cycle.multiplier)
            self.settled_by[g] = max(self.settled_by[g], min(constants, self.most_time[g]))

    def entered(self, pending: np.ndarray, now, undecided: np.ndarray) -> dict[int, Cycle | Torus]:
        """The attractors that have captured trajectories, by row."""
        if self.maps is None:
            return {}
        asked = undecided & self._may_be_captured(now)
        return come_to(self.maps, self.group[pending], section_of(now), np.array(now.crossing), asked, self.known)

    def at_last(
        self, pending: np.ndarray, now, late: np.ndarray, proving: bool, report
    ) -> tuple[np.ndarray, dict[int, Cycle | Torus], np.ndarray, Progress]:
        """Of trajectories whose time is over: which are chaotic, and, if that is to be proved, the attractors that others come
        to, and which slide for ever; and all of them when that is so, which may be long after their time was over.
        """
        chaotic, none = np.zeros(len(pending), bool), np.zeros(0, int)
        asks = np.flatnonzero(late & self._may_be_captured(now))
        if self.maps is None or not len(asks):
            return chaotic, {}, none, now
        group, at = self.group[pending[asks]], section_of(now).rows(asks)
        if not proving:
            chaotic[asks] = followed_on(self.maps, group, at).chaotic
            return chaotic, {}, none, now
        for g in np.unique(group).tolist():
            if g not in self.known_at_last:
                self.known_at_last[g] = self.known[g].copy()

        def slides(own, at: Section) -> Bool[np.ndarray, " r"]:
            return bounds(self.shared, own, at, self.batch.pool) < 1

        found = fates(self.maps, group, at, self.known_at_last, report, slides)
        chaotic[asks] = found.chaotic
        sliding = np.flatnonzero(found.without_events)
        if len(sliding):
            bound = bounds(self.shared, group[sliding], found.at.rows(sliding), self.batch.pool)
            now.bound[asks[sliding]] = bound
            sliding = sliding[bound < 1]
        decided = np.array([*found.attractor, *sliding], int)
        now = _later(now, asks[decided], found.time[decided], found.events[decided])
        return chaotic, {int(asks[row]): one for row, one in found.attractor.items()}, asks[sliding], now

    def _may_be_captured(self, now: Progress) -> Bool[np.ndarray, " m"]:
        """Which trajectories may be on an attractor: under constant friction, sliding alone has none but its equilibrium."""
        constant = self.batch.scene.friction.constant
        return has_crossed(now) & (now.events > 0 if constant else True)


def has_crossed(now) -> Bool[np.ndarray, " m"]:
    """Which trajectories have crossed the section under their final load."""
    return np.all(np.isfinite(now.crossing), axis=1)


def section_of(now) -> Section:
    """Where trajectories are."""
    return Section(np.array(now.y), np.array(now.contact.status), np.array(now.contact.direction))
