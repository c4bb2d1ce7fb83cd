"""The attractors of groups: what is known of each, attractors added from where motions are, and who has come to which.

Cycles are computed (`cycles`); what motions trace that no cycle captures is tried as a torus (`tori`).
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from ..section.return_maps import ReturnMaps, Section
from .cycles import CROSSINGS, NEARLY, Cycle, captured, distinct, is_new, stable_cycles
from .tori import TUBES, Torus, reached, tori_from

# Members of each group that are tried for a torus, one after the other.
TRIED = 2


class Attractors(NamedTuple):
    """What was found of a group."""

    cycles: list[Cycle]
    tori: list[Torus]

    @property
    def locked(self) -> bool:
        """Whether there is a cycle of many crossings, on a locked torus: motions take long to close in on it, and nothing else
        need be sought for them.
        """
        return any(len(cycle.points) > CROSSINGS for cycle in self.cycles)

    def copy(self) -> "Attractors":
        return Attractors(list(self.cycles), list(self.tori))


def add_cycles(
    maps: ReturnMaps,
    group: Int[np.ndarray, " m"],
    at: Section,
    of_group: dict[int, Attractors],
    crossings: int = CROSSINGS,
    settled: bool = False,
    nearly: float = NEARLY,
) -> Bool[np.ndarray, " m"]:
    """Adds the stable cycles that motions from these states are near to (`cycles.stable_cycles`) to those known of their
    groups; and which of the motions are near to one, new or known.
    """
    near, known = np.zeros(len(group), bool), {g: one.cycles for g, one in of_group.items()}
    for g, rows, cycle in stable_cycles(maps, group, at, known, crossings, settled, nearly):
        near[rows] = True
        _add_cycle(maps, of_group[g], cycle)
    return near


def add_tori(
    maps: ReturnMaps,
    group: Int[np.ndarray, " m"],
    at: Section,
    of_group: dict[int, Attractors],
    report,
    tubes=TUBES[:1],
) -> None:
    """Adds the tori that motions from these states are on to those known of their groups, and the cycles of locked ones."""
    known = [of_group[int(g)] for g in group]
    tori, locked = tori_from(maps, group, at, [one.cycles for one in known], [one.tori for one in known], report, tubes)
    for row, torus in tori.items():
        known[row].tori.append(torus)
    for row, cycle in locked:
        _add_cycle(maps, known[row], cycle)


def add_tori_by_turns(
    maps: ReturnMaps,
    group: Int[np.ndarray, " m"],
    at: Section,
    usable: Bool[np.ndarray, " m"],
    of_group: dict[int, Attractors],
    report,
) -> Bool[np.ndarray, " m"]:
    """The same from where the usable motions are on the section, one of each group after the other, while there are some that
    none of the known attractors captures; which are left then.
    """
    left = usable.copy()
    for _ in range(TRIED):
        picked = distinct(maps.weights * at.y, group, left & usable, most=1)
        if not len(picked):
            break
        report(0)
        add_tori(maps, group[picked], at.rows(picked), of_group, report)
        usable = usable.copy()
        usable[picked] = False
        usable &= ~np.isin(group, [g for g, one in of_group.items() if one.locked])
        left[list(come_to(maps, group, at, at.y, left, of_group))] = False
    return left


def _add_cycle(maps: ReturnMaps, known: Attractors, cycle: Cycle) -> None:
    if is_new(maps, cycle, known.cycles):
        known.cycles.append(cycle)


def come_to(
    maps: ReturnMaps,
    group: Int[np.ndarray, " m"],
    at: Section,
    latest: Float[np.ndarray, "m 2n"],
    asked: Bool[np.ndarray, " m"],
    of_group: dict[int, Attractors],
) -> dict[int, Cycle | Torus]:
    """The known attractors of their groups by which trajectories have been captured, by row. Only those that are `asked` count;
    `latest` are their last crossings, see `cycles.captured`.
    """
    rows = np.flatnonzero(asked)
    if not len(rows):
        return {}
    rows = rows[np.argsort(group[rows], kind="stable")]
    which, first = np.unique(group[rows], return_index=True)
    own = [(part, of_group[int(g)]) for g, part in zip(which, np.split(rows, first[1:]), strict=True)]
    cycles = [(part, cycle) for part, known in own for cycle in known.cycles]
    place = captured(maps, group, at, latest, cycles)
    found: dict[int, Cycle | Torus] = {int(row): cycles[place[row]][1] for row in np.flatnonzero(place >= 0)}
    tori = [(part[place[part] < 0], torus) for part, known in own for torus in known.tori]
    return found | reached(maps, group, at, latest, tori)
