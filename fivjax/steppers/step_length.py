"""How long the steps of a Taylor series may be for a given error, in units of the fastest vibration."""

import functools

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..contact import Mechanics

# The longest advance, in units of time. A block that is carried by the belt moves in a straight line, and one at rest not at
# all, so that their series end at once; powers of a longer time would overflow.
LONGEST_STEP = 1e6


def time_unit(mechanics: Mechanics) -> Float[Array, ""]:
    """A time in which the phase of the fastest vibration advances by about one rad, in s; a power of two, so that scaling by it
    does not round.

    In seconds the coefficients of a series grow like powers of the fastest rate, out of the range of single precision.
    """
    rate = fastest_rate(mechanics)
    # The power of two below the rate is its exponent alone. Not by `jnp.frexp`: some versions of JAX lower that after double
    # precision has been switched off again.
    bits = jnp.int64 if rate.dtype == jnp.float64 else jnp.int32
    exponent = jax.lax.bitcast_convert_type(jnp.array(jnp.inf, rate.dtype), bits)
    below = jax.lax.bitcast_convert_type(jax.lax.bitcast_convert_type(rate, bits) & exponent, rate.dtype)
    return jnp.where((below > 0) & jnp.isfinite(below), 0.5 / below, 1.0)


def fastest_rate(mechanics: Mechanics) -> Float[Array, ""]:
    positions, velocities = jax.lax.stop_gradient((mechanics.free_position, mechanics.free_velocity))
    return jnp.maximum(jnp.sqrt(jnp.max(jnp.abs(positions))), jnp.max(jnp.abs(velocities)))


def attainable(tolerance: float, dtype) -> float:
    # Terms below the rounding of the first ones need not be smaller still.
    return max(tolerance, 0.25 * float(jnp.finfo(dtype).eps))


def trusted(states: Float[Array, "k state"], tolerance: float) -> Float[Array, ""]:
    """How far the series is accurate, in its units of time: up to where its last two terms are `tolerance` of its first
    ones.
    """
    order, n = len(states) - 1, states.shape[1] // 2
    tolerance = attainable(tolerance, states.dtype)

    def size(k):
        return jax.lax.stop_gradient(jnp.max(jnp.abs(states[k][:n])))

    tiny = float(jnp.finfo(states.dtype).tiny)
    moves = (size(0) > 0) | (size(1) > 0)
    # At rest, but accelerated: a load has just jumped.
    starts = size(2) > 0

    def reach(last, first):
        # The logarithm of h where |c_last| h^last = tolerance |c_j| h^j. In slow motion of a stiff structure the last term may
        # underflow; it then counts as the smallest normal number.
        end = jnp.log(jnp.maximum(size(last), tiny))
        # So does what is asked for of the first ones, in a motion that has faded to next to nothing.
        asked = [jnp.where(size(j) > 0, jnp.maximum(tolerance * size(j), tiny), 0.0) for j in first]
        return [(jnp.log(most) - end) * (1.0 / (last - j)) for j, most in zip(first, asked, strict=True)]

    def nearest(*first):
        # The larger h, because either coefficient may vanish.
        return jnp.minimum(*(functools.reduce(jnp.maximum, reach(last, first)) for last in (order, order - 1)))

    reached = jax.lax.cond(moves, lambda: nearest(0, 1), lambda: nearest(2))
    return jnp.where(moves | starts, jnp.minimum(jnp.exp(reached), LONGEST_STEP), LONGEST_STEP)
