"""A window of time ahead of many trajectories, and the Taylor series within one of its intervals."""

import math

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from ..contact.rounding import zero_at_start
from ..foundation.polynomial import value_and_slope
from .propagation import INTERVALS, ORDER


class Window(eqx.Module):
    """A window of time ahead of trajectories (last axis): samples at the ends of intervals, and bounds in between."""

    rows: Float[Array, "r l"]
    sizes: Float[Array, "8 l"]
    exact: Bool[Array, "2 l"]  # see `contact.exactly_zero`
    n: int = eqx.field(static=True)
    tangential: int = eqx.field(static=True)

    @property
    def parts(self) -> list[Array]:
        """The first coefficients of the guards at the start; the control points of their series there; their control points as
        cubics in each interval; samples of the state.
        """
        return _parts(self.rows, (4, 2), (ORDER, 2), (3, INTERVALS, 2), (INTERVALS + 1, 2 * self.n))

    @property
    def speed(self) -> Float[Array, "i l"]:
        """Samples of the tangential velocity."""
        return self.parts[-1][:, self.n + self.tangential]

    def safe_intervals(self, steps: Float[Array, " l"]) -> Int[Array, " l"]:
        """The number of intervals from the start that are certain to have no event and not the end of the step (after `steps`
        intervals): a polynomial is positive where its control points are.
        """
        start, hull, control, _ = self.parts
        limits, uncubic = self.sizes[:6].reshape(3, 2, -1), self.sizes[6:]
        safe = jnp.minimum(jnp.minimum(control[0], control[1]), control[2]) > uncubic  # [interval, guard, trajectory]
        index = jnp.arange(INTERVALS)[:, None]
        safe = safe[:, 0] & safe[:, 1] | (index == 0)
        first = least(jnp.where(safe, INTERVALS, index).astype(jnp.int32))
        first = jnp.where(first_is_safe(start, hull, limits, self.exact), first, 0)
        return jnp.minimum(first, jnp.floor(steps).astype(jnp.int32))

    def state_at(self, interval: Int[Array, " l"]) -> Float[Array, "state l"]:
        """The state where an interval begins."""
        samples = self.parts[-1]
        return jnp.where(interval == INTERVALS, samples[INTERVALS], chosen(samples[:INTERVALS], interval))

    def rise(self, interval: Int[Array, " l"]) -> tuple[Bool[Array, " l"], tuple[Array, Array]]:
        """Whether the tangential velocity rises through zero before the beginning of an interval, and the samples of the
        state around its last rise.
        """
        samples, speed, index = self.parts[-1], self.speed, jnp.arange(INTERVALS)[:, None]
        rises = (speed[:-1] < 0) & (speed[1:] >= 0) & (index < interval)
        last = -least(jnp.where(rises, -index, 1).astype(jnp.int32))
        return last >= 0, (chosen(samples[:-1], last), chosen(samples[1:], last))

    def first_rise(self) -> Int[Array, " l"]:
        """The first interval in which the tangential velocity rises through zero, by its samples."""
        speed, index = self.speed, jnp.arange(INTERVALS)[:, None]
        return least(jnp.where((speed[:-1] < 0) & (speed[1:] >= 0), index, INTERVALS).astype(jnp.int32))

    def highest_sample(self, steps: Float[Array, " l"]) -> Float[Array, " l"]:
        """The largest tangential speed among the samples within the first `steps` intervals."""
        return -least(jnp.where(jnp.arange(INTERVALS + 1)[:, None] <= steps, -jnp.abs(self.speed), 0.0))

    def fastest(self, steps: Float[Array, " l"], sign: float) -> Int[Array, " l"]:
        """The sample next to the highest peak of the tangential velocity, times `sign`, within the first `steps` intervals.

        The sample that is largest may belong to a lower peak: peaks are told by the parabolas through three samples.
        """
        return fastest(sign * self.speed, steps)


class Bracket(eqx.Module):
    """Brackets of the first roots of the guards in [0, 1], from values and derivatives at both ends."""

    guess: Float[Array, "2 l"]  # of the root; of the lowest point where the guard perhaps dips; else 1
    zeros: Int[Array, "2 l"]  # number of roots at the start, which do not count
    end: Float[Array, "2 l"]  # where the guard is no longer positive, if it crosses
    crosses: Bool[Array, "2 l"]
    spent: Bool[Array, "2 l"]  # negative from the start
    dips: Bool[Array, "2 l"]  # positive at both ends, but perhaps not in between


class Series(eqx.Module):
    """Taylor series of trajectories (last axis) from the beginning of an interval; time in units of the interval."""

    rows: Float[Array, "q l"]
    sizes: Float[Array, "8 l"]
    exact: Bool[Array, "2 l"]  # see `contact.exactly_zero`
    n: int = eqx.field(static=True)

    @property
    def parts(self) -> list[Array]:
        """Coefficients of the guards; values of the guards at the end of the interval; coefficients of the displacements."""
        return _parts(self.rows, (ORDER + 1, 2), (2,), (ORDER + 2, self.n))

    def brackets(self, inside: Bool[Array, " l"]) -> "Bracket":
        """The brackets of both guards. Where a trajectory is at the end of the window, not `inside` an interval, there are
        none.
        """
        c, end, _ = self.parts
        return bracketed(c, end, self.sizes[:6].reshape(3, 2, -1), self.exact, inside)

    def without_zeros(self, zeros: Int[Array, "2 l"]) -> Float[Array, "k 2 l"]:
        """The coefficients of the guards; the first `zeros`, which are zero up to rounding, are exactly zero."""
        c = self.parts[0]
        return jnp.where(zeros > jnp.arange(ORDER + 1)[:, None, None], 0.0, c)

    def speed(self, tangential: int) -> Float[Array, "k l"]:
        """The series of the tangential velocity, in m per interval."""
        return self.parts[2][1:, tangential] * jnp.arange(1.0, ORDER + 2)[:, None]

    def state(self, x: Float[Array, " l"]) -> Float[Array, "state l"]:
        """Displacements, and velocities in m per interval."""
        return jnp.concatenate(value_and_slope(self.parts[2], x))


def first_is_safe(
    start: Float[Array, "4 2 l"], hull: Float[Array, "k 2 l"], limits: Float[Array, "3 2 l"], exact: Bool[Array, "2 l"]
) -> Bool[Array, " l"]:
    """Whether the first interval is certain to have no event: a guard may start at zero there, because the status has just
    begun. From the first coefficients of the guards, the control points of their series, and the bounds on rounding.
    """
    zeros, lead = leading(start, limits, exact)
    safe = (lead > 0) & (least(hull[2:]) > 0) & ((zeros >= 2) | (hull[0] > 0)) & ((zeros >= 3) | (hull[1] > 0))
    return safe[0] & safe[1]


def bracketed(
    c: Float[Array, "k 2 l"],
    end: Float[Array, "2 l"],
    limits: Float[Array, "3 2 l"],
    exact: Bool[Array, "2 l"],
    inside: Bool[Array, " l"],
) -> Bracket:
    """The brackets of both guards from the first five coefficients of their series or more, their values at the `end`, and the
    bounds on rounding; none for trajectories that are not `inside` an interval.
    """
    zeros, lead = leading(c, limits, exact)
    spent = inside & (lead < 0)
    crosses = inside & (lead >= 0) & (end <= 0)
    slope = jnp.where(zeros == 0, c[1], jnp.where(zeros == 1, c[2], jnp.where(zeros == 2, c[3], c[4])))
    bend = end - lead - slope
    guess = parabola_root(lead, slope, bend)
    bottom = -slope / (2 * jnp.where(bend > 0, bend, 1.0))
    # The factors allow for the difference from a parabola.
    dips = inside & (lead > 0) & (end > 0) & (slope < 0) & (slope + 2.2 * bend > 0)
    dips = dips & (lead + 0.5 * slope * bottom <= 0.1 * bend)
    guess = jnp.where(crosses, jnp.clip(guess, 0.0, 1.0), jnp.where(dips, jnp.clip(bottom, 0.0, 1.0), 1.0))
    return Bracket(guess, zeros, jnp.ones_like(lead), crosses, spent, dips)


def fastest(speed: Float[Array, "i l"], steps: Float[Array, " l"]) -> Int[Array, " l"]:
    """The sample next to the highest peak within the first `steps` intervals, from all samples."""
    index = jnp.arange(INTERVALS + 1)[:, None]
    rise, bend = 0.5 * (speed[2:] - speed[:-2]), speed[2:] - 2.0 * speed[1:-1] + speed[:-2]
    bends = (bend < 0) & (jnp.abs(rise) <= -bend) & (rise <= -bend * (steps - index[1:-1]))
    above = jnp.where(bends, -0.5 * rise**2 / jnp.where(bends, bend, 1.0), 0.0)
    none = jnp.zeros_like(speed[:1])
    peak = jnp.where(index <= steps, speed + jnp.concatenate([none, above, none]), -jnp.inf)
    return least(jnp.where(peak == -least(-peak), index, INTERVALS).astype(jnp.int32))


def _parts(rows: Array, *shapes: tuple[int, ...]) -> list[Array]:
    """Rows cut into arrays of these shapes, with a last axis over trajectories."""
    ends = np.cumsum([math.prod(shape) for shape in shapes])
    return [
        rows[end - math.prod(shape) : end].reshape(*shape, -1) for shape, end in zip(shapes, ends.tolist(), strict=True)
    ]


def parabola_root(lead: Array, slope: Array, bend: Array) -> Array:
    """Where lead + slope x + bend x² first falls to zero, if it does; in the form without cancellation."""
    root = jnp.sqrt(jnp.maximum(slope**2 - 4 * bend * lead, 0.0))
    rises = slope > 0
    half = 0.5 * jnp.where(rises, slope + root, root - slope)
    below = jnp.where(rises, bend, half)
    return jnp.where(rises, -half, lead) / jnp.where(below == 0, 1.0, below)


def chosen(rows: Float[Array, "i *x l"], index: Int[Array, " l"]) -> Float[Array, "*x l"]:
    """For each trajectory the row with its index, of as many rows as a window has intervals."""
    size = INTERVALS
    while size > 1:
        size //= 2
        rows = jnp.where((index & size) > 0, rows[size:], rows[:size])
    return rows[0]


def least(rows: Array) -> Array:
    """The minimum along the first axis, by halves: unlike a reduction, XLA makes this elementwise arithmetic on
    trajectories.
    """
    while rows.shape[0] > 1:
        half = rows.shape[0] // 2
        rest = rows[2 * half :]
        rows = jnp.minimum(rows[:half], rows[half : 2 * half])
        rows = jnp.concatenate([jnp.minimum(rows[:1], rest), rows[1:]]) if rest.shape[0] else rows
    return rows[0]


def leading(
    c: Float[Array, "k g l"], limits: Float[Array, "3 g l"], exact: Bool[Array, "g l"]
) -> tuple[Int[Array, "g l"], Float[Array, "g l"]]:
    """How many of the first coefficients of guards are zero up to rounding, and the first one that is not."""
    size = jnp.abs(c[0]) + jnp.abs(c[1]) + jnp.abs(c[2]) + jnp.abs(c[3])
    zeros, lead = jnp.zeros_like(size, jnp.int32), c[0]
    for k, zero in enumerate(zero_at_start(c, size, limits, exact)):
        zeros, lead = zeros + zero, jnp.where(zero, c[k + 1], lead)
    return zeros, lead
