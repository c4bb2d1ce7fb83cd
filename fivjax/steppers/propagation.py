"""The matrices that give a scene's motion over a window of time, in each contact mode, under constant friction."""

import math
from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .. import contact as physics
from ..contact import Contact, Mechanics, Status
from ..contact.rounding import largest_rounding

# Intervals in a window, a power of two. In a long window the work after an event is wasted; short ones have more overhead.
INTERVALS = 16
# Order of the Taylor series within an interval, in which the fastest motion turns by 0.6 (`propagators`): 0.6^16 / 16! is below
# rounding.
ORDER = 15
# Approximate number of rows of all matrices of a scene, per coordinate: for estimates of memory.
MATRIX_ROWS = 4 * (INTERVALS + ORDER)


class Propagators(eqx.Module):
    """The matrices of one scene. Their columns are the entries of (state, load, 1) that are not zero, of the four contact modes
    side by side.
    """

    mechanics: Mechanics
    interval: Float[Array, ""]  # between two samples, s
    window: Float[Array, "r c"]  # the samples of the state, with bounds on the guards between them
    series: Float[Array, "q c"]  # the Taylor series in an interval
    # For rounding of the guards' first three coefficients, and for their difference from cubics.
    sizes: Float[Array, "8 c"]


class Propagation(eqx.Module):
    """How kernels step in place of `EventExact`: the same motion to rounding, by matrices prepared for each scene.

    It needs one contact and constant friction, and gives no derivatives.
    """

    dt: ClassVar = math.inf
    round: ClassVar = 16

    def prepare(self, mechanics: Mechanics) -> Propagators:
        return propagators(mechanics)


def propagators(mechanics: Mechanics) -> Propagators:
    """The matrices for one scene with constant friction."""
    # The phase of the fastest vibration advances by this much between two samples, rad: guards are nearly cubic there.
    turn = 0.6
    n = mechanics.free_load.shape[0]
    ways = _ways(mechanics.free_load.dtype)
    generators, guards = jax.vmap(lambda way: _affine(mechanics, way))(ways)
    interval = turn / jnp.max(jax.vmap(_spectral_radius)(generators))
    identity = jnp.broadcast_to(jnp.eye(2 * n + 2, dtype=generators.dtype), generators.shape)

    def next_power(power, k):
        power = power @ generators * (interval / k)
        return power, power

    orders = jnp.arange(1.0, ORDER + 2, dtype=generators.dtype)
    _, powers = jax.lax.scan(next_power, identity, orders)
    powers = jnp.concatenate([identity[None], powers])
    step = jnp.sum(powers, axis=0)
    _, samples = jax.lax.scan(lambda sample, _: (step @ sample, step @ sample), identity, length=INTERVALS)
    samples = jnp.concatenate([identity[None], samples])

    coefficients = guards @ powers[: ORDER + 1]  # [order, way, guard, column]
    hulls = jnp.einsum("jk,kwgc->jwgc", _bernstein(ORDER), coefficients)[1:]
    values, slopes = guards @ samples, coefficients[1] @ samples
    control = jnp.stack([values[1:], values[:-1] + slopes[:-1] / 3, values[1:] - slopes[1:] / 3])
    window = [hulls, control, samples[:, :, : 2 * n]]
    series = [coefficients, jnp.sum(coefficients, axis=0), powers[:, :, :n]]

    sizes, rates = jax.vmap(lambda way: _magnitudes(mechanics, way))(ways)
    terms = jnp.stack([sizes, sizes @ rates * interval, sizes @ rates @ rates * (0.5 * interval**2)])
    # The error of a cubic with the values and slopes of both ends is at most 1/384 of the fourth derivative. Twice that, as the
    # derivative may grow between samples.
    uncubic = jnp.max(jnp.abs(coefficients[4] @ samples), axis=0) * (2 * math.factorial(4) / 384)
    rounding = [largest_rounding(terms), uncubic]

    def table(parts: list[Float[Array, "... 4 _ column"]]) -> Float[Array, "row entry"]:
        flat = [jnp.moveaxis(part, -3, 0).reshape(4, -1, 2 * n + 2) for part in parts]
        rows = jnp.concatenate(flat, axis=1)
        closed, everything = _columns(n, mechanics.normal)
        return jnp.concatenate([*(rows[way][:, closed] for way in range(3)), rows[3][:, everything]], axis=1)

    return Propagators(mechanics, interval, table(window), table(series), table(rounding))


def _bernstein(order: int) -> np.ndarray:
    """The matrix from a polynomial's coefficients to its Bernstein control points on [0, 1]: it lies in their convex hull."""
    return np.array([[math.comb(j, k) / math.comb(order, k) for k in range(order + 1)] for j in range(order + 1)])


def _ways(dtype) -> Contact:
    """Sticking, sliding in either direction, detached."""
    status = jnp.array([Status.STICK, Status.SLIDE, Status.SLIDE, Status.DETACH], jnp.int32)
    return Contact(status, jnp.array([1.0, 1.0, -1.0, 1.0], dtype))


def _columns(n: int, normal: int) -> tuple[np.ndarray, np.ndarray]:
    """Which entries of (state, load, 1) are not zero: in contact (no gap, no gap rate), and detached."""
    everything = np.arange(2 * n + 2)
    return everything[(everything != normal) & (everything != n + normal)], everything


def _affine(mechanics: Mechanics, contact: Contact) -> tuple[Float[Array, "m m"], Float[Array, "2 m"]]:
    """Rates and guards in one contact mode, as matrices on (state, load, 1)."""
    n = mechanics.free_load.shape[0]

    def rates_and_guards(v):
        y, load = v[: 2 * n], v[2 * n]
        rates = physics.acceleration(mechanics, contact, load, y)
        return jnp.concatenate([v[n : 2 * n], rates, physics.guards(mechanics, contact, load, y)])

    zero = jnp.zeros(2 * n + 1, mechanics.free_load.dtype)
    matrix = jnp.concatenate([jax.jacfwd(rates_and_guards)(zero), rates_and_guards(zero)[:, None]], axis=1)
    unchanging = jnp.zeros((2, 2 * n + 2), zero.dtype)
    return jnp.concatenate([matrix[: 2 * n], unchanging]), matrix[2 * n :]


def _magnitudes(mechanics: Mechanics, contact: Contact) -> tuple[Float[Array, "2 m"], Float[Array, "m m"]]:
    """`contact.magnitudes` as matrices on the sizes of (state, load, 1): one for the guards, one for the rates."""
    n = mechanics.free_load.shape[0]

    def sizes(v):
        guards, rates = physics.magnitudes(mechanics, contact, v[2 * n], v[: 2 * n])
        return jnp.concatenate([guards, rates])

    zero = jnp.zeros(2 * n + 1, mechanics.free_load.dtype)
    # The load enters by its size; at one, the derivative of |load| is one.
    matrix = jnp.concatenate([jax.jacfwd(sizes)(zero.at[2 * n].set(1.0)), sizes(zero)[:, None]], axis=1)
    unchanging = jnp.zeros((2, 2 * n + 2), zero.dtype)
    return matrix[:2], jnp.concatenate([matrix[2:], unchanging])


def _spectral_radius(matrix: Float[Array, "m m"]) -> Float[Array, ""]:
    """By Gelfand's formula: the 64th root of the norm of the 64th power. A little too large, never too small."""

    def squared(carry, _):
        log_size, matrix = carry
        size = jnp.max(jnp.abs(matrix))
        size = jnp.where(size > 0, size, 1.0)
        return (2 * (log_size + jnp.log(size)), (matrix / size) @ (matrix / size)), None

    (log_size, matrix), _ = jax.lax.scan(squared, (jnp.zeros((), matrix.dtype), matrix), length=6)
    return jnp.exp((log_size + jnp.log(jnp.linalg.norm(matrix) + jnp.finfo(matrix.dtype).tiny)) / 64)
