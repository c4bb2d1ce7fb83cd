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
from .catalogue import CapturingSet, Catalogue
from .creeping import creep
from .cycles import MORE_CROSSINGS, MOST_CROSSINGS, Recurrence
from .divergence import long_divergence
from .motions import Motions, far_apart
from .tori import AT_A_TIME, TUBES, is_drifting
from .tube import RETURNS_INSIDE

# Times that a few more motions of each group are asked; and returns that those take which drift in between.
TIMES, ONWARD = 4, 8192
# Returns after which motions without events are asked again and again whether they slide for ever.
SLID_ON = (RETURNS_INSIDE, 512, 512, 1024)
# Which motions are certain to slide for ever.
Slides = Callable[[Motions], Bool[np.ndarray, " r"]]


class Fates(NamedTuple):
    """What becomes of trajectories: which are chaotic, the attractors of others, by row, and which have no events any more, at
    least for some time. Where they are when that is known, how much later that is, and how often a contact's status has changed
    on the way.
    """

    chaotic: Bool[np.ndarray, " m"]
    attractor: dict[int, CapturingSet]
    without_events: Bool[np.ndarray, " m"]
    at: Section
    time: Float[np.ndarray, " m"]  # s
    changes: Int[np.ndarray, " m"]

    def put(self, rows: Int[np.ndarray, " r"], found: "Fates") -> None:
        """Write what becomes of the motions of these rows, from where they were known to be."""
        self.chaotic[rows], self.without_events[rows] = found.chaotic, found.without_events
        self.attractor.update((int(rows[row]), one) for row, one in found.attractor.items())
        self.at.put(rows, found.at)
        self.time[rows] += found.time
        self.changes[rows] += found.changes


def fates(catalogue: Catalogue, motions: Motions, slides: Slides | None = None) -> Fates:
    """What becomes of these motions; their loads are final. The catalogue gets the attractors that are found."""
    maps, group = catalogue.maps, motions.group
    at, _, changes, time, *_ = maps.returns(*motions, 1)
    found = Fates(np.zeros(len(group), bool), {}, np.zeros(len(group), bool), at, time, changes)
    left, onward = np.all(np.isfinite(at.y), axis=1), np.ones(len(group), bool)
    # A few of each group first: mostly the others are by now where these come to.
    for rows in (far_apart(maps.weights * at.y, group, left), np.arange(len(group))):
        rows = rows[left[rows]]
        left[rows] = False
        captured = catalogue.captures(Motions(group, at).rows(rows), np.ones(len(rows), bool))
        found.attractor.update((int(rows[row]), one) for row, one in captured.items())
        arrived = [rows[list(captured)]]
        rows = np.delete(rows, list(captured))
        if len(rows):
            slow = _slow_fates(catalogue, Motions(group, at).rows(rows), onward[rows], slides)
            found.put(rows, slow)
            ended = slow.chaotic | slow.without_events
            ended[list(slow.attractor)] = True
            arrived.append(rows[ended])
        # Where none of these comes to anything, neither do others that go on.
        onward &= np.isin(group, group[np.concatenate(arrived)])
    return found


class _Underway(NamedTuple):
    """Motions that are followed on: where they are by now, how much later that is (s), and how often a contact's status has
    changed on the way. All are written in place.
    """

    motions: Motions
    time: Float[np.ndarray, " m"]
    changes: Int[np.ndarray, " m"]

    def move(self, rows, at: Section, time, changes) -> None:
        """These are further, after so much more time and so many more changes."""
        self.motions.at.put(rows, at)
        self.time[rows] += time
        self.changes[rows] += changes


def _slow_fates(catalogue: Catalogue, motions: Motions, onward: Bool[np.ndarray, " m"], slides: Slides | None) -> Fates:
    """The same of motions that nothing has captured by now: those without events are most likely slow to fade."""
    count = len(motions.group)
    run = _Underway(motions, np.zeros(count), np.zeros(count, int))
    found = Fates(np.zeros(count, bool), {}, np.zeros(count, bool), run.motions.at, run.time, run.changes)
    if slides is not None:
        found.without_events[:] = _slide_on(catalogue, run, found.attractor, slides)
    left = ~found.without_events
    left[list(found.attractor)] = False
    rows = np.flatnonzero(left)
    if len(rows):
        found.put(rows, _long_fates(catalogue, run.motions.rows(rows), onward[rows], slides))
    return found


def _slide_on(
    catalogue: Catalogue, run: _Underway, attractor: dict[int, CapturingSet], slides: Slides
) -> Bool[np.ndarray, " m"]:
    """Which of these motions are certain to slide for ever: while they have no events they are followed until that is so, or
    until they are captured, by an `attractor`.
    """
    maps, rows = catalogue.maps, np.arange(len(run.time))
    certain = np.zeros(len(rows), bool)

    def left(rows) -> Int[np.ndarray, " r"]:
        """Those of the rows of which it is not known by now."""
        if not len(rows):
            return rows
        motions = run.motions.rows(rows)
        certain[rows] = ended = slides(motions)
        captured = catalogue.captures(motions, ~ended)
        attractor.update((int(rows[row]), one) for row, one in captured.items())
        ended[list(captured)] = True
        return rows[~ended]

    for returns in SLID_ON:
        if not len(rows):
            return certain
        later = maps.returns(*run.motions.rows(rows), returns)
        run.move(rows, later.at, later.time, later.changes)
        rows = left(rows[(later.events == 0) & np.all(np.isfinite(later.at.y), axis=1)])
    asked = np.zeros(len(certain), bool)
    asked[rows] = True
    left(np.flatnonzero(_creep(catalogue, run, asked, slides)))
    return certain


def _long_fates(catalogue: Catalogue, motions: Motions, onward: Bool[np.ndarray, " m"], slides: Slides | None) -> Fates:
    """The same of motions each of which is followed for thousands of returns, and those to be followed `onward`, if they drift,
    for tens of thousands.
    """
    maps, group = catalogue.maps, motions.group
    followed = long_divergence(maps, motions, arrived=lambda motions: _arrived(catalogue, motions, slides))
    now, chaotic = followed.at, followed.chaotic
    run = _Underway(Motions(group, now), followed.time, followed.changes)
    attractor: dict[int, CapturingSet] = {}
    left = ~chaotic & np.all(np.isfinite(now.y), axis=1)
    without_events = left & ~maps.moves(group, now.y)
    rows = np.flatnonzero(left & ~without_events)
    if slides is not None and len(rows):
        without_events[rows] = slides(run.motions.rows(rows))
    left &= ~without_events
    asks, further = left.copy(), np.zeros(len(group), bool)
    for turn in range(TIMES + 1):
        new = catalogue.captures(run.motions, left)
        attractor |= new
        left[list(new)] = False
        if turn == TIMES or not np.any(left):
            break
        catalogue.report(0)
        picked = far_apart(maps.weights * now.y, group, asks & left)
        if len(picked):
            _search(catalogue, run.motions.rows(picked), followed.closing_in[picked])
        asks[picked] = False
        creeping = _creep(catalogue, run, left & onward, slides)
        drifting = creeping | _drift(maps, run, left & onward & ~creeping)
        left &= np.all(np.isfinite(now.y), axis=1)
        asks, further = asks | drifting, further | drifting
    rows = np.flatnonzero(left)
    without_events[rows] = maps.returns(*run.motions.rows(rows), RETURNS_INSIDE).events == 0
    # Where neighbours closed in and yet there is no cycle, the motion was only regular for a time.
    rows = np.flatnonzero(left & (further | followed.closing_in) & ~without_events)
    if len(rows):
        chaotic[rows] = long_divergence(maps, run.motions.rows(rows)).chaotic
    return Fates(chaotic, attractor, without_events, now, run.time, run.changes)


def _arrived(catalogue: Catalogue, motions: Motions, slides: Slides | None) -> Bool[np.ndarray, " m"]:
    """Which of these motions an attractor has captured, or are certain to slide for ever."""
    done = np.zeros(len(motions.group), bool) if slides is None else slides(motions)
    done[list(catalogue.captures(motions, ~done))] = True
    return done


def _creep(
    catalogue: Catalogue, run: _Underway, asked: Bool[np.ndarray, " m"], slides: Slides | None
) -> Bool[np.ndarray, " m"]:
    """Which of these motions creep along a line of states: they are taken to where an attractor captures them, where they are
    certain to slide for ever, or where they creep no more.
    """
    asked_rows = np.flatnonzero(asked)

    def arrived(rows, at: Section) -> Bool[np.ndarray, " r"]:
        return _arrived(catalogue, Motions(run.motions.group[asked_rows[rows]], at), slides)

    creeping = np.zeros(len(asked), bool)
    if len(asked_rows):
        creeps, at, later, more = creep(catalogue.maps, run.motions.rows(asked_rows), arrived)
        rows = asked_rows[creeps]
        creeping[rows] = True
        run.move(rows, at.rows(creeps), later[creeps], more[creeps])
    return creeping


def _drift(maps: ReturnMaps, run: _Underway, asked: Bool[np.ndarray, " m"]) -> Bool[np.ndarray, " m"]:
    """Which of these motions drift, as they do away from a cycle that repels weakly, or past a fold: they are taken further."""
    rows, drifting = np.flatnonzero(asked), np.zeros(len(asked), bool)
    if len(rows):
        seen = maps.returns(*run.motions.rows(rows), AT_A_TIME, AT_A_TIME)
        own = np.array([is_drifting(maps.weights * one) for one in seen.path])
        rows = rows[own]
        run.move(rows, seen.at.rows(own), seen.time[own], seen.changes[own])
        drifting[rows] = True
        for _ in range(0, ONWARD, AT_A_TIME):
            # One that has faded is left where it was.
            rows = rows[maps.moves(run.motions.group[rows], run.motions.at.y[rows])]
            later = maps.returns(*run.motions.rows(rows), AT_A_TIME)
            there = np.all(np.isfinite(later.at.y), axis=1)
            rows, at = rows[there], later.at.rows(there)
            run.move(rows, at, later.time[there], later.changes[there])
    return drifting


def _search(catalogue: Catalogue, motions: Motions, closing_in: Bool[np.ndarray, " m"]) -> None:
    """Adds the attractors that these motions are on, where they are new. On some of them neighbours are `closing_in`."""
    on_torus = ~closing_in
    for closes_in, most in ((True, MOST_CROSSINGS), (False, MORE_CROSSINGS)):
        here = np.flatnonzero(closing_in == closes_in)
        if len(here):
            on_torus[here] &= ~catalogue.add_cycles(motions.rows(here), Recurrence(most, settled=True))
    rows = np.flatnonzero(on_torus)
    if len(rows):
        catalogue.add_tori(motions.rows(rows), TUBES)
