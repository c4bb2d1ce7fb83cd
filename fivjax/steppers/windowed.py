"""Exact motion through many contact events, fast in large batches; for constant friction.

Within one status the motion is then linear: states a little later, two littles later, … are matrices times the state
now. One product of a small matrix with all lanes that share their mechanics samples a whole *window* of their future,
and the control points of the guards between the samples. They show the interval in which the status may end, and only
there its Taylor series, again a matrix times the state, is searched for the instant. What ends a status and what follows
is read from `contact`, as everywhere.

Lanes stand side by side along the last axis: these products are then matrix-matrix products, which is what a processor
does best, and everything else is plain arithmetic on rows of lanes. `jax.vmap` over lanes with common mechanics leads
here, too.
"""

import functools
import math
from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from .. import contact as physics
from ..contact import Contact, Mechanics, State, Status
from ..contact.rounding import RESTING, largest_rounding, zero_at_start
from ..foundation.compiling import computed_once
from ..foundation.polynomial import value_and_slope, value_slope_and_bend
from .base import Advance
from .section import Rise

# Intervals in a window, a power of two: long windows waste work after an event, short ones pay for their stages more often.
INTERVALS = 16
# The fastest vibration turns by this much between two samples, rad: guards look like cubics there.
TURN = 0.6
# Order of the Taylor series within an interval: TURN^16 / 16! is below rounding.
ORDER = 15
MOST_ROOT_STEPS = 60
# Terms of the series in the steps of Newton's method that nearly all roots are found with: few while it is still far off.
ROOT_STEPS = (5, 5, ORDER)
# Rows of all matrices of a scene per coordinate, about; for those who have to know how much memory they take.
MATRIX_ROWS = 4 * (INTERVALS + ORDER)


class Propagators(eqx.Module):
    """The matrices of one scene. Their columns are those of `_stacked`: the four ways to be in contact, side by side."""

    mechanics: Mechanics
    interval: Float[Array, ""]  # between two samples, s
    window: Float[Array, "r c"]  # see `_Window`
    series: Float[Array, "q c"]  # see `_Series`
    sizes: Float[Array, "8 c"]  # rounding of the guards' first three coefficients, and how far they are from cubics


class Windowed(eqx.Module):
    """`EventExact` for many lanes at once: the same motion to rounding, from matrices prepared per scene.

    It needs constant friction and gives no derivatives. `lanes` uses it in place of `EventExact` where it can, by the same
    three names as any stepper's: `round`, `prepare` and `advance`.
    """

    dt: ClassVar = np.inf
    round: ClassVar = 16

    def prepare(self, mechanics: Mechanics) -> Propagators:
        return propagators(mechanics)

    def advance(
        self,
        prepared: Propagators,
        contact: Contact,
        load: Float[Array, ""],
        y: State,
        h: Float[Array, ""],
        at_section: bool = False,
    ) -> Advance:
        del at_section  # the crossing is read off the window's samples
        return _advance_one(prepared, contact, load, y, h)


@jax.custom_batching.custom_vmap
def _advance_one(prepared: Propagators, contact: Contact, load, y: State, h) -> Advance:
    lane = jax.tree.map(lambda leaf: leaf[..., None], (contact, load, y, h))
    return jax.tree.map(lambda leaf: leaf[..., 0], _advance(prepared, *lane))


@_advance_one.def_vmap
def _advance_many(size: int, batched, prepared: Propagators, *lanes):
    """Lanes with common mechanics go side by side along the last axis; others have nothing to share."""
    axes = jax.tree.map(lambda is_batched: 0 if is_batched else None, tuple(batched))
    if any(jax.tree.leaves(batched[0])):
        after = jax.vmap(_advance_one.fun, in_axes=axes)(prepared, *lanes)
    else:

        def side_by_side(leaf, axis):
            return jnp.broadcast_to(leaf[..., None], (*leaf.shape, size)) if axis is None else jnp.moveaxis(leaf, 0, -1)

        lanes = [jax.tree.map(side_by_side, leaf, axis) for leaf, axis in zip(lanes, axes[1:], strict=True)]
        after = jax.tree.map(lambda leaf: jnp.moveaxis(leaf, -1, 0), _advance(prepared, *lanes))
    return after, jax.tree.map(lambda _: True, after)


def _advance(
    prepared: Propagators, contact: Contact, load: Float[Array, " l"], y: Float[Array, "2n l"], h: Float[Array, " l"]
) -> Advance:
    """One advance of lanes side by side: to the next event, the end of the step or that of the window, whichever comes
    first.
    """
    mechanics, n = prepared.mechanics, y.shape[0] // 2
    steps = jnp.minimum(h / prepared.interval, INTERVALS)
    here = _stacked(mechanics, contact, load, y)
    exact = physics.exactly_zero(contact)
    window = _Window(prepared.window @ here, prepared.sizes @ jnp.abs(here), exact, n, mechanics.tangential)
    none, no_state = jnp.zeros_like(load), jnp.zeros_like(y)

    interval = computed_once(lambda: window.safe_intervals(steps), none.astype(jnp.int32))
    state, peak = computed_once(lambda: (window.state_at(interval), window.peak(interval)), (no_state, none))
    rises, around = computed_once(lambda: window.rise(interval), (none > 0, (no_state, no_state)))
    there = _stacked(mechanics, contact, load, state)
    series = _Series(prepared.series @ there, prepared.sizes @ jnp.abs(there), exact, n)
    no = jnp.zeros((2, *none.shape), bool)
    guess = jnp.zeros((2, *none.shape), none.dtype)
    like = _Bracket(guess, no.astype(jnp.int32), guess, no, no, no)
    brackets = _dipped(series, computed_once(lambda: series.brackets(interval < INTERVALS), like))
    end = jnp.where(interval == INTERVALS, 0.0, jnp.minimum(steps - interval, 1.0))
    share, fires = _first_root(series, brackets, end)

    velocity = n + mechanics.tangential

    def follow():
        reached = series.state(share)
        reached = jnp.where(jnp.arange(2 * n)[:, None] >= n, reached / prepared.interval, reached)
        next_contact, y_next = over_lanes(reached, contact, load, fires)
        # The last rise is the one that counts: in what is left of the interval, after the window's.
        later = (state[velocity] < 0) & (reached[velocity] >= 0)
        before, after = jnp.where(later, state, around[0]), jnp.where(later, reached, around[1])
        at = _rise(before, after, prepared.interval * jnp.where(later, share, 1.0), mechanics.tangential)
        jumps = (reached[velocity] < 0) & (y_next[velocity] >= 0)
        rise = Rise(rises | later | jumps, jnp.where(jumps, y_next, at))
        return jnp.maximum(peak, jnp.abs(reached[velocity])), next_contact, y_next, rise, reached

    @functools.partial(jax.vmap, in_axes=(-1, 0, 0, -1), out_axes=(0, -1))
    def over_lanes(reached, contact, load, fires):
        state = physics.on_constraint(mechanics, contact, reached)
        return physics.transition(mechanics, contact, load, state, fires, RESTING[state.dtype.name] * prepared.interval)

    like = none, contact, no_state, Rise(none > 0, no_state), no_state
    peak, next_contact, y_next, rise, end = computed_once(follow, like)
    return Advance(y_next, next_contact, (interval + share) * prepared.interval, peak, rise, end, fires)


def _rise(
    before: Float[Array, "2n l"], after: Float[Array, "2n l"], h: Float[Array, " l"], tangential: int
) -> Float[Array, "2n l"]:
    """Where the tangential velocity rises through zero between two states a time `h` (s) apart, on cubics through both.

    It is off by some thousandths, and by the same ones whenever the motion is the same: as good a place to compare orbits
    at as the rise itself, which an advance would have to end at.
    """
    n = before.shape[0] // 2
    h = jnp.where(h > 0, h, 1.0)
    way = (after[:n] - before[:n]) / h
    slope = 2 * (3 * way - 2 * before[n:] - after[n:])
    bend = 3 * (before[n:] + after[n:] - 2 * way)
    value, first, second = before[n + tangential], slope[tangential], bend[tangential]
    x = jnp.clip(_parabola_root(-value, -first, -second), 0.0, 1.0)
    velocity = before[n:] + x * (slope + x * bend)
    velocity = jnp.where(jnp.arange(n)[:, None] == tangential, 0.0, velocity)
    return jnp.concatenate([before[:n] + h * x * (before[n:] + x * (slope / 2 + x * bend / 3)), velocity])


def propagators(mechanics: Mechanics) -> Propagators:
    """The matrices for one scene with constant friction."""
    n = mechanics.free_load.shape[0]
    ways = _ways(mechanics.free_load.dtype)
    generators, guards = jax.vmap(lambda way: _affine(mechanics, way))(ways)
    interval = TURN / jnp.max(jax.vmap(_spectral_radius)(generators))
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
    window = [coefficients[:4], hulls, control, samples[:, :, : 2 * n]]
    series = [coefficients, jnp.sum(coefficients, axis=0), powers[:, :, :n]]

    sizes, rates = jax.vmap(lambda way: _magnitudes(mechanics, way))(ways)
    terms = jnp.stack([sizes, sizes @ rates * interval, sizes @ rates @ rates * (0.5 * interval**2)])
    # A cubic with the values and slopes of both ends is off by at most a 384th of the fourth derivative; twice that is
    # what the derivative may grow to between samples.
    uncubic = jnp.max(jnp.abs(coefficients[4] @ samples), axis=0) * (2 * math.factorial(4) / 384)
    rounding = [largest_rounding(terms), uncubic]

    def table(parts: list[Float[Array, "*k 4 x c"]]) -> Float[Array, "r c"]:
        flat = [jnp.moveaxis(part, -3, 0).reshape(4, -1, 2 * n + 2) for part in parts]
        rows = jnp.concatenate(flat, axis=1)
        closed, everything = _columns(n, mechanics.normal)
        return jnp.concatenate([*(rows[way][:, closed] for way in range(3)), rows[3][:, everything]], axis=1)

    return Propagators(mechanics, interval, table(window), table(series), table(rounding))


def _bernstein(order: int) -> np.ndarray:
    """From a polynomial's coefficients to its control points on [0, 1]: it lies in their convex hull."""
    return np.array([[math.comb(j, k) / math.comb(order, k) for k in range(order + 1)] for j in range(order + 1)])


def _ways(dtype) -> Contact:
    """Sticking, sliding in either direction, detached."""
    status = jnp.array([Status.STICK, Status.SLIDE, Status.SLIDE, Status.DETACH], jnp.int32)
    return Contact(status, jnp.array([1.0, 1.0, -1.0, 1.0], dtype))


def _columns(n: int, normal: int) -> tuple[np.ndarray, np.ndarray]:
    """What of (state, load, 1) is not zero: in contact, when there is neither gap nor gap rate, and detached."""
    everything = np.arange(2 * n + 2)
    return everything[(everything != normal) & (everything != n + normal)], everything


def _stacked(
    mechanics: Mechanics, contact: Contact, load: Float[Array, " l"], y: Float[Array, "2n l"]
) -> Float[Array, "c l"]:
    """(state, load, 1) in the columns of the way the contact is in, zero in the others."""
    n, normal = y.shape[0] // 2, mechanics.normal
    rest = jnp.stack([load, jnp.ones_like(load)])
    closed = jnp.concatenate([y[:normal], y[normal + 1 : n + normal], y[n + normal + 1 :], rest])
    sliding = contact.status == Status.SLIDE
    ways = [contact.status == Status.STICK, sliding & (contact.direction > 0), sliding & (contact.direction < 0)]
    columns = [jnp.where(way, closed, 0.0) for way in ways]
    return jnp.concatenate([*columns, jnp.where(contact.status == Status.DETACH, jnp.concatenate([y, rest]), 0.0)])


def _affine(mechanics: Mechanics, contact: Contact) -> tuple[Float[Array, "m m"], Float[Array, "2 m"]]:
    """Rates and guards in one way of contact, as matrices on (state, load, 1)."""
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
    """`contact.magnitudes` as matrices on the sizes of (state, load, 1): of the guards, and of the rates."""
    n = mechanics.free_load.shape[0]

    def sizes(v):
        guards, rates = physics.magnitudes(mechanics, contact, v[2 * n], v[: 2 * n])
        return jnp.concatenate([guards, rates])

    zero = jnp.zeros(2 * n + 1, mechanics.free_load.dtype)
    # The load is a size like the others: the slope of its own size at zero is one.
    matrix = jnp.concatenate([jax.jacfwd(sizes)(zero.at[2 * n].set(1.0)), sizes(zero)[:, None]], axis=1)
    unchanging = jnp.zeros((2, 2 * n + 2), zero.dtype)
    return matrix[:2], jnp.concatenate([matrix[2:], unchanging])


def _spectral_radius(matrix: Float[Array, "m m"]) -> Float[Array, ""]:
    """By Gelfand's formula, the 64th root of the size of the 64th power: a little too large, never too small."""

    def squared(carry, _):
        log_size, matrix = carry
        size = jnp.max(jnp.abs(matrix))
        size = jnp.where(size > 0, size, 1.0)
        return (2 * (log_size + jnp.log(size)), (matrix / size) @ (matrix / size)), None

    (log_size, matrix), _ = jax.lax.scan(squared, (jnp.zeros((), matrix.dtype), matrix), length=6)
    return jnp.exp((log_size + jnp.log(jnp.linalg.norm(matrix) + jnp.finfo(matrix.dtype).tiny)) / 64)


class _Window(eqx.Module):
    """The future of lanes side by side, at the ends of the intervals and between them."""

    rows: Float[Array, "r l"]
    sizes: Float[Array, "8 l"]
    exact: Bool[Array, "2 l"]  # see `contact.exactly_zero`
    n: int = eqx.field(static=True)
    tangential: int = eqx.field(static=True)

    @property
    def parts(self) -> list[Array]:
        """First coefficients of the guards at the start; control points of their series there; their control points as
        cubics in each interval; samples of the state.
        """
        return _parts(self.rows, (4, 2), (ORDER, 2), (3, INTERVALS, 2), (INTERVALS + 1, 2 * self.n))

    @property
    def speed(self) -> Float[Array, "i l"]:
        """Samples of the tangential velocity."""
        return self.parts[-1][:, self.n + self.tangential]

    def safe_intervals(self, steps: Float[Array, " l"]) -> Int[Array, " l"]:
        """How many intervals from the start on are certain to hold no event and no end of the step (`steps` intervals
        off): a polynomial stays positive where its control points are.
        """
        start, hull, control, _ = self.parts
        limits, uncubic = self.sizes[:6].reshape(3, 2, -1), self.sizes[6:]
        safe = jnp.minimum(jnp.minimum(control[0], control[1]), control[2]) > uncubic  # [interval, guard, lane]
        # In the first interval a guard may start at zero, because its status has just begun.
        zeros, lead = _start(start, limits, self.exact)
        first_safe = (lead > 0) & (_least(hull[2:]) > 0)
        first_safe = first_safe & ((zeros >= 2) | (hull[0] > 0)) & ((zeros >= 3) | (hull[1] > 0))
        index = jnp.arange(INTERVALS)[:, None]
        safe = safe[:, 0] & safe[:, 1] | (index == 0)
        first = _least(jnp.where(safe, INTERVALS, index).astype(jnp.int32))
        first = jnp.where(first_safe[0] & first_safe[1], first, 0)
        return jnp.minimum(first, jnp.floor(steps).astype(jnp.int32))

    def state_at(self, interval: Int[Array, " l"]) -> Float[Array, "2n l"]:
        """The state where an interval begins."""
        samples = self.parts[-1]
        return jnp.where(interval == INTERVALS, samples[INTERVALS], _chosen(samples[:INTERVALS], interval))

    def rise(self, interval: Int[Array, " l"]) -> tuple[Bool[Array, " l"], tuple[Array, Array]]:
        """Whether the tangential velocity rises through zero before the beginning of an interval, and the samples of the
        state around the last time.
        """
        samples, speed, index = self.parts[-1], self.speed, jnp.arange(INTERVALS)[:, None]
        rises = (speed[:-1] < 0) & (speed[1:] >= 0) & (index < interval)
        last = -_least(jnp.where(rises, -index, 1).astype(jnp.int32))
        return last >= 0, (_chosen(samples[:-1], last), _chosen(samples[1:], last))

    def peak(self, interval: Int[Array, " l"]) -> Float[Array, " l"]:
        """The largest tangential speed up to the beginning of an interval."""
        speed = jnp.abs(self.speed)
        return -_least(jnp.where(jnp.arange(INTERVALS + 1)[:, None] <= interval, -speed, 0.0))


class _Series(eqx.Module):
    """Taylor series of lanes side by side from the beginning of an interval, in units of the interval."""

    rows: Float[Array, "q l"]
    sizes: Float[Array, "8 l"]
    exact: Bool[Array, "2 l"]  # see `contact.exactly_zero`
    n: int = eqx.field(static=True)

    @property
    def parts(self) -> list[Array]:
        """Coefficients of the guards; their values at the end of the interval; coefficients of the displacements."""
        return _parts(self.rows, (ORDER + 1, 2), (2,), (ORDER + 2, self.n))

    def brackets(self, inside: Bool[Array, " l"]) -> "_Bracket":
        """Of each guard; at the end of the window, not `inside` an interval, there is nothing to look for."""
        c, end, _ = self.parts
        zeros, lead = _start(c, self.sizes[:6].reshape(3, 2, -1), self.exact)
        spent = inside & (lead < 0)
        crosses = inside & (lead >= 0) & (end <= 0)
        slope = jnp.where(zeros == 0, c[1], jnp.where(zeros == 1, c[2], jnp.where(zeros == 2, c[3], c[4])))
        bend = end - lead - slope
        guess = _parabola_root(lead, slope, bend)
        bottom = -slope / (2 * jnp.where(bend > 0, bend, 1.0))
        # With allowance for what is not parabolic.
        dips = inside & (lead > 0) & (end > 0) & (slope < 0) & (slope + 2.2 * bend > 0)
        dips = dips & (lead + 0.5 * slope * bottom <= 0.1 * bend)
        guess = jnp.where(crosses, jnp.clip(guess, 0.0, 1.0), jnp.where(dips, jnp.clip(bottom, 0.0, 1.0), 1.0))
        return _Bracket(guess, zeros, jnp.ones_like(lead), crosses, spent, dips)

    def without_zeros(self, zeros: Int[Array, "2 l"]) -> Float[Array, "k 2 l"]:
        """The guards, their coefficients that are zero but for rounding exactly so."""
        c = self.parts[0]
        return jnp.where(zeros > jnp.arange(ORDER + 1)[:, None, None], 0.0, c)

    def state(self, x: Float[Array, " l"]) -> Float[Array, "2n l"]:
        """Displacements, and velocities in m per interval."""
        return jnp.concatenate(value_and_slope(self.parts[2], x))


def _parts(rows: Array, *shapes: tuple[int, ...]) -> list[Array]:
    """Rows cut into pieces of these shapes, lanes last."""
    ends = np.cumsum([math.prod(shape) for shape in shapes])
    return [
        rows[end - math.prod(shape) : end].reshape(*shape, -1) for shape, end in zip(shapes, ends.tolist(), strict=True)
    ]


def _parabola_root(lead: Array, slope: Array, bend: Array) -> Array:
    """Where lead + slope x + bend x² first falls to zero, if it does; in the form that does not cancel."""
    root = jnp.sqrt(jnp.maximum(slope**2 - 4 * bend * lead, 0.0))
    rises = slope > 0
    half = 0.5 * jnp.where(rises, slope + root, root - slope)
    below = jnp.where(rises, bend, half)
    return jnp.where(rises, -half, lead) / jnp.where(below == 0, 1.0, below)


def _chosen(rows: Float[Array, "i *x l"], index: Int[Array, " l"]) -> Float[Array, "*x l"]:
    """Of as many rows as a window has intervals the one with this index in each lane."""
    size = INTERVALS
    while size > 1:
        size //= 2
        rows = jnp.where((index & size) > 0, rows[size:], rows[:size])
    return rows[0]


def _least(rows: Array) -> Array:
    """The least along the first axis, by halves: XLA turns that, unlike a reduction, into plain arithmetic on lanes."""
    while rows.shape[0] > 1:
        half = rows.shape[0] // 2
        rest = rows[2 * half :]
        rows = jnp.minimum(rows[:half], rows[half : 2 * half])
        rows = jnp.concatenate([jnp.minimum(rows[:1], rest), rows[1:]]) if rest.shape[0] else rows
    return rows[0]


def _start(
    c: Float[Array, "k g l"], limits: Float[Array, "3 g l"], exact: Bool[Array, "g l"]
) -> tuple[Int[Array, "g l"], Float[Array, "g l"]]:
    """How many coefficients at the start are zero but for rounding, and the first that is not."""
    size = jnp.abs(c[0]) + jnp.abs(c[1]) + jnp.abs(c[2]) + jnp.abs(c[3])
    zeros, lead = jnp.zeros_like(size, jnp.int32), c[0]
    for k, zero in enumerate(zero_at_start(c, size, limits, exact)):
        zeros, lead = zeros + zero, jnp.where(zero, c[k + 1], lead)
    return zeros, lead


class _Bracket(eqx.Module):
    """What is known of the first roots of the guards in [0, 1] from their starts and ends."""

    guess: Float[Array, "2 l"]  # at the root; at the lowest point of one that perhaps dips; else 1
    zeros: Int[Array, "2 l"]  # roots at the very start, not meant
    end: Float[Array, "2 l"]  # where it is no longer positive, if it crosses
    crosses: Bool[Array, "2 l"]
    spent: Bool[Array, "2 l"]  # negative from the start
    dips: Bool[Array, "2 l"]  # positive at both ends, perhaps not in between


def _dipped(series: _Series, brackets: _Bracket) -> _Bracket:
    """The brackets of polynomials that seemed to dip below zero, decided at their lowest points; seldom run at all."""

    def decided(bracket: _Bracket) -> _Bracket:
        c = series.parts[0]

        def nearer(_, x):
            _, slope, bend = value_slope_and_bend(c, x)
            return jnp.clip(x - slope / jnp.where(bend > 0, bend, 1.0), 0.0, 1.0)

        # Newton's method: within an interval a slope is all but a straight line. It sets out from what the loop carries:
        # what depends on nothing else, XLA takes out of the loop and computes every time.
        lowest = jax.lax.fori_loop(0, 6, nearer, bracket.guess)
        below = bracket.dips & (value_and_slope(c, lowest)[0] <= 0)
        return _Bracket(
            guess=jnp.where(below, 0.5 * lowest, bracket.guess),
            zeros=bracket.zeros,
            end=jnp.where(below, lowest, bracket.end),
            crosses=bracket.crosses | below,
            spent=bracket.spent,
            dips=jnp.zeros_like(bracket.dips),
        )

    return jax.lax.while_loop(lambda bracket: jnp.any(bracket.dips), decided, brackets)


def _first_root(
    series: _Series, brackets: _Bracket, end: Float[Array, " l"]
) -> tuple[Float[Array, " l"], Bool[Array, "2 l"]]:
    """Where in its interval the advance ends, `end` at the latest, as a share of it, and which of the guards end it there."""
    crosses, spent = brackets.crosses, brackets.spent
    c = series.without_zeros(brackets.zeros)
    # A few steps for all at once cost less than a loop that goes on until the last lane is done.
    near = computed_once(lambda: _approached(c, brackets), brackets.guess)
    root, _, slope, settled = _newton(c, brackets.zeros, near)
    # In a bracket, the function falls through its root; a dip ends where it is lowest.
    settled = settled & (slope < 0) & (root > 0) & (root <= brackets.end)
    root, slope = _bisected(c, brackets, root, slope, crosses & ~settled)
    root = jnp.where(crosses, root, jnp.inf)
    first = jnp.minimum(root[0], root[1])
    # Roots that differ by rounding are the same: the two guards of an open gap always are.
    same = 8 * jnp.finfo(end.dtype).eps * sum(jnp.abs(c[k]) for k in range(4))
    fires = crosses & ((root == first) | ((root - first) * jnp.abs(slope) <= same))
    any_spent = spent[0] | spent[1]
    first, fires = jnp.where(any_spent, 0.0, first), jnp.where(any_spent, spent, fires)
    fires = fires & (first <= end)
    return jnp.where(fires[0] | fires[1], first, end), fires


def _approached(c: Float[Array, "k 2 l"], brackets: _Bracket) -> Float[Array, "2 l"]:
    """The first roots in their brackets to half of all digits and more, where Newton's method goes the common way."""
    x = jnp.minimum(brackets.guess, brackets.end)
    for order in ROOT_STEPS:
        x = jnp.clip(_newton(c[: order + 1], brackets.zeros, x)[0], 0.0, brackets.end)
    return x


def _newton(c: Float[Array, "k *x l"], zeros: Int[Array, "*x l"], x: Float[Array, "*x l"]):
    """After one step of Newton's method: where, value and slope before it, and whether it was so short that it is the last."""
    value, slope = value_and_slope(c, x)
    # Without the roots at zero, which are divided out of value and slope alike.
    slope = slope - zeros * value / jnp.where(x > 0, x, 1.0)
    nearer = x - value / jnp.where(slope == 0, 1.0, slope)
    # The next error is the square of this one.
    return nearer, value, slope, (jnp.abs(nearer - x) <= 1e-7) & (slope != 0)


def _bisected(
    c: Float[Array, "k *x l"], brackets: _Bracket, root: Float[Array, "*x l"], slope, open_: Bool[Array, "*x l"]
) -> tuple[Float[Array, "*x l"], Float[Array, "*x l"]]:
    """Roots and the slopes there, those of `open_` polynomials found anew: by Newton's method in their brackets, bisecting
    where it leaves them. Seldom run at all.
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
