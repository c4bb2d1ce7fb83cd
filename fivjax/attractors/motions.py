"""Motions of many groups on the Poincaré section, in rows, as the searches for attractors follow them."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from ..section.return_maps import Section

# Motions of a group from which attractors are sought at a time.
NOMINATED = 2


class Motions(NamedTuple):
    """Motions in rows: the group of each, and where it is on the section, or on the way to it."""

    group: Int[np.ndarray, " m"]
    at: Section

    def rows(self, chosen) -> "Motions":
        return Motions(self.group[chosen], self.at.rows(chosen))


def far_apart(
    states: Float[np.ndarray, "m 2n"], group, chosen: Bool[np.ndarray, " m"], most: int = NOMINATED
) -> Int[np.ndarray, " r"]:
    """A few of the chosen rows of each group, far from each other."""
    picked: list[int] = []
    for g in np.unique(group[chosen]):
        rows = np.flatnonzero(chosen & (group == g))
        mine = [rows[0]]
        away = np.linalg.norm(states[rows] - states[rows[0]], axis=1)
        while len(mine) < min(most, len(rows)):
            mine.append(rows[np.argmax(away)])
            away = np.minimum(away, np.linalg.norm(states[rows] - states[mine[-1]], axis=1))
        picked += mine
    return np.array(picked, int)


def extent(weighted: Float[np.ndarray, "k *m state"]) -> Float[np.ndarray | np.floating, "*m"]:
    """The root mean square distance of points from their mean."""
    away = weighted - np.mean(weighted, axis=0)
    return np.sqrt(np.einsum("k...j,k...j->...", away, away) / len(away))


def smooth_mean(values: Float[np.ndarray, "k *state"]) -> Float[np.ndarray, "*state"]:
    """A mean whose weights vanish smoothly at both ends: of a quasi-periodic sequence it is much better than equal weights."""
    x = (np.arange(len(values)) + 0.5) / len(values)
    weights = np.exp(-1.0 / (x * (1 - x)))
    return np.tensordot(weights / np.sum(weights), values, axes=1)


def position_of(points: Float[np.ndarray, "k state"]) -> float:
    """A number by which attractors of the same amplitude and period are told apart: how far the mean of the points lies along a
    fixed direction, in units of their size. No exchange of coordinates leaves the direction as it is.
    """
    direction = np.cos(np.arange(points.shape[1]))
    return float(np.mean(points, axis=0) @ direction / np.mean(np.linalg.norm(points, axis=1)))
