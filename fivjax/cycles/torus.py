r"""Tori: motions that beat for ever, as closed curves of the section that the return map turns.

Where a limit cycle has lost its stability in a Neimark–Sacker bifurcation, the points of the section wind around a curve that
the return map leads into itself, and never repeat. With $ρ$ turns a return, the $j$-th point lies at the phase $jρ$ (modulo
1), and in the order of their phases the points of one long trajectory trace the curve. Where an impact falls on the section
the curve is in several pieces, and where the sequence of contact events changes along it, it has kinks, with images that fade
under the map; so it is kept as points, not as a Fourier series. Between them it is smooth: left out, half of the points lie on
cubics through their neighbours to some 1e-9 of the curve's size, and the closer, by the fourth power, the more there are.

A torus is accepted when

- its points wind around the curve many times, and do not drift: early and late ones have the same mean, to a small share of
  the curve's extent, as the averages of a motion on a torus have and those of a slow transient have not;
- its curve is smooth in the order of the phases: neighbours lie close together, but for few jumps;
- the largest Lyapunov exponent of the return map is zero, to what so many returns can tell: not positive (chaos), and the
  second is negative: deviations from the curve contract;
- trajectories that start in a tube about the curve are back in half the tube some returns later. A motion that fades slowly,
  or passes the ghost of a vanished cycle, fails that: next to it nothing comes back.

What meets none of this is no limit cycle.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from ..contact import Contact, Status
from ..model.scene import Scene
from ..steppers.event_exact import EventExact
from .around import seen_around, word
from .cycle import LimitCycle, under_final_load
from .section_map import Point, points_along, return_with_jacobian, sliding_state

# Trajectories side by side and points of the section at a time, in a search, too: one program is compiled for all.
SIDE_BY_SIDE, POINTS = 8, 96
# Points of the curve, in multiples of `POINTS`.
CHUNKS = 24
# Returns over which Lyapunov exponents are taken.
EXPONENT_RETURNS = 384
# The largest exponent counts as zero, and the second as negative, beyond this (per return).
ZERO = 0.01
# Neighbours on the curve are farther apart than this share of its size at jumps only, and of jumps there are few.
JUMP, MOST_JUMPS = 0.05, 12
# The points wind around the curve at least so often, and the means of the first and the last third of them differ by less than
# this share of their extent.
LEAST_TURNS = 20
DRIFT = 0.05
# The tube's radius, relative to the size of the points, or to the extent of the curve if that is small; starts in it.
TUBE, TUBE_OF_EXTENT = 0.02, 0.2
TUBE_STARTS = 64
# They have to be back, for the last returns of a look, within so many looks of `POINTS` returns.
HOME, TUBE_LOOKS = 16, 4


class Curve(NamedTuple):
    """A closed curve of the section."""

    points: Float[np.ndarray, "k state"]  # in the order of their phases, deviations from sliding
    rotation: float  # turns per return
    jumps: int
    residual: float  # the median distance of a point from the curve through the others, relative to its size


def torus_of(scene: Scene, stepper: EventExact, point: Point) -> LimitCycle | None:
    """The torus that a trajectory at this point of the section has come to; none if it is none."""
    orbit = _orbit(scene, stepper, point)
    if orbit is None:
        return None
    returns, times, windows = orbit
    weights = np.asarray(scene.structure.weights)
    curve = _curve(weights, returns)
    if curve is None:
        return None
    exponents = lyapunov_exponents(scene, stepper, point)
    if exponents is None or abs(exponents[0]) > ZERO or exponents[1] > -ZERO:
        return None
    if not _attracts(scene, stepper, curve):
        return None
    period = float(np.mean(times))
    every = [
        seen_around(scene, stepper, window, float(np.sum(times[k * POINTS : (k + 1) * POINTS])), 16 * POINTS)
        for k, window in enumerate(windows)
    ]
    seen = every[0]
    largest = np.exp(exponents).astype(complex)
    return LimitCycle(
        scene=under_final_load(scene),
        kind="torus",
        period=period,
        state=np.asarray(point.y) + np.asarray(sliding_state(scene, scene.load.final)),
        contact=Contact(np.asarray(point.contact.status), np.asarray(point.contact.direction)),
        word=word(seen.segments)[:64],
        multipliers=largest,
        stable=True,
        amplitude=max(float(part.amplitude) for part in every),
        residual=curve.residual,
        crossings=1,
        harmonics=seen.lines,
        points=curve.points,
        return_jacobian=np.diag(np.pad(largest.real, (0, len(weights) - len(largest)))),
        rotation_number=curve.rotation,
    )


def _orbit(scene: Scene, stepper: EventExact, point: Point):
    starts = jax.tree.map(lambda leaf: jnp.stack([leaf] * SIDE_BY_SIDE), point)
    states, times, windows = [], [], []
    for _ in range(CHUNKS):
        windows.append(jax.tree.map(lambda leaf: leaf[0], starts))
        found = points_along(scene, stepper, starts, POINTS)
        states.append(np.asarray(found.point.y)[0])
        times.append(np.asarray(found.time)[0])
        starts = jax.tree.map(lambda leaf: leaf[:, -1], found.point)
    returns = np.concatenate(states)
    return None if not np.all(np.isfinite(returns)) else (returns, np.concatenate(times), windows)


def _curve(weights: np.ndarray, returns: Float[np.ndarray, "k state"]) -> Curve | None:
    """The curve through the points of one trajectory, if its points lie on one."""
    weighted = weights * returns
    size = np.mean(np.linalg.norm(weighted, axis=-1))
    rotation = _rotation(weighted)
    if abs(rotation) * len(returns) < LEAST_TURNS or _drifts(weighted):
        return None
    order = np.argsort(np.mod(rotation * np.arange(len(returns)), 1.0), kind="stable")
    path = weighted[order]
    steps = np.linalg.norm(np.diff(np.concatenate([path, path[:1]]), axis=0), axis=-1) / size
    jumps = int(np.sum(steps > JUMP))
    if jumps > MOST_JUMPS:
        return None
    return Curve(returns[order], float(rotation), jumps, float(np.median(off_the_curve(path)) / size))


def off_the_curve(path: Float[np.ndarray, "k state"]) -> Float[np.ndarray, " m"]:
    """How far each second point of a closed path lies from the cubic through the two others on either side of it.

    The cubic's argument is the way along the chord between the nearest two: phases need not be known. Infinite at a jump.
    """
    left_out = np.arange(1, len(path) - len(path) % 2, 2)
    others = path[(left_out[:, None] + np.array([-3, -1, 1, 3])) % len(path)]
    from_first = np.concatenate([others, path[left_out][:, None]], axis=1) - others[:, 1:2]
    chord = from_first[:, 2]
    with np.errstate(divide="ignore", invalid="ignore"):
        *along, here = np.moveaxis(np.einsum("mks,ms->mk", from_first, chord) / np.sum(chord**2, axis=1)[:, None], 1, 0)
        weights = [
            np.prod([(here - along[j]) / (along[i] - along[j]) for j in range(4) if j != i], axis=0) for i in range(4)
        ]
        distance = np.linalg.norm(np.einsum("km,mks->ms", weights, others) - path[left_out], axis=1)
    return np.where(np.isfinite(distance), distance, np.inf)


def _extent(weighted: Float[np.ndarray, "k state"]) -> float:
    """How far points lie from their middle, in the root mean square."""
    return float(np.sqrt(np.mean(np.sum((weighted - np.mean(weighted, axis=0)) ** 2, axis=-1))))


def _drifts(weighted: Float[np.ndarray, "k state"]) -> bool:
    """Whether the points move on in the mean: on a torus they go round and round."""
    third = len(weighted) // 3
    x = (np.arange(third) + 0.5) / third
    bump = np.exp(-1.0 / (x * (1 - x)))[:, None]
    early, late = (np.sum(bump * part, axis=0) / np.sum(bump) for part in (weighted[:third], weighted[-third:]))
    return bool(np.linalg.norm(late - early) > DRIFT * _extent(weighted))


def tube_radius(weighted: Float[np.ndarray, "k state"]) -> float:
    """The radius of the tube about a curve through these points."""
    size = float(np.mean(np.linalg.norm(weighted, axis=-1)))
    return min(TUBE * size, TUBE_OF_EXTENT * _extent(weighted))


def _rotation(weighted: Float[np.ndarray, "k state"]) -> float:
    """Turns per return: a guess from the angle about the middle, then where the points in order make the shortest path."""
    centred = weighted - np.mean(weighted, axis=0)
    _, _, axes = np.linalg.svd(centred, full_matrices=False)
    plane = centred @ axes[:2].T
    angle = np.arctan2(plane[:, 1], plane[:, 0])
    turns = np.diff(np.unwrap(angle)) / (2 * np.pi)
    # Weights that vanish smoothly at both ends average a quasi-periodic sequence far better than equal ones.
    x = (np.arange(len(turns)) + 0.5) / len(turns)
    bump = np.exp(-1.0 / (x * (1 - x)))
    guess = np.sum(bump * turns) / np.sum(bump)
    k = np.arange(len(weighted))

    def length(rotation: float) -> float:
        path = weighted[np.argsort(np.mod(rotation * k, 1.0), kind="stable")]
        return float(np.sum(np.linalg.norm(np.diff(path, axis=0), axis=-1)))

    width = 1.0 / len(weighted)
    for _ in range(4):
        tried = guess + width * np.linspace(-1.0, 1.0, 33)
        guess = tried[int(np.argmin([length(rotation) for rotation in tried]))]
        width /= 10.0
    return float(guess)


def lyapunov_exponents(scene: Scene, stepper: EventExact, point: Point) -> Float[np.ndarray, " m"] | None:
    """Exponents of the return map along a trajectory, largest first, per return."""
    basis, logs = None, []
    weights = np.asarray(scene.structure.weights)
    for _ in range(EXPONENT_RETURNS):
        found, jacobian = return_with_jacobian(scene, stepper, point, 1)
        if not np.all(np.isfinite(jacobian)):
            return None
        scaled = weights[:, None] * jacobian / weights
        moved = scaled @ (np.eye(len(weights)) if basis is None else basis)
        basis, upper = np.linalg.qr(moved)
        logs.append(np.log(np.maximum(np.abs(np.diag(upper)), 1e-300)))
        point = found.point
    # The first returns turn the basis into place.
    exponents = np.mean(logs[EXPONENT_RETURNS // 6 :], axis=0)
    return np.sort(exponents)[::-1][:4]


def _attracts(scene: Scene, stepper: EventExact, curve: Curve) -> bool:
    """Whether starts in the tube about the curve come back into half of it, and stay while they are followed."""
    weights = np.asarray(scene.structure.weights)
    weighted = weights * curve.points
    radius = tube_radius(weighted)
    structure = scene.structure
    velocity, gap = structure.size + structure.tangential, structure.normal
    random = np.random.default_rng(0)
    chosen = curve.points[np.linspace(0, len(curve.points) - 1, TUBE_STARTS).astype(int)]
    for begin in range(0, TUBE_STARTS, SIDE_BY_SIDE):
        states = chosen[begin : begin + SIDE_BY_SIDE]
        open_ = states[:, gap] > 0
        away = random.normal(size=states.shape)
        away[:, velocity] = 0.0
        away[~open_, gap] = away[~open_, structure.size + gap] = 0.0
        away *= radius / np.linalg.norm(away, axis=-1, keepdims=True)
        starts = states + away / weights
        starts[:, gap] = np.maximum(starts[:, gap], 0.0)
        status = np.where(open_, Status.DETACH, Status.SLIDE)
        contact = Contact(jnp.asarray(status, jnp.int32), jnp.full(len(states), np.sign(float(scene.belt_speed))))
        now, home = Point(jnp.asarray(starts), contact), False
        for _ in range(TUBE_LOOKS):
            found = points_along(scene, stepper, now, POINTS)
            ends = weights * np.asarray(found.point.y)[:, -HOME:]
            if not np.all(np.isfinite(ends)):
                return False
            apart = np.min(np.linalg.norm(ends[:, :, None] - weighted, axis=-1), axis=-1)
            home = bool(np.max(apart) < 0.5 * radius)
            if home:
                break
            now = jax.tree.map(lambda leaf: leaf[:, -1], found.point)
        if not home:
            return False
    return True


def on_torus(scene: Scene, torus: LimitCycle, points: Float[np.ndarray, "k state"]) -> bool:
    """Whether the last of these points (weighted deviations) lie in the torus' tube."""
    weighted = np.asarray(scene.structure.weights) * torus.points
    apart = np.min(np.linalg.norm(points[-HOME:, None] - weighted, axis=-1), axis=-1)
    return bool(np.max(apart) < tube_radius(weighted))
