"""Stable cycles of many groups, closed side by side from states to which trajectories nearly return, and which motions each has
captured.

The return map is evaluated for many points of many groups in one batch: for Newton's method with its derivative, for
neighbourhoods (`neighbourhood`) and for crossings of trajectories without. Everything else is small linear algebra.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from ..contact import Status
from ..section.return_maps import ReturnMaps, Section
from .closing import Closed, close
from .motions import Motions, position_of
from .neighbourhood import LARGEST, CycleTrial, Neighbourhood, ReturnImages, cycle_trials, neighbourhoods, side_by_side

# Crossings of the section in one period: of cycles that are sought first; of those on a torus that is locked to them; and of
# those on which neighbours close in.
CROSSINGS, MORE_CROSSINGS, MOST_CROSSINGS = 8, 40, 512
# A multiplier of the section's return map this close to 1 counts as 1.
FAMILY_TOLERANCE = 1e-7


class Recurrence(NamedTuple):
    """How a motion has to come back to the section for a cycle to be computed near it, and which cycles then count."""

    crossings: int = CROSSINGS  # it comes back within so many crossings
    nearly: float = 0.1  # to within this share of its size
    # Its time is over: it has settled on a cycle, or never will. All cycles count then, however weakly they attract and however
    # near one has to be.
    settled: bool = False

    def is_met(self, missed: Float[np.ndarray, " m"], lag: Int[np.ndarray, " m"]) -> Bool[np.ndarray, " m"]:
        """Which motions come back, if they miss their start by such shares of their size after so many crossings."""
        # After many crossings any motion on a torus comes back nearly.
        few, many = (1e-3, 1e-4) if self.settled else (self.nearly, 0.02)
        return missed <= np.where(lag > CROSSINGS, many, few)

    def attracts_soon(self, multiplier: float, crossings: int) -> bool:
        """Whether a cycle is one that motions come to soon. One of many crossings that attracts weakly lies on a torus that is
        locked weakly: that is better taken as one.
        """
        return self.settled or crossings <= CROSSINGS or not multiplier > 0.95


AT_FIRST = Recurrence()


class StableCycle(NamedTuple):
    """A stable periodic cycle of a group, with the neighbourhood in which it captures."""

    points: Float[np.ndarray, "k 2n"]  # its states on the section, in order; the first is the neighbourhood's centre
    period: float  # s
    multiplier: float  # the size of the largest, but the one of the cycle's own direction
    amplitude: float  # m/s
    neighbourhood: Neighbourhood

    @property
    def reach(self) -> float:
        """The neighbourhood's radius, relative to the cycle's size in the same norm."""
        about = self.neighbourhood
        return float(about.radius / np.linalg.norm(about.norm @ about.centre))

    @property
    def contraction(self) -> float:
        """The largest factor by which distances in the neighbourhood change in one period."""
        return self.neighbourhood.contraction

    @property
    def position(self) -> float:
        """See `position_of`."""
        return position_of(self.points)


def stable_cycles(
    maps: ReturnMaps, motions: Motions, known: dict[int, list[StableCycle]], recurrence: Recurrence = AT_FIRST
) -> list[tuple[int, Int[np.ndarray, " r"], StableCycle]]:
    """The stable cycles that motions are near to: of each the group, the rows that led to it, and it. Those of a group that are
    `known` are not computed anew.
    """
    near, closed = close_recurring(maps, motions, recurrence)
    group, lag = motions.group, closed.crossings
    points_of = points_on(maps, group[near], closed)
    # Of those that are the same, at whichever of its crossings, the first stands for all.
    kept: list[int] = []
    rows_of: list[list[int]] = []
    alike: dict[tuple[int, int], list[int]] = {}
    for row in range(len(near)):
        kind = int(group[near[row]]), int(lag[row])
        for k in alike.setdefault(kind, []):
            if _passes(maps, closed.at.y[row], points_of[kept[k]]):
                rows_of[k].append(near[row])
                break
        else:
            alike[kind].append(len(kept))
            kept.append(row)
            rows_of.append([near[row]])
    before = [cycle_through(maps, closed.at.y[row], known.get(int(group[near[row]]), [])) for row in kept]
    largest = np.max(np.abs(np.linalg.eigvals(closed.jacobian[kept])), axis=1)
    found, new = [], []
    for k, row in enumerate(kept):
        if before[k] is not None:
            found.append((int(group[near[row]]), np.array(rows_of[k]), before[k]))
        elif recurrence.attracts_soon(largest[k], lag[row]):
            new.append(k)
    if not new:
        return found
    attempts = _trials(maps, closed, np.array(kept)[new], recurrence)
    stable = [k for k, attempt in zip(new, attempts, strict=True) if attempt is not None]
    trials = [attempt for attempt in attempts if attempt is not None]
    if not stable:
        return found
    chosen = np.array(kept)[stable]
    own, centre = group[near[chosen]], closed.at.rows(chosen)
    about = neighbourhoods(trials, _return_map(maps, own, centre, lag[chosen]))
    amplitude = maps.peaks(own, centre, lag[chosen])
    for k, row, where, peak in zip(stable, chosen, about, amplitude, strict=True):
        if where is not None:
            cycle = StableCycle(points_of[row], float(closed.period[row]), float(largest[k]), float(peak), where)
            found.append((int(group[near[row]]), np.array(rows_of[k]), cycle))
    return found


def close_recurring(
    maps: ReturnMaps, motions: Motions, recurrence: Recurrence = AT_FIRST
) -> tuple[Int[np.ndarray, " r"], Closed]:
    """The rows of motions that nearly repeat and that Newton's method makes a cycle of, and the cycles."""
    group = motions.group
    last, states = maps.path(*motions, recurrence.crossings + 1)
    path = maps.weights * states  # [row, crossing, coordinate]
    size = np.linalg.norm(path[:, -1], axis=-1)
    with np.errstate(invalid="ignore", divide="ignore"):
        back = np.linalg.norm(path[:, -2::-1] - path[:, -1:], axis=-1) / size[:, None]
        nearest = back.min(axis=1)
        lag = 1 + np.argmax(back <= np.maximum(1.5 * nearest, 1e-9)[:, None], axis=1)
        repeats = recurrence.is_met(nearest, lag)
    near = np.flatnonzero(np.isfinite(size) & maps.moves(group, states[:, -1]) & repeats)
    closed = close(maps, group[near], last.rows(near), lag[near])
    # Sliding closes upon itself as well.
    kept = np.flatnonzero(closed.found & maps.moves(group[near], closed.at.y))
    at, *others = closed
    return near[kept], Closed(at.rows(kept), *(part[kept] for part in others))


def points_on(maps: ReturnMaps, group: Int[np.ndarray, " m"], closed: Closed) -> list[Float[np.ndarray, "_ 2n"]]:
    """The states of each of these cycles on the section, in order."""
    if not len(group):
        return []
    _, later = maps.path(group, closed.at, int(np.max(closed.crossings)))
    whole = np.concatenate([closed.at.y[:, None], later], axis=1)
    return [points[:count] for points, count in zip(whole, closed.crossings, strict=True)]


def in_families(maps: ReturnMaps, motions: Motions) -> Bool[np.ndarray, " m"]:
    """Which motions are near periodic ones that are one of a family each: a second multiplier is 1, because oscillators without
    coupling may be shifted against each other in time.
    """
    group = motions.group
    found = np.zeros(len(group), bool)
    if len(maps.structure.contacts) == 1:
        return found
    near, closed = close_recurring(maps, motions)
    multipliers = np.linalg.eigvals(closed.jacobian)
    found[near] = np.any(np.abs(multipliers - 1.0) < FAMILY_TOLERANCE, axis=1)
    return found


def cycle_through(maps: ReturnMaps, y: Float[np.ndarray, " 2n"], cycles: list[StableCycle]) -> StableCycle | None:
    """The one of these cycles that has this state among its points."""
    return next((cycle for cycle in cycles if _passes(maps, y, cycle.points)), None)


def _passes(maps: ReturnMaps, y: Float[np.ndarray, " 2n"], points: Float[np.ndarray, "k 2n"]) -> bool:
    """Whether this state is among those points, but for a share of its size by which two computations of a cycle may differ."""
    apart = np.min(np.linalg.norm(maps.weights * (points - y), axis=1))
    return bool(apart < 1e-6 * np.linalg.norm(maps.weights * y))


def _trials(
    maps: ReturnMaps, closed: Closed, rows: Int[np.ndarray, " m"], recurrence: Recurrence
) -> list[CycleTrial | None]:
    """The checks to be made for these of the cycles."""
    at = closed.at.rows(rows)
    weights = np.array([maps.weights * _just_opened(maps, *one) for one in zip(at.y, at.status, strict=True)])
    found = cycle_trials(at, closed.jacobian[rows], weights, maps.free_directions(at.status, at.y))
    # A cycle of many crossings that captures only what is nearer than this lies on a torus that is locked weakly.
    least = 0.0 if recurrence.settled else 1e-3 / LARGEST
    return [
        one
        if one is None or count <= CROSSINGS
        # Its points lie close together.
        else one._replace(smallest=max(one.smallest, least * one.largest), largest=one.largest / 8)
        for one, count in zip(found, closed.crossings[rows], strict=True)
    ]


def _just_opened(maps: ReturnMaps, y: Float[np.ndarray, " 2n"], status) -> Float[np.ndarray, " 2n"]:
    """Factors on the weights with which the gap counts, and its rate, at a state of one contact that has just lifted off: as
    small as they are then, so they are in all motions nearby. An ellipsoid in which they were free would hold states below the
    belt, however small it is.
    """
    factors = np.ones(len(y))
    if np.ndim(status) or status != Status.DETACH:
        return factors
    places = np.array([0, len(y) // 2]) + maps.normal
    weighted = maps.weights * np.abs(y)
    size, (gap, rate) = np.linalg.norm(weighted), weighted[places]
    if 0 < gap < 1e-3 * size and rate > 0:
        # The time since then, in units of the weights: of a gap that opens with the third power of time.
        since = min(3 * gap / rate, 1.0)
        factors[places] = np.maximum(since * size / weighted[places], 1.0)
    return factors


def _return_map(maps: ReturnMaps, group, centre: Section, crossings):
    """The return maps of cycles, each over so many crossings and in its own contact mode (`neighbourhood.ReturnMap`)."""

    def returned(chosen, y):
        each = np.repeat(chosen, y.shape[1])
        at = centre.rows(each)._replace(y=y.reshape(-1, y.shape[-1]))
        image = maps.returns(group[each], at, crossings[each])
        return ReturnImages(*(part.reshape(*y.shape[:2], *part.shape[1:]) for part in (*image.at, image.events)))

    return returned


def capturing_cycles(
    maps: ReturnMaps,
    motions: Motions,
    latest: Float[np.ndarray, "m 2n"],
    known: list[tuple[Int[np.ndarray, " r"], StableCycle]],
) -> Int[np.ndarray, " m"]:
    """Which cycle each motion has entered the neighbourhood of, by its place in `known`; -1 where none.

    `known` are cycles, each with the rows of the motions that it may have captured; `latest` are the motions' last crossings as
    far as their stepper knows them, good enough to tell which ones to ask. What counts is where the exact return map leads from
    where they are now.
    """
    which = np.full(len(motions.group), -1)
    if not known:
        return which
    weights, cycles = maps.weights, [cycle for _, cycle in known]
    about = side_by_side([cycle.neighbourhood for cycle in cycles])
    within = about.radius + maps.known_to * np.linalg.norm(weights * about.centre, axis=1)
    row = np.concatenate([rows for rows, _ in known])
    place = np.repeat(np.arange(len(known)), [len(rows) for rows, _ in known])
    length = np.array([len(cycle.points) for cycle in cycles])
    near, crossings = np.zeros(len(row), bool), np.zeros(len(row), int)
    for count in np.unique(length):
        alike, own = np.flatnonzero(length == count), np.flatnonzero(length[place] == count)
        points = np.array([cycles[k].points for k in alike])[np.searchsorted(alike, place[own])]
        apart = np.linalg.norm(weights * (latest[row[own], None] - points), axis=2)
        with np.errstate(invalid="ignore"):
            near[own] = np.min(apart, axis=1) <= within[place[own]]
        crossings[own] = count - np.argmin(apart, axis=1)
    row, place, crossings = row[near], place[near], crossings[near]
    image = maps.returns(*motions.rows(row), crossings).at
    inside = Neighbourhood(*(part[place] for part in about)).contains(*image)
    which[row[inside]] = place[inside]
    return which
