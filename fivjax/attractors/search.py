"""The search for the attractors of groups: from motions that are released about steady sliding, or from attractors nearby.

Groups of a map lie close together. So a few of them are searched by releases, and their attractors seed the search in others
(`Grid.seeding`): a cycle is continued by Newton's method, a torus by a motion that begins on it. Each is proved anew. Where
nothing can be continued, motions are released there, too. What else a group may have is found by trajectories that nothing
captures. The limit cycles of one scene are those of a group of one.

What is found of a group depends on its parameters, on those of the group that seeds it, and on the structure by which the map
measures states (`maps.axes.at_middle`): on no trajectory of the map, nor on their number, nor on who is in the same job.
"""

from collections.abc import Callable

import numpy as np
from jaxtyping import Bool, Float, Int

from ..section.return_maps import Images, ReturnMaps, Section
from .approach import LONGEST, returns_from
from .catalogue import Attractors, Catalogue
from .cycles import AT_FIRST, CROSSINGS, MORE_CROSSINGS, Recurrence
from .motions import Motions, far_apart

# Groups whose motions are followed at once: the paths of those that may be on tori take memory, some 0.2 MB each.
TOGETHER = 256
# Returns after which motions that are followed are asked whether they have been captured.
FOLLOWED = 256


def search_groups(
    catalogue: Catalogue,
    equilibrium: Float[np.ndarray, "g 2n"],
    seeds: dict[int, int],
    complete: Callable[[list[int]], None],
) -> None:
    """Adds to the catalogue the attractors of the groups in `seeds`, each with the group that seeds it: itself, where motions
    are released from multiples of its `equilibrium` under the final load. `complete` is told of groups whose search is over,
    some at a time.
    """
    found = catalogue.of_group

    def by_releases(groups: list[int]) -> None:
        for start in range(0, len(groups), TOGETHER):
            part = groups[start : start + TOGETHER]
            found.update((g, Attractors.none()) for g in part)
            _by_releases(catalogue.only(part), equilibrium, np.array(part))
            complete(part)

    by_releases(sorted({seed for seed in seeds.values() if seed not in found}))
    seeded = sorted(g for g in seeds if g not in found)
    found |= {g: Attractors.none() for g in seeded}
    for start in range(0, len(seeded), TOGETHER):
        part = seeded[start : start + TOGETHER]
        _continue_from_seeds(catalogue, {g: seeds[g] for g in part})
        complete([g for g in part if found[g].cycles or found[g].tori])
    by_releases([g for g in seeded if not (found[g].cycles or found[g].tori)])


def _by_releases(catalogue: Catalogue, equilibrium: Float[np.ndarray, "g 2n"], groups: Int[np.ndarray, " g"]) -> None:
    """Adds the attractors to which motions come that are released at different energies: from rest under several multiples of
    the final load. Where they come to may be an attractor, and never is an unstable cycle, which is met by nobody.
    """
    loads = np.linspace(1.5, 6.0, 8)
    own = np.repeat(groups, len(loads))
    at = catalogue.maps.in_contact(own, (np.tile(loads, len(groups)) - 1.0)[:, None] * equilibrium[own])
    search_from(catalogue, Motions(own, at))


def search_from(catalogue: Catalogue, motions: Motions) -> Motions:
    """Adds the attractors to which motions from these states come; and the motions that are still going on then, captured by
    none.
    """
    done, weights = 0, catalogue.maps.weights
    # Returns after which cycles are computed from where motions are, and how nearly they have to have come back.
    for stop, nearly in {24: 0.1, 64: 0.03, 128: 0.01}.items():
        if not len(motions.group):
            return motions
        catalogue.report(0)
        motions, done = _follow_lasting(catalogue.maps, motions, stop - done), stop
        captured = catalogue.has_captured(motions)
        picked = far_apart(weights * motions.at.y, motions.group, ~captured)
        if len(picked) and np.any(catalogue.add_cycles(motions.rows(picked), Recurrence(nearly=nearly))):
            captured[list(catalogue.captures(motions, ~captured))] = True
        motions = motions.rows(~captured)
    return motions.rows(catalogue.add_tori_by_turns(motions, np.ones(len(motions.group), bool)))


def follow_into_slow_cycles(catalogue: Catalogue, motions: Motions) -> Motions:
    """What is left of the motions, each where it was last followed to, without those that an attractor captures in twice the
    time in which the slowest known cycle of their group draws them in, from as far away as it is large; in `LONGEST` returns at
    most. A few of each group are followed first, and the others only where one of these is captured.
    """
    maps, group, every = catalogue.maps, motions.group, np.arange(len(motions.group))
    slowest = {
        g: max((returns_from(one, 1.0) for one in own.cycles), default=0.0) for g, own in catalogue.of_group.items()
    }
    within = np.minimum([2 * slowest[g] for g in group.tolist()], LONGEST)
    motions, left = motions.rows(every), np.ones(len(group), bool)
    few = far_apart(maps.weights * motions.at.y, group, within > 0)
    for some in (few, np.delete(every, few)):
        some = some[within[some] > 0]
        for done in range(0, LONGEST, FOLLOWED):
            rows = some[left[some] & (within[some] > done)]
            if not len(rows):
                break
            catalogue.report(0)
            before = motions.rows(rows)
            later = maps.returns(*before, FOLLOWED)
            goes_on = _goes_on(maps, before, later)
            within[rows[~goes_on]] = 0.0
            rows = rows[goes_on]
            motions.at.put(rows, later.at.rows(goes_on))
            left[rows[list(catalogue.captures(motions.rows(rows), np.ones(len(rows), bool)))]] = False
        within[~np.isin(group, group[some[~left[some]]])] = 0.0
    return motions.rows(left)


def _follow_lasting(maps: ReturnMaps, motions: Motions, returns: int) -> Motions:
    """Those of the motions, so many returns later, that neither fade nor stop crossing the section."""
    half = returns // 2
    middle = Motions(motions.group, maps.returns(*motions, half).at)
    last = maps.returns(*middle, returns - half)
    return Motions(motions.group, last.at).rows(_goes_on(maps, middle, last))


def _goes_on(maps: ReturnMaps, before: Motions, later: Images) -> Bool[np.ndarray, " m"]:
    """Which of these motions neither fade nor stop crossing the section on their way to `later`."""
    with np.errstate(invalid="ignore"):
        was, now = (np.linalg.norm(maps.weights * at.y, axis=1) for at in (before.at, later.at))
        # One that has had no event, and has shrunk by a tenth, fades.
        return ~((later.events == 0) & (now < 0.9 * was)) & maps.moves(before.group, later.at.y)


def _continue_from_seeds(catalogue: Catalogue, seeds: dict[int, int]) -> None:
    """Adds the attractors of these groups to which motions come that begin on those of the group that seeds each."""
    few, many, on_tori = [], [], []
    for g, seed in seeds.items():
        for cycle in catalogue.of_group[seed].cycles:
            (few if len(cycle.points) <= CROSSINGS else many).append((g, cycle.points[0]))
        on_tori += [(g, torus.tube.states[-1] / catalogue.maps.weights) for torus in catalogue.of_group[seed].tori]
    own = catalogue.only(seeds)
    catalogue.report(0)
    # Returns after which a motion from a cycle, or from a torus, nearby has come near to the one of its own group.
    near_cycle, near_torus = 32, 256
    left = []
    for starts, recurrence in ((few, AT_FIRST), (many, Recurrence(MORE_CROSSINGS))):
        motions = _follow_from(catalogue.maps, starts, near_cycle)
        left.append(motions.rows(~own.add_cycles(motions, recurrence)))
    # Cycles of many crossings lie on tori.
    group, at = left[-1]
    left[-1] = Motions(group, catalogue.maps.returns(group, at, near_torus - near_cycle).at)
    left.append(_follow_from(catalogue.maps, on_tori, near_torus))
    group = np.concatenate([motions.group for motions in left])
    at = Section(*(np.concatenate(parts) for parts in zip(*(motions.at for motions in left), strict=True)))
    motions, usable = Motions(group, at), np.all(np.isfinite(at.y), axis=1)
    usable[list(own.captures(motions, usable))] = False
    own.add_tori_by_turns(motions, usable)


def _follow_from(maps: ReturnMaps, starts: list, returns: int) -> Motions:
    """Motions from these starts on the section, each with its group, so many returns later."""
    group = np.array([g for g, _ in starts], int)
    y = np.array([y for _, y in starts]).reshape(len(starts), len(maps.weights))
    at = maps.with_modes(group, y)
    return Motions(group, maps.returns(group, at, returns).at)
