"""The plan of a run of many trajectories: how they are divided into jobs, and which jobs need the attractors of others first.

The plan follows from the trajectories alone, not from the executor, so results are the same, bit for bit, on any executor.
Trajectories of a group (`groups`) share data, above all their attractors, so a job has whole groups if these are small enough.
"""

import math
from collections.abc import Collection, Iterator, Mapping, Sequence
from functools import cached_property
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from ..foundation.blocks import MANY
from ..model.scene import Scene
from ..steppers.base import AbstractStepper
from .groups import OF_KICK, Limits, Task, bytes_per_trajectory, followed_by_kernel, groups_of

# Indices of trajectories in a run; those of one job, for instance.
Indices = Int[np.ndarray, " r"]
# Attractors are computed from scratch for one in so many values of each parameter, and continued from there to the values that
# follow (`attractors.search`).
SEEDING = 4


class Grid:
    """One trajectory for each combination of values on axes, in the order of a grid.

    `states` are names of axes that are initial displacements or velocities instead of parameters, with their indices in the
    state; all other coordinates begin at the sliding equilibrium. `of_kick` are names of the kick's parameters.
    """

    def __init__(
        self,
        axes: dict[str, np.ndarray],
        states: Mapping[str, int] | None = None,
        of_kick: Collection[str] = OF_KICK,
    ):
        self.axes, self.names, self.states = axes, tuple(axes), dict(states or {})
        self.of_kick = tuple(name for name in axes if name in of_kick and name not in self.states)
        self.shape = tuple(len(values) for values in axes.values())
        self.total = math.prod(self.shape)
        # Axes along which groups change.
        self.across = [k for k, name in enumerate(axes) if name not in self.of_kick and name not in self.states]
        self.group_count = math.prod(self.shape[k] for k in self.across)

    def columns(self, places: Indices | None = None) -> dict[str, np.ndarray]:
        """The values of these trajectories (all, unless given), by name."""
        index = np.unravel_index(np.arange(self.total) if places is None else places, self.shape)
        return {name: values[own] for (name, values), own in zip(self.axes.items(), index, strict=True)}

    def seeding(self, places: Indices) -> Float[np.ndarray, "r k"]:
        """The parameters of the group whose attractors seed the search in the group of each of these trajectories: its own,
        where that is searched from scratch. It follows from the whole grid, not from `places`.
        """
        index = np.unravel_index(places, self.shape)
        columns = [(list(self.axes.values())[k], index[k]) for k in self.across]
        if not columns:
            return np.zeros((len(places), 0))
        own = np.stack([values[at] for values, at in columns], axis=-1)
        return _near_enough(own, np.stack([values[at - at % SEEDING] for values, at in columns], axis=-1))

    def groups(self, places: Indices) -> Int[np.ndarray, " r"]:
        """The group of each of these trajectories."""
        if not self.across:
            return np.zeros(len(places), int)
        index = np.unravel_index(places, self.shape)
        return np.ravel_multi_index([index[k] for k in self.across], [self.shape[k] for k in self.across])

    def tile(self, most: int) -> tuple[int, ...]:
        """The shape of the equal parts of the grid that make jobs: at most `most` trajectories, whole groups if these are small
        enough.
        """
        shape, left = [1] * len(self.shape), max(most, 1)
        inside_groups = [k for k in range(len(self.shape)) if k not in self.across]
        for k in (*reversed(inside_groups), *reversed(self.across)):
            parts = -(-self.shape[k] // left)
            shape[k] = -(-self.shape[k] // parts)
            left = max(left // shape[k], 1)
        return tuple(shape)

    def jobs(self, places: Indices | None, most: int) -> Sequence[Indices]:
        """These trajectories (all, unless given) divided into jobs; a part of the grid is never in two of them."""
        tile = self.tile(most)
        if places is None:
            return Tiles(self.shape, tile)
        return cut_into_jobs(Tiles(self.shape, tile).holding(places), places, most)


class TrajectoryList:
    """Trajectories by equally long columns of their values; `states` as in a grid."""

    def __init__(self, values: Mapping[str, np.ndarray], states: Mapping[str, int] | None = None):
        self.values, self.names, self.states = dict(values), tuple(values), dict(states or {})
        self.of_kick = tuple(name for name in OF_KICK if name in values)
        self.total = len(next(iter(values.values())))
        self._distinct, self._group = groups_of(self.values, (*self.of_kick, *self.states))
        self.group_count = len(self._distinct)

    def columns(self, places: Indices | None = None) -> dict[str, np.ndarray]:
        """The values of these trajectories (all, unless given), by name."""
        return {name: column[slice(None) if places is None else places] for name, column in self.values.items()}

    def seeding(self, places: Indices) -> Float[np.ndarray, "r k"]:
        """As for a grid; a group for which there is none of the run is searched from scratch."""
        return self._seeding[self._group[places]]

    @cached_property
    def _seeding(self) -> Float[np.ndarray, "g k"]:
        own = self._distinct
        if not own.shape[1]:
            return own
        ranks = np.stack([np.unique(column, return_inverse=True)[1] for column in own.T], axis=-1)
        place = {tuple(rank): k for k, rank in enumerate(ranks.tolist())}
        wanted = (ranks - ranks % SEEDING).tolist()
        return _near_enough(own, own[[place.get(tuple(rank), k) for k, rank in enumerate(wanted)]])

    def groups(self, places: Indices) -> Int[np.ndarray, " r"]:
        """The group of each of these trajectories."""
        return self._group[places]

    def jobs(self, places: Indices | None, most: int) -> Sequence[Indices]:
        """These trajectories (all, unless given) divided into jobs, group by group."""
        places = np.arange(self.total) if places is None else places
        return cut_into_jobs(self._group[places], places, most)


def _near_enough(own: Float[np.ndarray, "r k"], other: Float[np.ndarray, "r k"]) -> Float[np.ndarray, "r k"]:
    """The other parameters where they differ little from the own ones, else the own ones."""
    # Further away an attractor cannot be continued.
    near = np.all(np.abs(other - own) <= 0.2 * np.abs(own), axis=1)
    return np.where(near[:, None], other, own)


class Tiles(Sequence):
    """The equal parts ("tiles") of a grid, each as the indices of its trajectories."""

    def __init__(self, shape: tuple[int, ...], tile: tuple[int, ...]):
        self.shape, self.tile, self.total = shape, tile, math.prod(shape)
        self.parts = tuple(-(-length // part) for length, part in zip(shape, tile, strict=True))

    def __len__(self) -> int:
        return math.prod(self.parts)

    def slices(self, number: int) -> tuple[slice, ...]:
        """The position of a part on the grid."""
        if not 0 <= number < len(self):
            raise IndexError(number)
        at = np.unravel_index(number, self.parts)
        return tuple(
            slice(int(k) * part, min((int(k) + 1) * part, length))
            for k, part, length in zip(at, self.tile, self.shape, strict=True)
        )

    def __getitem__(self, number: int) -> Indices:
        along = [np.arange(part.start, part.stop) for part in self.slices(number)]
        return np.ravel_multi_index(np.ix_(*along), self.shape).ravel()

    def holding(self, places: Indices) -> Int[np.ndarray, " r"]:
        """The number of the part in which each of these trajectories lies."""
        index = np.unravel_index(places, self.shape)
        return np.ravel_multi_index([i // part for i, part in zip(index, self.tile, strict=True)], self.parts)

    def among(self, places: Indices | None) -> Iterator[tuple[int, Int[np.ndarray, " t"], Int[np.ndarray, " t"]]]:
        """The parts in which these trajectories (all, unless given) lie: of each its number, which entries of it they are, and
        which of `places`.
        """
        if places is None:
            for number in range(len(self)):
                yield number, np.arange(len(self[number])), self[number]
            return
        numbers = self.holding(places)
        order = np.argsort(numbers, kind="stable")
        found, first = np.unique(numbers[order], return_index=True)
        for number, rows in zip(found.tolist(), np.split(order, first[1:]), strict=True):
            yield number, np.searchsorted(self[number], places[rows]), rows


def cut_into_jobs(unit: Int[np.ndarray, " r"], places: Indices, most: int) -> list[Indices]:
    """Jobs of whole units with at most `most` trajectories each; a larger unit makes several jobs."""
    order = np.argsort(unit, kind="stable")
    _, counts = np.unique(unit, return_counts=True)
    ends, filled, at = [0], 0, 0
    for count in counts:
        if filled and filled + count > most:
            ends.append(at)
            filled = 0
        for start in range(most, count, most):
            ends.append(at + start)
        at, filled = at + count, filled + count if count <= most else most
    return [places[order[a:b]] for a, b in zip(ends, [*ends[1:], len(places)], strict=True) if b > a]


# The most trajectories of a job, if kernels follow those of one contact under constant friction, and if not: a second or two of
# work, because an interrupt loses as much, and a job must end before its worker is lost; and enough that few groups are in
# several jobs. A long run has jobs that are up to so many times as large, while there are so many of them: to follow more at
# once takes less of Python.
IN_A_JOB, IN_A_LONG_JOB = 8192, 1024
TIMES_AS_LARGE, JOBS = 8, 8
# The most groups of a job, for the same reason: most of the work on a small group are its attractors.
GROUPS_IN_A_JOB = 512


class Plan(NamedTuple):
    """A run in parts that follow one another; the jobs of a part are independent."""

    task: Task
    trajectories: Grid | TrajectoryList
    jobs: Sequence[Indices]
    parts: tuple[list[int], ...]  # numbers of jobs; if several share a group, all but the first are in the second part
    memory: float  # of the largest job, bytes


def plan_of(
    scene: Scene,
    trajectories: Grid | TrajectoryList,
    method: AbstractStepper,
    limits: Limits,
    places: Indices | None = None,
) -> Plan:
    """The plan of a run of these trajectories, or of those at `places`; see `engine.run_to_verdict`."""
    states = trajectories.states
    per_group = trajectories.total / trajectories.group_count
    each = bytes_per_trajectory(scene, per_group)
    count = trajectories.total if places is None else len(places)
    jobs = trajectories.jobs(places, largest_job_size(takes_long(scene, method, limits.energy), each, per_group, count))
    every = np.arange(trajectories.group_count) if places is None else np.unique(trajectories.groups(places))
    counts, later = np.zeros(len(every), np.int64), []
    for number, own in enumerate(jobs):
        groups, here = np.unique(np.searchsorted(every, trajectories.groups(own)), return_counts=True)
        if np.any(counts[groups]):
            later.append(number)
        counts[groups] += here
    total = int(counts.sum())
    # Trajectories of a group in a row of a block: enough to fill a vector unit and to make matrix products worthwhile.
    side_by_side = 16
    in_rows = np.sum(-(-counts // side_by_side)) * side_by_side
    task = Task(
        scene=scene,
        method=method,
        names=tuple(name for name in trajectories.names if name not in trajectories.of_kick and name not in states),
        of_kick=trajectories.of_kick,
        states=states,
        limits=limits,
        # The same in all jobs, because matrix products of other shapes round differently. A trajectory in a row of its own
        # costs four times as much as one in a full row.
        width=side_by_side if in_rows <= 4 * total else 1,
        many=total >= MANY,
        # To find an approach takes about as long as to follow so many trajectories to a cycle's neighbourhood.
        from_afar=per_group >= 32,
    )
    waiting = set(later)
    first = [number for number in range(len(jobs)) if number not in waiting]
    return Plan(task, trajectories, jobs, (first, later), each * max(map(len, jobs), default=0))


def takes_long(scene: Scene, method: AbstractStepper, energy: bool) -> bool:
    """Whether a trajectory takes several times what one of a single contact under constant friction takes by kernels."""
    one = len(scene.structure.contacts) == 1
    return energy or not (one and scene.friction.constant and followed_by_kernel(scene, method))


def largest_job_size(takes_long: bool, each: float, per_group: float, count: int) -> int:
    """The most trajectories of a job, of so many in the run, if each takes `each` bytes and so many, on average, are of one
    group.
    """
    by_time = IN_A_LONG_JOB if takes_long else IN_A_JOB
    times = min(max(count // (JOBS * by_time), 1), TIMES_AS_LARGE)
    memory = 2.5e8  # of a job, bytes: trajectories in small groups take much
    return max(1, min(by_time * times, int(memory // each), int(GROUPS_IN_A_JOB * per_group)))
