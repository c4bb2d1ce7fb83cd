"""Comparison of a small motion, or of the response to a kick, with a recording, block by block."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Complex, Float

from ..foundation.compiling import compiled
from ..foundation.linear_solve import solve
from ..foundation.matrix_factors import exponential, orthonormal_columns
from ..io.recordings import Averaged, Channel, Recording
from ..linear.linearisation import linear_sliding
from ..model.scene import Scene
from ..model.sliding import free_in_sliding
from ..simulation.start import start_state
from ..steppers.base import AbstractStepper
from .characteristic import characteristic_residual
from .misfit import AbstractMisfit, Compared, finite, window
from .mode_poles import strongest_poles
from .noise import noise_of_means
from .responses import Response, response_of
from .samples import Sampled, sampled


class AbstractWaveformMisfit(AbstractMisfit):
    """A recording that is compared block by block; far from the answer, by the poles and shapes of its small motion."""

    edges: Float[Array, " edge"]
    means: Float[Array, "B k"]
    sigma: Float[Array, "B k"]
    t: Float[Array, " B"]
    kept: Float[Array, "B k"]
    sampled: Sampled
    known: dict[str, Array]
    poles: Complex[Array, " j"]
    shapes: Complex[Array, "j k"]
    channels: tuple[Channel, ...] = eqx.field(static=True)

    def coarse(self, scene):
        return characteristic_residual(scene.replace(**self.known), self.poles, self.shapes, self.channels)

    def _weight(self, share):
        return window(self.edges, share)[:, None] * self.kept / self.sigma


class SlidingMisfit(AbstractWaveformMisfit):
    """A small motion about steady sliding. It is a sum of the sliding modes, whose unknown amplitudes are found by linear least
    squares inside the residual (variable projection; Golub and Pereyra 1973), with the unknown zero of a displacement."""

    projected: int = eqx.field(static=True)
    unknowns: int = eqx.field(static=True, default=0)

    def compared(self, scene, own, share):
        weight = self._weight(share)
        waves, target = self.waves(scene.replace(**self.known)), weight * self.means
        q, r = orthonormal_columns((weight[..., None] * waves).reshape(-1, waves.shape[-1]))
        target = target.ravel()
        amplitudes = solve(r, q.T @ target)
        never = jnp.zeros(self.means.shape, bool)
        return Compared(finite(target - q @ (q.T @ target)), waves @ amplitudes, never, jnp.zeros(0), None)

    def waves(self, scene) -> Float[Array, "B k m"]:
        """Blocks for each unit initial state, scaled to the same size; then a constant for each displacement."""
        waves = free_waves(scene, linear_sliding(scene).matrix, self.sampled, self.channels)
        # Responses to displacements and to velocities differ by a factor of the frequency, which would worsen the conditioning.
        waves = waves / jnp.sqrt(jnp.mean(jax.lax.stop_gradient(waves) ** 2, axis=(0, 1)))
        return jnp.concatenate([waves, zeros_of_displacements(self.channels, len(self.means))], axis=2)


class KickMisfit(AbstractWaveformMisfit):
    """The response to the scene's own load, from steady sliding or another state, through every contact event."""

    method: AbstractStepper
    reference: Float[Array, ""]  # the time offset, or the one from which an unknown one is measured, s
    y0: Float[Array, " state"] | None  # the state at time 0, None for steady sliding; zeros where it is not known
    scale: Float[Array, " m"] | None  # units of an unknown state
    free: tuple[int, ...] = eqx.field(static=True)  # the places in a state that are unknown
    unknowns: int = eqx.field(static=True)
    projected: int = eqx.field(static=True, default=0)

    @property
    def offset_unit(self) -> Float[Array, ""]:
        """The unit of an unknown time offset: a block, in s."""
        return self.edges[1] - self.edges[0]

    def own(self, x):
        """The time offset (s) and the state at time 0, None for steady sliding."""
        if self.free:
            assert self.y0 is not None and self.scale is not None
            return self.reference, self.y0.at[jnp.array(self.free)].set(self.scale * x)
        return (self.reference + self.offset_unit * x[0] if self.unknowns else self.reference), self.y0

    def compared(self, scene, own, share):
        model, touched = self.predicted(scene, own)
        residual = finite(self._weight(share) * (self.means - model)).ravel()
        return Compared(residual, model, touched, jnp.zeros(0), None)

    def predicted(self, scene: Scene, own) -> tuple[Float[Array, "B k"], Bool[Array, "B k"]]:
        """The blocks' means, and which are next to an instant at which they jump."""
        response = self.response(scene, own, self.sampled)
        accelerations, velocities = self.sampled.jumping(self.channels)
        model = self.sampled.of_blocks(response.means)
        if self.sampled.filtered:
            return model, jnp.zeros(model.shape, bool)
        touched = (response.contacts | response.loads)[:, None] & accelerations
        return model, touched | (response.landings[:, None] & velocities)

    def response(self, scene: Scene, own, sampled: Sampled) -> Response:
        """The response as `sampled`."""
        offset, y0 = own
        begin = offset + self.edges[0]
        return response_of(scene.replace(**self.known), self.method, y0, sampled, begin, self.channels)

    def first(self, scene: Scene) -> Float[np.ndarray, " u"]:
        """Where to start for the recording's own unknowns: for a state, with the free motion without friction that is closest
        to the beginning of the recording."""
        if not self.free:
            return np.zeros(self.unknowns)
        return np.asarray(_closest_start(scene.replace(**self.known), self)) / np.asarray(self.scale)


def free_waves(scene: Scene, matrix, sampled: Sampled, channels: tuple[Channel, ...]) -> Float[Array, "B k m"]:
    """Blocks of the free motion with this state matrix, for each unit initial state."""
    m = matrix.shape[0] // 2
    # Velocities in units of a frequency: of entries that differ by its square, exponentials lose digits.
    squares = jax.lax.stop_gradient(jnp.max(jnp.abs(matrix[m:, :m])))
    units = jnp.append(jnp.ones(m), jnp.full(m, jnp.sqrt(jnp.where(squares > 0, squares, 1.0))))
    scaled = matrix * units / units[:, None]
    states = powers(exponential(sampled.width * scaled), sampled.count) @ _inside(scaled, sampled)
    states = states * units[:, None] / units
    rates = jnp.concatenate([states, matrix[m:] @ states], axis=1)
    keep = free_in_sliding(scene.structure).tolist()
    columns = [keep.index(channel.coordinate) + m * channel.derivative for channel in channels]
    return sampled.of_blocks(rates[:, jnp.array(columns)])


def zeros_of_displacements(channels: tuple[Channel, ...], blocks: int) -> Float[Array, "B k d"]:
    """A constant for each channel of a displacement, whose sensor's zero is not known."""
    places = [k for k, channel in enumerate(channels) if channel.derivative == 0]
    return jnp.broadcast_to(jnp.eye(len(channels))[:, np.array(places, int)], (blocks, len(channels), len(places)))


def _inside(matrix, sampled: Sampled) -> Float[Array, "m m"]:
    """The mean of a block's samples, for each unit state at its beginning."""
    size = matrix.shape[0]
    if sampled.averages:
        both = jnp.zeros((2 * size, 2 * size)).at[:size, :size].set(matrix).at[:size, size:].set(jnp.eye(size))
        return exponential(sampled.width * both)[:size, size:] / sampled.width
    step = sampled.width / sampled.per_block
    each = powers(exponential(step * matrix), sampled.per_block) @ exponential(0.5 * step * matrix)
    return jnp.mean(each, axis=0)


def _closest_start(scene: Scene, mine: KickMisfit) -> Float[np.ndarray, " u"]:
    waves, means, equilibrium = map(np.asarray, _weighted_waves(scene, mine))
    # Displacements and velocities differ by a factor of the frequency.
    sizes = np.linalg.norm(waves, axis=0)
    sizes[sizes == 0] = 1.0
    # By NumPy: columns may depend on each other.
    return equilibrium + (np.linalg.lstsq(waves / sizes, means)[0] / sizes)[: len(mine.free)]


@compiled
def _weighted_waves(scene: Scene, mine: KickMisfit):
    """The beginning of the recording, the free motions that may explain it as columns, and the equilibrium."""
    # The share of a recording from whose beginning an unknown start is guessed.
    beginning = 0.15
    linear = linear_sliding(scene)
    waves = free_waves(scene, linear.frictionless, mine.sampled, mine.channels)
    # Friction at a standstill shifts the position about which it vibrates.
    waves = jnp.concatenate([waves, zeros_of_displacements(mine.channels, len(mine.means))], axis=2)
    weight = window(mine.edges, jnp.asarray(beginning))[:, None] / mine.sigma
    columns = (weight[..., None] * waves).reshape(-1, waves.shape[-1])
    return columns, (weight * mine.means).ravel(), linear.equilibrium[jnp.array(mine.free)]


def misfit_of_waveform(recording: Recording, blocks: Averaged, method: AbstractStepper, scene: Scene) -> AbstractMisfit:
    """A recording of a small motion or of a kick, averaged over blocks, ready to be compared."""
    # The least share of the signal's energy that poles must explain to count as those of a small motion.
    least_explained = 0.7
    known = {name: jnp.asarray(value) for name, value in recording.known.items()}
    sigma = noise_of_means(recording, blocks)
    width = blocks.edges[1] - blocks.edges[0]
    # The response to a kick may be a small motion again towards its end.
    tail = blocks.means if recording.regime == "sliding" else blocks.means[len(blocks.means) // 3 :]
    displacements = [k for k, channel in enumerate(recording.channels) if channel.derivative == 0]
    tail = tail - np.where(np.isin(np.arange(tail.shape[1]), displacements), tail.mean(axis=0), 0.0)
    modes = scene.structure.size - len(scene.structure.contacts)
    found = strongest_poles(tail, width, modes, sigma)
    # Padded to the largest number of poles, so that all recordings of this length share compiled programs.
    values = np.full(modes, complex(np.nan, np.nan))
    shapes = np.full((len(values), len(recording.channels)), complex(np.nan, np.nan))
    if found.explained > least_explained:
        values[: len(found.values)], shapes[: len(found.values)] = found.values, found.shapes
    common: dict = {
        "edges": jnp.asarray(blocks.edges),
        "means": jnp.asarray(blocks.means),
        "sigma": jnp.asarray(np.broadcast_to(sigma, blocks.means.shape)),
        "t": jnp.asarray(0.5 * (blocks.edges[1:] + blocks.edges[:-1])),
        "kept": jnp.ones(blocks.means.shape),
        "sampled": sampled(recording, blocks),
        "known": known,
        "poles": jnp.asarray(values),
        "shapes": jnp.asarray(shapes),
        "channels": recording.channels,
    }
    if recording.regime == "sliding":
        return SlidingMisfit(**common, projected=2 * modes + len(displacements))
    return _kick(recording, method, scene.replace(**recording.known), common)


def _kick(recording: Recording, method: AbstractStepper, scene: Scene, common: dict) -> KickMisfit:
    low, high = recording.offset
    # What is predicted begins this much before the first sample; before a known state nothing is known.
    before = -float(common["edges"][0] + common["sampled"].lead)
    if recording.y0 is not None and common["sampled"].averages and low < before:
        raise ValueError(
            f"Argument `offset` of a recording with `y0` must be at least {before:.3g} s, but is {low:g}: its first "
            f"averages, or what its filter remembers, would begin before the state `y0`. Leave out its first samples."
        )
    kick = KickMisfit(
        **common,
        method=method,
        reference=jnp.asarray(low),
        y0=None if recording.y0 is None else start_state(scene, recording.y0),
        scale=None,
        free=(),
        unknowns=int(low < high),
    )
    if not starts_unknown(scene, recording):
        return kick
    n, keep = scene.structure.size, free_in_sliding(scene.structure)
    free = tuple(int(place) for place in (*keep, *(n + keep)))
    parts = (jnp.zeros(2 * n), jnp.ones(len(free)), jnp.asarray(before))
    kick = dataclasses.replace(kick, y0=parts[0], scale=parts[1], reference=parts[2], free=free, unknowns=len(free))
    guess = np.abs(kick.first(scene).reshape(2, -1)).max(axis=1)
    scale = jnp.asarray(np.repeat(np.where(guess > 0, guess, 1.0), len(keep)))
    return dataclasses.replace(kick, scale=scale)


def starts_unknown(scene: Scene, recording: Recording) -> bool:
    """Whether a run has no known start: on a belt at rest nothing slides steadily."""
    return recording.regime == "kick" and recording.y0 is None and bool(np.any(np.asarray(scene.belt_speed) == 0))


def powers(step: Float[Array, "m m"], count: int) -> Float[Array, "count m m"]:
    """I, step, step², …: by doubling, so that a long recording takes only a few products of many matrices."""
    found, next_one = jnp.eye(step.shape[0])[None], step
    while found.shape[0] < count:
        found = jnp.concatenate([found, found @ next_one])
        next_one = next_one @ next_one
    return found[:count]
