r"""How far a scene is from a recording: residuals in units of the measuring noise, for each regime.

| regime | far from the answer (`coarse`) | near it (`residual`) |
|---|---|---|
| sliding | poles and shapes in the characteristic equation | waveform, the initial state eliminated |
| kick | the same, where the recording ends in a small motion | waveform of the whole response, through every event |
| limit cycle (`cycle_misfit`) | harmonics, roughly | harmonics, fractions of time |

The coarse residuals put measured poles into the scene's own characteristic equation. That equation is linear in springs
and dampers, so there is no neighbouring period to fall into. The waveform is compared over windows that grow.
"""

import abc
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Complex, Float

from ..contact import Contact
from ..io.recordings import Averaged, Channel, Recording
from ..linear.linearisation import linear_sliding
from ..model.scene import Scene, steady_sliding
from ..simulation.trajectory import states_at
from ..steppers.base import MOST_ADVANCES, AbstractStepper
from . import features

# What stands for a motion that is not finite: bad enough never to be chosen, small enough to square.
HOPELESS = 1e6
# Errors that coarse residuals are measured in: shapes are known to some per cent, poles ten times better.
COARSE_SHAPE = 0.03
COARSE_POLE = 3e-3
# A kick's time offset is moved in units of this, in s.
OFFSET_UNIT = 1e-3


class Compared(NamedTuple):
    """A scene beside a recording."""

    residual: Float[Array, " r"]  # in standard deviations of the noise
    model: Float[Array, "B k"]  # block means that the scene gives; NaN where it gives none
    # For a cycle that is a guess: by how much it does not close, and its status after one period.
    unclosed: Float[Array, " c"]
    contact: Contact | None


class AbstractMisfit(eqx.Module):
    """One recording beside the scene it is to be explained by. Times are s after the recording's first sample."""

    # Standard deviations of the block means, by channel.
    sigma: eqx.AbstractVar[Float[Array, " k"]]
    known: eqx.AbstractVar[dict[str, Array]]
    # Numbers that the residual fits on its own, beside the parameters.
    fitted_by_elimination: eqx.AbstractVar[int]

    def coarse(self, scene: Scene) -> Float[Array, " c"]:
        """Residuals that lead to the right period from afar; may be empty."""
        return jnp.zeros(0)

    @abc.abstractmethod
    def compared(self, scene: Scene, own, share: Float[Array, ""]) -> Compared:
        """The scene beside the first `share` of the recording. What is the recording's `own`: the time offset of a kick
        (s), a guess of the cycle."""


class SlidingMisfit(AbstractMisfit):
    """A small motion about steady sliding. Whatever set it off, it is a sum of the sliding modes: their amplitudes are
    found by linear least squares inside the residual (variable projection; Golub and Pereyra 1973)."""

    edges: Float[Array, " B+1"]
    means: Float[Array, "B k"]
    sigma: Float[Array, " k"]
    known: dict[str, Array]
    poles: Complex[Array, " j"]
    shapes: Complex[Array, "j k"]
    channels: tuple[Channel, ...] = eqx.field(static=True)
    fitted_by_elimination: int = eqx.field(static=True)

    def coarse(self, scene):
        return _characteristic(scene.replace(**self.known), self.poles, self.shapes, self.channels)

    def compared(self, scene, own, share):
        weight = _window(self.edges, share)[:, None] / self.sigma
        waves, target = self._waves(scene), weight * self.means
        q, r = jnp.linalg.qr((weight[..., None] * waves).reshape(-1, waves.shape[-1]))
        target = target.ravel()
        amplitudes = jax.scipy.linalg.solve_triangular(r, q.T @ target)
        return Compared(_finite(target - q @ (q.T @ target)), waves @ amplitudes, jnp.zeros(0), None)

    def _waves(self, scene) -> Float[Array, "B k m"]:
        """Block means for each unit initial state, scaled alike."""
        scene = scene.replace(**self.known)
        matrix = linear_sliding(scene).matrix
        m = matrix.shape[0] // 2
        width = self.edges[1] - self.edges[0]
        states = _powers(jax.scipy.linalg.expm(width * matrix), self.edges.shape[0])
        keep = _sliding_coordinates(scene)
        columns = []
        for quantity, coordinate in self.channels:
            row = keep.index(coordinate) + (m if quantity == "acceleration" else 0)
            columns.append((states[1:, row] - states[:-1, row]) / width)
        waves = jnp.stack(columns, axis=1)
        # Displacements and velocities differ by the frequency, which least squares need not see.
        return waves / jnp.sqrt(jnp.mean(jax.lax.stop_gradient(waves) ** 2, axis=(0, 1)))


class KickMisfit(AbstractMisfit):
    """The response to the scene's own load, from steady sliding, through every contact event."""

    edges: Float[Array, " B+1"]
    means: Float[Array, "B k"]
    sigma: Float[Array, " k"]
    known: dict[str, Array]
    poles: Complex[Array, " j"]
    shapes: Complex[Array, "j k"]
    method: AbstractStepper
    channels: tuple[Channel, ...] = eqx.field(static=True)
    # Whether no contact event is taken to happen: then matrix exponentials do, a hundred times as fast.
    uneventful: bool = eqx.field(static=True)
    fitted_by_elimination: int = eqx.field(static=True, default=0)

    def coarse(self, scene):
        return _characteristic(scene.replace(**self.known), self.poles, self.shapes, self.channels)

    def compared(self, scene, own, share):
        weight = _window(self.edges, share)[:, None] / self.sigma
        model = jnp.diff(self.integrals(scene, self.edges + own), axis=0) / (self.edges[1] - self.edges[0])
        return Compared(_finite(weight * (self.means - model)).ravel(), model, jnp.zeros(0), None)

    def integrals(self, scene: Scene, instants: Float[Array, " i"], eventful: bool = False) -> Float[Array, "i k"]:
        """What the channels are rates of, velocities and displacements, at evenly spaced instants of the simulation (s)."""
        respond = _sliding_throughout if self.uneventful and not eventful else _through_events
        y = respond(scene.replace(**self.known), self.method, instants)
        return _integrals(y, self.channels)


def _through_events(scene: Scene, method: AbstractStepper, instants: Float[Array, " i"]) -> Float[Array, "i 2n"]:
    """States at instants of the simulation (s): the response from steady sliding, which it was in before, too."""
    q, _ = steady_sliding(scene, scene.load.force)
    y0 = jnp.concatenate([q, jnp.zeros_like(q)])
    instants = jnp.concatenate([jnp.zeros(1), jnp.maximum(instants, 0.0)])
    y, *_ = states_at(scene, method, y0, instants, MOST_ADVANCES, derivatives="forward")
    return y[1:]


def _sliding_throughout(scene: Scene, method: AbstractStepper, instants: Float[Array, " i"]) -> Float[Array, "i 2n"]:
    """The same for constant friction, if the contact never stops sliding: exact, from one load to the next."""
    matrix, keep = linear_sliding(scene).matrix, _sliding_coordinates(scene)
    n = scene.structure.size
    steps = _powers(jax.scipy.linalg.expm((instants[1] - instants[0]) * matrix), instants.shape[0])

    def equilibrium(force):
        q, _ = steady_sliding(scene, force)
        return jnp.concatenate([q[jnp.array(keep)], jnp.zeros(len(keep))])

    rest = equilibrium(scene.load.force)
    begin, z = jnp.zeros(()), rest
    found = jnp.broadcast_to(rest, (instants.shape[0], len(rest)))
    jumps = scene.load.jumps
    for k in range(jumps.shape[0]):
        z = rest + jax.scipy.linalg.expm((jumps[k] - begin) * matrix) @ (z - rest)
        begin = jumps[k]
        until = jumps[k + 1] if k + 1 < jumps.shape[0] else jnp.inf
        middle = begin + jnp.minimum(0.5 * (until - begin), 1.0)
        rest = equilibrium(scene.load(middle))
        moving = steps @ (jax.scipy.linalg.expm((instants[0] - begin) * matrix) @ (z - rest)) + rest
        found = jnp.where((instants >= begin)[:, None], moving, found)
    columns = jnp.array([*keep, *(n + i for i in keep)])
    return jnp.zeros((instants.shape[0], 2 * n)).at[:, columns].set(found)


def _integrals(y, channels: tuple[Channel, ...]):
    n = y.shape[1] // 2
    return y[:, jnp.array([coordinate + (n if quantity == "acceleration" else 0) for quantity, coordinate in channels])]


def _characteristic(
    scene: Scene, poles: Complex[Array, " j"], shapes: Complex[Array, "j k"], channels: tuple[Channel, ...]
) -> Float[Array, " c"]:
    r"""Measured poles and shapes in $(λ^2 - A_{22}λ - A_{21})\,φ = 0$, relative to $λ^2 φ$; and its determinant."""
    matrix = linear_sliding(scene).matrix
    m = matrix.shape[0] // 2
    if poles.shape[0] == 0:
        return jnp.zeros(0)
    keep = _sliding_coordinates(scene)

    def dynamic(pole):
        return jnp.eye(m) * pole**2 - matrix[m:, m:] * pole - matrix[m:, :m]

    def determinant(pole, others):
        # How far the pole is from the scene's nearest one: others that were measured too are divided out.
        apart = jnp.abs(pole - others)
        apart = jnp.prod(jnp.where(apart == 0, 1.0, jnp.maximum(apart, 1e-3 * jnp.abs(pole))))
        missing = m - others.shape[0]
        distance = jnp.linalg.det(dynamic(pole)) / (apart * (2 * jnp.abs(pole)) ** m * jnp.abs(pole) ** missing)
        return distance / (COARSE_POLE * jnp.abs(pole))

    found = [jax.vmap(lambda pole: determinant(pole, poles))(poles)]
    measured = {}
    for k, (quantity, coordinate) in enumerate(channels):
        measured.setdefault(coordinate, shapes[:, k] / (poles**2 if quantity == "acceleration" else poles))
    if set(keep) <= set(measured):
        shape = jnp.stack([measured[coordinate] for coordinate in keep], axis=1)
        shape = shape / jnp.linalg.norm(shape, axis=1, keepdims=True)
        unbalanced = jax.vmap(lambda pole, phi: dynamic(pole) @ phi / jnp.abs(pole) ** 2)(poles, shape)
        found.append(unbalanced.ravel() / COARSE_SHAPE)
    found = jnp.concatenate(found)
    return _finite(jnp.concatenate([found.real, found.imag]))


def _powers(step: Float[Array, "m m"], count: int) -> Float[Array, "count m m"]:
    """I, step, step², …: by doubling, so that a long recording is a few products of many matrices."""
    powers, next_one = jnp.eye(step.shape[0])[None], step
    while powers.shape[0] < count:
        powers = jnp.concatenate([powers, powers @ next_one])
        next_one = next_one @ next_one
    return powers[:count]


def _sliding_coordinates(scene: Scene) -> list[int]:
    return [i for i in range(scene.structure.size) if i != scene.structure.normal]


def _window(edges, share) -> Float[Array, " B"]:
    # In whole blocks; the last of them carries the tolerance of a rounding.
    return jnp.where(edges[1:] <= share * edges[-1] * (1 + 1e-9), 1.0, 0.0)


def _finite(residual):
    good: Bool[Array, " r"] = jnp.isfinite(residual)
    return jnp.where(good, jnp.clip(jnp.where(good, residual, 0.0), -HOPELESS, HOPELESS), HOPELESS)


def noise_of_means(recording: Recording, blocks: Averaged) -> np.ndarray:
    """Standard deviations of block means, from those of single samples.

    Where these are not stated, from third differences of the samples: what is left of a signal that is sampled many times
    a period is the noise, and the median passes over its jumps. For sparse samples this is too large.
    """
    if recording.noise is not None:
        sigma = recording.noise
    else:
        differences = np.abs(np.diff(recording.values, 3, axis=0))
        # The third difference of white noise has 1 + 9 + 9 + 1 times its variance; 0.6745 is the median of |normal|.
        sigma = np.median(differences, axis=0) / (0.6745 * np.sqrt(20.0))
    # A recording without any noise would leave rounding to be fitted.
    least = 1e-9 * np.sqrt(np.mean(blocks.means**2, axis=0)) + 1e-300
    return np.maximum(sigma / np.sqrt(blocks.per_block), least)


def misfit(
    recording: Recording, blocks: Averaged, method: AbstractStepper, scene: Scene, uneventful: bool
) -> AbstractMisfit:
    """A recording of a small motion or of a kick, averaged over blocks, ready to be compared."""
    known = {name: jnp.asarray(value) for name, value in recording.known.items()}
    sigma = noise_of_means(recording, blocks)
    width = blocks.edges[1] - blocks.edges[0]
    # A kick's response is a small motion again, if at all, towards its end.
    tail = blocks.means if recording.regime == "sliding" else blocks.means[len(blocks.means) // 3 :]
    found = features.poles(tail, width, scene.structure.size - 1)
    # Poles that leave much of the signal unexplained are not those of a small motion.
    good = found.explained > 0.7
    values, shapes = (found.values, found.shapes) if good else (found.values[:0], found.shapes[:0])
    common: dict = {
        "edges": jnp.asarray(blocks.edges),
        "means": jnp.asarray(blocks.means),
        "sigma": jnp.asarray(sigma),
        "known": known,
        "poles": jnp.asarray(values),
        "shapes": jnp.asarray(shapes),
        "channels": recording.channels,
    }
    if recording.regime == "sliding":
        return SlidingMisfit(**common, fitted_by_elimination=2 * (scene.structure.size - 1))
    return KickMisfit(**common, method=method, uneventful=uneventful)


def sliding_frequencies(scene: Scene, recording: Recording) -> Float[np.ndarray, " m"]:
    """Of the sliding modes that vibrate, in Hz, under what is known of a run."""
    modes = np.linalg.eigvals(np.asarray(linear_sliding(scene.replace(**recording.known)).matrix))
    modes = np.abs(modes.imag) / (2 * np.pi)
    return modes[modes > 0]
