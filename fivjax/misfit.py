r"""How far a scene is from a recording: residuals in units of the measuring noise, for each regime.

| regime | far from the answer (`coarse`) | near it (`residual`) |
|---|---|---|
| sliding | poles and shapes in the characteristic equation | waveform, the initial state eliminated |
| kick | the same, where the recording ends in a small motion | waveform of the whole response, through every event |
| limit cycle | frequency and fundamentals | harmonics, fractions of time |

The coarse residuals put measured poles into the scene's own characteristic equation. That equation is linear in springs
and dampers, so there is no neighbouring period to fall into. The waveform is compared over windows that grow.
"""

import abc

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Complex, Float

from . import features
from .contact import Mechanics, Status, status_from_forces
from .scene import Scene, steady_sliding
from .signals import Averaged, Channel, Recording, averaged
from .simulate import states_at
from .sliding import linear_sliding
from .steppers import MOST_ADVANCES, AbstractStepper, advance_adding

# What stands for a motion that is not finite: bad enough never to be chosen, small enough to square.
HOPELESS = 1e6
# Errors that coarse residuals are measured in: shapes are known to some per cent, poles ten times better.
COARSE_SHAPE = 0.03
COARSE_POLE = 3e-3
# A kick's time offset is moved in units of this, in s.
OFFSET_UNIT = 1e-3
# From its first, arbitrary state a limit cycle is followed for so many periods before it is looked at, and then for these.
SETTLING_PERIODS = 80
CYCLE_PERIODS = 30
MOST_HARMONICS = 8
# Blocks per period: many, because landings are short; the least and the most.
CYCLE_BLOCKS = (28, 48)


class AbstractMisfit(eqx.Module):
    """One recording beside the scene it is to be explained by. Times are s after the recording's first sample."""

    # Standard deviations of the block means, by channel.
    sigma: eqx.AbstractVar[Float[Array, " k"]]
    known: eqx.AbstractVar[dict[str, Array]]
    # Numbers that the residual fits on its own, beside the parameters.
    fitted_by_elimination: eqx.AbstractVar[int]

    @abc.abstractmethod
    def coarse(self, scene: Scene) -> Float[Array, " c"]:
        """Residuals that lead to the right period from afar; may be empty."""

    @abc.abstractmethod
    def residual(
        self, scene: Scene, offset: Float[Array, ""], share: Float[Array, ""]
    ) -> tuple[Float[Array, " r"], Float[Array, "B k"]]:
        """Residuals over the first `share` of the recording, in standard deviations of the noise, and the block means that
        the scene gives; NaN where it gives none."""


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

    def residual(self, scene, offset, share):
        weight = _window(self.edges, share)[:, None] / self.sigma
        waves, target = self._waves(scene), weight * self.means
        q, r = jnp.linalg.qr((weight[..., None] * waves).reshape(-1, waves.shape[-1]))
        target = target.ravel()
        amplitudes = jax.scipy.linalg.solve_triangular(r, q.T @ target)
        return _finite(target - q @ (q.T @ target)), waves @ amplitudes

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

    def residual(self, scene, offset, share):
        weight = _window(self.edges, share)[:, None] / self.sigma
        model = jnp.diff(self.integrals(scene, self.edges + offset), axis=0) / (self.edges[1] - self.edges[0])
        return _finite(weight * (self.means - model)).ravel(), model

    def integrals(self, scene: Scene, instants: Float[Array, " i"], eventful: bool = False) -> Float[Array, "i k"]:
        """What the channels are rates of, velocities and displacements, at evenly spaced instants of the simulation (s)."""
        respond = _sliding_throughout if self.uneventful and not eventful else _through_events
        y = respond(scene.replace(**self.known), self.method, instants)
        return _integrals(y, self.channels)


class CycleMisfit(AbstractMisfit):
    """A limit cycle by its harmonics and, where they were measured, its fractions of time in the statuses."""

    means: Float[Array, "B k"]
    sigma: Float[Array, " k"]
    known: dict[str, Array]
    measured: Float[Array, " h"]
    whitening: Float[Array, "h h"]
    fractions: Float[
        Array, "2 2"
    ]  # sticking, detached; value and standard deviation, which is infinite if not measured
    method: AbstractStepper
    width: Float[Array, ""]  # of a block, s
    frequency: Float[Array, ""]  # Hz, as measured
    blocks: int = eqx.field(static=True)
    count: int = eqx.field(static=True)
    channels: tuple[Channel, ...] = eqx.field(static=True)
    fitted_by_elimination: int = eqx.field(static=True, default=0)

    def coarse(self, scene):
        return self._roughly(*self._orbit(scene))

    def residual(self, scene, offset, share):
        means, fractions = self._orbit(scene)
        lines = self.whitening @ (self.measured - self._features(means))
        exactly = _finite(jnp.concatenate([lines, (self.fractions[:, 0] - fractions) / self.fractions[:, 1]]))
        return jnp.where(share < 1, self._roughly(means, fractions), exactly), means

    def _roughly(self, means, fractions):
        """The same features, with errors that are those of a guess."""
        found = self._features(means) / self.measured[1]
        expected = self.measured / self.measured[1]
        # Frequency to a per mille, lines to 5 % of the largest, fractions of time to 5 % of it all.
        error = jnp.full(found.shape, 0.05).at[0].set(1e-3 * expected[0])
        times = (self.fractions[:, 0] - fractions) / jnp.maximum(self.fractions[:, 1], 0.05)
        return _finite(jnp.concatenate([(expected - found) / error, times]))

    def _features(self, means):
        return features.harmonics(means, self.width, self.count, 0.6 * self.frequency, 1.6 * self.frequency)

    def _orbit(self, scene) -> tuple[Float[Array, "b k"], Float[Array, "2"]]:
        """Block means on the orbit that it settles on, and the fractions of their time spent sticking and detached."""
        scene = scene.replace(**self.known)
        mechanics, load = Mechanics(scene), scene.load.final
        n, tangential = scene.structure.size, scene.structure.tangential
        q, _ = steady_sliding(scene, load)
        # A kick almost as fast as the belt: outside everything that dies out.
        y0 = jnp.concatenate([q, jnp.zeros(n)]).at[n + tangential].set(0.9 * scene.belt_speed)
        codes = jnp.array([Status.STICK, Status.DETACH])

        def spend(spent, contact, y, after):
            return spent + jnp.where(contact.status == codes, after.h, 0.0)

        def to_next(carry, h):
            y, contact, spent = carry
            y, contact, spent, reached = advance_adding(
                self.method, mechanics, contact, load, y, h, MOST_ADVANCES, spent, spend, "lax"
            )
            y = jnp.where(reached, y, jnp.nan)
            return (y, contact, spent), (y, spent)

        settling = SETTLING_PERIODS / self.frequency
        spans = jnp.concatenate([settling[None], jnp.full(self.blocks, self.width)])
        start = (y0, status_from_forces(mechanics, load, y0), jnp.zeros(2))
        _, (y, spent) = jax.lax.scan(to_next, start, spans)
        means = jnp.diff(_integrals(y, self.channels), axis=0) / self.width
        # Tapered, because it need not be a whole number of periods.
        weights = jnp.hanning(self.blocks)
        return means, weights @ jnp.diff(spent, axis=0) / (jnp.sum(weights) * self.width)


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
        return recording.noise / np.sqrt(blocks.per_block)
    differences = np.abs(np.diff(recording.values, 3, axis=0))
    # The third difference of white noise has 1 + 9 + 9 + 1 times its variance; 0.6745 is the median of |normal|.
    return np.median(differences, axis=0) / (0.6745 * np.sqrt(20.0) * np.sqrt(blocks.per_block))


def misfit(
    recording: Recording, blocks: Averaged, method: AbstractStepper, scene: Scene, uneventful: bool
) -> AbstractMisfit:
    """A recording, averaged over blocks, ready to be compared."""
    known = {name: jnp.asarray(value) for name, value in recording.known.items()}
    size = np.sqrt(np.mean(blocks.means**2, axis=0))
    # A recording without any noise would leave rounding to be fitted.
    sigma = np.maximum(noise_of_means(recording, blocks), 1e-9 * size + 1e-300)
    if recording.regime == "limit cycle":
        return _cycle(recording, blocks, method, known, sigma, scene)
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


def _fundamental(means, width: float, lowest: float, highest: float, count: int) -> float:
    # As arrays, so that another recording finds it compiled.
    return float(_compiled_fundamental(means, jnp.asarray(width), count, jnp.asarray(lowest), jnp.asarray(highest)))


_compiled_fundamental = eqx.filter_jit(features.fundamental)


def _left_by_lines(means: np.ndarray, width: float, frequency: float, count: int) -> np.ndarray:
    """What harmonics of this frequency do not explain."""
    turns = 2 * np.pi * frequency * width * np.outer(np.arange(len(means)), np.arange(1, count + 1))
    waves = np.concatenate([np.ones((len(means), 1)), np.cos(turns), np.sin(turns)], axis=1)
    return means - waves @ np.linalg.lstsq(waves, means, rcond=None)[0]


@eqx.filter_jit
def _features_with_slopes(means, width, lowest, highest, count: int):
    def features_of(means):
        return features.harmonics(means, width, count, lowest, highest)

    return features_of(means), jax.jacrev(features_of)(means)


def cycle_rate(recording: Recording, scene: Scene) -> float:
    """Blocks per second for a limit cycle, so many to a period that what averaging folds down lies between its lines."""
    blocks = averaged(recording, 16 * _sliding_frequencies(scene, recording).max())
    width = float(blocks.edges[1] - blocks.edges[0])
    samples = recording.rate / _first_frequency(recording, blocks.means, width, scene)
    choices = np.arange(max(1, int(samples / CYCLE_BLOCKS[1])), max(2, int(samples / CYCLE_BLOCKS[0]) + 1))
    return recording.rate / float(choices[np.argmin([_folded(samples / choice) for choice in choices])])


def _folded(per_period: float) -> float:
    """How much of the lines around each multiple of the block rate is taken for fitted lines, in units of a flat spectrum.

    Averaging leaves a share h/(m r) of what lies next to m times the rate of r blocks per period, for the line h; the
    taper keeps out what is folded down far enough from it.
    """
    m = np.arange(1, 13)
    aside = np.abs(m * per_period - np.round(m * per_period)) * CYCLE_PERIODS
    t = np.linspace(0, 1, 401)
    taper = features.taper(len(t))
    seen = np.abs(np.exp(2j * np.pi * np.outer(aside, t)) @ taper) / taper.sum()
    return float(np.sum(seen * MOST_HARMONICS / (m * per_period)))


def _sliding_frequencies(scene: Scene, recording: Recording) -> np.ndarray:
    modes = np.linalg.eigvals(np.asarray(linear_sliding(scene.replace(**recording.known)).matrix))
    modes = np.abs(modes.imag) / (2 * np.pi)
    return modes[modes > 0]


def _first_frequency(recording: Recording, means: np.ndarray, width: float, scene: Scene) -> float:
    """The fundamental, sought where the sliding modes are: a start 30 % off in a spring is 16 % off in frequency."""
    modes = _sliding_frequencies(scene, recording)
    return _fundamental(jnp.asarray(means), width, 0.6 * modes.min(), 1.6 * modes.max(), 1)


def _cycle(recording, blocks: Averaged, method, known, sigma, scene: Scene) -> CycleMisfit:
    width = float(blocks.edges[1] - blocks.edges[0])
    means = jnp.asarray(blocks.means)
    frequency = _first_frequency(recording, blocks.means, width, scene)
    count = int(np.clip(0.3 / (width * frequency), 1, MOST_HARMONICS))
    limits = (0.6 * frequency, 1.6 * frequency)
    frequency = _fundamental(means, width, *limits, count)
    left = _left_by_lines(blocks.means, width, frequency, count)
    if recording.noise is None:
        # Sparse samples leave no clean differences; then what the harmonics leave is the better bound.
        sigma = np.minimum(sigma, np.sqrt(np.sum(left**2, axis=0) / (len(left) - 2 * count - 1)))

    # How the noise of every sample reaches every feature, to first order.
    # As arrays, so that another recording finds it compiled.
    low, high = jnp.asarray(limits[0]), jnp.asarray(limits[1])
    measured, jacobian = _features_with_slopes(means, jnp.asarray(width), low, high, count)
    jacobian = np.asarray(jacobian)
    covariance = np.einsum("abk,cbk,k->ac", jacobian, jacobian, sigma**2)
    whitening = np.linalg.inv(np.linalg.cholesky(covariance))
    fractions = np.array([value or (0.0, np.inf) for value in (recording.sticking, recording.detached)])
    return CycleMisfit(
        means=means,
        sigma=jnp.asarray(sigma),
        known=known,
        measured=measured,
        whitening=jnp.asarray(whitening),
        fractions=jnp.asarray(fractions),
        method=method,
        width=jnp.asarray(width),
        frequency=jnp.asarray(frequency),
        # In tens, so that recordings of nearly the same frequency share what is compiled.
        blocks=int(min(len(blocks.means), 10 * np.ceil(0.1 * CYCLE_PERIODS / (width * frequency)))),
        count=count,
        channels=recording.channels,
    )
