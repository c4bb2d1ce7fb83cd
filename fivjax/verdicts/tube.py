"""The check that a torus attracts: motions that start in a tube about it come back.

Where a limit cycle has lost its stability to a torus, no state of the section repeats. The torus is then given by a set of its
crossing states. It attracts if all starts that are displaced from the set by a fixed share of its size, inwards, outwards and
in other directions, come back to within half of that distance and stay there for many crossings. Near a slow fade, and near the
ghost of a cycle just past its fold, they do not come back: starts that are displaced inwards go on inwards.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float

# The tube's radius, relative to the mean size of the states.
RADIUS = 0.04
# Number of starts in it: one in four displaced outwards, one in four inwards, the others at random.
STARTS = 16
# Number of crossings in a row that must lie within half the tube.
HOME = 16


def directions_from(
    states: Float[np.ndarray, "k 2n"],
) -> tuple[Float[np.ndarray, "m 2n"], Float[np.ndarray, "m 2n"], float]:
    """States spread over a set; the direction in which a start is displaced from each; and the mean size of the states."""
    chosen = states[np.linspace(0, len(states) - 1, STARTS).round().astype(int)]
    random = np.random.default_rng(0).normal(size=chosen.shape)
    kind = np.arange(STARTS) % 4
    away = np.where((kind == 0)[:, None], chosen, np.where((kind == 1)[:, None], -chosen, random))
    return chosen, away, mean_size(states)


def mean_size(states: Float[np.ndarray, "k 2n"]) -> float:
    """The mean length of weighted deviations."""
    return float(np.mean(np.linalg.norm(states, axis=-1)))


def starts(
    states: Float[np.ndarray, "k 2n"], velocity: int, gap: int, gap_rate: int, radius: float = RADIUS
) -> Float[np.ndarray, "m 2n"]:
    """States on the edge of the tube about weighted deviations `states`, whose `radius` is relative to their mean size.

    `velocity`, `gap` and `gap_rate` are the indices of the tangential velocity, which is zero on the section, and of the normal
    displacement and velocity, which are zero in contact.
    """
    chosen, away, size = directions_from(states)
    # A gap this small is a rounding error of contact.
    open_ = chosen[:, gap] > 1e-6 * size
    away[:, velocity] = 0.0
    away[~open_, gap] = away[~open_, gap_rate] = 0.0
    found = chosen + radius * size * away / np.linalg.norm(away, axis=-1, keepdims=True)
    found[:, velocity] = 0.0
    found[open_, gap] = np.maximum(found[open_, gap], 1e-6 * size)
    found[~open_, gap] = found[~open_, gap_rate] = 0.0
    return found


@dataclass(frozen=True, eq=False)
class Tube:
    """What lies within `radius` of a set of weighted crossing states, relative to their mean size."""

    states: Float[np.ndarray, "k 2n"]
    radius: float

    @cached_property
    def size(self) -> float:
        """The mean size of the states."""
        return mean_size(self.states)

    @cached_property
    def _tree(self):
        return tree_of(self.states)

    def holds(self, points: Float[np.ndarray, "*m 2n"], within: float = 0.5) -> Bool[np.ndarray, "*m"]:
        """Which points lie in this share of the tube; those that are not finite do not."""
        finite = np.all(np.isfinite(points), axis=-1)
        most = within * self.radius * self.size
        # The tree looks no further than that: what is nearest there or beyond is infinitely far.
        apart, _ = self._tree.query(np.where(finite[..., None], points, 0.0), distance_upper_bound=most)
        return finite & np.isfinite(apart)

    def home(self, ends: Float[np.ndarray, "h m 2n"], within: float = 0.5) -> Bool[np.ndarray, " m"]:
        """Which motions have come back: all of their last crossing states lie in this share of the tube."""
        return np.all(self.holds(ends, within), axis=0)


def tree_of(states: Float[np.ndarray, "k 2n"]):
    """A tree of states, in which nearest ones are found fast."""
    from scipy.spatial import KDTree

    return KDTree(states)
