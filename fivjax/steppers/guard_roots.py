"""Where guards run out along a step, from their Taylor series."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from .. import contact as physics
from ..contact import Mechanics
from ..contact.rounding import zero_at_start
from ..foundation.polynomial import ratio, value_and_slope, value_slope_and_bend

MOST_ROOT_STEPS = 60
# A guard that starts further below zero, in shares of its size, has been put there by a jump: of the load, or of the forces of
# another contact. What is not is the error of the series by which the last advance ended.
JUMPED = 1e3


def together(
    mechanics: Mechanics, scaled: Float[Array, "k g"], fires: Bool[Array, " g"], first: Float[Array, ""]
) -> Bool[Array, " g"]:
    """Which of the guards of several contacts that run out at the end of the advance are one event.

    An event of one contact acts at once on the contacts that the mass matrix couples with it. So their simultaneous events,
    even if the instants differ by rounding, are one event. Simultaneous events of other contacts follow one after another,
    perhaps with no time in between: each then has its own instant, and its own derivative.
    """
    count = 2 * len(mechanics.places)
    chosen = jax.lax.argmax(fires, 0, jnp.int32)
    contact = jnp.minimum(chosen, count - 1) // 2
    among = physics.affected_by(mechanics, jnp.arange(count // 2) == contact)
    own = jnp.arange(count) // 2 == chosen // 2
    own_guards = jax.lax.stop_gradient(scaled[:, :count])
    values, slopes = value_and_slope(own_guards, first)
    size = jnp.sum(jnp.abs(own_guards), axis=0)
    nearly = (values <= 64 * jnp.finfo(size.dtype).eps * size) & (slopes < 0)
    coupled = jnp.repeat(among, 2) & jnp.any(fires[:count])
    of_contacts = coupled & (fires[:count] | (nearly & ~own))
    # The row of the section, if there is one, belongs to no contact.
    return jnp.concatenate([of_contacts, fires[count:]])


def march_to_roots(
    c: Float[Array, "k g"],
    rounding: Float[Array, "3 g"] | None = None,
    exact: Bool[Array, " g"] | None = None,
    near: Float[Array, ""] | float = 1.0,
) -> tuple[Float[Array, " g"], Bool[Array, " g"]]:
    r"""How far in [0, 1] each polynomial $\sum c_k x^k$ is known to stay positive, and whether it has its first root there.

    It marches from zero by steps d in which no root is possible: a lower bound on the second derivative gives
    $g + g' d - B_2 d^2 / 2 > 0$, and where $g$, $g'$ and $g''$ are positive, one on the third gives
    $g' + g'' d / 2 - B_3 d^2 / 6 > 0$, which is needed at the flat start after a lift-off. On [0, 1] the negative coefficients
    alone give the bounds. So no root is skipped, a dip below zero inside the interval is found at its first crossing, and near
    a simple root the march converges quadratically. Roots at zero, where the status began, are divided out; with an `exact`
    start, a small value there is no rounding error. What is small is told on [0, `near`]: over a long time a straight motion
    makes any value at the start small. A march that uses up its steps has still shown that there is no root up to where it
    came; and one that has passed the root of an earlier polynomial ends there.
    """
    count = c.shape[1]
    rounding = jnp.zeros((3, count), c.dtype) if rounding is None else rounding
    exact = jnp.zeros(count, bool) if exact is None else exact

    def further(first, of_one):
        # Roots that differ by rounding only are found.
        x, found = _first_root(*of_one, near=near, until=jnp.minimum(first * (1 + 16 * jnp.finfo(c.dtype).eps), 1.0))
        return jnp.minimum(first, x), (x, found)

    # One after the other: a march of few steps does not wait for a long one.
    return jax.lax.scan(further, jnp.ones((), c.dtype), (c.T, rounding.T, exact))[1]


def _first_root(
    c: Float[Array, " k"], rounding: Float[Array, "3"], exact: Bool[Array, ""], *, near, until
) -> tuple[Float[Array, ""], Bool[Array, ""]]:
    eps, sizes = float(jnp.finfo(c.dtype).eps), jnp.abs(c)
    size = jnp.sum(sizes)
    of_near = size - (1 - near) * (size - sizes[0])
    powers = [1.0, near, near * near]
    first = [[own[k] * power for k, power in enumerate(powers)] for own in (c, rounding)]
    one, two, three = zero_at_start(first[0], of_near, first[1], exact)
    for by, divided in ((2, two), (1, (one & ~two) | three)):
        c = jnp.where(divided, jnp.concatenate([c[by:], jnp.zeros(by, c.dtype)]), c)
    k = np.arange(len(c))
    falling = jnp.where(c < 0, -c, 0.0)
    # Its negative coefficients alone cannot use it up.
    lasts = c[0] > jnp.sum(falling[1:])
    bound_2, bound_3 = (jnp.sum(falling * of.astype(c.dtype)) for of in (k * (k - 1), k * (k - 1) * (k - 2)))
    huge = 1.0 / eps
    # Already used up: after a jump of the load, or if the last advance ended short of the root by rounding.
    spent = c[0] < 0

    def going(carry):
        x, step, count = carry
        return ~spent & (x < until) & (step > 2 * eps * x) & (count < MOST_ROOT_STEPS)

    def cubic(slope, bend):
        return ratio(0.5 * bend + jnp.sqrt(0.25 * bend**2 + (2 / 3) * bound_3 * slope), bound_3 / 3, huge)

    def march(carry):
        x, _, count = carry
        value, slope, bend = jax.lax.cond(
            x > 0, lambda x: value_slope_and_bend(c, x), lambda x: (c[0], c[1], 2 * c[2]), x
        )
        value = jnp.where(value > 0, value, 0.0)
        root = jnp.sqrt(slope**2 + 2 * bound_2 * value)
        # Two forms of the same root, each used where it has no cancellation.
        falls = slope < 0
        step = ratio(jnp.where(falls, 2 * value, slope + root), jnp.where(falls, root - slope, bound_2), huge)
        rises = (slope >= 0) & (bend >= 0)
        step = jax.lax.cond(rises, lambda *way: jnp.maximum(step, cubic(*way)), lambda *_: step, slope, bend)
        return x + step, step, count + 1

    none = jnp.zeros_like(size)
    begin = jnp.where(lasts, 1.0, none), none + 1, jnp.zeros((), jnp.int32)
    x, step, _ = jax.lax.while_loop(going, march, begin)
    found = spent | ((x < until) & (step <= 2 * eps * x))
    return jnp.where(size > 0, jnp.minimum(x, 1.0), 1.0), found & (size > 0)


def implicit_root(
    scaled: Float[Array, "k g"], fires: Bool[Array, " g"], x: Float[Array, ""], tolerance: float
) -> Float[Array, ""]:
    """The root `x` of the guards that fire, with the derivatives of an implicit function, of any order; of a series with this
    relative error.

    Where a jump has used up the guard at x = 0, no root moves: the event is at the instant of the jump.
    """
    # An index of 64 bits could not be lowered in a single-precision program.
    chosen = jnp.arange(fires.shape[0]) == jax.lax.argmax(fires, 0, jnp.int32)
    size = jnp.sum(jnp.where(chosen, jnp.abs(scaled), 0.0))
    least = jnp.sum(jnp.where(chosen, scaled[0], 0.0))
    rounding = JUMPED * max(tolerance, float(jnp.finfo(scaled.dtype).eps)) * size
    jumped = jax.lax.stop_gradient((x == 0) & (least < -rounding))
    return _moving_root(scaled, jax.lax.stop_gradient(x), jnp.where(jumped, False, chosen))


@jax.custom_jvp
def _moving_root(c: Float[Array, "k g"], x: Float[Array, ""], chosen: Bool[Array, " g"]) -> Float[Array, ""]:
    """x, which is a root of the chosen polynomial; if none is chosen, it stays."""
    del c, chosen
    return x


@_moving_root.defjvp
def _(primals, tangents):
    c, _, chosen = primals
    # With its own derivative, so that further ones are right as well.
    x = _moving_root(*primals)
    value, _ = value_and_slope(tangents[0], x)
    _, slope = value_and_slope(c, x)
    value, slope = (jnp.sum(jnp.where(chosen, part, 0.0)) for part in (value, slope))
    return x, -value / jnp.where(slope == 0, 1.0, slope)
