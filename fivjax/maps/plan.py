"""A run of many trajectories planned: cut into jobs, and which of them wait for others' attractors.

The plan follows from the trajectories alone, never from who runs it: so results are the same, bit for bit, on any executor.
"""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import jax
import numpy as np

from ..model.scene import Scene
from ..steppers.base import AbstractStepper
from ..steppers.windowed import Windowed
from .blocks import MANY
from .jobs import Task
from .sharing import HISTORY, bytes_per_trajectory, in_bulk
from .trajectories import Grid, Listed, Places

# Trajectories of a group that stand side by side in a block: enough to fill a vector unit and to make matrix products pay.
SIDE_BY_SIDE = 16
# What a trajectory that shares nothing costs, in trajectories that stand side by side.
COST_OF_STANDING_ALONE = 4
# Trajectories of a job, at most, where they are followed in bulk and where each takes longer: some seconds of work, because
# an interrupt loses as much; and enough that few groups are in several jobs.
IN_A_JOB, IN_A_LONG_JOB = 8192, 1024
# Memory that a job may take, bytes: trajectories that share little take much.
OF_A_JOB = 2.5e8


class Plan(NamedTuple):
    """What is to be done, in parts one after the other, whose jobs are independent."""

    task: Task
    trajectories: Grid | Listed
    jobs: Sequence[Places]
    parts: tuple[
        list[int], ...
    ]  # numbers of jobs; where several share a group, all but the first are in the second part
    memory: float  # that the largest job takes, bytes


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
    each = bytes_per_trajectory(scene, trajectories.total / trajectories.group_count)
    jobs = trajectories.jobs(places, in_a_job(followed, each))
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
        # The same in all jobs, because products of other shapes round differently.
        width=SIDE_BY_SIDE if in_rows <= COST_OF_STANDING_ALONE * total else 1,
        many=total >= MANY,
    )
    waiting = set(later)
    first = [number for number in range(len(jobs)) if number not in waiting]
    return Plan(task, trajectories, jobs, (first, later), each * max(map(len, jobs), default=0))


def in_a_job(method: AbstractStepper | Windowed, each: float) -> int:
    """Trajectories that a job has at most, of which each takes so many bytes."""
    by_time = IN_A_JOB if isinstance(method, Windowed) else IN_A_LONG_JOB
    return max(1, min(by_time, int(OF_A_JOB // each)))
