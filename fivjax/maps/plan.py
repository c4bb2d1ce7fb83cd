"""The plan of a run of many trajectories: its jobs, and which of them need the attractors of others first.

The plan follows from the trajectories alone, not from the executor, so results are the same, bit for bit, on any executor.
"""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import jax
import numpy as np

from ..foundation.blocks import MANY
from ..model.scene import Scene
from ..steppers.base import AbstractStepper
from ..steppers.propagation import Propagation
from .groups import HISTORY, bytes_per_trajectory, in_bulk
from .jobs import Task
from .trajectories import Grid, Listed, Places

# Trajectories of a group in a row of a block: enough to fill a vector unit and to make matrix products worthwhile.
SIDE_BY_SIDE = 16
# The cost of a trajectory in a row of its own, relative to one in a full row.
COST_OF_STANDING_ALONE = 4
# The most trajectories of a job, with `Propagation` and with other steppers: a second or two of work, because an interrupt
# loses as much, and a job must end before its worker is lost; and enough that few groups are in several jobs.
IN_A_JOB, IN_A_LONG_JOB = 8192, 1024
# The most groups of a job, for the same reason: most of the work on a small group are its attractors.
GROUPS_IN_A_JOB = 512
# Memory that a job may take, bytes: trajectories in small groups take much.
OF_A_JOB = 2.5e8


class Plan(NamedTuple):
    """A run in parts that follow one another; the jobs of a part are independent."""

    task: Task
    trajectories: Grid | Listed
    jobs: Sequence[Places]
    parts: tuple[list[int], ...]  # numbers of jobs; if several share a group, all but the first are in the second part
    memory: float  # of the largest job, bytes


def planned(
    scene: Scene,
    values: Mapping[str, np.ndarray],
    method: AbstractStepper,
    *,
    t_max: float | None,
    max_steps: int,
    energy: bool = False,
    states: Mapping[str, int] | None = None,
    places: Places | None = None,
) -> Plan:
    """The plan of a run of these trajectories, or of those at `places`; see `engine.run_to_verdict`."""
    states = {} if states is None else dict(states)
    trajectories = values if isinstance(values, Grid) else Listed(values, tuple(states))
    followed = method if energy else in_bulk(method, scene)
    of_group = trajectories.total / trajectories.group_count
    each = bytes_per_trajectory(scene, of_group)
    jobs = trajectories.jobs(places, in_a_job(followed, each, of_group))
    counts, later = np.zeros(trajectories.group_count, np.int64), []
    for number, own in enumerate(jobs):
        groups, here = np.unique(trajectories.groups(own), return_counts=True)
        if np.any(counts[groups]):
            later.append(number)
        counts[groups] += here
    total = int(counts.sum())
    in_rows = np.sum(-(-counts // SIDE_BY_SIDE)) * SIDE_BY_SIDE
    task = Task(
        scene=jax.tree.map(lambda leaf: np.asarray(leaf) if isinstance(leaf, jax.Array) else leaf, scene),
        method=followed,
        names=tuple(name for name in values if name not in HISTORY and name not in states),
        history=tuple(name for name in values if name in HISTORY),
        states=states,
        t_max=None if t_max is None else float(t_max),
        max_steps=int(max_steps),
        energy=energy,
        # The same in all jobs, because matrix products of other shapes round differently.
        width=SIDE_BY_SIDE if in_rows <= COST_OF_STANDING_ALONE * total else 1,
        many=total >= MANY,
    )
    waiting = set(later)
    first = [number for number in range(len(jobs)) if number not in waiting]
    return Plan(task, trajectories, jobs, (first, later), each * max(map(len, jobs), default=0))


def in_a_job(method: AbstractStepper | Propagation, each: float, of_group: float) -> int:
    """The most trajectories of a job, if each takes `each` bytes and so many, on average, are of one group."""
    by_time = IN_A_JOB if isinstance(method, Propagation) else IN_A_LONG_JOB
    return max(1, min(by_time, int(OF_A_JOB // each), int(GROUPS_IN_A_JOB * of_group)))
