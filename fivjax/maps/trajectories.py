"""The trajectories of a run, and how they are divided into jobs, which does not depend on the executor.

Trajectories of a group (`sharing`) share data, above all their attractors, so a job has whole groups if these are small enough.
"""

import math
from collections.abc import Iterator, Mapping, Sequence
from functools import cached_property

import numpy as np
from jaxtyping import Float, Int

from .groups import HISTORY, grouped

# Indices of trajectories in a run; those of one job, for instance.
Places = Int[np.ndarray, " r"]
# Attractors are computed from scratch for one in so many values of each parameter, and continued from there to the values that
# follow, if these differ by no more than this share (`attractor_search`).
SEEDING, SEEDED_WITHIN = 4, 0.2


class Grid(Mapping):
    """One trajectory for each combination of values on axes, in the order of a grid."""

    def __init__(self, axes: dict[str, np.ndarray], states: Sequence[str] = ()):
        self.axes = axes
        self.shape = tuple(len(values) for values in axes.values())
        self.total = math.prod(self.shape)
        # Axes along which groups change.
        self.across = [k for k, name in enumerate(axes) if name not in HISTORY and name not in states]
        self.group_count = math.prod(self.shape[k] for k in self.across)

    def __getitem__(self, name: str) -> np.ndarray:
        return self.columns(np.arange(self.total))[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self.axes)

    def __len__(self) -> int:
        return len(self.axes)

    def columns(self, places: Places) -> dict[str, np.ndarray]:
        """The values of these trajectories, by name."""
        index = np.unravel_index(places, self.shape)
        return {name: values[own] for (name, values), own in zip(self.axes.items(), index, strict=True)}

    def seeding(self, places: Places) -> Float[np.ndarray, "r k"]:
        """The parameters of the group whose attractors seed the search in the group of each of these trajectories: its own,
        where that is searched from scratch. It follows from the whole grid, not from `places`.
        """
        index = np.unravel_index(places, self.shape)
        columns = [(list(self.axes.values())[k], index[k]) for k in self.across]
        if not columns:
            return np.zeros((len(places), 0))
        own = np.stack([values[at] for values, at in columns], axis=-1)
        return _near_enough(own, np.stack([values[at - at % SEEDING] for values, at in columns], axis=-1))

    def groups(self, places: Places) -> Int[np.ndarray, " r"]:
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

    def jobs(self, places: Places | None, most: int) -> Sequence[Places]:
        """These trajectories (all, unless given) divided into jobs; a part of the grid is never in two of them."""
        tile = self.tile(most)
        if places is None:
            return Tiles(self.shape, tile)
        return cut(Tiles(self.shape, tile).holding(places), places, most)


class Listed:
    """Trajectories by equally long columns of their values."""

    def __init__(self, values: Mapping[str, np.ndarray], states: Sequence[str] = ()):
        self.values = dict(values)
        self.total = len(next(iter(values.values())))
        self._distinct, self._group = grouped(self.values, states)
        self.group_count = len(self._distinct)

    def columns(self, places: Places) -> dict[str, np.ndarray]:
        """The values of these trajectories, by name."""
        return {name: column[places] for name, column in self.values.items()}

    def seeding(self, places: Places) -> Float[np.ndarray, "r k"]:
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

    def groups(self, places: Places) -> Int[np.ndarray, " r"]:
        """The group of each of these trajectories."""
        return self._group[places]

    def jobs(self, places: Places | None, most: int) -> Sequence[Places]:
        """These trajectories (all, unless given) divided into jobs, group by group."""
        places = np.arange(self.total) if places is None else places
        return cut(self._group[places], places, most)


def _near_enough(own: Float[np.ndarray, "r k"], other: Float[np.ndarray, "r k"]) -> Float[np.ndarray, "r k"]:
    """The other parameters where they differ little from the own ones, else the own ones."""
    near = np.all(np.abs(other - own) <= SEEDED_WITHIN * np.abs(own), axis=1)
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

    def __getitem__(self, number: int) -> Places:
        along = [np.arange(part.start, part.stop) for part in self.slices(number)]
        return np.ravel_multi_index(np.ix_(*along), self.shape).ravel()

    def holding(self, places: Places) -> Int[np.ndarray, " r"]:
        """The number of the part in which each of these trajectories lies."""
        index = np.unravel_index(places, self.shape)
        return np.ravel_multi_index([i // part for i, part in zip(index, self.tile, strict=True)], self.parts)

    def among(self, places: Places | None) -> Iterator[tuple[int, Int[np.ndarray, " t"], Int[np.ndarray, " t"]]]:
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


def cut(unit: Int[np.ndarray, " r"], places: Places, most: int) -> list[Places]:
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
