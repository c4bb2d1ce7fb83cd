"""Trajectories that nothing has captured in their time: followed on by the return map, and asked where they have come to.

Before, few of a group are asked and searches are short, because most trajectories come to attractors that are found soon. Here
each is asked, and from where it is thousands of returns later: cycles count however weakly they attract and however narrow
their neighbourhood is, and tori however narrow the tube from which everything comes back to them. The proof is the same.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from ..section.return_maps import ReturnMaps, Section
from .creeping import crept
from .cycles import MORE_CROSSINGS, MOST_CROSSINGS, Cycle, distinct
from .known import Attractors, add_cycles, add_tori, come_to
from .parting import followed_on
from .tori import AT_A_TIME, TUBES, Torus, is_drifting
from .tube import HOME

# Times that a few more motions of each group are asked; and returns that those take which drift in between.
TIMES, ONWARD = 4, 8192


class Fates(NamedTuple):
    """What becomes of trajectories: which are chaotic, the attractors of others, by row, and which have no events any more, at
    least for some time. Where they are when that is known, how much later that is, and their contact events on the way.
    """

    chaotic: Bool[np.ndarray, " m"]
    attractor: dict[int, Cycle | Torus]
    without_events: Bool[np.ndarray, " m"]
    at: Section
    time: Float[np.ndarray, " m"]  # s
    events: Int[np.ndarray, " m"]


def fates(
    maps: ReturnMaps,
    group: Int[np.ndarray, " m"],
    at: Section,
    of_group: dict[int, Attractors],
    report,
    slides: Callable[[Int[np.ndarray, " r"], Section], Bool[np.ndarray, " r"]] | None = None,
) -> Fates:
    """What becomes of motions from these states; their loads are final. `of_group` are the attractors known of each group, and
    gets those that are found. `slides` tells, by groups and states, which motions are certain to slide for ever.
    """
    at, events, time, *_ = maps.returns(group, at, 1)
    attractor: dict[int, Cycle | Torus] = {}
    chaotic, quiet = np.zeros((2, len(group)), bool)
    left, onward = np.all(np.isfinite(at.y), axis=1), np.ones(len(group), bool)
    # A few of each group first: mostly the others are by now where these come to.
    for rows in (distinct(maps.weights * at.y, group, left), np.arange(len(group))):
        rows = rows[left[rows]]
        left[rows] = False
        captured = come_to(maps, group[rows], at.rows(rows), at.y[rows], np.ones(len(rows), bool), of_group)
        attractor |= {int(rows[row]): one for row, one in captured.items()}
        rows = np.delete(rows, list(captured))
        if len(rows):
            found = _followed(maps, group[rows], at.rows(rows), onward[rows], of_group, report, slides)
            chaotic[rows], quiet[rows] = found.chaotic, found.without_events
            at.put(rows, found.at)
            time[rows] += found.time
            events[rows] += found.events
            attractor |= {int(rows[row]): one for row, one in found.attractor.items()}
            # Where none of these comes to anything, neither do others that go on.
            ended = found.chaotic | found.without_events
            ended[list(found.attractor)] = True
            onward &= np.isin(group, group[rows[ended]])
    return Fates(chaotic, attractor, quiet, at, time, events)


def _followed(
    maps: ReturnMaps,
    group,
    at: Section,
    onward: Bool[np.ndarray, " m"],
    of_group: dict[int, Attractors],
    report,
    slides,
) -> Fates:
    """The same of motions each of which is followed for thousands of returns, and those to be followed `onward`, if they drift,
    for tens of thousands.
    """
    followed = followed_on(maps, group, at)
    now, chaotic, time, events = followed.at, followed.chaotic, followed.time, followed.events
    attractor: dict[int, Cycle | Torus] = {}
    left = ~chaotic & np.all(np.isfinite(now.y), axis=1)
    asks, further, quiet = left.copy(), *np.zeros((2, len(group)), bool)
    for turn in range(TIMES + 1):
        new = come_to(maps, group, now, now.y, left, of_group)
        attractor |= new
        left[list(new)] = False
        if turn == TIMES or not np.any(left):
            break
        report(0)
        picked = distinct(maps.weights * now.y, group, asks & left)
        if len(picked):
            _search(maps, group, now, followed.closing_in, picked, of_group, report)
        asks[picked] = False
        creeping = _crept(maps, group, now, time, events, left & onward, of_group, slides)
        drifting = creeping | _drifted(maps, group, now, time, events, left & onward & ~creeping)
        left &= np.all(np.isfinite(now.y), axis=1)
        asks, further = asks | drifting, further | drifting
    rows = np.flatnonzero(left)
    quiet[rows] = maps.returns(group[rows], now.rows(rows), HOME).events == 0
    rows = np.flatnonzero(left & further & ~quiet)
    if len(rows):
        chaotic[rows] = followed_on(maps, group[rows], now.rows(rows)).chaotic
    return Fates(chaotic, attractor, quiet, now, time, events)


def _crept(
    maps: ReturnMaps, group, now: Section, time, events, asked: Bool[np.ndarray, " m"], of_group, slides
) -> Bool[np.ndarray, " m"]:
    """Which of these motions creep along a line of states: `now` they are further, after that much more `time` and `events`,
    where an attractor captures them, where they are certain to slide for ever, or where they creep no more.
    """
    asked_rows = np.flatnonzero(asked)

    def arrived(rows, at: Section) -> Bool[np.ndarray, " r"]:
        own = group[asked_rows[rows]]
        done = ~maps.moves(own, at.y)
        done[list(come_to(maps, own, at, at.y, ~done, of_group))] = True
        return done if slides is None else done | slides(own, at)

    creeping = np.zeros(len(asked), bool)
    if len(asked_rows):
        creeps, at, later, more = crept(maps, group[asked_rows], now.rows(asked_rows), arrived)
        rows = asked_rows[creeps]
        creeping[rows] = True
        now.put(rows, at.rows(creeps))
        time[rows] += later[creeps]
        events[rows] += more[creeps]
    return creeping


def _drifted(
    maps: ReturnMaps, group, now: Section, time, events, asked: Bool[np.ndarray, " m"]
) -> Bool[np.ndarray, " m"]:
    """Which of these motions drift, as they do away from a cycle that repels weakly, or past a fold: `now` they are further,
    after that much more `time` and `events`.
    """
    rows, drifting = np.flatnonzero(asked), np.zeros(len(asked), bool)
    if len(rows):
        seen = maps.returns(group[rows], now.rows(rows), AT_A_TIME, AT_A_TIME)
        own = np.array([is_drifting(maps.weights * one) for one in seen.path])
        rows = rows[own]
        later = maps.returns(group[rows], seen.at.rows(own), ONWARD)
        now.put(rows, later.at)
        time[rows] += seen.time[own] + later.time
        events[rows] += seen.events[own] + later.events
        drifting[rows] = True
    return drifting


def _search(
    maps: ReturnMaps,
    group,
    at: Section,
    closing_in: Bool[np.ndarray, " m"],
    picked: Int[np.ndarray, " r"],
    of_group: dict[int, Attractors],
    report,
) -> None:
    """Adds the attractors that the picked motions are on, where they are new. On some of them neighbours are `closing_in`."""
    on_torus = ~closing_in[picked]
    for closes_in, most in ((True, MOST_CROSSINGS), (False, MORE_CROSSINGS)):
        here = np.flatnonzero(closing_in[picked] == closes_in)
        if not len(here):
            continue
        rows = picked[here]
        on_torus[here] &= ~add_cycles(maps, group[rows], at.rows(rows), of_group, most, settled=True)
    rows = picked[on_torus]
    if len(rows):
        add_tori(maps, group[rows], at.rows(rows), of_group, report, TUBES)
