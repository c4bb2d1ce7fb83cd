"""The search for the attractors of groups: from an ensemble of released trajectories, or from attractors of groups nearby.

Groups of a map lie close together. So a few of them are searched from ensembles, and their attractors are continued to the
others: a cycle by Newton's method, a torus by a motion that begins on it. Each is proved anew. Where nothing can be continued,
there is an ensemble, too. What else a group may have is found by trajectories that nothing captures.

What is found depends on the groups that are searched together: on no trajectory of the map, nor on their number.
"""

import numpy as np
from jaxtyping import Float, Int

from ..verdicts.verdict import Verdict
from .attractors import Attractors, add_cycles, add_tori_by_turns, come_to, has_crossed, section_of
from .captures import CROSSINGS, NEARLY, distinct
from .flattened import Flattened
from .following import begun, follow
from .kernels import Kernels
from .section import ReturnMaps, Section
from .sharing import Batch
from .tori import section_at

# Loads that the ensemble is released from, in final loads: its members have different energies. Where they come to may be an
# attractor, and never is an unstable cycle, which is met by nobody.
RELEASES = np.linspace(1.5, 6.0, 8)
# Steps of an ensemble after which cycles are computed from where its members are, and how nearly they have to have come back.
NEWTON_AT = {192: 0.1, 512: 0.03, 1024: 0.01}
# Groups whose ensembles are followed at once: the paths of motions that may be on tori take memory, some 0.2 MB each.
ENSEMBLES = 256
# One in so many values of each parameter has ensembles, and attractors are continued over so many values at most.
ONE_IN, REACH = 4, 8
# Returns after which a motion from a cycle, or from a torus, nearby has come near to the one of its own group.
NEAR_CYCLE, NEAR_TORUS = 32, 256


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
    found = {int(g): Attractors([], []) for g in groups}

    def by_ensembles(places: Int[np.ndarray, " r"]) -> None:
        for start in range(0, len(places), ENSEMBLES):
            part = places[start : start + ENSEMBLES]
            _by_ensembles(batch, kernels, shared, maps, groups[part], columns[part], found, report)

    first, nearest = first_of(shared.tree.values[groups])
    by_ensembles(np.flatnonzero(first))
    near = np.flatnonzero(~first & (nearest >= 0))
    for start in range(0, len(near), ENSEMBLES):
        part = near[start : start + ENSEMBLES]
        _continued(maps, groups[part], groups[nearest[part]], found, report)
    nothing = np.array([not (found[int(g)].cycles or found[int(g)].tori) for g in groups])
    by_ensembles(np.flatnonzero(~first & nothing))
    return list(found.values())


def first_of(values: Float[np.ndarray, "g k"]) -> tuple[np.ndarray, Int[np.ndarray, " g"]]:
    """Which groups, by their parameters, are searched first: those with every so-many-th value of each; and the nearest of
    these to each group, or -1 where none is near.
    """
    ranks = np.stack([np.unique(column, return_inverse=True)[1] for column in values.T], axis=1, dtype=int)
    first = np.all(ranks % ONE_IN == 0, axis=1)
    places, nearest = np.flatnonzero(first), np.full(len(values), -1)
    if len(places):
        from scipy.spatial import KDTree

        _, own = KDTree(ranks[places]).query(ranks, distance_upper_bound=REACH)
        nearest = np.where(own < len(places), places[np.minimum(own, len(places) - 1)], -1)
    return first, nearest


def _by_ensembles(
    batch: Batch,
    kernels: Kernels | None,
    shared: Flattened,
    maps: ReturnMaps,
    groups: Int[np.ndarray, " g"],
    columns: Float[np.ndarray, "g h"],
    found: dict[int, Attractors],
    report,
) -> None:
    """Adds the attractors to which trajectories come that are released at different energies."""
    members = len(RELEASES)
    own, each = np.repeat(groups, members), np.repeat(columns, members, axis=0)
    # The ensemble's own states, not those of a trajectory.
    each[:, len(batch.history) :] = np.nan
    of_group = {int(g): found[int(g)] for g in groups}
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
        now = trajectories.tree[1]
        add_tori_by_turns(maps, running, section_of(now), np.array(now.crossing), has_crossed(now), of_group, report)


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


def _continued(
    maps: ReturnMaps,
    groups: Int[np.ndarray, " g"],
    neighbours: Int[np.ndarray, " g"],
    found: dict[int, Attractors],
    report,
) -> None:
    """Adds the attractors of these groups to which motions come that begin on those of a neighbour of each."""
    on_cycles, on_tori = [], []
    for g, neighbour in zip(groups.tolist(), neighbours.tolist(), strict=True):
        for cycle in found[neighbour].cycles:
            # Those of many crossings lie on tori.
            (on_cycles if len(cycle.points) <= CROSSINGS else on_tori).append((g, cycle.points[0]))
        on_tori += [(g, torus.tube.states[-1] / maps.weights) for torus in found[neighbour].tori]
    of_group = {int(g): found[int(g)] for g in groups}
    report(0)
    group, at = _moved(maps, on_cycles, NEAR_CYCLE)
    near = add_cycles(maps, group, at, of_group, nearly=NEARLY) if len(group) else np.zeros(0, bool)
    further, on_torus = _moved(maps, on_tori, NEAR_TORUS)
    group = np.concatenate([group[~near], further])
    at = Section(*(np.concatenate(parts) for parts in zip(at.rows(~near), on_torus, strict=True)))
    usable = np.all(np.isfinite(at.y), axis=1)
    usable[list(come_to(maps, group, at, at.y, usable, of_group))] = False
    add_tori_by_turns(maps, group, at, at.y, usable, of_group, report)


def _moved(maps: ReturnMaps, starts: list, returns: int) -> tuple[Int[np.ndarray, " m"], Section]:
    """The groups of these starts on the section, and where motions from there are after so many returns."""
    group = np.array([g for g, _ in starts], int)
    y = np.array([y for _, y in starts]).reshape(len(starts), len(maps.weights))
    return group, maps.returns(group, section_at(y, maps.normal, maps.sliding[group]), returns).at
