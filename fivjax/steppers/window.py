"""Where the guards may run out in a window of time ahead, and where the tangential velocity has its highest peak."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from ..contact.rounding import zero_at_start
from .propagation import INTERVALS


class Bracket(eqx.Module):
    """Brackets of the first roots of the guards in [0, 1], from values and derivatives at both ends."""

    guess: Float[Array, "2"]  # of the root, if it crosses; else 1
    zeros: Int[Array, "2"]  # number of roots at the start, which do not count
    end: Float[Array, "2"]  # where the guard is no longer positive, if it crosses
    crosses: Bool[Array, "2"]
    spent: Bool[Array, "2"]  # negative from the start


def first_is_safe(
    start: Float[Array, "4 2"], hull: Float[Array, "k 2"], limits: Float[Array, "3 2"], exact: Bool[Array, "2"]
) -> Bool[Array, ""]:
    """Whether the first interval is certain to have no event: a guard may start at zero there, because the status has just
    begun. From the first coefficients of the guards, the control points of their series, and the bounds on rounding.
    """
    zeros, lead = leading(start, limits, exact)
    safe = (lead > 0) & (least(hull[2:]) > 0) & ((zeros >= 2) | (hull[0] > 0)) & ((zeros >= 3) | (hull[1] > 0))
    return safe[0] & safe[1]


def bracketed(
    c: Float[Array, "k 2"],
    end: Float[Array, "2"],
    limits: Float[Array, "3 2"],
    exact: Bool[Array, "2"],
) -> Bracket:
    """The brackets of both guards from the first five coefficients of their series or more, their values at the `end`, and the
    bounds on rounding.
    """
    zeros, lead = leading(c, limits, exact)
    spent = lead < 0
    crosses = (lead >= 0) & (end <= 0)
    slope = jnp.where(zeros == 0, c[1], jnp.where(zeros == 1, c[2], jnp.where(zeros == 2, c[3], c[4])))
    bend = end - lead - slope
    guess = parabola_root(lead, slope, bend)
    guess = jnp.where(crosses, jnp.clip(guess, 0.0, 1.0), 1.0)
    return Bracket(guess, zeros, jnp.ones_like(lead), crosses, spent)


def fastest(speed: Float[Array, " i"], steps: Float[Array, ""]) -> Int[Array, ""]:
    """The sample next to the highest peak within the first `steps` intervals, from all samples."""
    index = jnp.arange(INTERVALS + 1)
    rise, bend = 0.5 * (speed[2:] - speed[:-2]), speed[2:] - 2.0 * speed[1:-1] + speed[:-2]
    bends = (bend < 0) & (jnp.abs(rise) <= -bend) & (rise <= -bend * (steps - index[1:-1]))
    above = jnp.where(bends, -0.5 * rise**2 / jnp.where(bends, bend, 1.0), 0.0)
    none = jnp.zeros_like(speed[:1])
    peak = jnp.where(index <= steps, speed + jnp.concatenate([none, above, none]), -jnp.inf)
    return least(jnp.where(peak == -least(-peak), index, INTERVALS).astype(jnp.int32))


def parabola_root(lead: Array, slope: Array, bend: Array) -> Array:
    """Where lead + slope x + bend x² first falls to zero, if it does; in the form without cancellation."""
    root = jnp.sqrt(jnp.maximum(slope**2 - 4 * bend * lead, 0.0))
    rises = slope > 0
    half = 0.5 * jnp.where(rises, slope + root, root - slope)
    below = jnp.where(rises, bend, half)
    return jnp.where(rises, -half, lead) / jnp.where(below == 0, 1.0, below)


def least(rows: Array) -> Array:
    """The minimum along the first axis, by halves."""
    while rows.shape[0] > 1:
        half = rows.shape[0] // 2
        rest = rows[2 * half :]
        rows = jnp.minimum(rows[:half], rows[half : 2 * half])
        rows = jnp.concatenate([jnp.minimum(rows[:1], rest), rows[1:]]) if rest.shape[0] else rows
    return rows[0]


def leading(
    c: Float[Array, "k g"], limits: Float[Array, "3 g"], exact: Bool[Array, " g"]
) -> tuple[Int[Array, " g"], Float[Array, " g"]]:
    """How many of the first coefficients of guards are zero up to rounding, and the first one that is not."""
    size = jnp.abs(c[0]) + jnp.abs(c[1]) + jnp.abs(c[2]) + jnp.abs(c[3])
    zeros, lead = jnp.zeros_like(size, jnp.int32), c[0]
    for k, zero in enumerate(zero_at_start(c, size, limits, exact)):
        zeros, lead = zeros + zero, jnp.where(zero, c[k + 1], lead)
    return zeros, lead
