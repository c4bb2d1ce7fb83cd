"""The approach to a stable cycle: a tube about paths that lead into it, which captures from further away than its ellipsoid.

The ellipsoid in which a cycle's return map contracts (`neighbourhood`) ends where motions begin to pass through other events.
Next to a grazing that is near, though motions come in from far away. So motions are started about the cycle and followed until
its ellipsoid has them; the states through which they come make a set. What starts on the edge of a tube about that set is
followed, too: if all of it comes back to well within the tube, and stays there, the tube is drawn in as one about a torus is
(`tori`), and with it to the cycle. A trajectory is captured once its crossings in a row lie in half of the tube.

This holds for a cycle on a locked torus as well: the paths then go about the torus.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from ..section.return_maps import ReturnMaps
from . import tube
from .cycles import CROSSINGS, StableCycle, capturing_cycles
from .motions import Motions
from .returning import starts_beyond, starts_on_edges, tubes_returned_to
from .tube import Tube


class Ways(NamedTuple):
    """How motions are followed on their ways into a cycle."""

    away: float  # their distance from it in the beginning, relative to its size
    settling: int  # returns before states count
    kept: int  # returns whose states count
    led: int  # of `STARTS` motions so many have to lead into the cycle


# Into a cycle of few crossings; the furthest distance from which all lead in counts. And about a torus that is locked to a
# cycle of many, along which it takes long.
ABOUT = Ways(0.25, 0, 48, tube.STARTS), Ways(0.06, 0, 48, tube.STARTS)
LOCKED = (Ways(tube.RADIUS, 48, 128, 4),)
# The most returns in which motions are followed until they lead into a cycle.
LONGEST = 16384


class Approach(NamedTuple):
    """A stable cycle, with a tube about paths that lead into it, which captures from further away than its neighbourhood."""

    cycle: StableCycle
    tube: Tube  # about weighted deviations, as that of a torus


def approaches(
    maps: ReturnMaps, group: Int[np.ndarray, " c"], cycles: list[StableCycle], report
) -> list[Approach | None]:
    """The approaches to cycles, each of its `group`; None where a tube about none was seen to be drawn in."""
    found: list[Approach | None] = [None] * len(cycles)
    # Where the neighbourhood is as wide as half of the tube, that says enough.
    small = [k for k, cycle in enumerate(cycles) if cycle.reach < 0.5 * tube.RADIUS]
    locked = [k for k in small if len(cycles[k].points) > CROSSINGS]
    for chosen, kinds in ([k for k in small if k not in locked], ABOUT), (locked, LOCKED):
        for ways in kinds:
            chosen = [k for k in chosen if found[k] is None]
            if not chosen:
                break
            report(0)
            states = _ways_in(maps, group[chosen], [cycles[k] for k in chosen], ways)
            tried = [
                (k, Approach(cycles[k], Tube(own, tube.RADIUS)))
                for k, own in zip(chosen, states, strict=True)
                if own is not None
            ]
            own = group[[k for k, _ in tried]]
            for place in _drawn_in(maps, own, [one for _, one in tried], report).tolist():
                k, found[k] = tried[place]
    return found


def _ways_in(
    maps: ReturnMaps, group: Int[np.ndarray, " c"], cycles: list[StableCycle], ways: Ways
) -> list[Float[np.ndarray, "k 2n"] | None]:
    """The weighted states through which motions come into each cycle that start about it, the first of all motions first; None
    where they do not.
    """
    count, size = tube.STARTS, len(maps.weights)
    about = [Tube(np.resize(maps.weights * cycle.points, (count, size)), ways.away) for cycle in cycles]
    own, at = np.repeat(group, count), starts_on_edges(maps, group, about)
    if ways.settling:
        at = maps.returns(own, at, ways.settling).at
    at, paths = maps.path(own, at, ways.kept)
    done, each = ways.settling + ways.kept, np.arange(len(own)).reshape(-1, count)
    ok = np.all(np.isfinite(paths).reshape(len(cycles), -1), axis=1)
    # Twice as long as it takes to come in by the cycle's multiplier.
    nearer = np.log(np.maximum([ways.away / cycle.reach for cycle in cycles], np.e))
    needed = [len(cycle.points) * factor for cycle, factor in zip(cycles, nearer, strict=True)]
    within = done + tube.HOME + 2 * np.array(needed) / [1 - cycle.multiplier for cycle in cycles]
    # Of a torus that is locked weakly it is enough that it is drawn in: on a closed curve that has a periodic motion all others
    # come to such ones.
    led = np.where((within <= LONGEST) | (ways.led == count), ways.led, 0)
    left = np.repeat(ok, count) & (np.arange(len(own)) % count < np.repeat(led, count))
    while True:
        asked = [(rows[left[rows]], cycle) for rows, cycle in zip(each, cycles, strict=True)]
        left[capturing_cycles(maps, Motions(own, at), at.y, asked) >= 0] = False
        # One that is late tells of all of its cycle.
        ok &= ~np.any(left[each], axis=1) | (done < np.minimum(within, LONGEST))
        left &= np.repeat(ok, count)
        rows = np.flatnonzero(left)
        if not len(rows):
            break
        further = max(tube.HOME, done // 4)
        at.put(rows, maps.returns(own[rows], at.rows(rows), further).at)
        done += further
    states = np.swapaxes((maps.weights * paths).reshape(len(cycles), count, ways.kept, size), 1, 2)
    return [one.reshape(-1, size) if good else None for one, good in zip(states, ok, strict=True)]


def _drawn_in(maps: ReturnMaps, group: Int[np.ndarray, " a"], tried: list[Approach], report) -> Int[np.ndarray, " d"]:
    """Which of these tubes are drawn in: what starts on their edges comes back, above all where ways begin and further out."""
    left = np.arange(len(tried))
    for beyond in (True, False):
        if not len(left):
            break
        own, tubes = group[left], [tried[k].tube for k in left]
        centres = [maps.weights * tried[k].cycle.points for k in left]
        starts = starts_beyond(maps, own, tubes, centres) if beyond else starts_on_edges(maps, own, tubes)
        left = left[tubes_returned_to(maps, own, tubes, starts, report)[0]]
    return left
