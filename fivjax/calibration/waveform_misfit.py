"""Comparison of a small motion, or of the response to a kick, with a recording, block by block."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float

from ..foundation.linear_solve import solve
from ..foundation.matrix_factors import exponential, orthonormal_columns
from ..io.recordings import Averaged, Channel, Recording
from ..linear.linearisation import linear_sliding
from ..model.scene import Scene, steady_sliding
from ..model.sliding import free_in_sliding
from ..simulation.rows import states_at
from ..steppers.base import MOST_ADVANCES, AbstractStepper
from .characteristic import characteristic_residual
from .misfit import AbstractMisfit, Compared, finite, window
from .mode_poles import strongest_poles
from .noise import noise_of_means

# The least share of the signal's energy that poles must explain to count as those of a small motion.
LEAST_EXPLAINED = 0.7


class AbstractWaveformMisfit(AbstractMisfit):
    """A recording that is compared block by block; far from the answer, by the poles and shapes of its small motion."""

    edges: Float[Array, " edge"]
    means: Float[Array, "B k"]
    sigma: Float[Array, " k"]
    known: dict[str, Array]
    poles: Complex[Array, " j"]
    shapes: Complex[Array, "j k"]
    channels: tuple[Channel, ...] = eqx.field(static=True)

    def coarse(self, scene):
        return characteristic_residual(scene.replace(**self.known), self.poles, self.shapes, self.channels)


class SlidingMisfit(AbstractWaveformMisfit):
    """A small motion about steady sliding. It is a sum of the sliding modes, whose unknown amplitudes are found by linear least
    squares inside the residual (variable projection; Golub and Pereyra 1973)."""

    projected: int = eqx.field(static=True)

    def compared(self, scene, own, share):
        weight = window(self.edges, share)[:, None] / self.sigma
        waves, target = self._waves(scene), weight * self.means
        q, r = orthonormal_columns((weight[..., None] * waves).reshape(-1, waves.shape[-1]))
        target = target.ravel()
        amplitudes = solve(r, q.T @ target)
        return Compared(finite(target - q @ (q.T @ target)), waves @ amplitudes, jnp.zeros(0), None)

    def _waves(self, scene) -> Float[Array, "B k m"]:
        """Block means for each unit initial state, scaled to the same size."""
        scene = scene.replace(**self.known)
        matrix = linear_sliding(scene).matrix
        m = matrix.shape[0] // 2
        width = self.edges[1] - self.edges[0]
        states = _powers(exponential(width * matrix), self.edges.shape[0])
        keep = free_in_sliding(scene.structure).tolist()
        columns = []
        for quantity, coordinate in self.channels:
            row = keep.index(coordinate) + (m if quantity == "acceleration" else 0)
            columns.append((states[1:, row] - states[:-1, row]) / width)
        waves = jnp.stack(columns, axis=1)
        # Responses to displacements and to velocities differ by a factor of the frequency, which would worsen the conditioning.
        return waves / jnp.sqrt(jnp.mean(jax.lax.stop_gradient(waves) ** 2, axis=(0, 1)))


class KickMisfit(AbstractWaveformMisfit):
    """The response to the scene's own load, from steady sliding, through every contact event."""

    method: AbstractStepper
    # Whether contact events are excluded: then matrix exponentials are enough, and a hundred times as fast.
    uneventful: bool = eqx.field(static=True)
    projected: int = eqx.field(static=True, default=0)

    def compared(self, scene, own, share):
        weight = window(self.edges, share)[:, None] / self.sigma
        model = jnp.diff(self.integrals(scene, self.edges + own), axis=0) / (self.edges[1] - self.edges[0])
        return Compared(finite(weight * (self.means - model)).ravel(), model, jnp.zeros(0), None)

    def integrals(self, scene: Scene, instants: Float[Array, " i"], eventful: bool = False) -> Float[Array, "i k"]:
        """The integrals of the channels (velocities or displacements) at evenly spaced instants of the simulation (s)."""
        respond = _sliding_throughout if self.uneventful and not eventful else _through_events
        y = respond(scene.replace(**self.known), self.method, instants)
        return _integrals(y, self.channels)


def _through_events(scene: Scene, method: AbstractStepper, instants: Float[Array, " i"]) -> Float[Array, "i state"]:
    """States at instants of the simulation (s); before its start, the state of steady sliding."""
    q, _ = steady_sliding(scene, scene.load.force)
    y0 = jnp.concatenate([q, jnp.zeros_like(q)])
    instants = jnp.concatenate([jnp.zeros(1), jnp.maximum(instants, 0.0)])
    y, *_ = states_at(scene, method, y0, instants, MOST_ADVANCES, derivatives="forward")
    return y[1:]


def _sliding_throughout(scene: Scene, method: AbstractStepper, instants: Float[Array, " i"]) -> Float[Array, "i state"]:
    """The same for constant friction, if no contact ever stops sliding: exact, from one jump of the load to the next."""
    n, matrix = scene.structure.size, linear_sliding(scene).matrix
    keep = free_in_sliding(scene.structure).tolist()
    steps = _powers(exponential((instants[1] - instants[0]) * matrix), instants.shape[0])

    def equilibrium(force):
        q, _ = steady_sliding(scene, force)
        return jnp.concatenate([q[jnp.array(keep)], jnp.zeros(len(keep))])

    rest = equilibrium(scene.load.force)
    begin, z = jnp.zeros(()), rest
    found = jnp.broadcast_to(rest, (instants.shape[0], len(rest)))
    jumps = scene.load.jumps
    for k in range(jumps.shape[0]):
        z = rest + exponential((jumps[k] - begin) * matrix) @ (z - rest)
        begin = jumps[k]
        until = jumps[k + 1] if k + 1 < jumps.shape[0] else jnp.inf
        middle = begin + jnp.minimum(0.5 * (until - begin), 1.0)
        rest = equilibrium(scene.load(middle))
        moving = steps @ (exponential((instants[0] - begin) * matrix) @ (z - rest)) + rest
        found = jnp.where((instants >= begin)[:, None], moving, found)
    columns = jnp.array([*keep, *(n + i for i in keep)])
    return jnp.zeros((instants.shape[0], 2 * n)).at[:, columns].set(found)


def _integrals(y, channels: tuple[Channel, ...]):
    n = y.shape[1] // 2
    return y[:, jnp.array([coordinate + (n if quantity == "acceleration" else 0) for quantity, coordinate in channels])]


def _powers(step: Float[Array, "m m"], count: int) -> Float[Array, "count m m"]:
    """I, step, step², …: by doubling, so that a long recording takes only a few products of many matrices."""
    powers, next_one = jnp.eye(step.shape[0])[None], step
    while powers.shape[0] < count:
        powers = jnp.concatenate([powers, powers @ next_one])
        next_one = next_one @ next_one
    return powers[:count]


def misfit_of_waveform(
    recording: Recording, blocks: Averaged, method: AbstractStepper, scene: Scene, uneventful: bool
) -> AbstractMisfit:
    """A recording of a small motion or of a kick, averaged over blocks, ready to be compared."""
    known = {name: jnp.asarray(value) for name, value in recording.known.items()}
    sigma = noise_of_means(recording, blocks)
    width = blocks.edges[1] - blocks.edges[0]
    # The response to a kick may be a small motion again towards its end.
    tail = blocks.means if recording.regime == "sliding" else blocks.means[len(blocks.means) // 3 :]
    modes = scene.structure.size - len(scene.structure.contacts)
    found = strongest_poles(tail, width, modes, sigma)
    # Padded to the largest number of poles, so that all recordings of this length share compiled programs.
    values = np.full(modes, np.nan, complex)
    shapes = np.full((len(values), len(recording.channels)), np.nan, complex)
    if found.explained > LEAST_EXPLAINED:
        values[: len(found.values)], shapes[: len(found.values)] = found.values, found.shapes
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
        return SlidingMisfit(**common, projected=2 * modes)
    return KickMisfit(**common, method=method, uneventful=uneventful)
