"""Where guards run out along a step, from their Taylor series."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from .. import contact as physics
from ..contact import Mechanics
from ..contact.rounding import zero_at_start
from ..foundation.polynomial import moving_root, ratio, value_and_slope, value_slope_and_bend

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


class _Guards(NamedTuple):
    """Guards as polynomials on [0, 1], without what is no more than rounding at their start."""

    c: Float[Array, "k g"]
    begin: Float[Array, " g"]  # up to here there is no root
    spent: Bool[Array, " g"]  # at the start: by a jump, or where the last advance ended a rounding before a root
    scale: Float[Array, " g"]  # one over the size
    # Relative to the size, the second derivative is nowhere less than minus the first of these, and a third of the third
    # derivative between minus the second and the last.
    bound_2: Float[Array, " g"]
    bound_3: Float[Array, " g"]
    largest_3: Float[Array, " g"]
    over_bound_3: Float[Array, " g"]  # one over the second of these


def march_to_roots(
    c: Float[Array, "k g"],
    rounding: Float[Array, "3 g"] | None = None,
    exact: Bool[Array, " g"] | None = None,
    near: Float[Array, ""] | float = 1.0,
    ends: Bool[Array, " g"] | bool = True,
) -> tuple[Float[Array, " g"], Bool[Array, " g"]]:
    r"""How far in [0, 1] each polynomial $\sum c_k x^k$ is known to stay positive, and whether it has its first root there.

    The negative coefficients alone bound it from below: where $c_0$ to $c_k$ are not negative, there is no root before $c_k$ is
    used up by their sum. From there it marches by steps d in which no root is possible. They bound the second and the third
    derivative, too: by $-B_2$ and $-B_3$. So up to a distance D there is $g + g' d - B d^2 / 2 > 0$ with
    $B = \min(B_2, B_3 D / 3 - g'')$; with $D = 2 g / |g'|$ the march converges cubically near a simple root. Where g rises, it
    is not lower up to $d = 3 g'' / B_3$: steps grow on the way from where it and its derivatives are next to zero. No root is
    skipped, and a dip below zero inside the interval is found at its first crossing.

    A root at zero, where the status began, does not count; with an `exact` start, a small value there is no rounding error.
    What is small is told on [0, `near`]: over a long time a straight motion makes any value at the start small. A march that
    uses up its steps has still shown that there is no root up to where it came. Behind the root of a polynomial that `ends` the
    advance none goes on.
    """
    count = c.shape[1]
    rounding = jnp.zeros((3, count), c.dtype) if rounding is None else rounding
    exact = jnp.zeros(count, bool) if exact is None else exact
    guards = _from_start(c, rounding, exact, near)

    def further(way):
        x, going, found, steps = way
        # Roots that differ by rounding only are found.
        first = jnp.min(jnp.where(found & ends, x, 1.0))
        until = jnp.minimum(first * (1 + 16 * jnp.finfo(c.dtype).eps), 1.0)
        there, is_root = _further(guards, x, until)
        x, found = jnp.where(going, there, x), found | (going & is_root)
        return x, going & ~is_root & (x < until), found, steps + 1

    begin = guards.begin, ~guards.spent & (guards.begin < 1), guards.spent, jnp.zeros((), jnp.int32)
    x, _, found, _ = jax.lax.while_loop(lambda way: jnp.any(way[1]) & (way[3] < MOST_ROOT_STEPS), further, begin)
    return x, found


def _from_start(
    c: Float[Array, "k g"], rounding: Float[Array, "3 g"], exact: Bool[Array, " g"], near: Float[Array, ""] | float
) -> _Guards:
    k = np.arange(len(c))
    # By these, the coefficients make the sum of all, and bounds on the second derivative and on a third of the third.
    weights = np.array([np.ones(len(c)), k * (k - 1), k * (k - 1) * (k - 2) / 3], c.dtype)
    first, later = c[:3], c[3:]

    def more(sums, row):
        own, weights = row
        return [total + weights[:, None] * part for total, part in zip(sums, (jnp.abs(own), own), strict=True)], None

    # A loop that XLA unrolls, and that kernels keep.
    none = jnp.zeros((3, c.shape[1]), c.dtype)
    (sizes, sums), _ = jax.lax.scan(more, [none, none], (later, weights.T[3:]), unroll=True)
    size = sizes[0] + jnp.sum(jnp.abs(first), axis=0)
    of_near = size - (1 - near) * (size - jnp.abs(first[0]))
    powers = jnp.stack([near**j * jnp.ones_like(size) for j in range(3)])
    zero = zero_at_start(first * powers, of_near, rounding * powers, exact)
    first = jnp.where(jnp.stack(zero), 0.0, first)
    lead, largest, none_falls = first[0], first[0], first[0] >= 0
    for own in (first[1], first[2], *later[:2]):
        lead = jnp.where(lead == 0, own, lead)
        none_falls = none_falls & (own >= 0)
        largest = jnp.where(none_falls, jnp.maximum(largest, own), largest)
    # The sums of negative coefficients alone are half of the difference of both.
    falling = 0.5 * (sizes - sums) + jnp.tensordot(weights[:, :3], jnp.maximum(-first, 0.0), 1)
    spent, scale = lead < 0, ratio(1.0, size, 0.0)
    begin = jnp.where(spent, 0.0, jnp.minimum(ratio(largest, falling[0], 1.0), 1.0))
    bound_3 = scale * falling[2]
    bounds = scale * falling[1], bound_3, scale * sizes[2], ratio(1.0, bound_3, jnp.inf)
    return _Guards(jnp.concatenate([first, later]), begin, spent, scale, *bounds)


def _further(
    guards: _Guards, x: Float[Array, " g"], until: Float[Array, ""]
) -> tuple[Float[Array, " g"], Bool[Array, " g"]]:
    """A step along guards, up to `until` at most; and whether their roots are where it ends."""
    eps = float(jnp.finfo(x.dtype).eps)
    value, slope, bend = (guards.scale * own for own in value_slope_and_bend(guards.c, x))
    value = jnp.where(value > 0, value, 0.0)
    falls, far, steep = slope < 0, until - x, slope**2
    bound = jnp.minimum(guards.bound_3 * far - bend, guards.bound_2)
    # Where it falls, both times the square of the slope: then D needs no division.
    by_third = steep**2 - 2 * value * (2 * guards.bound_3 * value * slope + bend * steep)
    by_second = steep * (steep + 2 * guards.bound_2 * value)
    under_root = jnp.where(falls, jnp.minimum(by_third, by_second), steep + 2 * bound * value)
    root = jnp.sqrt(jnp.maximum(under_root, 0.0))
    step = ratio(jnp.where(falls, -2 * value * slope, slope + root), jnp.where(falls, steep + root, bound), 1.0)
    step = jnp.where(falls, step, jnp.maximum(step, jnp.where(bend > 0, bend * guards.over_bound_3, 0.0)))
    inside = step < far
    x = jnp.where(inside, x + step, until)
    # After a step that ends at the root but for rounding, none more is needed to see it.
    at_root = falls & (root > 0) & (2 * guards.largest_3 * value * step**2 <= eps * x * steep)
    return x, inside & (x < until) & (at_root | (step <= 2 * eps * x))


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
    return moving_root(scaled, jax.lax.stop_gradient(x), jnp.where(jumped, False, chosen))
