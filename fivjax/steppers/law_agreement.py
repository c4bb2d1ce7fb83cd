"""How far along a step a Taylor series still follows the friction law.

The last terms of a series do not show everything: they are tiny while $e^{-d u}$ grows from $e^{-80}$ to 1, and they know
nothing of a kink ahead. So the series of μ is compared with the law itself along the step, at the series' own slip speed.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from ..contact import Contact, Status
from ..foundation.polynomial import extremum, in_shares, value_and_slope
from ..model.friction import AbstractFriction
from .step_length import attainable

# Where they are compared, besides where slip is fastest and slowest: at this many equal parts of the step.
PARTS = 8
TURNING_STEPS, NEAR = 5, 1e-4
# A step is not cut to less than this share: over so short a time, a kink at its very start has no effect.
SHORTEST = 1e-8
MOST_HALVINGS = 80


def agreeing(
    law: AbstractFriction,
    contact: Contact,
    friction: Float[Array, "k *contacts"],
    slip: Float[Array, "k *contacts"],
    reach: Float[Array, ""],
    tolerance: float,
) -> Float[Array, ""]:
    """The share of a step of length `reach` over which the series of μ is the law at the series' slip speed.

    Where the two part, because the series ends too soon or the law has a kink there, the step ends at the last place before.
    If there is none, bisection finds where they part. The step then ends just beyond it, so that the next one begins on the
    other side of a kink.
    """
    # The difference that counts as rounding, in units of the last place of μ.
    roundings = 128
    law, friction, slip, reach = jax.lax.stop_gradient((law, friction, slip, reach))
    mu, u = in_shares(friction, reach), in_shares(slip, reach)
    sliding = contact.status == Status.SLIDE
    eps = float(jnp.finfo(mu.dtype).eps)
    allowed = max(attainable(tolerance, mu.dtype), roundings * eps) * jnp.maximum(jnp.abs(mu[0]), jnp.abs(law.static))

    def parted(x: Float[Array, ""], speed: Float[Array, "*contacts"]) -> Bool[Array, ""]:
        # Also below zero, where sliding is over: a kink may lie on the last short way there.
        of_series = value_and_slope(mu, x)[0]
        return jnp.any(sliding & ~(jnp.abs(of_series - law(speed)) <= allowed))

    equal = jnp.arange(1, PARTS + 1, dtype=mu.dtype) / PARTS
    speeds, slopes = jax.vmap(lambda x: value_and_slope(u, x))(equal)
    turning = _turning(u, equal, speeds, slopes)
    at_turning = jax.vmap(lambda x: value_and_slope(u, x)[0])(turning)
    places = jnp.concatenate([equal, turning])
    wrong = jax.vmap(parted)(places, jnp.concatenate([speeds, at_turning]))
    high = jnp.min(jnp.where(wrong, places, jnp.inf))
    before = jnp.max(jnp.where(places < high, places, 0.0))

    def going(carry):
        low, high, count = carry
        return (before == 0) & jnp.isfinite(high) & (high - low > 4 * eps * high) & (count < MOST_HALVINGS)

    def halved(carry):
        low, high, count = carry
        middle = 0.5 * (low + high)
        beyond = parted(middle, value_and_slope(u, middle)[0])
        return jnp.where(beyond, low, middle), jnp.where(beyond, middle, high), count + 1

    _, beyond, _ = jax.lax.while_loop(going, halved, (before, high, jnp.zeros((), jnp.int32)))
    return jnp.clip(jnp.where((before > 0) & jnp.isfinite(high), before, beyond), SHORTEST, 1.0)


def _turning(
    u: Float[Array, "k *contacts"],
    x: Float[Array, " p"],
    speeds: Float[Array, "p *contacts"],
    slopes: Float[Array, "p *contacts"],
) -> Float[Array, " q"]:
    """Nearly where slip is fastest and slowest, from samples of it and of its slope at these places."""
    rising = jnp.array([1.0, -1.0], x.dtype).reshape(2, 1, *[1] * (u.ndim - 1))
    best = jnp.argmax(rising * speeds, axis=1)  # [fastest or slowest, *contacts]
    chosen = best[:, None] == jnp.arange(len(x)).reshape(1, -1, *[1] * (u.ndim - 1))
    slope = jnp.sum(jnp.where(chosen, rising * slopes, 0.0), axis=1)
    # Slip that only rises, or only falls, turns nowhere: the end of the step is looked at anyway, and at its beginning the
    # series is the law.
    at_end = (best == len(x) - 1) & (slope >= 0)
    at_begin = (best == 0) & (rising[:, 0] * u[1] <= 0)
    inside = ~(at_end | at_begin)

    def going(carry):
        _, change, count = carry
        return jnp.any(jnp.abs(change) > NEAR) & (count < TURNING_STEPS)

    def nearer(carry):
        x, _, count = carry
        further = jnp.where(inside, extremum(u, x, 0.0, jnp.ones_like(x), 1), x)
        return further, further - x, count + 1

    begin = x[best], jnp.where(inside, 1.0, 0.0).astype(x.dtype), jnp.zeros((), jnp.int32)
    return jnp.ravel(jax.lax.while_loop(going, nearer, begin)[0])
