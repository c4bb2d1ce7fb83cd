r"""Tori: quasi-periodic motions, as closed curves on the section that the return map leaves invariant.

Where a limit cycle has lost its stability in a Neimark–Sacker bifurcation, the points of the section wind around an invariant
curve of the return map and never repeat. With a rotation number of $ρ$ turns per return, the $j$-th point lies at the phase
$jρ$ (modulo 1), and the points of one long trajectory, in the order of their phases, trace the curve. Where an impact falls on
the section the curve is in several pieces, and where the sequence of contact events changes along it, it has kinks, whose
images under the map become weaker. So it is kept as points, not as a Fourier series. Between kinks it is smooth: the median
distance of points from cubics through their neighbours is some 1e-9 of the curve's size, and falls with the fourth power of
their number. A torus of more dimensions is no curve; its points are then in the order of time.

What a torus is accepted by is in `attractors.tori`; here it is only described.
"""

import numpy as np
from jaxtyping import Float

from ..attractors.motions import smooth_mean
from ..attractors.tori import Torus
from ..contact import Contact
from ..model.scene import Scene
from ..section.about_sliding import sliding_state
from ..section.return_maps import ReturnMaps
from .cycle import LimitCycle, under_final_load
from .one_period import follow_period, word

# Points of the curve; and returns in a window of which harmonics and the word are given.
POINTS, WINDOW = 2304, 96


def limit_cycle_of_torus(maps: ReturnMaps, scene: Scene, torus: Torus) -> LimitCycle:
    """The description of a torus of the only group."""
    weights, only = maps.weights, np.zeros(1, int)
    start = maps.with_modes(only, torus.tube.states[-1:] / weights)
    start = maps.returns(only, start, 1).at
    found = maps.returns(only, start, POINTS, POINTS)
    points, rotation, residual = _curve(weights, found.path[0])
    exponents = _lyapunov_exponents(maps, found.path[0])
    point = start.point(0)
    seen = follow_period(scene, point, float(maps.returns(only, start, WINDOW).time[0]))
    largest = np.exp(exponents).astype(complex)
    return LimitCycle(
        scene=under_final_load(scene),
        kind="torus",
        period=torus.period,
        state=np.asarray(point.y) + np.asarray(sliding_state(scene, scene.load.final)),
        contact=Contact(np.asarray(point.contact.status), np.asarray(point.contact.direction)),
        word=word(seen.segments)[:64],
        multipliers=largest,
        stable=True,
        amplitude=torus.amplitude,
        residual=residual,
        crossings=1,
        harmonics=seen.harmonics,
        points=points,
        return_jacobian=np.diag(np.pad(largest.real, (0, len(weights) - len(largest)))),
        rotation_number=rotation,
        reach=torus.reach,
        contraction=torus.contraction,
    )


def _curve(
    weights: np.ndarray, returns: Float[np.ndarray, "k state"]
) -> tuple[Float[np.ndarray, "k state"], float | None, float]:
    """The points of one trajectory in the order of their phases on a closed curve, the turns per return, and the median
    distance of a point from the curve through the others, relative to the curve's size. None, and NaN, if they lie on no curve.
    """
    # Neighbours on the curve are closer than this share of its size, except at jumps; and the largest number of jumps.
    jump, most_jumps = 0.05, 12
    weighted = weights * returns
    size = np.mean(np.linalg.norm(weighted, axis=-1))
    rotation = _rotation(weighted)
    order = np.argsort(np.mod(rotation * np.arange(len(returns)), 1.0), kind="stable")
    path = weighted[order]
    steps = np.linalg.norm(np.diff(np.concatenate([path, path[:1]]), axis=0), axis=-1) / size
    if np.sum(steps > jump) > most_jumps:
        return returns, None, float("nan")
    return returns[order], rotation, float(np.median(off_the_curve(path)) / size)


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


def _rotation(weighted: Float[np.ndarray, "k state"]) -> float:
    """Turns per return, so that the points in their order have the shortest path: next to those about the mean, or to a strong
    line of the spectrum, which may be a harmonic. In some coordinates a curve does not go once around the mean.

    Without sign: a closed curve may be run through either way.
    """
    most_lines = 4
    centred = weighted - np.mean(weighted, axis=0)
    _, _, axes = np.linalg.svd(centred, full_matrices=False)
    plane = centred @ axes[:2].T
    angle = np.arctan2(plane[:, 1], plane[:, 0])
    turns = np.diff(np.unwrap(angle)) / (2 * np.pi)
    count = len(weighted)
    spectrum = np.sum(np.abs(np.fft.rfft(centred * np.hanning(count)[:, None], axis=0)) ** 2, axis=1)
    inner = spectrum[1:-1]
    peaks = 1 + np.flatnonzero((inner > spectrum[:-2]) & (inner >= spectrum[2:]))
    lines = peaks[np.argsort(-spectrum[peaks])][:most_lines] / count
    # The turns of which a line is the first, second or third harmonic, of those that the returns cannot tell apart.
    fundamentals = [lines, lines / 2, (1 - lines) / 2, lines / 3, (1 - lines) / 3, (1 + lines) / 3]
    guesses = [abs(smooth_mean(turns)), *np.concatenate(fundamentals)]
    return min((_with_shortest_path(weighted, guess) for guess in guesses), key=lambda found: found[1])[0]


def _with_shortest_path(weighted: Float[np.ndarray, "k state"], guess: float) -> tuple[float, float]:
    """The turns per return next to a guess, and the length of the path."""
    width, shortest = 1.0 / len(weighted), np.inf
    for _ in range(4):
        tried = guess + width * np.linspace(-1.0, 1.0, 33)
        orders = np.argsort(np.mod(tried[:, None] * np.arange(len(weighted)), 1.0), axis=1, kind="stable")
        lengths = np.sum(np.linalg.norm(np.diff(weighted[orders], axis=1), axis=-1), axis=1)
        best = int(np.argmin(lengths))
        guess, shortest = float(tried[best]), float(lengths[best])
        width /= 10.0
    return guess, shortest


def _lyapunov_exponents(maps: ReturnMaps, path: Float[np.ndarray, "k state"]) -> Float[np.ndarray, " m"]:
    """Exponents of the return map along these states, one return apart; largest first, per return.

    A direction that one of the returns takes away, as a contact that sticks does, has the exponent $-∞$.
    """
    # So many of the returns align the basis of deviations, and are left out.
    aligning = 64
    # What is left of a direction that is taken away is rounding.
    rounding = 1e-12
    weights, basis, logs, group = maps.weights, np.eye(len(maps.weights)), [], np.zeros(len(path), int)
    along = maps.with_modes(group, path)
    _, _, derived = maps.derived(group, along, 1)
    for jacobian in derived:
        basis, upper = np.linalg.qr((weights[:, None] * jacobian / weights) @ basis)
        kept = np.abs(np.diag(upper))
        logs.append(np.log(kept, out=np.full(len(kept), -np.inf), where=kept > rounding))
    gone = np.isneginf(logs := np.array(logs[aligning:]))
    # Growth changes with a beat, of which equal weights would count a last part: some 1e-3 per return where it is slow.
    exponents = np.where(np.any(gone, axis=0), -np.inf, smooth_mean(np.where(gone, 0.0, logs)))
    return np.sort(exponents)[::-1][:4]
