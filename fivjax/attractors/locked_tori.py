"""Tori that are locked to a cycle of many crossings: motions come to the torus first, and along it to the cycle."""

import numpy as np
from jaxtyping import Float, Int

from ..section.return_maps import ReturnMaps
from .cycles import MOST_CROSSINGS, Recurrence, StableCycle, stable_cycles
from .motions import Motions, extent

# The weighted states that motions trace on the section, in order, by row.
States = dict[int, Float[np.ndarray, "k 2n"]]


def cycles_repeated(
    maps: ReturnMaps, group: Int[np.ndarray, " m"], traced: States, cycles: list[list[StableCycle]]
) -> list[tuple[int, StableCycle]]:
    """The cycles of motions that have nearly come to one of many crossings by the end of what they trace, with their rows."""
    ends: States = {}
    for row, states in traced.items():
        back = np.linalg.norm(states[-1 - MOST_CROSSINGS : -1] - states[-1], axis=1)
        # Hardly any motion on a torus comes back as close as this.
        if np.min(back) <= 1e-4 * extent(states):
            ends[row] = states[-1:]
    return _cycles_near(maps, group, ends, cycles)


def cycles_closed_in_on(
    maps: ReturnMaps,
    group: Int[np.ndarray, " m"],
    traced: States,
    cycles: list[list[StableCycle]],
) -> list[tuple[int, StableCycle]]:
    """The cycles to which some of these tori are locked, with their rows: weakly, so that motions come to the torus long before
    they come to the cycle.
    """
    ends: States = {}
    for row, states in traced.items():
        back = np.linalg.norm(states[-1 - MOST_CROSSINGS : -1] - states[-1], axis=1)
        lag = MOST_CROSSINGS - int(np.argmin(back))
        apart = np.linalg.norm(states[lag:] - states[:-lag], axis=1)
        third = len(apart) // 3
        # On a torus that is not locked, mostly as far apart in the end as in the beginning; and hardly ever as close as this.
        closes_in = np.median(apart[-third:]) <= 0.9 * np.median(apart[:third])
        if closes_in and np.min(back) <= 1e-3 * extent(states):
            ends[row] = states[-1:]
        elif np.min(back) <= 1e-4 * extent(states):
            # Next to the unstable cycle of a locked torus, motions nearly repeat that for long. Between its places are those of
            # the stable one.
            places = states[-lag:-1]
            ends[row] = 0.5 * (states[-1:] + places[[np.argmin(np.linalg.norm(places - states[-1], axis=1))]])
    return _cycles_near(maps, group, ends, cycles, 4096)


def _cycles_near(
    maps: ReturnMaps,
    group: Int[np.ndarray, " m"],
    ends: States,
    cycles: list[list[StableCycle]],
    onward: int = 0,
) -> list[tuple[int, StableCycle]]:
    """The cycles near these states, one of each row, or near where they lead in so many returns, with rows."""
    rows = list(ends)
    if not rows:
        return []
    own, last = group[rows], np.concatenate([ends[row] for row in rows]) / maps.weights
    at = maps.with_modes(own, last)
    if onward:
        at = maps.returns(own, at, onward).at
    known = {int(group[row]): cycles[row] for row in rows}
    near = stable_cycles(maps, Motions(own, at), known, Recurrence(MOST_CROSSINGS, settled=True))
    return [(rows[k], cycle) for _, which, cycle in near for k in which]
