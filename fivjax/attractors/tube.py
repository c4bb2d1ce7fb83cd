"""The check that a torus attracts: motions that start in a tube about it come back.

Where a limit cycle has lost its stability to a torus, no state of the section repeats. The torus is then given by a set of its
crossing states. It attracts if all starts that are displaced from the set by a fixed share of its size, inwards, outwards and
in other directions, come back to well within that distance and stay there for many crossings. Near a slow fade, and near the
ghost of a cycle just past its fold, they do not come back: starts that are displaced inwards go on inwards.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float, Int

# The tube's radius, relative to the mean size of the states.
RADIUS = 0.04
# Number of starts in it: one in four displaced outwards, one in four inwards, the others at random.
STARTS = 16
# Number of crossings in a row that must lie within half the tube.
RETURNS_INSIDE = 16


def mean_size(states: Float[np.ndarray, "k 2n"]) -> float:
    """The mean length of weighted deviations."""
    return float(np.mean(np.linalg.norm(states, axis=-1)))


@dataclass(frozen=True, eq=False)
class Tube:
    """What lies within `radius` of a set of weighted crossing states, relative to their mean size."""

    states: Float[np.ndarray, "k 2n"]
    radius: float

    def __reduce__(self):
        # Without the tree, which is twice as large as the states.
        return Tube, (self.states, self.radius)

    @cached_property
    def size(self) -> float:
        """The mean size of the states."""
        return mean_size(self.states)

    @cached_property
    def _tree(self):
        return tree_of(self.states)

    def starts(self, section: Float[np.ndarray, " n"], gaps: Int[np.ndarray, " c"]) -> Float[np.ndarray, "m 2n"]:
        """States spread over the set and displaced to the edge of the tube: one in four outwards, one in four inwards, the
        others at random.

        `section` has the section's weights of velocities, in weighted coordinates; `gaps` are the indices of the normal
        displacements, which are zero in contact, as are their velocities.
        """
        chosen = thin(self.states, STARTS)[:STARTS]
        random = np.random.default_rng(0).normal(size=chosen.shape)
        kind = np.arange(STARTS) % 4
        away = np.where((kind == 0)[:, None], chosen, np.where((kind == 1)[:, None], -chosen, random))
        return self.displaced(chosen, away, section, gaps)

    def displaced(
        self,
        chosen: Float[np.ndarray, "m 2n"],
        away: Float[np.ndarray, "m 2n"],
        section: Float[np.ndarray, " n"],
        gaps: Int[np.ndarray, " c"],
    ) -> Float[np.ndarray, "m 2n"]:
        """Those of the states displaced to the tube's edge in these directions, as far as the section and the contact allow."""
        # A gap this small is a rounding error of contact.
        least = 1e-6 * self.size
        open_ = chosen[:, gaps] > least
        away = _on_section(_in_contact(away, open_, gaps), section)
        found = chosen + self.radius * self.size * away / np.linalg.norm(away, axis=-1, keepdims=True)
        found[:, gaps] = np.maximum(found[:, gaps], least)
        return _in_contact(_on_section(found, section), open_, gaps)

    def holds(self, points: Float[np.ndarray, "*m 2n"], within: float = 0.5) -> Bool[np.ndarray, "*m"]:
        """Which points lie in this share of the tube; those that are not finite do not."""
        finite = np.all(np.isfinite(points), axis=-1)
        most = within * self.radius * self.size
        # The tree looks no further than that: what is nearest there or beyond is infinitely far.
        apart, _ = self._tree.query(np.where(finite[..., None], points, 0.0), distance_upper_bound=most)
        return finite & np.isfinite(apart)

    def holds_all(self, ends: Float[np.ndarray, "h m 2n"], within: float = 0.5) -> Bool[np.ndarray, " m"]:
        """Which motions have come back: all of their last crossing states lie in this share of the tube."""
        return np.all(self.holds(ends, within), axis=0)


def thin(states: Float[np.ndarray, "k 2n"], count: int) -> Float[np.ndarray, "_ 2n"]:
    """Every k-th state, so that `count` of them are left, or some more."""
    return states[:: max(len(states) // count, 1)]


def tree_of(states: Float[np.ndarray, "k 2n"]):
    """A tree of states, in which nearest ones are found fast."""
    from scipy.spatial import KDTree

    # Balanced, it would be split next to zero where half of the states are in contact: by the least number above it, which is
    # zero to a process whose processor a library has told so, and the stack fills.
    return KDTree(states, balanced_tree=False)


def _in_contact(
    states: Float[np.ndarray, "m 2n"], open_: Bool[np.ndarray, "m c"], gaps: Int[np.ndarray, " c"]
) -> Float[np.ndarray, "m 2n"]:
    """These states with contact where it is not `open_`."""
    states, n = states.copy(), states.shape[1] // 2
    for places in (gaps, n + gaps):
        states[:, places] = np.where(open_, states[:, places], 0.0)
    return states


def _on_section(states: Float[np.ndarray, "m 2n"], section: Float[np.ndarray, " n"]) -> Float[np.ndarray, "m 2n"]:
    """These states moved to where the weighted sum of velocities is zero."""
    states, n = states.copy(), len(section)
    states[:, n:] -= np.outer(states[:, n:] @ section, section) / (section @ section)
    return states
