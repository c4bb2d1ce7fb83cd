"""A job between two rounds: all that it needs to go on from there with the same bits, and who keeps it."""

from typing import NamedTuple, Protocol

import numpy as np

from ..attractors.known import Attractors
from .results import Verdicts


class Halfway(NamedTuple):
    """The state of a job after some rounds. What trajectories share follows from the job's values and is worked out again."""

    done: int  # steps of each trajectory
    own_from: int  # steps after which trajectories search for attractors of their own
    verdicts: Verdicts  # of all trajectories of the job
    pending: np.ndarray  # trajectories without a verdict, as indices
    numbers: np.ndarray  # their states, see `Flattened`
    settled_by: np.ndarray  # time that the known cycles of each group take to attract, s
    known: dict[bytes, Attractors]  # what searches have found, by the group's parameters
    # The same with what trajectories have found on their way, by the group's number; and when their time was over.
    of_groups: dict[int, Attractors]
    at_last: dict[int, Attractors]


class Log(Protocol):
    """What keeps the state of a job while it runs."""

    def last(self) -> Halfway | None:
        """The state in which an interrupted run of the job was kept."""
        ...

    def note(self, now: Halfway, at_once: bool = False) -> None:
        """Keep this state if it is time, or almost so if `at_once`. Until `moving`, its arrays do not change."""
        ...

    def moving(self) -> None:
        """The arrays of the state noted last are about to change."""
        ...


class NoLog:
    """Keeps nothing."""

    def last(self) -> Halfway | None:
        return None

    def note(self, now: Halfway, at_once: bool = False) -> None:
        del now, at_once

    def moving(self) -> None:
        pass
