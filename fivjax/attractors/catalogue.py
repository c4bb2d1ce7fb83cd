"""The catalogue of attractors: those that are known of each group, the search for more from where motions are, and which
motions each has captured.

Cycles are computed (`cycles`); what motions trace that no cycle captures is tried as a torus (`tori`).
"""

from collections.abc import Callable, Iterable
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from ..section.return_maps import ReturnMaps
from .approach import Approach, approaches
from .cycles import AT_FIRST, CROSSINGS, Recurrence, StableCycle, capturing_cycles, cycle_through, stable_cycles
from .motions import Motions, far_apart
from .returning import captured_by_tubes
from .tori import TUBES, Torus, contains_cycle, tori_from

# By what a motion has been captured: a cycle's neighbourhood or approach, or a torus.
CapturingSet = StableCycle | Approach | Torus


class Attractors(NamedTuple):
    """What was found of a group."""

    cycles: list[StableCycle]
    tori: list[Torus]
    approaches: list[Approach]  # to some of the cycles

    @property
    def locked(self) -> bool:
        """Whether there is a cycle of many crossings, on a locked torus: motions take long to close in on it, and nothing else
        need be sought for them.
        """
        return any(len(cycle.points) > CROSSINGS for cycle in self.cycles)

    @classmethod
    def none(cls) -> "Attractors":
        """Nothing is known yet."""
        return cls([], [], [])

    def with_cycle(self, maps: ReturnMaps, cycle: StableCycle) -> StableCycle:
        """The one of the cycles that this is, which is added if it is new."""
        before = cycle_through(maps, cycle.points[0], self.cycles)
        if before is None:
            self.cycles.append(cycle)
        return cycle if before is None else before

    def add_torus(self, torus: Torus) -> None:
        """Adds a torus unless a known one captures most of it: two motions on the same one may have been tried at once, and on
        one of more dimensions the states of neither are next to all of the other's.
        """
        if not any(np.mean(one.tube.holds(torus.tube.states)) > 0.5 for one in self.tori):
            self.tori.append(torus)

    def copy(self) -> "Attractors":
        return Attractors(*(list(own) for own in self))

    def keep_apart(self, maps: ReturnMaps) -> None:
        """Leave out approaches in whose tubes other cycles lie: what they capture may come to those."""
        others = [(one, [cycle for cycle in self.cycles if cycle is not one.cycle]) for one in self.approaches]
        self.approaches[:] = [one for one, cycles in others if not contains_cycle(maps, one.tube, cycles)]


class Catalogue(NamedTuple):
    """The attractors that are known of each group, the groups' return maps, by which more are found, and who is told that a
    search goes on (by `report(0)`).
    """

    maps: ReturnMaps
    of_group: dict[int, Attractors]
    report: Callable[[int], None]
    from_afar: bool = False  # whether cycles capture from far away, too, by their approaches

    def add_cycles(self, motions: Motions, recurrence: Recurrence = AT_FIRST) -> Bool[np.ndarray, " m"]:
        """Adds the stable cycles that these motions are near to (`cycles.stable_cycles`), and tells which of the motions are
        near to one, new or known.
        """
        near, known = np.zeros(len(motions.group), bool), {g: one.cycles for g, one in self.of_group.items()}
        found = stable_cycles(self.maps, motions, known, recurrence)
        for _, rows, _ in found:
            near[rows] = True
        self._add([(g, cycle) for g, _, cycle in found])
        return near

    def _add(self, new: list[tuple[int, StableCycle]]) -> None:
        """Adds those of these cycles of groups that are new, each with its approach."""
        added = []
        for g, cycle in new:
            if self.of_group[g].with_cycle(self.maps, cycle) is cycle:
                added.append((g, cycle))
        if self.from_afar:
            self._add_approaches(added)
        self._keep_apart(g for g, _ in added)

    def add_approaches(self, groups: list[int]) -> None:
        """Adds the approaches to those cycles of many crossings of these groups that have none."""
        known = [(g, self.of_group[g]) for g in groups]
        have = [one.cycle for _, of_group in known for one in of_group.approaches]
        self._add_approaches(
            [
                (g, cycle)
                for g, of_group in known
                for cycle in of_group.cycles
                if len(cycle.points) > CROSSINGS and not any(cycle is one for one in have)
            ]
        )
        self._keep_apart(groups)

    def _add_approaches(self, to: list[tuple[int, StableCycle]]) -> None:
        if not to:
            return
        groups = np.array([g for g, _ in to])
        for g, one in zip(groups.tolist(), approaches(self.maps, groups, [c for _, c in to], self.report), strict=True):
            if one is not None:
                self.of_group[g].approaches.append(one)

    def _keep_apart(self, groups: Iterable[int]) -> None:
        for g in set(groups):
            self.of_group[g].keep_apart(self.maps)

    def add_tori(self, motions: Motions, tubes=TUBES[:1]) -> None:
        """Adds the tori that these motions are on, and the cycles of locked ones."""
        known = [self.of_group[int(g)] for g in motions.group]
        cycles, tori = [one.cycles for one in known], [one.tori for one in known]
        tori, locked = tori_from(self.maps, motions, cycles, tori, self.report, tubes)
        for row, torus in tori.items():
            known[row].add_torus(torus)
        self._add([(int(motions.group[row]), cycle) for row, cycle, one in locked if one is None])
        for row, cycle, one in locked:
            if one is not None:
                # What the tube captures comes to the cycle in the end.
                known[row].approaches.append(Approach(known[row].with_cycle(self.maps, cycle), one))
        self._keep_apart(motions.group.tolist())

    def add_tori_by_turns(self, motions: Motions, usable: Bool[np.ndarray, " m"]) -> Bool[np.ndarray, " m"]:
        """The same from the usable motions, one of each group after the other, while there are some that none of the known
        attractors captures; which are left then.
        """
        left = usable.copy()
        for _ in range(2):
            picked = far_apart(self.maps.weights * motions.at.y, motions.group, left & usable, most=1)
            if not len(picked):
                break
            self.report(0)
            self.add_tori(motions.rows(picked))
            usable = usable.copy()
            usable[picked] = False
            usable &= ~np.isin(motions.group, [g for g, one in self.of_group.items() if one.locked])
            left[list(self.captures(motions, left))] = False
        return left

    def captures(
        self, motions: Motions, asked: Bool[np.ndarray, " m"], latest: Float[np.ndarray, "m 2n"] | None = None
    ) -> dict[int, CapturingSet]:
        """The known attractors of their groups by which motions have been captured, by row. Only those that are `asked` count;
        `latest` are their last crossings (`cycles.capturing_cycles`), unless they are on the section.
        """
        group, latest = motions.group, motions.at.y if latest is None else latest
        rows = np.flatnonzero(asked)
        if not len(rows):
            return {}
        rows = rows[np.argsort(group[rows], kind="stable")]
        which, first = np.unique(group[rows], return_index=True)
        own = [(part, self.of_group[int(g)]) for g, part in zip(which, np.split(rows, first[1:]), strict=True)]
        cycles = [(part, cycle) for part, known in own for cycle in known.cycles]
        place = capturing_cycles(self.maps, motions, latest, cycles)
        found: dict[int, CapturingSet] = {int(row): cycles[place[row]][1] for row in np.flatnonzero(place >= 0)}
        tubes = [(part[place[part] < 0], one) for part, known in own for one in (*known.tori, *known.approaches)]
        return found | captured_by_tubes(self.maps, motions, latest, tubes)

    def has_captured(self, motions: Motions) -> Bool[np.ndarray, " m"]:
        """Which of these motions on the section a known attractor has captured."""
        found = np.zeros(len(motions.group), bool)
        found[list(self.captures(motions, ~found))] = True
        return found

    def only(self, groups) -> "Catalogue":
        """The catalogue of these groups; what is added to it is added to the whole."""
        return self._replace(of_group={g: self.of_group[g] for g in groups})
