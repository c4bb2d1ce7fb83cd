"""The search for the attractors of groups: from an ensemble of released trajectories, or from attractors of groups nearby.

Groups of a map lie close together. So a few of them are searched from ensembles, and their attractors seed the search in the
others (`Grid.seeding`): a cycle is continued by Newton's method, a torus by a motion that begins on it. Each is proved anew.
Where nothing can be continued, there is an ensemble, too. What else a group may have is found by trajectories that nothing
captures.

What is found of a group depends on its parameters and on those of the group that seeds it: on no trajectory of the map, nor on
their number, nor on who is in the same job.
"""

from collections.abc import Callable

import numpy as np
from jaxtyping import Float, Int

from ..verdicts.verdict import Verdict
from .attractors import Attractors, add_cycles, add_tori_by_turns, come_to, has_crossed, section_of
from .captures import CROSSINGS, distinct
from .flattened import Flattened
from .following import begun, follow
from .kernels import Kernels
from .return_maps import ReturnMaps, Section
from .sharing import Batch
from .tori import section_at

# Loads that the ensemble is released from, in final loads: its members have different energies. Where they come to may be an
# attractor, and never is an unstable cycle, which is met by nobody.
RELEASES = np.linspace(1.5, 6.0, 8)
# Steps of an ensemble after which cycles are computed from where its members are, and how nearly they have to have come back.
NEWTON_AT = {192: 0.1, 512: 0.03, 1024: 0.01}
# Groups whose ensembles are followed at once: the paths of motions that may be on tori take memory, some 0.2 MB each.
ENSEMBLES = 256
# Returns after which a motion from a cycle, or from a torus, nearby has come near to the one of its own group.
NEAR_CYCLE, NEAR_TORUS = 32, 256


def search(
    batch: Batch,
    kernels: Kernels | None,
    shared: Flattened,
    maps: ReturnMaps,
    seeds: dict[int, int],
    columns: Float[np.ndarray, " h"],
    found: dict[int, Attractors],
    report,
    complete: Callable[[list[int]], None],
) -> None:
    """Adds to those `found` the attractors of the groups in `seeds`, each with the group that seeds it: itself, where it is
    searched from an ensemble. `columns` are the load's histories of any trajectory. `complete` is told of groups whose search
    is over, some at a time.
    """

    def by_ensembles(groups: list[int]) -> None:
        for g in groups:
            found[g] = Attractors([], [])
        for start in range(0, len(groups), ENSEMBLES):
            part = groups[start : start + ENSEMBLES]
            _by_ensembles(batch, kernels, shared, maps, np.array(part), columns, found, report)
            complete(part)

    by_ensembles(sorted({seed for seed in seeds.values() if seed not in found}))
    seeded = sorted(g for g in seeds if g not in found)
    found |= {g: Attractors([], []) for g in seeded}
    for start in range(0, len(seeded), ENSEMBLES):
        part = seeded[start : start + ENSEMBLES]
        _continued(maps, {g: seeds[g] for g in part}, found, report)
        complete([g for g in part if found[g].cycles or found[g].tori])
    by_ensembles([g for g in seeded if not (found[g].cycles or found[g].tori)])


def _by_ensembles(
    batch: Batch,
    kernels: Kernels | None,
    shared: Flattened,
    maps: ReturnMaps,
    groups: Int[np.ndarray, " g"],
    columns: Float[np.ndarray, " h"],
    found: dict[int, Attractors],
    report,
) -> None:
    """Adds the attractors to which trajectories come that are released at different energies."""
    members = len(RELEASES)
    own = np.repeat(groups, members)
    each = np.tile(columns, (len(own), 1))
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
        usable = has_crossed(now) & (now.events > 0)
        add_tori_by_turns(maps, running, section_of(now), np.array(now.crossing), usable, of_group, report)


def _left_by_cycles(
    maps: ReturnMaps, group, now, of_group: dict[int, Attractors], nearly: float
) -> Int[np.ndarray, " r"]:
    """The members that are still in motion where no cycle captures them; adds cycles where members are by now."""
    moving, latest, at = now.verdict == Verdict.UNDECIDED, np.array(now.crossing), section_of(now)
    usable = moving & has_crossed(now) & (now.events > 0)
    captured_by = come_to(maps, group, at, latest, usable, of_group)
    usable[list(captured_by)] = moving[list(captured_by)] = False
    picked = distinct(maps.weights * latest, group, usable)
    if len(picked) and np.any(add_cycles(maps, group[picked], at.rows(picked), of_group, nearly=nearly)):
        moving[list(come_to(maps, group, at, latest, usable, of_group))] = False
    return np.flatnonzero(moving)


def _continued(maps: ReturnMaps, seeds: dict[int, int], found: dict[int, Attractors], report) -> None:
    """Adds the attractors of these groups to which motions come that begin on those of the group that seeds each."""
    on_cycles, on_tori = [], []
    for g, seed in seeds.items():
        for cycle in found[seed].cycles:
            # Those of many crossings lie on tori.
            (on_cycles if len(cycle.points) <= CROSSINGS else on_tori).append((g, cycle.points[0]))
        on_tori += [(g, torus.tube.states[-1] / maps.weights) for torus in found[seed].tori]
    of_group = {g: found[g] for g in seeds}
    report(0)
    group, at = _moved(maps, on_cycles, NEAR_CYCLE)
    near = add_cycles(maps, group, at, of_group)
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
    at = section_at(y, maps.normal, maps.sliding[group])
    return group, maps.returns(group, at, returns).at
