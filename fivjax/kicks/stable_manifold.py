r"""The kick after which a motion neither returns to sliding nor comes to the limit cycle, and its derivatives.

The motion after the critical kick stays on the boundary between the two basins and approaches the attractor within it: a saddle
cycle $x_s$ of the section's return map, with one multiplier $Λ$ outside the unit circle. With $l$ its left eigenvector, and
$x_N$ the $N$-th crossing of the section after a kick $p$,

$$ F_N(p, θ) = l^T (x_N(p, θ) - x_s(θ)) = 0 $$

gives the critical kick, more exactly the larger $N$ is: the terms left out are of second order in the distance, and their
effect on $p$ falls like $1 / F_N'$. One trajectory gives $F_N$ and its derivative by $p$ for every $N$; Newton's method uses
the $N$ with the smallest error. At the root $dp/dθ = -F_{N,θ} / F_{N,p}$, with the derivative of the trajectory through every
event from the kick to the saddle, and $l^T x_{s,θ} = l^T P_θ / (1 - Λ)$.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from ..attractors.closing import FixedPoint, close_near
from ..contact import Contact
from ..foundation.precision import in_double_precision
from ..model.directions import directions_of
from ..model.scene import Scene
from ..section.about_sliding import weights_of
from ..section.crossings import Point
from ..section.return_maps import ReturnMaps
from .response import MOST_CROSSINGS, Crossings, kicked, returned, started

# The most trajectories of Newton's method, and the relative change of p at which it has converged.
MOST_TRAJECTORIES = 12
EXACT = 1e-13
# The most points of the section in one period of a saddle, and the number of first guesses tried.
MOST_POINTS, TRIED = 6, 8


class Critical(NamedTuple):
    """A critical kick."""

    p: float
    d_p: dict[str, float]  # by parameter
    trajectories: int  # number that Newton's method took
    saddle: FixedPoint


class Saddle(NamedTuple):
    """A saddle cycle with the multiplier and eigenvector that Newton's method needs."""

    closed: FixedPoint
    multiplier: float
    left: Float[np.ndarray, " state"]  # the multiplier's left eigenvector, in weighted coordinates of unit length


def saddle_of(closed: FixedPoint, weights: Float[np.ndarray, " state"]) -> Saddle | None:
    """A cycle as a saddle, if exactly one of its multipliers lies outside the unit circle."""
    scaled = weights[:, None] * closed.jacobian / weights
    if not np.all(np.isfinite(scaled)):
        return None
    values, left = np.linalg.eig(scaled.T)
    outside = np.flatnonzero(np.abs(values) > 1 + 1e-9)
    if len(outside) != 1 or abs(values[outside[0]].imag) > 0:
        return None
    vector = left[:, outside[0]].real
    return Saddle(closed, float(values[outside[0]].real), vector / np.linalg.norm(vector))


def saddle_passed(scene: Scene, path: Crossings) -> Saddle | None:
    """The saddle cycle that a trajectory passes, near the point where it repeats best."""
    maps = ReturnMaps.of(scene)
    weights, y = maps.weights, maps.weights * path.y[: path.count]
    sizes = np.linalg.norm(y, axis=-1)
    with_events, without = [], []
    for count in range(1, MOST_POINTS + 1):
        if len(y) <= count + 1:
            continue
        # The more crossings in between, the better a motion has to repeat.
        back = (1 + 0.5 * (count - 1)) * np.linalg.norm(y[count:] - y[:-count], axis=-1) / sizes[:-count]
        eventful = path.events[count : path.count] > path.events[: path.count - count]
        for tried, meant in ((with_events, eventful), (without, ~eventful)):
            one = np.where(meant, back, np.inf)
            lowest = (one[1:-1] <= one[:-2]) & (one[1:-1] <= one[2:])
            places = np.flatnonzero(lowest & (one[1:-1] < 0.2)) + 1
            tried += [(one[place], count, int(place)) for place in places]
    # Sliding that fades slowly repeats well, too: under constant friction it has no saddle, under other laws one seldom.
    guesses = sorted(with_events)[:TRIED] + ([] if scene.friction.constant else sorted(without)[:TRIED])
    for _, count, place in guesses:
        contact = Contact(np.asarray(path.status[place], np.int32), np.asarray(path.direction[place]))
        closed = close_near(maps, Point(np.asarray(path.y[place]), contact), count)
        found = None if closed is None else saddle_of(closed, weights)
        if found is not None:
            apart = np.linalg.norm(weights * np.asarray(found.closed.point.y) - y[place]) / sizes[place]
            if apart < 0.5:
                return found
    return None


class ManifoldDistances(NamedTuple):
    """$F_N$ and its derivative at each crossing of a trajectory near the saddle."""

    place: np.ndarray
    distance: np.ndarray  # from the saddle, relative to its size
    value: np.ndarray  # F_N
    slope: np.ndarray  # its derivative in p


def manifold_distances(path: Crossings, saddle: Saddle, weights: Float[np.ndarray, " state"]) -> ManifoldDistances:
    """`F_N` along a trajectory, with the derivative along the first direction."""
    # A trajectory is near the saddle if its distance is below this share of the saddle's size.
    near = 0.3
    target = weights * np.asarray(saddle.closed.point.y)
    away = weights * path.y[: path.count] - target
    distance = np.linalg.norm(away, axis=-1) / np.linalg.norm(target)
    same = path.status[: path.count] == np.asarray(saddle.closed.point.contact.status)
    status = np.all(same.reshape(path.count, -1), axis=1)
    # Up to the closest crossing: later the trajectory leaves, and may return on another way.
    closest = int(np.argmin(np.where(status, distance, np.inf)))
    place = np.flatnonzero((distance < near) & status & (np.arange(path.count) <= closest))
    slopes = (weights * path.y_parameter[0, : path.count]) @ saddle.left
    return ManifoldDistances(place, distance[place], (away @ saddle.left)[place], slopes[place])


@in_double_precision
def critical_kick(
    scene: Scene, bracket: tuple[float, float], names: tuple[str, ...], saddle: Saddle | None = None
) -> Critical | None:
    """The critical kick inside a bracket by Newton's method, with its derivatives; None if no saddle is passed.

    **Arguments:** `scene`, whose load is a `Pulse`; `bracket`, values of p on either side; `names` of the parameters;
    `saddle`, if it is known.
    """
    weights = weights_of(scene.structure)
    low, high = bracket
    # With all derivatives in each trajectory: one kernel for these, too, takes longer to build than they take.
    directions = directions_of(scene, ("p", *names))
    # From the side that slides: there only the saddle makes a motion with events repeat.
    p, best, crossings = low, np.inf, MOST_CROSSINGS
    for taken in range(1, MOST_TRAJECTORIES + 1):
        path = kicked(scene.replace(p=p), directions, crossings)
        if saddle is None:
            saddle = saddle_passed(scene, path)
            if saddle is None:
                return None
        near = manifold_distances(path, saddle, weights)
        if not len(near.place):
            return None
        size = np.linalg.norm(weights * np.asarray(saddle.closed.point.y))
        with np.errstate(all="ignore"):
            error = near.distance**2 * size / np.abs(near.slope)
        chosen = int(np.nanargmin(error))
        step = -near.value[chosen] / near.slope[chosen]
        if not low - (high - low) <= p + step <= high + (high - low):
            return None
        if abs(step) <= EXACT * p or (best < 1e-11 * p and abs(step) >= 0.5 * best):
            slopes = _derivatives(scene.replace(p=p), names, directions, saddle, path, near)
            return Critical(p, slopes, taken, saddle.closed)
        # The next trajectory stays near the saddle for longer, but not twice as long.
        crossings = min(2 * int(near.place[-1]) + 32, MOST_CROSSINGS)
        p, best = p + step, abs(step)
    return None


def _derivatives(
    scene: Scene,
    names: tuple[str, ...],
    directions: Scene,
    saddle: Saddle,
    path: Crossings,
    near: ManifoldDistances,
) -> dict[str, float]:
    weights = weights_of(scene.structure)
    with np.errstate(all="ignore"):
        error = near.distance / np.abs(near.slope)
    place = int(near.place[np.nanargmin(error)])
    of_saddle = returned(scene, directions, saddle.closed.point, saddle.closed.crossings)
    moved = (weights * of_saddle.y_parameter[:, saddle.closed.crossings - 1]) @ saddle.left / (1 - saddle.multiplier)
    value = (weights * path.y_parameter[:, place]) @ saddle.left - moved
    return dict(zip(names, (-value[1:] / value[0]).tolist(), strict=True))


@in_double_precision
def manifold_normal(
    scene: Scene, y: Float[np.ndarray, " state"], saddle: Saddle | None = None
) -> tuple[Float[np.ndarray, " state"], Saddle] | None:
    """The normal of the stable manifold at a state close to it, and the saddle it belongs to; None if no saddle is passed.

    **Arguments:** `scene`; `y`, a deviation from the sliding equilibrium under the final load; `saddle`, if it is known.
    """
    weights = weights_of(scene.structure)
    start = ReturnMaps.of(scene).in_contact(np.zeros(1, int), np.asarray(y)[None]).point(0)
    path = started(scene, start, np.eye(len(y)), MOST_CROSSINGS)
    saddle = saddle_passed(scene, path) if saddle is None else saddle
    if saddle is None:
        return None
    near = manifold_distances(path, saddle, weights)
    if not len(near.place):
        return None
    place = int(near.place[np.argmin(near.distance)])
    return (weights * path.y_parameter[: len(y), place]) @ saddle.left, saddle
