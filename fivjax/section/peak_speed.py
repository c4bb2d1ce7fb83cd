"""The largest tangential speed of a motion, from its Taylor series."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..contact import Mechanics
from ..foundation.polynomial import extremum, in_shares, moving_root, value_and_slope

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
    n = coefficients.shape[1] // 2
    for tangential, _ in mechanics.places:
        speeds = coefficients[:, n + tangential]
        # Most advances have no higher peak than those before them.
        most = jnp.sum(jnp.abs(in_shares(speeds, end)))
        before = jax.lax.cond(
            most <= before,
            lambda speeds, before: before,
            lambda speeds, before: peak_of_series(speeds, h, end, before),
            speeds,
            before,
        )
    return before


def peak_of_series(
    speeds: Float[Array, " order"], h: Float[Array, ""], end: Float[Array, ""], before: Float[Array, ""]
) -> Float[Array, ""]:
    """The largest speed of a series up to its end, or `before` if that is larger."""
    # At the advance's end, where an event ends it or the slope jumps, a peak's instant is the event's.
    until = jax.lax.stop_gradient(end)
    shares = np.linspace(0.0, 1.0, SAMPLES)
    k = np.arange(len(speeds))
    scaled = jax.lax.stop_gradient(in_shares(speeds, until))
    sizes = jnp.abs(shares[:, None] ** k @ scaled)
    highest = jnp.max(sizes)
    # Between samples a speed is higher than at both of them by an eighth of this at most.
    bend = jnp.sum(jnp.abs(scaled) * (k * (k - 1))) / (SAMPLES - 1) ** 2

    def peak() -> Float[Array, ""]:
        samples = until * shares
        # Not `argmax`, which JAX lowers in single precision when a caller's own `jit` is in it.
        largest = jnp.max(jnp.where(sizes == highest, samples, 0.0))
        x = jax.lax.stop_gradient(extremum(speeds, largest, 0.0, until, PEAK_STEPS))
        # Where Newton's method leads to a lower one, the sample counts.
        higher = jnp.abs(value_and_slope(speeds, x)[0]) >= highest
        # The value's first derivative does not depend on how the instant moves; the second does.
        slopes = (k[1:] * speeds[1:])[:, None]
        x = jnp.where(higher, moving_root(slopes, x, (higher & (x > 0) & (x < until))[None]), largest)
        peak, _ = value_and_slope(speeds, jnp.where(x >= until, end, x))
        return jnp.maximum(before, jnp.where(h > 0, jnp.abs(peak), 0.0))

    return jax.lax.cond(highest + bend / 8 <= before, lambda: before, peak)
