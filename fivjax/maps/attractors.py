"""The attractors of a group: computed from where an ensemble of released trajectories nominates them.

What is found depends on the group alone: on no trajectory of the map, nor on their number. Cycles are computed
(`captures`); what members trace that no cycle captures is tried as a torus (`tori`).
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from ..verdicts.verdict import Verdict
from .captures import CROSSINGS, NEARLY, Cycle, captured, distinct, is_new, stable_cycles
from .flattened import Flattened
from .following import begun, follow
from .kernels import Kernels
from .section import ReturnMaps, Section
from .sharing import Batch
from .tori import TUBES, Torus, reached, tori_from

# Loads that the ensemble is released from, in final loads: its members have different energies. Where they come to may be an
# attractor, and never is an unstable cycle, which is met by nobody.
RELEASES = np.linspace(1.5, 6.0, 8)
# Steps of an ensemble after which cycles are computed from where its members are, and how nearly they have to have come back.
NEWTON_AT = {192: 0.1, 512: 0.03, 1024: 0.01}
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


def search(
    batch: Batch,
    kernels: Kernels | None,
    shared: Flattened,
    maps: ReturnMaps,
    groups: Int[np.ndarray, " g"],
    columns: Float[np.ndarray, "g h"],
    report,
) -> list[Attractors]:
    """The attractors of these groups. `columns` are the load's histories of any trajectory of each."""
    members = len(RELEASES)
    own, each = np.repeat(groups, members), np.repeat(columns, members, axis=0)
    # The ensemble's own states, not those of a trajectory.
    each[:, len(batch.history) :] = np.nan
    of_group = {int(g): Attractors([], []) for g in groups}
    running, done = own, 0
    trajectories = begun(batch, shared, own, each, np.tile(RELEASES, len(groups)))
    for stop, nearly in NEWTON_AT.items():
        if not len(running):
            break
        report(0)
        follow(batch, kernels, shared, running, trajectories, stop - done)
        done = stop
        left = _left_by_cycles(maps, running, trajectories.tree[1], of_group, nearly)
        running, trajectories = running[left], trajectories.compacted(left)
    if len(running):
        _add_tori(maps, running, trajectories.tree[1], of_group, report)
    return list(of_group.values())


def _left_by_cycles(
    maps: ReturnMaps, group, now, of_group: dict[int, Attractors], nearly: float
) -> Int[np.ndarray, " r"]:
    """The members that are still in motion where no cycle captures them; adds cycles where members are by now."""
    moving, latest, at = now.verdict == Verdict.UNDECIDED, np.array(now.crossing), section_of(now)
    usable = moving & has_crossed(now)
    captured_by = come_to(maps, group, at, latest, usable, of_group)
    usable[list(captured_by)] = moving[list(captured_by)] = False
    picked = distinct(maps.weights * latest, group, usable)
    if len(picked) and np.any(add_cycles(maps, group[picked], at.rows(picked), of_group, nearly=nearly)):
        moving[list(come_to(maps, group, at, latest, usable, of_group))] = False
    return np.flatnonzero(moving)


def _add_tori(maps: ReturnMaps, group, now, of_group: dict[int, Attractors], report) -> None:
    """Adds the tori that members are on, and the cycles of those that are locked."""
    latest, at, usable = np.array(now.crossing), section_of(now), has_crossed(now)
    for _ in range(TRIED):
        picked = distinct(maps.weights * latest, group, usable, most=1)
        if not len(picked):
            break
        report(0)
        add_tori(maps, group[picked], at.rows(picked), of_group, report)
        usable[picked] = False
        usable &= ~np.isin(group, [g for g, one in of_group.items() if one.locked])
        usable[list(come_to(maps, group, at, latest, usable, of_group))] = False


def add_cycles(
    maps: ReturnMaps,
    group: Int[np.ndarray, " m"],
    at: Section,
    of_group: dict[int, Attractors],
    crossings: int = CROSSINGS,
    settled: bool = False,
    nearly: float = NEARLY,
) -> Bool[np.ndarray, " m"]:
    """Adds the stable cycles that motions from these states are near to (`captures.stable_cycles`) to those known of their
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
    `latest` are their last crossings, see `captures.captured`.
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


def has_crossed(now) -> Bool[np.ndarray, " m"]:
    """Which trajectories have crossed the section under their final load, and had events."""
    return np.all(np.isfinite(now.crossing), axis=1) & (now.events > 0)


def section_of(now) -> Section:
    """Where trajectories are."""
    return Section(np.array(now.y), np.array(now.contact.status), np.array(now.contact.direction))
