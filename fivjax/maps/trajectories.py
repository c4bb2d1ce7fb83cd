"""Which trajectories a run has, and how they are cut into jobs: by what they are alone, never by who computes them.

Trajectories of a group (`sharing`) share what is worked out once, their attractors above all, so a job has whole groups
where they are small enough.
"""

import math
from collections.abc import Iterator, Mapping, Sequence

import numpy as np
from jaxtyping import Int

from .sharing import HISTORY, grouped

# Trajectories by their places in a run; several are one job.
Places = Int[np.ndarray, " r"]


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
        """Their values, by name."""
        index = np.unravel_index(places, self.shape)
        return {name: values[own] for (name, values), own in zip(self.axes.items(), index, strict=True)}

    def groups(self, places: Places) -> Int[np.ndarray, " r"]:
        """The group that each belongs to."""
        if not self.across:
            return np.zeros(len(places), int)
        index = np.unravel_index(places, self.shape)
        return np.ravel_multi_index([index[k] for k in self.across], [self.shape[k] for k in self.across])

    def tile(self, most: int) -> tuple[int, ...]:
        """The shape of equal tiles of at most so many trajectories, of whole groups where these are small enough."""
        shape, left = [1] * len(self.shape), max(most, 1)
        inside_groups = [k for k in range(len(self.shape)) if k not in self.across]
        for k in (*reversed(inside_groups), *reversed(self.across)):
            parts = -(-self.shape[k] // left)
            shape[k] = -(-self.shape[k] // parts)
            left = max(left // shape[k], 1)
        return tuple(shape)

    def jobs(self, places: Places | None, most: int) -> Sequence[Places]:
        """These places (all, unless given) cut into jobs; each tile is in one of them."""
        tile = self.tile(most)
        if places is None:
            return Tiles(self.shape, tile)
        index = np.unravel_index(places, self.shape)
        parts = [-(-length // part) for length, part in zip(self.shape, tile, strict=True)]
        own = np.ravel_multi_index([i // part for i, part in zip(index, tile, strict=True)], parts)
        return cut(own, places, most)


class Listed:
    """Trajectories by equally long columns of their values."""

    def __init__(self, values: Mapping[str, np.ndarray], states: Sequence[str] = ()):
        self.values = dict(values)
        self.total = len(next(iter(values.values())))
        distinct, self._group = grouped(self.values, states)
        self.group_count = len(distinct)

    def columns(self, places: Places) -> dict[str, np.ndarray]:
        """Their values, by name."""
        return {name: column[places] for name, column in self.values.items()}

    def groups(self, places: Places) -> Int[np.ndarray, " r"]:
        """The group that each belongs to."""
        return self._group[places]

    def jobs(self, places: Places | None, most: int) -> Sequence[Places]:
        """These places (all, unless given) cut into jobs, group by group."""
        places = np.arange(self.total) if places is None else places
        return cut(self._group[places], places, most)


class Tiles(Sequence):
    """The places of each tile of a grid, tile by tile."""

    def __init__(self, shape: tuple[int, ...], tile: tuple[int, ...]):
        self.shape, self.tile = shape, tile
        self.parts = tuple(-(-length // part) for length, part in zip(shape, tile, strict=True))

    def __len__(self) -> int:
        return math.prod(self.parts)

    def slices(self, number: int) -> tuple[slice, ...]:
        """Where a tile lies on the grid."""
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

    def holding(self, places: Places) -> Int[np.ndarray, " t"]:
        """The numbers of the tiles that these places lie in."""
        index = np.unravel_index(places, self.shape)
        return np.unique(
            np.ravel_multi_index([i // part for i, part in zip(index, self.tile, strict=True)], self.parts)
        )


def cut(unit: Int[np.ndarray, " r"], places: Places, most: int) -> list[Places]:
    """Places in jobs of whole units, at most so many in one; a larger unit makes several jobs."""
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
