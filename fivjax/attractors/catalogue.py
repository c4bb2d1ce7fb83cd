"""The catalogue of the attractors of groups: what is known of each group, more found from where motions are, and by which of
them motions have been captured.

Cycles are computed (`cycles`); what motions trace that no cycle captures is tried as a torus (`tori`).
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from ..section.return_maps import ReturnMaps
from .cycles import AT_FIRST, CROSSINGS, Recurrence, StableCycle, capturing_cycles, is_new, stable_cycles
from .motions import Motions, far_apart
from .tori import TUBES, Torus, capturing_tori, tori_from


class Attractors(NamedTuple):
    """What was found of a group."""

    cycles: list[StableCycle]
    tori: list[Torus]

    @property
    def locked(self) -> bool:
        """Whether there is a cycle of many crossings, on a locked torus: motions take long to close in on it, and nothing else
        need be sought for them.
        """
        return any(len(cycle.points) > CROSSINGS for cycle in self.cycles)

    def copy(self) -> "Attractors":
        return Attractors(list(self.cycles), list(self.tori))

    def add_cycle(self, maps: ReturnMaps, cycle: StableCycle) -> None:
        """Add a cycle if it is new."""
        if is_new(maps, cycle, self.cycles):
            self.cycles.append(cycle)


class Catalogue(NamedTuple):
    """The attractors that are known of each group, the groups' return maps, by which more are found, and who is told that a
    search goes on (by `report(0)`).
    """

    maps: ReturnMaps
    of_group: dict[int, Attractors]
    report: Callable[[int], None]

    def add_cycles(self, motions: Motions, recurrence: Recurrence = AT_FIRST) -> Bool[np.ndarray, " m"]:
        """Adds the stable cycles that these motions are near to (`cycles.stable_cycles`), and tells which of the motions are
        near to one, new or known.
        """
        near, known = np.zeros(len(motions.group), bool), {g: one.cycles for g, one in self.of_group.items()}
        for g, rows, cycle in stable_cycles(self.maps, motions, known, recurrence):
            near[rows] = True
            self.of_group[g].add_cycle(self.maps, cycle)
        return near

    def add_tori(self, motions: Motions, tubes=TUBES[:1]) -> None:
        """Adds the tori that these motions are on, and the cycles of locked ones."""
        known = [self.of_group[int(g)] for g in motions.group]
        cycles, tori = [one.cycles for one in known], [one.tori for one in known]
        tori, locked = tori_from(self.maps, motions, cycles, tori, self.report, tubes)
        for row, torus in tori.items():
            known[row].tori.append(torus)
        for row, cycle in locked:
            known[row].add_cycle(self.maps, cycle)

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
    ) -> dict[int, StableCycle | Torus]:
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
        found: dict[int, StableCycle | Torus] = {int(row): cycles[place[row]][1] for row in np.flatnonzero(place >= 0)}
        tori = [(part[place[part] < 0], torus) for part, known in own for torus in known.tori]
        return found | capturing_tori(self.maps, motions, latest, tori)

    def only(self, groups) -> "Catalogue":
        """The catalogue of these groups; what is added to it is added to the whole."""
        return self._replace(of_group={g: self.of_group[g] for g in groups})
