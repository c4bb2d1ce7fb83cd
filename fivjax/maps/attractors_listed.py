"""The table of the attractors that have captured a map's trajectories."""

from collections.abc import Callable

import numpy as np
from jaxtyping import Int

from ..verdicts.verdict import Verdict
from .results import Verdicts

# Amplitudes and periods of the same cycle, computed from different guesses, agree to this relative error.
SAME = 1e-6
KINDS = np.array(["periodic", "torus"])


def attractor_table(
    groups: Callable[[np.ndarray], Int[np.ndarray, " r"]], verdicts: Verdicts
) -> tuple[Int[np.ndarray, " trajectories"], dict[str, np.ndarray]]:
    """The index of each trajectory's attractor in the table (-1 without one), and the table's columns by name.

    Attractors are in the order of their groups, and by amplitude within a group. `groups` gives the group of each trajectory
    from its index.
    """
    on_one = np.flatnonzero(verdicts.verdict == Verdict.LIMIT_CYCLE)
    columns = np.stack(
        [
            groups(on_one),
            verdicts.amplitude[on_one],
            verdicts.attractor_period[on_one],
            verdicts.attractor_kind[on_one],
        ]
    )
    order = np.lexsort((columns[2], columns[1], columns[3], columns[0]))
    columns = columns[:, order]
    differ = np.abs(np.diff(columns, axis=1)) > SAME * np.array([0.0, 1.0, 1.0, 0.0])[:, None] * np.abs(columns[:, 1:])
    new = np.concatenate([np.ones(min(len(on_one), 1), bool), np.any(differ, axis=0)])
    place = np.full(len(verdicts.verdict), -1, np.int32)
    place[on_one[order]] = np.cumsum(new) - 1
    first = on_one[order[new]]
    return place, {
        "attractor_amplitude": verdicts.amplitude[first],
        "attractor_period": verdicts.attractor_period[first],
        "attractor_kind": KINDS[verdicts.attractor_kind[first]],
        "attractor_multiplier": verdicts.attractor_multiplier[first],
    }
