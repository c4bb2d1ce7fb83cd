"""The first root of the guards within an interval: bracketed, then refined by Newton's method."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from ..foundation.compiling import computed_once
from ..foundation.polynomial import extremum, value_and_slope, value_slope_and_bend
from .propagation import ORDER
from .window import Bracket, Series

MOST_ROOT_STEPS = 60
# Steps of Newton's method in a bracket, for the root of a velocity that changes sign in an interval; bisection is seldom
# needed.
RISE_STEPS = 12
# Steps of Newton's method for where a guard is lowest, and for a peak, from the sample next to it.
LOWEST_STEPS, PEAK_STEPS = 6, 5
# Terms of the series in each of the first steps of Newton's method, which are enough for nearly all roots: few at first.
ROOT_STEPS = (5, 5, ORDER)


def dipped(series: Series, brackets: Bracket) -> Bracket:
    """The brackets, with guards that perhaps dip below zero decided at their lowest points; seldom run."""

    def decided(bracket: Bracket) -> Bracket:
        c = series.parts[0]

        def nearer(_, x):
            _, slope, bend = value_slope_and_bend(c, x)
            return jnp.clip(x - slope / jnp.where(bend > 0, bend, 1.0), 0.0, 1.0)

        # Newton's method: within an interval the slope is nearly linear. It starts from the value that the outer loop carries;
        # XLA would move anything that does not depend on it out of the loop and compute it every time.
        lowest = jax.lax.fori_loop(0, LOWEST_STEPS, nearer, bracket.guess)
        below = bracket.dips & (value_and_slope(c, lowest)[0] <= 0)
        return Bracket(
            guess=jnp.where(below, 0.5 * lowest, bracket.guess),
            zeros=bracket.zeros,
            end=jnp.where(below, lowest, bracket.end),
            crosses=bracket.crosses | below,
            spent=bracket.spent,
            dips=jnp.zeros_like(bracket.dips),
        )

    return jax.lax.while_loop(lambda bracket: jnp.any(bracket.dips), decided, brackets)


def first_root(
    series: Series, brackets: Bracket, end: Float[Array, " l"]
) -> tuple[Float[Array, " l"], Bool[Array, "2 l"]]:
    """Where the advance ends, as a share of its interval, `end` at the latest; and which of the guards end it there."""
    crosses, spent = brackets.crosses, brackets.spent
    c = series.without_zeros(brackets.zeros)
    # A fixed number of steps for all costs less than a loop that goes on until the last trajectory is done.
    near = computed_once(lambda: _approached(c, brackets), brackets.guess)
    root, _, slope, settled = _newton(c, brackets.zeros, near)
    # In its bracket the guard falls through its root; the bracket of a dip ends at its lowest point.
    settled = settled & (slope < 0) & (root > 0) & (root <= brackets.end)
    root, slope = _bisected(c, brackets, root, slope, crosses & ~settled)
    root = jnp.where(crosses, root, jnp.inf)
    first = jnp.minimum(root[0], root[1])
    # Roots that differ by rounding are one event; the two guards of an open gap always are.
    same = 8 * jnp.finfo(end.dtype).eps * sum(jnp.abs(c[k]) for k in range(4))
    fires = crosses & ((root == first) | ((root - first) * jnp.abs(slope) <= same))
    any_spent = spent[0] | spent[1]
    first, fires = jnp.where(any_spent, 0.0, first), jnp.where(any_spent, spent, fires)
    fires = fires & (first <= end)
    return jnp.where(fires[0] | fires[1], first, end), fires


def first_rise(
    series: Series, tangential: int, end: Float[Array, " l"]
) -> tuple[Bool[Array, " l"], Float[Array, " l"]]:
    """Whether the tangential velocity has risen through zero by `end` (a share of the interval), and where, or `end`."""
    speed = series.speed(tangential)

    def at(x):
        return value_and_slope(speed, x)

    last = at(end)[0]
    rises = (speed[0] < 0) & (last >= 0)

    def nearer(carry):
        low, high, x, open_, count = carry
        value, slope = at(x)
        low, high = jnp.where(value < 0, x, low), jnp.where(value < 0, high, x)
        newton = x - value / jnp.where(slope == 0, 1.0, slope)
        inside = (newton >= low) & (newton <= high)
        # Quadratic convergence: the next error is the square of this one.
        settled = inside & (jnp.abs(newton - x) <= 1e-8 * end)
        return low, high, jnp.where(inside, newton, 0.5 * (low + high)), open_ & ~settled, count + 1

    def going(carry):
        *_, open_, count = carry
        return jnp.any(open_) & (count < RISE_STEPS)

    secant = end * speed[0] / jnp.where(rises, speed[0] - last, 1.0)
    found = jax.lax.while_loop(going, nearer, (jnp.zeros_like(end), end, secant, rises, 0))
    return rises, jnp.where(rises, found[2], end)


def highest(c: Float[Array, "k l"], low: Float[Array, " l"], high: Float[Array, " l"]) -> Float[Array, " l"]:
    """The largest |value| of a polynomial near x = 0, for x between `low` <= 0 and `high` >= 0."""
    x = extremum(c, jnp.zeros_like(high), low, high, PEAK_STEPS)
    return jnp.maximum(jnp.abs(c[0]), jnp.abs(value_and_slope(c, x)[0]))


def _approached(c: Float[Array, "k 2 l"], brackets: Bracket) -> Float[Array, "2 l"]:
    """The first roots in their brackets to more than half of all digits, where Newton's method converges as usual."""
    x = jnp.minimum(brackets.guess, brackets.end)
    for order in ROOT_STEPS:
        x = jnp.clip(_newton(c[: order + 1], brackets.zeros, x)[0], 0.0, brackets.end)
    return x


def _newton(c: Float[Array, "k *x l"], zeros: Int[Array, "*x l"], x: Float[Array, "*x l"]):
    """One step of Newton's method: the new x, value and slope at the old one, and whether no further step is needed."""
    value, slope = value_and_slope(c, x)
    # The slope of the polynomial with its roots at zero divided out, up to the common factor of value and slope.
    slope = slope - zeros * value / jnp.where(x > 0, x, 1.0)
    nearer = x - value / jnp.where(slope == 0, 1.0, slope)
    # Quadratic convergence: the next error is the square of this one.
    return nearer, value, slope, (jnp.abs(nearer - x) <= 1e-7) & (slope != 0)


def _bisected(
    c: Float[Array, "k *x l"], brackets: Bracket, root: Float[Array, "*x l"], slope, open_: Bool[Array, "*x l"]
) -> tuple[Float[Array, "*x l"], Float[Array, "*x l"]]:
    """Roots and slopes; those of `open_` polynomials are found anew by Newton's method in their brackets, with bisection where
    it leaves them. Seldom run.
    """

    def going(carry):
        *_, open_, count = carry
        return jnp.any(open_) & (count < MOST_ROOT_STEPS)

    def step(carry):
        low, high, x, slope, open_, count = carry
        nearer, value, slope_at, done = _newton(c, brackets.zeros, x)
        low, high = jnp.where(value > 0, x, low), jnp.where(value > 0, high, x)
        nearer = jnp.where(done | ((nearer > low) & (nearer < high)), nearer, 0.5 * (low + high))
        x, slope = jnp.where(open_, jnp.clip(nearer, 0.0, 1.0), x), jnp.where(open_, slope_at, slope)
        return low, high, x, slope, open_ & ~done, count + 1

    x = jnp.where(open_, jnp.minimum(brackets.guess, brackets.end), root)
    begin = jnp.zeros_like(x), brackets.end, x, slope, open_, jnp.zeros((), jnp.int32)
    _, _, root, slope, *_ = jax.lax.while_loop(going, step, begin)
    return root, slope
