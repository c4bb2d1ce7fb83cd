"""The results of many trajectories, as arrays."""

from typing import NamedTuple

import numpy as np

from ..simulation.energy import exchanged
from ..verdicts.verdict import Verdict
from .one_trajectory import Progress

# `attractor_kind` of a trajectory: no attractor has captured it; a cycle has, or a torus; none has, and its neighbours diverge
# exponentially; and a cycle has, by its approach.
NO_ATTRACTOR, PERIODIC, TORUS, CHAOTIC, APPROACHED = -1, 0, 1, 2, 3


class Verdicts(NamedTuple):
    """The result of each trajectory; arrays over trajectories."""

    verdict: np.ndarray
    amplitude: np.ndarray  # m/s
    attractor_kind: np.ndarray  # see above
    attractor_period: np.ndarray  # s
    attractor_multiplier: np.ndarray  # size of the largest
    attractor_reach: np.ndarray  # of the neighbourhood that it draws in, relative to its size
    attractor_contraction: np.ndarray  # the factor by which that shrinks
    attractor_position: np.ndarray  # see `attractors.motions.position_of`
    bound: np.ndarray  # on the share of the margins of sliding that can still be used up; NaN but for those that slide
    decided_at: np.ndarray  # s
    events: np.ndarray
    last_event: np.ndarray  # s
    energy: dict[str, np.ndarray]  # terms of the ledger by name, J; empty where not asked for

    def pending(self, places: slice | np.ndarray = slice(None)) -> np.ndarray:
        """Which of the trajectories at these places have not been run."""
        return self.verdict[places] == Verdict.NOT_RUN


def not_run(total: int, energy: bool) -> Verdicts:
    """Results of `total` trajectories that have not been run."""
    # The energies of a trajectory, see `energy`; `kick_energy` is that of the vibration when the kick ends.
    energies = (
        "stick_work",
        "slide_work",
        "interface_work",
        "damping_work",
        "load_work",
        "kick_work",
        "impact_loss",
        "kick_energy",
        "energy_residual",
        "energy_exchanged",
    )
    numbers = {name: np.full(total, np.nan) for name in Verdicts._fields}
    return Verdicts(**numbers)._replace(
        verdict=np.full(total, Verdict.NOT_RUN, np.int8),
        attractor_kind=np.full(total, NO_ATTRACTOR, np.int8),
        events=np.zeros(total, np.int32),
        energy={name: np.full(total, np.nan) for name in energies} if energy else {},
    )


def by_name(verdicts: Verdicts) -> dict[str, np.ndarray]:
    """All arrays by name, including the terms of the ledger."""
    parts = verdicts._asdict()
    return {**parts.pop("energy"), **parts}


def record(
    verdicts: Verdicts, index: np.ndarray, now: Progress, verdict: np.ndarray, attractors: dict[str, np.ndarray]
) -> None:
    """Write the results of trajectories that have ended at their indices, with those of their attractors by name."""
    for name, values in attractors.items():
        getattr(verdicts, name)[index] = values
    verdicts.amplitude[index[verdict == Verdict.SLIDING]] = 0.0
    verdicts.decided_at[index] = np.where(verdict >= 0, now.t, np.nan)
    verdicts.bound[index] = np.where(verdict == Verdict.SLIDING, now.bound, np.nan)
    verdicts.events[index] = now.events
    verdicts.last_event[index] = now.last_event
    if now.energy is not None:
        ledger = now.energy.ledger
        terms = {**ledger.work.lines("work"), "impact_loss": ledger.impact, "energy_residual": ledger.worst}
        terms["energy_exchanged"] = exchanged(ledger)
        terms["kick_energy"] = now.energy.vibration
        for name, values in verdicts.energy.items():
            values[index] = terms[name]
    # Last and at once, so that a trajectory with a verdict is complete even after an interrupt.
    verdicts.verdict[index] = verdict
