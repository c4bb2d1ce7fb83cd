"""The largest tangential speed of a motion, from its Taylor series."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..contact import Mechanics
from ..foundation.polynomial import extremum, value_and_slope

# Samples of the tangential speed in a segment; Newton's method finds the peak from the largest.
SAMPLES = 24
PEAK_STEPS = 6


def higher_peak(
    mechanics: Mechanics, coefficients: Float[Array, "k state"], h, end, before: Float[Array, ""]
) -> Float[Array, ""]:
    """The largest tangential speed in m/s within an advance, or the one from `before` if that was larger.

    `coefficients` are those of the motion's Taylor series, `h` is the advance's duration in s and `end` the same in the unit
    of the series.
    """
    n, powers = coefficients.shape[1] // 2, end ** np.arange(len(coefficients))
    for tangential, _ in mechanics.places:
        speeds = coefficients[:, n + tangential]
        # Most advances have no higher peak than those before them.
        most = jnp.sum(jnp.abs(speeds) * powers)
        before = jax.lax.cond(
            most <= before,
            lambda speeds, before: before,
            lambda speeds, before: jnp.maximum(before, peak_of_series(speeds, h, end)),
            speeds,
            before,
        )
    return before


def peak_of_series(speeds: Float[Array, " order"], h: Float[Array, ""], end: Float[Array, ""]) -> Float[Array, ""]:
    # To first order the value at a peak does not depend on its instant; but at the advance's end, where an event ends it or the
    # slope jumps, the instant is the event's.
    until = jax.lax.stop_gradient(end)
    samples = until * jnp.linspace(0.0, 1.0, SAMPLES)
    sizes = jnp.abs(value_and_slope(speeds, samples)[0])
    # Not `argmax`, which JAX lowers in single precision when a caller's own `jit` is in it.
    largest = jax.lax.stop_gradient(jnp.max(jnp.where(sizes == jnp.max(sizes), samples, 0.0)))
    x = jax.lax.stop_gradient(extremum(speeds, largest, 0.0, until, PEAK_STEPS))
    # Where Newton's method leads to a lower one, the sample counts.
    x = jnp.where(jnp.abs(value_and_slope(speeds, x)[0]) >= jnp.max(sizes), x, largest)
    peak, _ = value_and_slope(speeds, jnp.where(x >= until, end, x))
    return jnp.where(h > 0, jnp.abs(peak), 0.0)
