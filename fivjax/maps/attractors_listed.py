"""The table of the attractors that have captured a map's trajectories."""

from collections.abc import Callable, Iterator

import numpy as np
from jaxtyping import Int

from ..verdicts.verdict import Verdict
from .results import Verdicts

# Amplitudes and periods of the same cycle, computed from different guesses, agree to this relative error.
SAME = 1e-6
KINDS = np.array(["periodic", "torus"])
# Trajectories whose attractors are told apart at a time: that takes much memory.
AT_A_TIME = 2**18


def attractor_table(
    groups: Callable[[np.ndarray], Int[np.ndarray, " r"]], verdicts: Verdicts
) -> tuple[Int[np.ndarray, " trajectories"], dict[str, np.ndarray]]:
    """The index of each trajectory's attractor in the table (-1 without one), and the table's columns by name.

    Attractors are in the order of their groups, and by amplitude within a group. `groups` gives the group of each trajectory
    from its index.
    """
    on_one = np.flatnonzero(verdicts.verdict == Verdict.LIMIT_CYCLE)
    group = groups(on_one)
    order = np.argsort(group, kind="stable")
    on_one, group = on_one[order], group[order]
    place, first = np.full(len(verdicts.verdict), -1, np.int32), [on_one[:0]]
    for part in _whole_groups(group):
        rows = on_one[part]
        columns = np.stack(
            [
                group[part],
                verdicts.amplitude[rows],
                verdicts.attractor_period[rows],
                verdicts.attractor_kind[rows],
            ]
        )
        order = np.lexsort((columns[2], columns[1], columns[3], columns[0]))
        rows, columns = rows[order], columns[:, order]
        allowed = SAME * np.array([0.0, 1.0, 1.0, 0.0])[:, None] * np.abs(columns[:, 1:])
        new = np.append(True, np.any(np.abs(np.diff(columns, axis=1)) > allowed, axis=0))
        place[rows] = sum(map(len, first)) + np.cumsum(new) - 1
        first.append(rows[new])
    chosen = np.concatenate(first)
    return place, {
        "attractor_amplitude": verdicts.amplitude[chosen],
        "attractor_period": verdicts.attractor_period[chosen],
        "attractor_kind": KINDS[verdicts.attractor_kind[chosen]],
        "attractor_multiplier": verdicts.attractor_multiplier[chosen],
        "attractor_reach": verdicts.attractor_reach[chosen],
        "attractor_contraction": verdicts.attractor_contraction[chosen],
    }


def _whole_groups(group: Int[np.ndarray, " r"]) -> Iterator[slice]:
    """Slices of sorted groups, each of whole ones and, if these are not larger, of `AT_A_TIME` trajectories at most."""
    start = 0
    while start < len(group):
        end = start + AT_A_TIME
        if end < len(group):
            before = int(np.searchsorted(group, group[end], side="left"))
            end = before if before > start else int(np.searchsorted(group, group[end], side="right"))
        yield slice(start, end)
        start = end
