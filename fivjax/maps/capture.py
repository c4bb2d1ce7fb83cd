"""Which trajectories of a job have been captured, and by what: the attractors of its groups, searched for and entered.

Most attractors are found by the search (`attractors.search`); others from where trajectories are that have taken long, or that
have used up their time (`attractors.long_run`).
"""

from collections import defaultdict
from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import numpy as np
from jaxtyping import Bool, Float, Int

from ..attractors.approach import Approach
from ..attractors.catalogue import Attractors, CapturingSet, Catalogue
from ..attractors.cycles import Recurrence
from ..attractors.divergence import long_divergence
from ..attractors.long_run import fates
from ..attractors.motions import Motions, far_apart
from ..attractors.search import TOGETHER, search_groups
from ..attractors.tori import TUBES, Torus
from ..contact import Status
from ..section.return_maps import INTERPOLATED, ROUNDED, ReturnMaps, Section
from ..steppers.event_exact import EventExact
from .following import Batch, bounds
from .job_files import JobState
from .one_trajectory import Progress
from .results import APPROACHED, CHAOTIC, NO_ATTRACTOR, PERIODIC, TORUS


class Late(NamedTuple):
    """What becomes of trajectories whose time is over."""

    chaotic: Bool[np.ndarray, " m"]
    attractor: dict[int, CapturingSet]  # by row
    sliding: Int[np.ndarray, " r"]  # rows of those that slide for ever
    now: Progress  # all trajectories when that is so, which may be long after their time was over


class Capture:
    """The attractors of the groups of a batch, and which trajectories have entered where they capture.

    `parameters` has those of the groups, `group` the group of each trajectory, `seeds` the group whose attractors seed the
    search in each; `report(0)` says that a search goes on.
    """

    def __init__(
        self,
        batch: Batch,
        parameters: Float[np.ndarray, "g k"],
        group: Int[np.ndarray, " m"],
        seeds: Int[np.ndarray, " g"],
        report: Callable[[int], None],
    ):
        self.batch, self.parameters, self.group, self.seeds, self.report = batch, parameters, group, seeds, report
        self.maps: ReturnMaps | None = None
        self.known: dict[int, Attractors] = {}
        # Those of each group when the time of its trajectories is over.
        self.known_at_last: dict[int, Attractors] = {}
        # Time that the known cycles of each group take to attract, and the most that is waited for them, s.
        self.settled_by = np.zeros(len(parameters))
        self.most_time = 20000.0 * np.asarray(batch.constants.modes.slowest_period)

    def _catalogue(self, maps: ReturnMaps, known: dict[int, Attractors]) -> Catalogue:
        return Catalogue(maps, known, self.report, self.batch.task.from_afar)

    def _return_maps(self) -> ReturnMaps:
        batch, own, scene = self.batch, self.batch.constants, self.batch.task.scene
        exact = batch.kernels is not None or isinstance(batch.task.method, EventExact)
        known_to = ROUNDED if exact else INTERPOLATED
        return ReturnMaps(
            scene.structure, own.mechanics, own.longest_return, batch.section_kernels, batch.pool, known_to
        )

    def state(self) -> tuple[np.ndarray, dict[int, Attractors], dict[int, Attractors]]:
        """What is known of attractors by now: the last parts of `JobState`."""
        mine, last = ({g: one.copy() for g, one in of.items()} for of in (self.known, self.known_at_last))
        return self.settled_by.copy(), mine, last

    def go_on(self, earlier: JobState) -> None:
        """Go on from that state."""
        self.known, self.known_at_last = dict(earlier.known), dict(earlier.at_last)
        self.settled_by = earlier.settled_by
        if self.known:
            self.maps = self._return_maps()

    def search(self, groups: np.ndarray, known: dict[bytes, Attractors], keep: Callable[[], None]) -> None:
        """Finds the attractors of these groups, where they are not `known`; `keep` is called when some are found."""
        self.maps = self._return_maps()
        keys = [row.tobytes() for row in self.parameters]
        seeds = {int(g): int(self.seeds[g]) for g in groups if keys[g] not in known}
        found = {g: known[keys[g]] for g in {*seeds, *seeds.values()} if keys[g] in known}

        def add(groups: list[int]) -> None:
            known.update((keys[g], found[g]) for g in groups)
            keep()

        equilibrium = np.asarray(self.batch.constants.modes.linear.equilibrium)
        search_groups(self._catalogue(self.maps, found), equilibrium, seeds, add)
        for g in groups:
            # Without what trajectories find by themselves.
            self.known[int(g)] = known[keys[g]].copy()
            self._wait_for_cycles(int(g))

    def search_alone(self, pending: np.ndarray, now: Progress, crossings: int) -> None:
        """Finds attractors from where a few trajectories of each group are that have taken long: cycles of up to so many
        `crossings`, and tori.
        """
        asks = self._may_be_captured(now)
        if not np.any(asks) or self.maps is None:
            return
        group, catalogue = self.group[pending], self._catalogue(self.maps, self.known)
        picked = far_apart(self.maps.weights * np.array(now.crossing), group, asks)
        motions = Motions(group, section_of(now)).rows(picked)
        near = catalogue.add_cycles(motions, Recurrence(crossings))
        alone = np.flatnonzero(~near & ~np.array([self.known[g].locked for g in motions.group]))
        alone = alone[np.unique(motions.group[alone], return_index=True)[1]]
        for start in range(0, len(alone), TOGETHER):
            catalogue.add_tori(motions.rows(alone[start : start + TOGETHER]), TUBES)
        for g in np.unique(motions.group).tolist():
            self._wait_for_cycles(g)

    def _wait_for_cycles(self, g: int) -> None:
        """From now on trajectories of the group have the time that its known cycles take to attract: twelve of their time
        constants, but not more than 20,000 periods of the slowest mode.
        """
        for cycle in self.known[g].cycles:
            constants = 12.0 * cycle.period / (1 - cycle.multiplier)
            self.settled_by[g] = max(self.settled_by[g], min(constants, self.most_time[g]))

    def entered(self, pending: np.ndarray, now: Progress, undecided: np.ndarray) -> dict[int, CapturingSet]:
        """The attractors that have captured trajectories, by row."""
        if self.maps is None:
            return {}
        motions, asked = Motions(self.group[pending], section_of(now)), undecided & self._may_be_captured(now)
        return self._catalogue(self.maps, self.known).captures(motions, asked, np.array(now.crossing))

    def at_last(self, pending: np.ndarray, now: Progress, late: np.ndarray, proving: bool) -> Late:
        """What becomes of trajectories whose time is over; unless that is to be proved, only which are chaotic."""
        chaotic, none = np.zeros(len(pending), bool), np.zeros(0, int)
        asks = np.flatnonzero(late & self._may_be_captured(now, growing=True))
        if self.maps is None or not len(asks):
            return Late(chaotic, {}, none, now)
        motions = Motions(self.group[pending[asks]], section_of(now).rows(asks))
        if not proving:
            chaotic[asks] = long_divergence(self.maps, motions).chaotic
            return Late(chaotic, {}, none, now)
        catalogue = self._catalogue(self.maps, self.known_at_last)
        new = [g for g in np.unique(motions.group).tolist() if g not in self.known_at_last]
        self.known_at_last.update((g, self.known[g].copy()) for g in new)
        # On a locked torus some motions are next to its unstable cycle for very long.
        catalogue.add_approaches(new)

        def slides(motions: Motions) -> Bool[np.ndarray, " r"]:
            return bounds(self.batch, *motions) < 1

        found = fates(catalogue, motions, slides)
        chaotic[asks] = found.chaotic
        sliding = np.flatnonzero(found.without_events)
        if len(sliding):
            bound = bounds(self.batch, motions.group[sliding], found.at.rows(sliding))
            now.bound[asks[sliding]] = bound
            sliding = sliding[bound < 1]
        decided = np.array([*found.attractor, *sliding], int)
        now = later(now, asks[decided], found.time[decided], found.changes[decided])
        return Late(chaotic, {int(asks[row]): one for row, one in found.attractor.items()}, asks[sliding], now)

    def _may_be_captured(self, now: Progress, growing: bool = False) -> Bool[np.ndarray, " m"]:
        """Which trajectories may be on an attractor: they have crossed the section under their final load, and under constant
        friction they have had events, or rebound, because sliding alone has no attractor but its equilibrium. Those of several
        contacts may still be `growing` towards their first event.
        """
        scene, crossed = self.batch.task.scene, np.all(np.isfinite(now.crossing), axis=1)
        without_events = not scene.friction.constant or (growing and len(scene.structure.contacts) > 1)
        slides = np.array(now.contact.status) == Status.SLIDE
        slides = np.all(slides, axis=tuple(range(1, slides.ndim)))
        return crossed if without_events else crossed & ((now.events > 0) | ~slides)


def section_of(now: Progress) -> Section:
    """Where trajectories are."""
    return Section(np.array(now.y), np.array(now.contact.status), np.array(now.contact.direction))


def later(
    now: Progress, rows: Int[np.ndarray, " r"], time: Float[np.ndarray, " r"], changes: Int[np.ndarray, " r"]
) -> Progress:
    """These trajectories after so much more time (s) and so many more changes of status. When the last was is not known."""
    t, total, last_event = (np.array(part) for part in (now.t, now.events, now.last_event))
    t[rows] += time
    total[rows] += changes
    last_event[rows[changes > 0]] = np.nan
    return eqx.tree_at(lambda now: (now.t, now.events, now.last_event), now, (t, total, last_event))


def attractor_columns(count: int, attractor: dict[int, CapturingSet], chaotic: np.ndarray) -> dict[str, np.ndarray]:
    """What results say of the attractor of each of so many trajectories, by their names of it."""
    kind = np.where(chaotic, CHAOTIC, NO_ATTRACTOR).astype(np.int8)
    told = ("amplitude", "period", "reach", "contraction", "multiplier", "position")
    numbers = dict(zip(told, np.full((len(told), count), np.nan), strict=True))
    rows_of = defaultdict(list)
    for row, captor in attractor.items():
        rows_of[id(captor)].append(row)
    for rows in rows_of.values():
        captor = attractor[rows[0]]
        one = captor.cycle if isinstance(captor, Approach) else captor
        kind[rows] = APPROACHED if one is not captor else TORUS if isinstance(one, Torus) else PERIODIC
        for name in told:
            numbers[name][rows] = getattr(one, name, np.nan)
    return {
        "amplitude": numbers.pop("amplitude"),
        **{f"attractor_{k}": v for k, v in {"kind": kind, **numbers}.items()},
    }
