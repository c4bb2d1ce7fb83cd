"""Motions that come to tubes: whether all that starts on a tube's edge comes back to it, and which motions have come home."""

from typing import Protocol, TypeVar

import numpy as np
from jaxtyping import Float, Int

from ..section.return_maps import ReturnMaps, Section
from . import tube
from .motions import Motions
from .tube import Tube

# Starts on a tube's edge are back when they are in this share of it, which is less than what captures: next to a slow fade
# there is a direction in which they come back hardly at all.
BACK_TO = 0.25


def tubes_returned_to(
    maps: ReturnMaps, group: Int[np.ndarray, " s"], tubes: list[Tube], starts: Section, report
) -> tuple[Int[np.ndarray, " t"], Section]:
    """To which tubes all `starts` come back, within so many crossings; and where the starts are then, tube by tube. The first
    few starts tell most sets that do not attract.
    """
    weights, count, first, within = maps.weights, len(starts.y) // len(tubes), 4, 1536
    own, last = np.repeat(group, count), Section(*(part.copy() for part in starts))
    back, ok = np.zeros(len(own), bool), np.ones(len(tubes), bool)
    smallest = np.array([np.min(np.linalg.norm(one.states, axis=1)) for one in tubes])
    place, of_tube = np.arange(len(own)) % count, np.arange(len(own)) // count
    for among in (place < first, place >= first):
        running = np.flatnonzero(among & ok[of_tube])
        crossed = 0
        while crossed < within and len(running):
            report(0)
            # Most are back soon; the others are looked at in growing steps.
            further = min(max(tube.RETURNS_INSIDE, crossed // 2), within - crossed)
            crossed += further
            image = maps.returns(own[running], last.rows(running), further, tube.RETURNS_INSIDE)
            last.put(running, image.at)
            ends = weights * np.moveaxis(image.path, 1, 0)
            # One that fades, or fails, does not come back.
            with np.errstate(invalid="ignore"):
                lost = ~(np.linalg.norm(ends[-1], axis=1) > 0.5 * smallest[of_tube[running]])
            ok[of_tube[running[lost]]] = False
            for k in np.unique(of_tube[running]):
                mine = of_tube[running] == k
                back[running[mine]] = tubes[k].holds_all(ends[:, mine], BACK_TO)
            running = running[ok[of_tube[running]] & ~back[running]]
        ok[of_tube[among & ~back]] = False
    return np.flatnonzero(ok), last


def starts_on_edges(maps: ReturnMaps, group: Int[np.ndarray, " s"], tubes: list[Tube]) -> Section:
    """The starts on the edge of each of these tubes, tube by tube."""
    return starts_at(maps, group, [one.starts(*_constraints(maps)) for one in tubes])


def starts_beyond(
    maps: ReturnMaps, group: Int[np.ndarray, " s"], tubes: list[Tube], centres: list[Float[np.ndarray, "k 2n"]]
) -> Section:
    """The same, from each tube's first states, away from the nearest of its centres."""
    found = []
    for one, points in zip(tubes, centres, strict=True):
        first = one.states[: tube.STARTS]
        away = first - points[np.argmin(np.linalg.norm(first[:, None] - points, axis=2), axis=1)]
        found.append(one.displaced(first, away, *_constraints(maps)))
    return starts_at(maps, group, found)


def starts_at(maps: ReturnMaps, group: Int[np.ndarray, " s"], states: list[Float[np.ndarray, "m 2n"]]) -> Section:
    """`STARTS` weighted states of each of these groups, as states of the section."""
    return maps.with_modes(np.repeat(group, tube.STARTS), np.concatenate(states) / maps.weights)


def _constraints(maps: ReturnMaps) -> tuple[Float[np.ndarray, " n"], Int[np.ndarray, " c"]]:
    """The section's weights of velocities, in weighted coordinates, and the indices of the normal displacements."""
    return maps.section / maps.weights[maps.structure.size :], np.atleast_1d(maps.normal)


class HasTube(Protocol):
    """What captures by a tube: a torus, or the approach to a cycle."""

    @property
    def tube(self) -> Tube: ...


Tubular = TypeVar("Tubular", bound=HasTube)


def captured_by_tubes(
    maps: ReturnMaps,
    motions: Motions,
    latest: Float[np.ndarray, "m 2n"],
    known: list[tuple[Int[np.ndarray, " r"], Tubular]],
) -> dict[int, Tubular]:
    """The one of these sets whose tube has captured each motion, by row. `known` has each set with the rows that it may have
    captured. As in `cycles.capturing_cycles`, the last crossings known, `latest`, tell which to ask; their next ones decide.
    """
    near = []
    for rows, one in known:
        within = 0.5 + maps.known_to / one.tube.radius
        near.append(rows[one.tube.holds(maps.weights * latest[rows], within)])
    asked = np.unique(np.concatenate([np.zeros(0, int), *near]))
    if not len(asked):
        return {}
    _, paths = maps.path(*motions.rows(asked), tube.RETURNS_INSIDE)
    found: dict[int, Tubular] = {}
    for (_, one), rows in zip(known, near, strict=True):
        open_ = np.array([row for row in rows if row not in found], int)
        if len(open_):
            ends = maps.weights * np.moveaxis(paths[np.searchsorted(asked, open_)], 1, 0)
            found |= dict.fromkeys(open_[one.tube.holds_all(ends)].tolist(), one)
    return found
