"""The search for the attractors of groups: from motions that are released about steady sliding, or from attractors nearby.

Groups of a map lie close together. So a few of them are searched by releases, and their attractors seed the search in others
(`Grid.seeding`): a cycle is continued by Newton's method, a torus by a motion that begins on it. Each is proved anew. Where
nothing can be continued, motions are released there, too. What else a group may have is found by trajectories that nothing
captures. The limit cycles of one scene are those of a group of one.

What is found of a group depends on its parameters and on those of the group that seeds it: on no trajectory of the map, nor on
their number, nor on who is in the same job.
"""

from collections.abc import Callable

import numpy as np
from jaxtyping import Float, Int

from ..section.return_maps import ReturnMaps, Section
from .cycles import CROSSINGS, distinct
from .known import Attractors, add_cycles, add_tori_by_turns, come_to
from .tori import section_at

# Loads from which motions are released, in final loads: they have different energies. Where they come to may be an attractor,
# and never is an unstable cycle, which is met by nobody.
RELEASES = np.linspace(1.5, 6.0, 8)
# Returns after which cycles are computed from where motions are, and how nearly they have to have come back.
NEWTON_AT = {24: 0.1, 64: 0.03, 128: 0.01}
# A motion that has had no event for half of these returns, and shrinks by this factor meanwhile, fades.
FADES = 0.9
# Groups whose motions are followed at once: the paths of those that may be on tori take memory, some 0.2 MB each.
TOGETHER = 256
# Returns after which a motion from a cycle, or from a torus, nearby has come near to the one of its own group.
NEAR_CYCLE, NEAR_TORUS = 32, 256


def search_groups(
    maps: ReturnMaps,
    equilibrium: Float[np.ndarray, "g 2n"],
    seeds: dict[int, int],
    found: dict[int, Attractors],
    report: Callable[[int], None],
    complete: Callable[[list[int]], None],
) -> None:
    """Adds to those `found` the attractors of the groups in `seeds`, each with the group that seeds it: itself, where motions
    are released from multiples of its `equilibrium` under the final load. `complete` is told of groups whose search is over,
    some at a time.
    """

    def by_releases(groups: list[int]) -> None:
        for start in range(0, len(groups), TOGETHER):
            part = groups[start : start + TOGETHER]
            found.update((g, Attractors([], [])) for g in part)
            _by_releases(maps, equilibrium, np.array(part), {g: found[g] for g in part}, report)
            complete(part)

    by_releases(sorted({seed for seed in seeds.values() if seed not in found}))
    seeded = sorted(g for g in seeds if g not in found)
    found |= {g: Attractors([], []) for g in seeded}
    for start in range(0, len(seeded), TOGETHER):
        part = seeded[start : start + TOGETHER]
        _continued(maps, {g: seeds[g] for g in part}, found, report)
        complete([g for g in part if found[g].cycles or found[g].tori])
    by_releases([g for g in seeded if not (found[g].cycles or found[g].tori)])


def _by_releases(maps: ReturnMaps, equilibrium, groups: Int[np.ndarray, " g"], of_group: dict[int, Attractors], report):
    """Adds the attractors to which motions come that are released at different energies."""
    own = np.repeat(groups, len(RELEASES))
    at = maps.in_contact(own, (np.tile(RELEASES, len(groups)) - 1.0)[:, None] * equilibrium[own])
    search_from(maps, own, at, of_group, report)


def search_from(
    maps: ReturnMaps,
    group: Int[np.ndarray, " m"],
    at: Section,
    of_group: dict[int, Attractors],
    report: Callable[[int], None],
) -> tuple[Int[np.ndarray, " r"], Section]:
    """Adds the attractors to which motions from these states come; and which are still in motion then, captured by none, and
    where they are.
    """
    rows, done = np.arange(len(group)), 0
    for stop, nearly in NEWTON_AT.items():
        if not len(rows):
            return rows, at
        report(0)
        rows, at = _further(maps, group, rows, at, stop - done)
        done, own = stop, group[rows]
        captured = np.zeros(len(rows), bool)
        captured[list(come_to(maps, own, at, at.y, ~captured, of_group))] = True
        picked = distinct(maps.weights * at.y, own, ~captured)
        if len(picked) and np.any(add_cycles(maps, own[picked], at.rows(picked), of_group, nearly=nearly)):
            captured[list(come_to(maps, own, at, at.y, ~captured, of_group))] = True
        rows, at = rows[~captured], at.rows(~captured)
    left = add_tori_by_turns(maps, group[rows], at, np.ones(len(rows), bool), of_group, report)
    return rows[left], at.rows(left)


def _further(maps: ReturnMaps, group, rows: Int[np.ndarray, " r"], at: Section, returns: int):
    """Those of the motions that neither fade nor stop crossing the section in so many returns; and where they are then."""
    half = returns // 2
    middle = maps.returns(group[rows], at, half).at
    last = maps.returns(group[rows], middle, returns - half)
    with np.errstate(invalid="ignore"):
        shrinks = np.linalg.norm(maps.weights * last.at.y, axis=1) < FADES * np.linalg.norm(
            maps.weights * middle.y, axis=1
        )
        goes_on = ~((last.events == 0) & shrinks) & maps.moves(group[rows], last.at.y)
    return rows[goes_on], last.at.rows(goes_on)


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
    add_tori_by_turns(maps, group, at, usable, of_group, report)


def _moved(maps: ReturnMaps, starts: list, returns: int) -> tuple[Int[np.ndarray, " m"], Section]:
    """The groups of these starts on the section, and where motions from there are after so many returns."""
    group = np.array([g for g, _ in starts], int)
    y = np.array([y for _, y in starts]).reshape(len(starts), len(maps.weights))
    at = section_at(y, maps.normal, maps.sliding[group])
    return group, maps.returns(group, at, returns).at
