"""The check that a torus attracts: motions that start in a tube about it come back.

Where a limit cycle has lost its stability to a torus, no state of the section repeats. The torus is then given by a set of its
crossing states. It attracts if all starts that are displaced from the set by a fixed share of its size, inwards, outwards and
in other directions, come back to within half of that distance and stay there for many crossings. Near a slow fade, and near the
ghost of a cycle just past its fold, they do not come back: starts that are displaced inwards go on inwards.
"""

import numpy as np
from jaxtyping import Bool, Float

# The tube's radius, relative to the mean size of the states.
RADIUS = 0.04
# Number of starts in it: one in four displaced outwards, one in four inwards, the others at random.
STARTS = 16
# Number of crossings in a row that must lie within half the tube.
HOME = 16
# Products of numbers at a time in distances to all states. OpenBLAS shares more among threads, which then wait for each other;
# maps have a thread for each core already.
PRODUCTS = 2**18


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


def home(
    states: Float[np.ndarray, "k 2n"], ends: Float[np.ndarray, "h m 2n"], radius: float = RADIUS
) -> Bool[np.ndarray, " m"]:
    """Which starts have come back: all of their last crossing states lie within half the tube."""
    size = mean_size(states)
    points = np.where(np.isfinite(ends), ends, np.inf).reshape(-1, ends.shape[-1])
    finite = np.all(np.isfinite(points), axis=-1)
    inside = finite & (nearest(np.where(finite[:, None], points, 0.0), states) <= 0.5 * radius * size)
    return np.all(inside.reshape(ends.shape[:-1]), axis=0)


def nearest(
    points: Float[np.ndarray, "m 2n"], states: Float[np.ndarray, "k 2n"], others: bool = False
) -> Float[np.ndarray, " m"]:
    """The distance of each point to the nearest of the states; with `others` the states are the points, and none is its own."""
    # One product of a few points at a time gives their squared distances but for their own squares: that stays in the cache.
    table = np.concatenate([-2 * states.T, np.sum(states**2, axis=-1)[None]])
    extended = np.concatenate([points, np.ones((len(points), 1))], axis=1)
    least = np.empty(len(points))
    count = max(1, PRODUCTS // table.size)
    for begin in range(0, len(points), count):
        some = slice(begin, begin + count)
        apart = extended[some] @ table
        if others:
            rows = np.arange(len(apart))
            apart[rows, begin + rows] = np.inf
        least[some] = np.min(apart, axis=1)
    return np.sqrt(np.maximum(least + np.sum(points**2, axis=-1), 0.0))
