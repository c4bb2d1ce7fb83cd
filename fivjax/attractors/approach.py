"""The approach to a stable cycle: a tube about paths that lead into it, which captures from further away than its ellipsoid.

The ellipsoid in which a cycle's return map contracts (`neighbourhood`) ends where motions begin to pass through other events.
Near a grazing that is close by, though motions come in from far away; on a locked torus they creep along the torus first. So
motions are started about the cycle. Some of them, pilots, are followed until its ellipsoid has them, the others until they have
come to where the pilots were. The states through which they come make a set. What starts on the edge of a tube about that set
is followed, too: if all of it comes back to well within the tube, and stays there, the tube is drawn in as one about a torus
is (`tori`), and with it to the cycle. A trajectory is captured once its crossings in a row lie in half of the tube.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from ..section.return_maps import ReturnMaps, Section
from . import tube
from .cycles import CROSSINGS, StableCycle, capturing_cycles
from .motions import Motions
from .returning import starts_beyond, starts_on_edges, tubes_returned_to
from .tori import around_stable_cycles
from .tube import Tube, thin


class PathSettings(NamedTuple):
    """How motions are followed on their ways into a cycle."""

    away: float  # their distance from it in the beginning, relative to its size
    settling: int  # returns before states count
    kept: int  # returns whose states count; of pilots all do


ABOUT_CYCLES = PathSettings(0.1, 0, 32)
# About a torus that is locked to a cycle of many crossings: along it motions take long.
ABOUT_LOCKED_TORI = PathSettings(tube.RADIUS, 48, 128)
# Motions that are followed until they lead into a cycle, the most returns in which they do, and how many of their states are
# kept at least, where there are more.
PILOTS, LONGEST, LEAST_KEPT = 4, 16384, 1024


class Approach(NamedTuple):
    """A stable cycle, with a tube about paths that lead into it, which captures from further away than its neighbourhood."""

    cycle: StableCycle
    tube: Tube  # about weighted deviations, as that of a torus


def approaches(
    maps: ReturnMaps, group: Int[np.ndarray, " c"], cycles: list[StableCycle], report
) -> list[Approach | None]:
    """An approach to each of the cycles, each of its `group`; None where no tube about paths into it was seen to attract."""
    found: list[Approach | None] = [None] * len(cycles)
    # Where motions come from the edge of a tube to the neighbourhood in fewer returns than this, that says enough.
    worthwhile = 96
    small = [k for k, cycle in enumerate(cycles) if returns_from(cycle, 0.5 * tube.RADIUS) > worthwhile]
    locked = [k for k in small if len(cycles[k].points) > CROSSINGS]
    for chosen, how in ([k for k in small if k not in locked], ABOUT_CYCLES), (locked, ABOUT_LOCKED_TORI):
        if not chosen:
            continue
        report(0)
        states = _paths_into(maps, group[chosen], [cycles[k] for k in chosen], how, report)
        whose = [chosen[place] for place in states]
        tried = [Approach(cycles[k], Tube(own, tube.RADIUS)) for k, own in zip(whose, states.values(), strict=True)]
        drawn = {whose[place]: tried[place] for place in _attracting(maps, group[whose], tried, report).tolist()}
        curves = {k: maps.weights * one.cycle.points for k, one in drawn.items() if k in locked}
        for k in around_stable_cycles(maps, group, curves, {k: drawn[k].tube for k in curves}):
            del drawn[k]
        for k, one in drawn.items():
            found[k] = one
    return found


def returns_from(cycle: StableCycle, away: float) -> float:
    """Returns in which motions so far from a cycle, relative to its size, come to its neighbourhood by its multiplier."""
    return np.log(max(away / cycle.reach, 1.0)) * len(cycle.points) / (1 - cycle.multiplier)


def _paths_into(
    maps: ReturnMaps, group: Int[np.ndarray, " c"], cycles: list[StableCycle], how: PathSettings, report
) -> dict[int, Float[np.ndarray, "k 2n"]]:
    """The weighted states on paths that start about each cycle and lead into it, by the cycle's index, beginning with the first
    state of each motion. Pilots are followed into the cycle's neighbourhood, the others until they come to where those have
    been. Cycles without such paths are left out.
    """
    count, size = tube.STARTS, len(maps.weights)
    about = [Tube(np.resize(maps.weights * cycle.points, (count, size)), how.away) for cycle in cycles]
    own, at = np.repeat(group, count), starts_on_edges(maps, group, about)
    if how.settling:
        at = maps.returns(own, at, how.settling).at
    at, paths = maps.path(own, at, how.kept)
    paths = np.swapaxes((maps.weights * paths).reshape(len(cycles), count, how.kept, size), 1, 2)
    each = np.arange(len(own)).reshape(-1, count)
    onward = _followed_into(maps, Motions(own, at), each[:, :PILOTS], cycles, how)
    # On long ways states lie close together.
    whose = {
        k: thin(np.concatenate([np.zeros((0, size)), *states]), LEAST_KEPT)
        for k, states in onward.items()
        if np.all(np.isfinite(paths[k]))
    }
    if not whose:
        return {}
    rows = list(whose)
    tubes = [Tube(np.concatenate([paths[k, :, :PILOTS].reshape(-1, size), whose[k]]), tube.RADIUS) for k in rows]
    others = at.rows(each[rows, PILOTS:].ravel())
    back, _ = tubes_returned_to(maps, group[rows], tubes, others, report)
    return {k: np.concatenate([paths[k].reshape(-1, size), whose[k]]) for k in (rows[place] for place in back)}


def _followed_into(
    maps: ReturnMaps, motions: Motions, each: Int[np.ndarray, "c pilots"], cycles: list[StableCycle], how: PathSettings
) -> dict[int, list[Float[np.ndarray, "k 2n"]]]:
    """Further weighted states of pilots, which have these rows for each cycle, until they are in its neighbourhood, by the
    cycle's place: of those where they come there in twice the time that the cycle's multiplier says.
    """
    within = np.array([how.kept + tube.RETURNS_INSIDE + 2 * returns_from(cycle, how.away) for cycle in cycles])
    states: dict[int, list] = {k: [] for k in range(len(cycles))}
    # Of a torus that is locked weakly it is enough that it is drawn in: on a closed curve that has a periodic motion all others
    # come to such ones.
    weakly = np.array([len(cycle.points) > CROSSINGS for cycle in cycles]) & (within > LONGEST)
    within = np.minimum(within, LONGEST)
    left = np.zeros(len(motions.group), bool)
    left[each[~weakly]] = True
    of, at, done = np.zeros(len(left), int), Section(*(part.copy() for part in motions.at)), how.kept
    of[each] = np.arange(len(cycles))[:, None]
    while True:
        asked = [(rows[left[rows]], cycle) for rows, cycle in zip(each, cycles, strict=True)]
        left[capturing_cycles(maps, Motions(motions.group, at), at.y, asked) >= 0] = False
        for k in np.unique(of[left]).tolist():
            # One that is late tells of all.
            if done >= within[k] or not np.all(np.isfinite(at.y[each[k]])):
                del states[k]
                left[each[k]] = False
        rows = np.flatnonzero(left)
        if not len(rows):
            return states
        further = max(tube.RETURNS_INSIDE, done // 4)
        ends, paths = maps.path(motions.group[rows], at.rows(rows), further)
        at.put(rows, ends)
        for row, path in zip(rows.tolist(), maps.weights * paths, strict=True):
            states[of[row]].append(path)
        done += further


def _attracting(maps: ReturnMaps, group: Int[np.ndarray, " a"], tried: list[Approach], report) -> Int[np.ndarray, " d"]:
    """Which of these tubes are drawn in: all that starts on their edges comes back, first further out, where paths begin."""
    left = np.arange(len(tried))
    for beyond in (True, False):
        if not len(left):
            break
        own, tubes = group[left], [tried[k].tube for k in left]
        centres = [maps.weights * tried[k].cycle.points for k in left]
        starts = starts_beyond(maps, own, tubes, centres) if beyond else starts_on_edges(maps, own, tubes)
        left = left[tubes_returned_to(maps, own, tubes, starts, report)[0]]
    return left
