"""The table of attractors that a map's trajectories were captured by."""

from collections.abc import Callable

import numpy as np
from jaxtyping import Int

from ..verdicts.verdict import Verdict
from .results import Verdicts

# Amplitudes and periods of one cycle, computed from different guesses, agree to this.
SAME = 1e-6
KINDS = np.array(["periodic", "torus"])


def attractor_table(
    groups: Callable[[np.ndarray], Int[np.ndarray, " r"]], verdicts: Verdicts
) -> tuple[Int[np.ndarray, " trajectories"], dict[str, np.ndarray]]:
    """Each trajectory's place in the table (-1 where it has none), and the table's columns by name.

    Attractors stand in the order of their groups, those of a group by amplitude. `groups` has the group of each
    trajectory by its place.
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
