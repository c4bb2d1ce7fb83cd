r"""Perturbations of steady sliding whose smallest size is sought: initial states, and histories of the load.

Both are vectors $u$ with a norm. While all contacts slide under constant friction, both change the quantities that end
sliding (normal forces and slip speeds) linearly: the change at the time $t$ is $κ(t) · u$. So no $u$ with a norm below the
margin over $\sup_t |κ(t)|_*$, in the dual norm, ever ends sliding. The supremum is bounded between instants, too.
"""

import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Complex, Float

from ..contact import Contact
from ..foundation.numpy_evaluation import by_numpy
from ..kernels.functions import KernelFunction
from ..linear.linearisation import LinearSliding, linear_sliding
from ..model.scene import Scene
from ..model.sliding import contact_coordinates, sliding_states
from ..section.about_sliding import mechanics_about_sliding
from ..section.crossings import MOST_SEGMENTS
from ..steppers.core import follow
from ..steppers.event_exact import EXACT_STEPPER, for_derivatives
from ..steppers.kernel_scope import has_kernel
from ..verdicts.sliding_proof import SlidingModes, sliding_modes

# Instants per period of the fastest mode, during a history and afterwards.
FINE, COARSE = 1500, 128
# Instants evaluated at a time, and histories followed at a time.
CHUNK, SIDE_BY_SIDE = 4096, 64
MOST_INSTANTS = 2_000_000

Vectors = Float[np.ndarray, "k m"]


class Certificate(NamedTuple):
    """A norm below which every perturbation slides for ever, and the shapes (of norm one) that come closest to ending
    sliding.
    """

    size: float
    shapes: Vectors


class Margin(NamedTuple):
    """A quantity of a contact that ends sliding where it falls to zero, and how far it is from that in steady sliding."""

    shares: Complex[np.ndarray, " k"]  # of the modes in it
    size: float  # m/s of slip; of pressing as in `LinearSliding`
    presses: bool  # whether it is pressing, which the load changes at once, too


class StableSliding(NamedTuple):
    """The sliding motion of one scene in modal coordinates."""

    modes: SlidingModes
    linear: LinearSliding
    shift: Complex[np.ndarray, " k"]  # shift of the equilibrium by the load, in modal coordinates
    margins: list[Margin]  # of slip and of pressing, of each contact


def stable_sliding(scene: Scene) -> StableSliding:
    """Sliding in modal coordinates, without the leading axis of groups.

    **Raises:** `ValueError` if steady sliding does not exist or is not stable.
    """
    batch = jax.tree.map(lambda leaf: np.asarray(leaf)[None], _linear(scene))
    modes = sliding_modes(batch)
    if not bool(modes.stable[0]) or not bool(batch.exists[0]):
        raise ValueError("Argument `scene` must slide steadily and stably, or no kick is needed to make it squeal.")
    own: SlidingModes = jax.tree.map(lambda leaf: leaf[0], modes)
    linear = own.linear
    shift = np.asarray(own.to_modal) @ np.asarray(linear.equilibrium)[_free_states(scene)].astype(complex)
    of_contacts = (own.slip, linear.slip_margin, False), (own.pressing, linear.pressing_margin, True)
    margins = [
        Margin(shares, float(size), presses)
        for every, sizes, presses in of_contacts
        for shares, size in zip(np.atleast_2d(every), np.atleast_1d(sizes), strict=True)
    ]
    return StableSliding(own, linear, shift, margins)


def _free_states(scene: Scene) -> np.ndarray:
    """Places in a state of the coordinates that sliding leaves free, and of their velocities."""
    return sliding_states(scene.structure.size, contact_coordinates(scene.structure)[1])


@by_numpy
def _linear(scene: Scene) -> LinearSliding:
    return linear_sliding(scene)


class InitialStates:
    """Deviations from sliding of contacts that stay closed; the norm is the square root of their energy, in √J."""

    # What it is called, and its largest norm.
    over, most = "state", math.inf

    def __init__(self, scene: Scene):
        self.scene, self.sliding, self.places = scene, stable_sliding(scene), _free_states(scene)
        free = self.places[: len(self.places) // 2]
        energy = np.zeros((2 * len(free), 2 * len(free)))
        energy[: len(free), : len(free)] = np.asarray(scene.structure.stiffness)[np.ix_(free, free)]
        energy[len(free) :, len(free) :] = np.asarray(scene.structure.mass)[np.ix_(free, free)]
        # The energy is half of z · energy z; `root` times a unit vector is a state with an energy of one joule.
        self.energy = 0.5 * energy
        self.root = np.linalg.inv(np.linalg.cholesky(self.energy)).T

    def norm(self, u: Vectors) -> Float[np.ndarray, " k"]:
        return np.sqrt(np.einsum("ki,ij,kj->k", u, self.energy, u))

    def steepest(self, gradient: Float[np.ndarray, " m"]) -> Float[np.ndarray, " m"]:
        """The vector of norm one with the largest scalar product with a gradient."""
        along = gradient @ self.root
        return self.root @ along / np.linalg.norm(along)

    def states(self, u: Vectors) -> Float[np.ndarray, "k state"]:
        """Deviations from sliding at the end of the perturbation."""
        full = np.zeros((len(u), 2 * self.scene.structure.size))
        full[:, self.places] = u
        return full

    def pulled_back(self, u: Float[np.ndarray, " m"], gradient: Float[np.ndarray, " state"]) -> Float[np.ndarray, " m"]:
        """The gradient by u, from the gradient by the state."""
        del u
        return gradient[self.places]

    def values(self, u: Float[np.ndarray, " m"]) -> Float[np.ndarray, " state"]:
        """What a user is told of a perturbation: the state itself."""
        return np.asarray(self.sliding.linear.equilibrium) + self.states(u[None])[0]

    def certificate(self) -> Certificate:
        modes = self.sliding.modes
        to_modal, rates = np.asarray(modes.to_modal) @ self.root, np.asarray(modes.eigenvalues)
        # A bound on the growth rate of the energy for any state, and so on changes between two instants.
        inner = np.linalg.solve(self.root, np.asarray(self.sliding.linear.matrix) @ self.root)
        growth = max(float(np.max(np.linalg.eigvalsh(0.5 * (inner + inner.T)))), 0.0)
        step = 2 * np.pi / (COARSE * np.max(np.abs(rates)))
        size, shapes = np.inf, []
        for shares, margin, _ in self.sliding.margins:
            rows = np.asarray(shares)[:, None] * to_modal
            sizes, vectors = _later(rows, rates, step, lambda rows: np.linalg.norm(rows, axis=-1))
            size = min(size, margin / (float(np.max(sizes)) * np.exp(growth * step)))
            chosen = vectors[_highest(sizes)]
            shapes.append(-(chosen / np.linalg.norm(chosen, axis=-1, keepdims=True)) @ self.root.T)
        return Certificate(size, np.concatenate(shapes))


class Histories:
    """Factors on the load, minus one, in equal pieces of a time; the norm is the largest absolute value."""

    over, most = "history", 1.0

    def __init__(self, scene: Scene, pieces: int, time: float):
        self.scene, self.pieces, self.time = scene, pieces, time
        self.sliding = stable_sliding(scene)
        self.by_kernel = has_kernel(scene, EXACT_STEPPER)
        self.given = scene, np.asarray(float(time))

    def norm(self, u: Vectors) -> Float[np.ndarray, " k"]:
        return np.max(np.abs(u), axis=-1)

    def steepest(self, gradient: Float[np.ndarray, " m"]) -> Float[np.ndarray, " m"]:
        return np.sign(gradient)

    def states(self, u: Vectors) -> Float[np.ndarray, "k state"]:
        found, size = [], len(u) if self.by_kernel else SIDE_BY_SIDE
        for start in range(0, len(u), size):
            # Padded with copies, so that XLA compiles one size.
            rows = np.minimum(np.arange(start, start + size), len(u) - 1)
            found.append(_after_history(self.given, own=(u[rows],), by_kernel=self.by_kernel)[0])
        return np.concatenate(found)[: len(u)]

    def pulled_back(self, u: Float[np.ndarray, " m"], gradient: Float[np.ndarray, " state"]) -> Float[np.ndarray, " m"]:
        args = *self.given, u
        _, (slopes, _) = _after_history.derived_by(args, u, np.eye(len(u)), by_kernel=self.by_kernel)
        return gradient @ slopes

    def values(self, u: Float[np.ndarray, " m"]) -> Float[np.ndarray, " m"]:
        """The factors themselves."""
        return 1.0 + u

    def certificate(self) -> Certificate:
        rates = np.asarray(self.sliding.modes.eigenvalues)
        edges, fastest = np.linspace(0.0, self.time, self.pieces + 1), np.max(np.abs(rates))
        periods = fastest * self.time / (2 * np.pi)
        # Of each instant there is a number for each piece, of which there are 16 unless asked otherwise.
        most = MOST_INSTANTS / FINE / max(1.0, self.pieces / 16)
        if periods > most:
            raise ValueError(
                f"A history of {self.time:g} s holds {periods:.0f} periods of the fastest mode, and a certified bound in "
                f"{self.pieces} pieces is known for up to {most:.0f}. Shorten it, give fewer `pieces`, or leave out modes that "
                "are so fast."
            )
        count = int(np.ceil(FINE * periods / self.pieces))
        inside = np.linspace(0.0, self.time / self.pieces, count + 1)
        size, shapes = np.inf, []
        for shares, margin, presses in self.sliding.margins:
            own = np.asarray(shares) * self.sliding.shift
            steady = float(np.real(np.sum(own)))
            # The direct effect of the load on the normal force, while it lasts.
            direct = margin - steady if presses else 0.0

            def response(t, own=own, jump=direct + steady):
                """The response to a load that is doubled at t = 0."""
                return jump - np.real(np.exp(np.multiply.outer(t, rates)) @ own)

            def bending(t, own=own):
                return -np.real(np.exp(np.multiply.outer(t, rates)) @ (own * rates**2))

            vectors, second = (
                np.concatenate([self._of_pieces(of, piece, edges, inside) for piece in range(self.pieces)])
                for of in (response, bending)
            )
            during = np.sum(np.abs(vectors), axis=-1)
            crude = 2 * self.pieces * float(np.sum(np.abs(own) * np.abs(rates) ** 4))
            peak = _peak(during, np.sum(np.abs(second), axis=-1), crude, inside[1] - inside[0])
            # Afterwards, by the time since then: of that since the beginning, powers of modes that decay fast overflow.
            until = np.exp(np.outer(rates, self.time - edges))
            rows = own[:, None] * (until[:, 1:] - until[:, :-1])
            step = 2 * np.pi / (COARSE * fastest)
            sizes, later = _later(rows, rates, step, _sum_of_sizes)
            bends, _ = _later(rows * rates[:, None] ** 2, rates, step, _sum_of_sizes)
            crude = float(np.sum(np.abs(rows) * np.abs(rates[:, None]) ** 4))
            largest = max(peak, _peak(sizes, bends, crude, step))
            size = min(size, margin / largest if largest > 0 else np.inf)
            for values, rows in ((during, vectors), (sizes, later)):
                shapes.append(-np.sign(rows[_highest(values)]))
        shapes = np.concatenate(shapes)
        return Certificate(float(size), np.where(shapes == 0, 1.0, shapes))

    def _of_pieces(self, of, piece: int, edges: np.ndarray, inside: np.ndarray) -> np.ndarray:
        """The contribution of each piece of the history so far during one piece, from the response to a step."""
        since = edges[piece] + inside[:, None] - edges[: piece + 1]
        before = np.arange(piece + 1) < piece
        ended = np.where(before, of(np.where(before, since - self.time / self.pieces, 0.0)), 0.0)
        return np.pad(of(since) - ended, ((0, 0), (0, self.pieces - piece - 1)))


def _peak(sizes: np.ndarray, bends: np.ndarray, crude: float, step: float) -> float:
    """A bound between instants, too: the distance from the chord is bounded by the second derivative, whose values between
    instants are bounded in the same way by a crude bound on the fourth.
    """
    chord = step**2 / 8
    return float(np.max(sizes)) + chord * (float(np.max(bends)) + chord * crude)


def _sum_of_sizes(rows: np.ndarray) -> np.ndarray:
    return np.sum(np.abs(rows), axis=-1)


def _later(rows: np.ndarray, rates: np.ndarray, step: float, norm) -> tuple[np.ndarray, np.ndarray]:
    """Responses and their norms at equally spaced instants from zero on, until later ones must be smaller than these."""
    whole = float(np.sum(norm(np.abs(rows))))
    sizes, vectors, most, count = [], [], 0.0, 0
    while not count or (whole > 0 and np.max(np.exp(rates.real * step * count)) * whole >= most):
        if count > MOST_INSTANTS:
            raise ValueError(
                "Steady sliding decays too slowly here for a certified bound. Go further from the critical friction."
            )
        t = step * np.arange(count, count + CHUNK)
        found = np.real(np.exp(np.outer(t, rates)) @ rows)
        vectors.append(found)
        sizes.append(norm(found))
        most, count = max(most, float(np.max(sizes[-1]))), count + CHUNK
    return np.concatenate(sizes), np.concatenate(vectors)


def _highest(sizes: np.ndarray) -> list[int]:
    """The indices at which a norm is largest: in all, in the first half up to that index, and well after it."""
    top = int(np.argmax(sizes))
    parts = ((0, len(sizes)), (0, top // 2), (min(top + top // 2 + 1, len(sizes)), len(sizes)))
    return [low + int(np.argmax(sizes[low:high])) for low, high in parts if high > low]


def _at_end(args, _):
    """The state after a history of the load that began in steady sliding."""
    scene, time, factors = args
    mechanics, n = mechanics_about_sliding(scene), scene.structure.size

    def piece(carry, factor):
        y, contact = carry
        # Loads are deviations from the final load.
        more, part = factor * scene.load.final, time / len(factors)
        after = follow(
            for_derivatives(EXACT_STEPPER), mechanics, contact, more, y, part, most=MOST_SEGMENTS, kind="lax"
        )
        return (after.y, after.contact), None

    sliding = Contact.sliding(jnp.sign(mechanics.belt_speed))
    return jax.lax.scan(piece, (jnp.zeros(2 * n), sliding), factors)[0][0], ()


# Of (scene, time in s, factors on the load).
_after_history = KernelFunction(_at_end)
