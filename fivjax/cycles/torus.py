r"""Tori: quasi-periodic motions, as closed curves on the section that the return map leaves invariant.

Where a limit cycle has lost its stability in a Neimark–Sacker bifurcation, the points of the section wind around an invariant
curve of the return map and never repeat. With a rotation number of $ρ$ turns per return, the $j$-th point lies at the phase
$jρ$ (modulo 1), and the points of one long trajectory, in the order of their phases, trace the curve. Where an impact falls on
the section the curve is in several pieces, and where the sequence of contact events changes along it, it has kinks, whose
images under the map become weaker. So it is kept as points, not as a Fourier series. Between kinks it is smooth: the median
distance of points from cubics through their neighbours is some 1e-9 of the curve's size, and falls with the fourth power of
their number.

A torus is accepted when

- its points wind around the curve many times without drift: early and late points have the same mean, to a small share of the
  curve's extent, unlike those of a slow transient;
- its curve is smooth in the order of the phases: neighbours lie close together, except at a few jumps;
- the largest Lyapunov exponent of the return map is zero, as far as so many returns can tell: a positive one would be chaos.
  The second exponent is negative: deviations from the curve contract;
- trajectories that start in a tube about the curve return into half of the tube. A motion that fades slowly, or passes the
  ghost of a vanished cycle, fails this test, because its neighbours do not return to it.

A motion that fails one of these tests is no torus.
"""

from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Bool, Float

from ..contact import Contact, Status
from ..model.scene import Scene
from ..steppers.event_exact import EventExact
from .about_sliding import sliding_state
from .around import seen_around, word
from .cycle import LimitCycle, under_final_load
from .section_map import points_along, return_with_jacobian
from .section_motion import Point

# Trajectories in a batch, and points of the section followed at a time; the same as in searches, so that one program serves
# both.
SIDE_BY_SIDE, POINTS = 8, 96
# Points of the curve, in multiples of `POINTS`.
CHUNKS = 24
# Number of returns over which Lyapunov exponents are computed.
EXPONENT_RETURNS = 384
# The largest exponent counts as zero up to this size, and the second as negative below minus this (per return).
ZERO = 0.01
# Neighbours on the curve are closer than this share of its size, except at jumps; and the largest number of jumps.
JUMP, MOST_JUMPS = 0.05, 12
# The least number of turns around the curve; and the largest difference between the means of the first and the last third of
# the points, as a share of their extent.
LEAST_TURNS = 20
DRIFT = 0.05
# The radius of the tube, relative to the size of the points, or to the extent of the curve if that is small.
TUBE, TUBE_OF_EXTENT = 0.02, 0.2
TUBE_STARTS = 64
# Starts have to be back for the last `HOME` of `POINTS` returns, within `TUBE_LOOKS` times as many.
HOME, TUBE_LOOKS = 16, 4


class Curve(NamedTuple):
    """A closed curve on the section."""

    points: Float[np.ndarray, "k state"]  # in the order of their phases, deviations from sliding
    rotation: float  # turns per return
    jumps: int
    residual: float  # the median distance of a point from the curve through the others, relative to the curve's size


def torus_of(scene: Scene, stepper: EventExact, point: Point) -> LimitCycle | None:
    """The torus that a trajectory at this point of the section has reached; None if it is no torus."""
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
    starts = jax.tree.map(lambda leaf: np.stack([leaf] * SIDE_BY_SIDE), point)
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
    """The curve through the points of one trajectory; None if they do not lie on one."""
    weighted = weights * returns
    size = np.mean(np.linalg.norm(weighted, axis=-1))
    rotation = _rotation(weighted)
    if abs(rotation) * len(returns) < LEAST_TURNS or drifts(weighted):
        return None
    order = np.argsort(np.mod(rotation * np.arange(len(returns)), 1.0), kind="stable")
    path = weighted[order]
    steps = np.linalg.norm(np.diff(np.concatenate([path, path[:1]]), axis=0), axis=-1) / size
    jumps = int(np.sum(steps > JUMP))
    if jumps > MOST_JUMPS:
        return None
    return Curve(returns[order], float(rotation), jumps, float(np.median(off_the_curve(path)) / size))


def off_the_curve(path: Float[np.ndarray, "k state"]) -> Float[np.ndarray, " m"]:
    """The distance of each second point of a closed path from the cubic through the two others on either side of it.

    The argument of the cubic is the distance along the chord between the nearest two, so phases need not be known. Infinite at
    a jump.
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


def extent(weighted: Float[np.ndarray, "k *m state"]) -> Float[np.ndarray | np.floating, "*m"]:
    """The root mean square distance of points from their mean."""
    away = weighted - np.mean(weighted, axis=0)
    return np.sqrt(np.einsum("k...j,k...j->...", away, away) / len(away))


def drifts(weighted: Float[np.ndarray, "k *m state"], share: float = DRIFT) -> Bool[np.ndarray, "*m"]:
    """Whether the mean of the points changes with time by more than this share of their extent: on a torus it does not."""
    third = len(weighted) // 3
    early, late = (smooth_mean(part) for part in (weighted[:third], weighted[-third:]))
    return np.linalg.norm(late - early, axis=-1) > share * extent(weighted)


def smooth_mean(values: Float[np.ndarray, "k *state"]) -> Float[np.ndarray, "*state"]:
    """A mean whose weights vanish smoothly at both ends: of a quasi-periodic sequence it is much better than equal weights."""
    x = (np.arange(len(values)) + 0.5) / len(values)
    weights = np.exp(-1.0 / (x * (1 - x)))
    return np.tensordot(weights / np.sum(weights), values, axes=1)


def tube_radius(weighted: Float[np.ndarray, "k state"]) -> float:
    """The radius of the tube about a curve through these weighted points."""
    size = float(np.mean(np.linalg.norm(weighted, axis=-1)))
    return min(TUBE * size, TUBE_OF_EXTENT * float(extent(weighted)))


def _rotation(weighted: Float[np.ndarray, "k state"]) -> float:
    """Turns per return: first from the angle about the mean, then so that the points in their order have the shortest path."""
    centred = weighted - np.mean(weighted, axis=0)
    _, _, axes = np.linalg.svd(centred, full_matrices=False)
    plane = centred @ axes[:2].T
    angle = np.arctan2(plane[:, 1], plane[:, 0])
    turns = np.diff(np.unwrap(angle)) / (2 * np.pi)
    guess = smooth_mean(turns)
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
    # The first returns are left out: the basis of deviations aligns itself in them.
    exponents = np.mean(logs[EXPONENT_RETURNS // 6 :], axis=0)
    return np.sort(exponents)[::-1][:4]


def _attracts(scene: Scene, stepper: EventExact, curve: Curve) -> bool:
    """Whether starts in the tube about the curve return into half of it and are there for the last `HOME` returns."""
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
        contact = Contact(np.asarray(status, np.int32), np.full(len(states), np.sign(float(scene.belt_speed))))
        now, home = Point(np.asarray(starts), contact), False
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
