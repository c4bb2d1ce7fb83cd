"""Trajectories that nothing has captured in their time: followed on by the return map, and asked where they have come to.

Before, few of a group are asked and searches are short, because most trajectories come to attractors that are found soon. Here
each is asked, and from where it is thousands of returns later: cycles count however weakly they attract and however narrow
their neighbourhood is, and tori however narrow the tube from which everything comes back to them. The proof is the same.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Int

from ..cycles.torus import drifts
from ..verdicts import tube
from .captures import MORE_CROSSINGS, Cycle, captured, distinct, is_new, stable_cycles
from .section import ReturnMaps, Section
from .tori import Followed, Torus, followed_on, tori_among

# Crossings of cycles on which neighbours close in.
MOST_CROSSINGS = 512
# Times that a few more motions of each group are asked.
TIMES = 4
# States on the section that make the set tried as a torus, and radii of the tube about it. Starts have to come closer than
# elsewhere, by so much: next to a slow fade there is a direction in which they come back hardly at all.
SET, RADII, CLOSER = 4096, (tube.RADIUS, tube.RADIUS / 4, tube.RADIUS / 16), 0.5
# Their mean may change with time by so much of their extent. A fade that takes thousands of periods is such a set, too, and
# starts further in are home while they pass it.
DRIFT = 5e-3
# Crossings in which starts in the tube have to be back.
BACK_WITHIN = 1536


class Fates(NamedTuple):
    """What becomes of trajectories: which are chaotic, and the attractors of others."""

    chaotic: Bool[np.ndarray, " m"]
    attractor: list[Cycle | Torus | None]


class Narrow(NamedTuple):
    """A torus that captures from within half of a tube of this radius, relative to its mean size."""

    torus: Torus
    radius: float


def fates(
    maps: ReturnMaps,
    group: Int[np.ndarray, " m"],
    at: Section,
    cycles: dict[int, list[Cycle]],
    tori: dict[int, list[Narrow]],
    report,
) -> Fates:
    """What becomes of motions from these states; their loads are final. `cycles` and `tori` are those known of each group, and
    get those that are found.
    """
    followed = followed_on(maps, group, at)
    attractor: list[Cycle | Torus | None] = [None] * len(group)
    left = ~followed.chaotic & np.all(np.isfinite(followed.at.y), axis=1)
    asks = left.copy()
    for time in range(TIMES + 1):
        for row, one in _captured(maps, group, followed.at, np.flatnonzero(left), cycles, tori):
            attractor[row], left[row] = one, False
        picked = distinct(maps.weights * followed.at.y, group, asks & left)
        if time == TIMES or not len(picked):
            break
        asks[picked] = False
        report(0)
        _search(maps, group, followed, picked, cycles, tori, report)
    return Fates(followed.chaotic, attractor)


def _captured(maps: ReturnMaps, group, at: Section, rows, cycles, tori) -> list[tuple[int, Cycle | Torus]]:
    """Which of these rows have come to an attractor that is known."""
    found: list[tuple[int, Cycle | Torus]] = []
    places = [(rows[group[rows] == g], cycle) for g in np.unique(group[rows]).tolist() for cycle in cycles.get(g, [])]
    which = captured(maps, group, at, at.y, places)
    found += [(int(row), places[which[row]][1]) for row in np.flatnonzero(which >= 0)]
    beating = np.array([row for row in rows[which[rows] < 0] if tori.get(int(group[row]))], int)
    if len(beating):
        _, path = maps.path(group[beating], at.rows(beating), tube.HOME)
        for row, states in zip(beating, maps.weights * path, strict=True):
            for torus, radius in tori[int(group[row])]:
                if tube.home(torus.states, states[:, None], radius).item():
                    found.append((int(row), torus))
                    break
    return found


def _search(maps: ReturnMaps, group, followed: Followed, picked, cycles, tori, report) -> None:
    """Adds the attractors that the picked motions are on, where they are new."""
    at, on_torus = followed.at, np.zeros(len(group), bool)
    on_torus[picked] = ~followed.closing_in[picked]
    for closing_in, most in ((True, MOST_CROSSINGS), (False, MORE_CROSSINGS)):
        rows = picked[followed.closing_in[picked] == closing_in]
        if not len(rows):
            continue
        for g, led, cycle in stable_cycles(maps, group[rows], at.rows(rows), cycles, most, settled=True):
            on_torus[rows[led]] = False
            if is_new(maps, cycle, cycles.get(g, [])):
                cycles.setdefault(g, []).append(cycle)
    open_ = np.flatnonzero(on_torus)
    if not len(open_):
        return
    _, paths = maps.path(group[open_], at.rows(open_), SET)
    set_of = {row: path for row, path in zip(open_, maps.weights * paths, strict=True) if not drifts(path, DRIFT)}
    # A tube that is wider says more, where everything in it comes back.
    for radius in RADII:
        open_ = np.array(list(set_of), int)
        if not len(open_):
            break
        known = [cycles.get(int(g), []) for g in group[open_]]
        sets = list(enumerate(set_of.values()))
        found, locked = tori_among(maps, group[open_], sets, known, BACK_WITHIN, report, radius, CLOSER * radius)
        for k, torus in found.items():
            tori.setdefault(int(group[open_[k]]), []).append(Narrow(torus, radius))
        for k, cycle in locked:
            cycles.setdefault(int(group[open_[k]]), []).append(cycle)
        for k in {*found, *(k for k, _ in locked)}:
            del set_of[open_[k]]
