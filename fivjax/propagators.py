"""Exact motion through many contact events, fast in large batches; for constant friction.

Within one status the motion is then linear: states a little later, two littles later, … are matrices times the state
now. One product of a small matrix with all lanes that share their mechanics samples a whole *window* of their future.
The samples of the guards show the interval in which the status may end, and only there its Taylor series, again a matrix
times the state, is searched for the instant. What ends a status and what follows is read from `contact`, as everywhere.

Under `jax.vmap` over lanes with common mechanics these products are matrix-matrix products, which is what a processor
does best. Between them stand a few stages of plain arithmetic, see `_stage`.
"""

import itertools
from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from . import contact as physics
from .contact import Contact, Mechanics, State, Status
from .steppers import Advance

# Intervals in a window: long windows waste work after an event, short ones pay for their stages more often.
INTERVALS = 16
# The fastest vibration turns by this much between two samples, rad: guards look like cubics there.
TURN = 0.35
# Order of the Taylor series within an interval: TURN^15 / 15! is below rounding.
ORDER = 14
# A guard whose first coefficients are this much smaller than all of them together starts at zero, but for rounding.
ROUNDING = (1e-12, 1e-9, 1e-9)
# Or if they are this many roundings of the terms that they are sums of.
ROUNDINGS = 64
# Rebounds shorter than this share of an interval are at rest.
RESTING = 1e-7
MOST_ROOT_STEPS = 60
# Rows of all matrices of a scene per coordinate, about; for those who have to know how much memory they take.
MATRIX_ROWS = 4 * (INTERVALS + ORDER)


class Propagators(eqx.Module):
    """The matrices of one scene. Their columns are those of `_stacked`: the four ways to be in contact, side by side."""

    mechanics: Mechanics
    interval: Float[Array, ""]  # between two samples, s
    window: Float[Array, "r c"]  # samples of guards, samples of states, series of the guards at the start
    series: Float[Array, "q c"]  # series of the guards and of the displacements, in units of the interval
    rounding: Float[Array, "6 c"]  # of the first three terms of the guards' series, on sizes of what the others act on


class Windowed(eqx.Module):
    """`EventExact` for many lanes at once: the same motion to rounding, from matrices prepared per scene.

    It needs constant friction and gives no derivatives. `lanes` uses it in place of `EventExact` where it can, by the same
    three names as any stepper's: `round`, `prepare` and `advance`.
    """

    dt: ClassVar = np.inf
    round: ClassVar = 32

    def prepare(self, mechanics: Mechanics) -> Propagators:
        return propagators(mechanics)

    def advance(
        self, prepared: Propagators, contact: Contact, load: Float[Array, ""], y: State, h: Float[Array, ""]
    ) -> Advance:
        mechanics = prepared.mechanics
        n = y.shape[0] // 2
        steps = jnp.minimum(h / prepared.interval, INTERVALS)
        here = _stacked(mechanics, contact, load, list(y))
        samples = _Samples(prepared.window @ here, prepared.rounding @ jnp.abs(here), n, mechanics.tangential)
        none = jnp.zeros_like(load)

        interval = _stage(lambda: _safe_intervals(samples, steps), none.astype(jnp.int32))
        there = _stage(lambda: samples.state_at(interval), [none] * 2 * n)
        there = _stacked(mechanics, contact, load, there)
        series = _Series(prepared.series @ there, prepared.rounding @ jnp.abs(there), n, mechanics.tangential)
        inside = interval < INTERVALS
        brackets = _dipped(series, _stage(lambda: series.brackets(inside), [_no_bracket(none)] * 3))
        roots = _polished(series, brackets)
        no = none > 0
        share, fires = _stage(lambda: _first_root(brackets, roots, steps, interval), (none, [no] * 3))
        reached = _stage(lambda: series.state(share), [none] * 2 * n)
        peak = _stage(lambda: samples.peak(interval), none)

        velocity = n + mechanics.tangential
        reached = [v / prepared.interval if i >= n else v for i, v in enumerate(reached)]
        reached[velocity] = jnp.where(fires[2], 0.0, reached[velocity])
        state = physics.on_constraint(mechanics, contact, jnp.stack(reached))
        ended = jnp.stack(fires[:2])

        def transition():
            return physics.transition(mechanics, contact, load, state, ended, RESTING * prepared.interval)

        next_contact, y_next = _stage(transition, (contact, jnp.zeros_like(y)))
        used = (interval + share) * prepared.interval
        return Advance(y_next, next_contact, used, jnp.maximum(peak, jnp.abs(reached[velocity])))


def _stage(function, like):
    """`function()`, computed once and kept.

    XLA on a CPU repeats arithmetic in every kernel that wants its result, so long chains with many results cost their
    square. A loop that runs once is a border over which it repeats nothing; the sevenfold speed of maps is owed to it.
    `like` has the structure and types of the result.
    """
    once = jnp.ones_like(jax.tree.leaves(like)[0], bool).ravel()[0]

    def body(carry):
        return jnp.zeros_like(once), jax.tree.map(lambda new, old: new.astype(old.dtype), function(), carry[1])

    return jax.lax.while_loop(lambda carry: carry[0], body, (once, like))[1]


def propagators(mechanics: Mechanics) -> Propagators:
    """The matrices for one scene with constant friction."""
    n = mechanics.free_load.shape[0]
    ways = [_affine(mechanics, way) for way in _ways(mechanics.free_load.dtype)]
    fastest = jnp.max(jnp.stack([_spectral_radius(generator) for generator, _ in ways]))
    interval = TURN / fastest
    window, series, rounding = [], [], []
    columns = zip(_ways(mechanics.free_load.dtype), ways, _columns(n, mechanics.normal), strict=True)
    for contact, (generator, guards), used in columns:
        powers = [jnp.eye(2 * n + 2, dtype=generator.dtype)]
        for k in range(ORDER + 1):
            powers.append(powers[-1] @ generator * (interval / (k + 1)))
        step = sum(powers[1:], powers[0])
        samples = [powers[0]]
        for _ in range(INTERVALS + 1):
            samples.append(step @ samples[-1])
        guard_series = _rows([guards @ power for power in powers[: ORDER + 1]])
        guard_samples = _rows([guards @ sample for sample in samples])
        states = _rows([sample[: 2 * n] for sample in samples[: INTERVALS + 1]])
        paths = _rows([power[:n] for power in powers])
        window.append(jnp.concatenate([guard_samples, states, guard_series])[:, used])
        series.append(jnp.concatenate([guard_series, paths])[:, used])
        sizes, rates = _magnitudes(mechanics, contact)
        terms = [sizes, sizes @ rates * interval, sizes @ rates @ rates * (0.5 * interval**2)]
        rounding.append(ROUNDINGS * jnp.finfo(sizes.dtype).eps * _rows(terms)[:, used])
    return Propagators(mechanics, interval, *(jnp.concatenate(rows, axis=1) for rows in (window, series, rounding)))


def _rows(matrices: list[Float[Array, "k c"]]) -> Float[Array, "r c"]:
    """All first rows, then all second rows, …"""
    stacked = jnp.stack(matrices, axis=1)
    return stacked.reshape(-1, stacked.shape[-1])


def _ways(dtype) -> list[Contact]:
    """Sticking, sliding in either direction, detached."""

    def way(status: Status, direction: float) -> Contact:
        return Contact(jnp.asarray(status, jnp.int32), jnp.asarray(direction, dtype))

    return [way(Status.STICK, 1.0), way(Status.SLIDE, 1.0), way(Status.SLIDE, -1.0), way(Status.DETACH, 1.0)]


def _columns(n: int, normal: int) -> list[np.ndarray]:
    """For each way, what of (state, load, 1) is not zero there: a closed contact has neither gap nor gap rate."""
    everything = np.arange(2 * n + 2)
    closed = everything[(everything != normal) & (everything != n + normal)]
    return [closed, closed, closed, everything]


def _stacked(mechanics: Mechanics, contact: Contact, load: Float[Array, ""], y: list) -> Float[Array, " c"]:
    """(state, load, 1) in the columns of the way the contact is in, zero in the others."""
    n = len(y) // 2
    everything = [*y, load, jnp.ones_like(load)]
    sliding = contact.status == Status.SLIDE
    ways = [
        contact.status == Status.STICK,
        sliding & (contact.direction > 0),
        sliding & (contact.direction < 0),
        contact.status == Status.DETACH,
    ]
    columns = zip(ways, _columns(n, mechanics.normal), strict=True)
    return jnp.stack([jnp.where(way, everything[i], 0.0) for way, used in columns for i in used])


def _affine(mechanics: Mechanics, contact: Contact) -> tuple[Float[Array, "m m"], Float[Array, "2 m"]]:
    """Rates and guards in one way of contact, as matrices on (state, load, 1)."""
    n = mechanics.free_load.shape[0]

    def rates(v):
        return jnp.concatenate([v[n : 2 * n], physics.acceleration(mechanics, contact, v[2 * n], v[: 2 * n])])

    def guards(v):
        return physics.guards(mechanics, contact, v[2 * n], v[: 2 * n])

    def matrix(f):
        zero = jnp.zeros(2 * n + 1, mechanics.free_load.dtype)
        return jnp.concatenate([jax.jacfwd(f)(zero), f(zero)[:, None]], axis=1)

    unchanging = jnp.zeros((2, 2 * n + 2), mechanics.free_load.dtype)
    return jnp.concatenate([matrix(rates), unchanging]), matrix(guards)


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
    log_size = jnp.zeros((), matrix.dtype)
    for _ in range(6):
        size = jnp.max(jnp.abs(matrix))
        size = jnp.where(size > 0, size, 1.0)
        log_size = 2 * (log_size + jnp.log(size))
        matrix = (matrix / size) @ (matrix / size)
    return jnp.exp((log_size + jnp.log(jnp.linalg.norm(matrix) + jnp.finfo(matrix.dtype).tiny)) / 64)


class _Samples(eqx.Module):
    """The future of one lane at the ends of the intervals, and the guards' series at its start.

    Rows are taken apart where they are used: what a `_stage` is given should be one array, not hundreds.
    """

    rows: Float[Array, " r"]
    rounding: Float[Array, "6"]
    n: int = eqx.field(static=True)
    tangential: int = eqx.field(static=True)

    @property
    def guards(self) -> list[list[Float[Array, ""]]]:
        """One sample more than there are ends, for second differences."""
        return _cut(self.rows, 2, INTERVALS + 2, 0)

    @property
    def states(self) -> list[list[Float[Array, ""]]]:
        return _cut(self.rows, 2 * self.n, INTERVALS + 1, 2 * (INTERVALS + 2))

    @property
    def start(self) -> list[list[Float[Array, ""]]]:
        return _cut(self.rows, 2, ORDER + 1, 2 * (INTERVALS + 2) + 2 * self.n * (INTERVALS + 1))

    @property
    def speed(self) -> list[Float[Array, ""]]:
        return self.states[self.n + self.tangential]

    def state_at(self, interval: Int[Array, ""]) -> list[Float[Array, ""]]:
        """The state where an interval begins."""
        found = []
        for samples in self.states:
            value = samples[0]
            for k, sample in enumerate(samples[1:], start=1):
                value = jnp.where(interval == k, sample, value)
            found.append(value)
        return found

    def peak(self, interval: Int[Array, ""]) -> Float[Array, ""]:
        """The largest tangential speed up to the beginning of an interval."""
        largest = jnp.abs(self.speed[0])
        for k, speed in enumerate(self.speed[1:], start=1):
            largest = jnp.where(interval >= k, jnp.maximum(largest, jnp.abs(speed)), largest)
        return largest


class _Series(eqx.Module):
    """Taylor series of one lane from the beginning of an interval, in units of the interval."""

    rows: Float[Array, " q"]
    rounding: Float[Array, "6"]
    n: int = eqx.field(static=True)
    tangential: int = eqx.field(static=True)

    @property
    def paths(self) -> list[list[Float[Array, ""]]]:
        return _cut(self.rows, self.n, ORDER + 2, 2 * (ORDER + 1))

    @property
    def watched(self) -> list[list[Float[Array, ""]]]:
        """The guards, and the negative tangential velocity: where it rises through zero orbits are compared."""
        path = self.paths[self.tangential]
        return [*_cut(self.rows, 2, ORDER + 1, 0), [-(k + 1) * path[k + 1] for k in range(ORDER + 1)]]

    def brackets(self, inside: Bool[Array, ""]) -> list["_Bracket"]:
        """Of each watched polynomial; at the end of the window, not `inside` an interval, there is nothing to look for."""
        first, second, falling = self.watched
        rounding = _cut(self.rounding, 2, 3, 0)
        none = [jnp.zeros_like(falling[0])] * 3
        return [
            _bracket(first, rounding[0], inside),
            _bracket(second, rounding[1], inside),
            _bracket(falling, none, inside & (falling[0] > 0)),
        ]

    def state(self, x: Float[Array, ""]) -> list[Float[Array, ""]]:
        """Displacements, and velocities in m per interval."""
        values, slopes = zip(*(_value_and_slope(path, x) for path in self.paths), strict=True)
        return [*values, *slopes]


def _cut(rows, parts: int, length: int, start: int):
    return [[rows[start + p * length + k] for k in range(length)] for p in range(parts)]


def _safe_intervals(samples: _Samples, steps: Float[Array, ""]) -> Int[Array, ""]:
    """How many intervals from the start on are certain to hold no event and no end of the step (`steps` intervals off).

    A guard may run out where a sample is not positive, and where samples that are all positive look like a parabola that
    has its lowest point between two of them, with allowance for what is not parabolic.
    """
    speed, start = samples.speed, samples.start
    unsafe = [(before < 0) & (after >= 0) for before, after in itertools.pairwise(speed)]
    for g in samples.guards:
        bend = [g[k + 1] - 2 * g[k] + g[k - 1] for k in range(1, INTERVALS + 1)]
        slope = [0.5 * (g[k + 1] - g[k - 1]) for k in range(1, INTERVALS + 1)]
        for k in range(1, INTERVALS):
            b = jnp.maximum(jnp.abs(bend[k - 1]), jnp.abs(bend[k]))
            lowest_inside = (slope[k - 1] < 0.2 * b) & (slope[k] > -0.2 * b)
            unsafe[k] = unsafe[k] | (g[k + 1] <= 0) | (lowest_inside & (jnp.minimum(g[k], g[k + 1]) <= 0.25 * b))
    # In the first interval a guard may start at zero, because its status has just begun.
    rounding = _cut(samples.rounding, 2, 3, 0)
    unsafe[0] = unsafe[0] | ~(_stays_positive(start[0], rounding[0]) & _stays_positive(start[1], rounding[1]))
    first = jnp.full_like(steps, INTERVALS)
    for k in reversed(range(INTERVALS)):
        first = jnp.where(unsafe[k], 1.0 * k, first)
    return jnp.minimum(first, jnp.floor(steps)).astype(jnp.int32)


def _stays_positive(c: list[Float[Array, ""]], rounding: list[Float[Array, ""]]) -> Bool[Array, ""]:
    """Whether the first coefficient that is not zero outweighs all the negative ones after it."""
    zeros, lead = _start(c, rounding)
    return lead + sum(jnp.where(zeros < k, jnp.minimum(ck, 0.0), 0.0) for k, ck in enumerate(c)) > 0


def _start(c: list[Float[Array, ""]], rounding: list[Float[Array, ""]]) -> tuple[Int[Array, ""], Float[Array, ""]]:
    """How many coefficients at the start are zero but for rounding, and the first that is not."""
    size = sum(jnp.abs(ck) for ck in c)
    zero = jnp.abs(c[0]) <= jnp.maximum(size * ROUNDING[0], rounding[0])
    zeros, lead = zero.astype(jnp.int32), jnp.where(zero, c[1], c[0])
    for k in (1, 2):
        zero = zero & (jnp.abs(c[k]) <= jnp.maximum(size * ROUNDING[k], rounding[k]))
        zeros, lead = zeros + zero, jnp.where(zero, c[k + 1], lead)
    return zeros, lead


class _Bracket(eqx.Module):
    """What is known of a polynomial's first root in [0, 1] from its start and its end."""

    guess: Float[Array, ""]
    zeros: Int[Array, ""]  # roots at the very start, not meant
    end: Float[Array, ""]  # where it is no longer positive, if it crosses
    crosses: Bool[Array, ""]
    spent: Bool[Array, ""]  # negative from the start
    dips: Bool[Array, ""]  # positive at both ends, perhaps not in between


def _no_bracket(like: Float[Array, ""]) -> _Bracket:
    no = like > like
    return _Bracket(like, jnp.zeros_like(like, jnp.int32), like, no, no, no)


def _bracket(c: list[Float[Array, ""]], rounding: list[Float[Array, ""]], watch: Bool[Array, ""]) -> _Bracket:
    zeros, lead = _start(c, rounding)
    end = sum((jnp.where(zeros > k, 0.0, c[k]) for k in range(3)), sum(c[3:]))
    spent = watch & (lead < 0)
    crosses = watch & (lead >= 0) & (end <= 0)
    # The first root of the parabola with this start, slope and end, in the form that does not cancel.
    slope = sum(jnp.where(zeros == k, c[k + 1], 0.0) for k in range(4))
    bend = end - lead - slope
    root = jnp.sqrt(jnp.maximum(slope**2 - 4 * bend * lead, 0.0))
    rises = slope > 0
    half = 0.5 * jnp.where(rises, slope + root, root - slope)
    below = jnp.where(rises, bend, half)
    guess = jnp.where(rises, -half, lead) / jnp.where(below == 0, 1.0, below)
    guess = jnp.where(crosses, jnp.clip(guess, 0.0, 1.0), 1.0)
    lowest = lead - slope**2 / (4 * jnp.where(bend > 0, bend, 1.0))
    # With allowance for what is not parabolic.
    dips = watch & (lead > 0) & (end > 0) & (slope < 0) & (slope + 2.2 * bend > 0) & (lowest <= 0.1 * bend)
    return _Bracket(guess, zeros, jnp.ones_like(lead), crosses, spent, dips)


def _dipped(series: _Series, brackets: list[_Bracket]) -> list[_Bracket]:
    """The brackets of polynomials that seemed to dip below zero, decided at their lowest points; seldom run at all."""

    def decided(brackets: list[_Bracket]) -> list[_Bracket]:
        return [_decided(c, b) for c, b in zip(series.watched, brackets, strict=True)]

    def any_dips(brackets: list[_Bracket]) -> Bool[Array, ""]:
        return brackets[0].dips | brackets[1].dips

    return jax.lax.while_loop(any_dips, decided, brackets)


def _decided(c: list[Float[Array, ""]], bracket: _Bracket) -> _Bracket:
    slopes = [k * ck for k, ck in enumerate(c)][1:]

    def nearer(_, x):
        slope, bend = _value_and_slope(slopes, x)
        return jnp.clip(x - slope / jnp.where(bend > 0, bend, 1.0), 0.0, 1.0)

    # Newton's method: within an interval a slope is all but a straight line.
    lowest = jax.lax.fori_loop(0, 6, nearer, jnp.full_like(bracket.end, 0.5))
    below = bracket.dips & (_value_and_slope(c, lowest)[0] <= 0)
    return _Bracket(
        guess=jnp.where(below, 0.5 * lowest, bracket.guess),
        zeros=bracket.zeros,
        end=jnp.where(below, lowest, bracket.end),
        crosses=bracket.crosses | below,
        spent=bracket.spent,
        dips=jnp.zeros_like(bracket.dips),
    )


def _polished(series: _Series, brackets: list[_Bracket]) -> list[Float[Array, ""]]:
    """The roots of the watched polynomials that cross zero, by Newton's method within brackets."""
    none = jnp.zeros_like(brackets[0].guess)

    def going(carry):
        *_, open_, count = carry
        return (open_[0] | open_[1] | open_[2]) & (count < MOST_ROOT_STEPS)

    def newton(carry):
        *state, count = carry
        own = zip(series.watched, brackets, *state, strict=True)
        after = [_newton(c, bracket.zeros, *lane) for c, bracket, *lane in own]
        return (*map(list, zip(*after, strict=True)), count + 1)

    start = [none] * 3, [b.end for b in brackets], [b.guess for b in brackets], [b.crosses for b in brackets]
    _, _, roots, _, _ = jax.lax.while_loop(going, newton, (*start, jnp.zeros((), jnp.int32)))
    return roots


def _newton(c, zeros, low, high, x, open_):
    """One step on the polynomial without its roots at zero, which are divided out of value and slope alike."""
    c = [jnp.where(zeros > k, 0.0, ck) if k < 3 else ck for k, ck in enumerate(c)]
    value, slope = _value_and_slope(c, x)
    slope = slope - zeros * value / jnp.where(x > 0, x, 1.0)
    low, high = jnp.where(value > 0, x, low), jnp.where(value > 0, high, x)
    nearer = x - value / jnp.where(slope == 0, 1.0, slope)
    # The next error is the square of this one.
    done = (jnp.abs(nearer - x) <= 1e-7) & (slope != 0)
    nearer = jnp.where(done | ((nearer > low) & (nearer < high)), nearer, 0.5 * (low + high))
    return low, high, jnp.where(open_, jnp.clip(nearer, 0.0, 1.0), x), open_ & ~done


def _first_root(
    brackets: list[_Bracket], roots: list[Float[Array, ""]], steps: Float[Array, ""], interval: Int[Array, ""]
) -> tuple[Float[Array, ""], list[Bool[Array, ""]]]:
    """Where in its interval the advance ends, as a share of it, and which of the watched end it there."""
    end = jnp.where(interval == INTERVALS, 0.0, jnp.minimum(steps - interval, 1.0))
    roots = [jnp.where(b.spent, 0.0, root) for b, root in zip(brackets, roots, strict=True)]
    fires = [(b.crosses | b.spent) & (root <= end) for b, root in zip(brackets, roots, strict=True)]
    for root, fired in zip(roots, fires, strict=True):
        end = jnp.where(fired, jnp.minimum(end, root), end)
    # Guards that run out at the same instant, but for rounding, do so together.
    together = end * (1 + 4 * jnp.finfo(end.dtype).eps)
    return end, [fired & (root <= together) for root, fired in zip(roots, fires, strict=True)]


def _value_and_slope(c: list[Float[Array, ""]], x: Float[Array, ""]):
    value, slope = c[-1], jnp.zeros_like(c[-1])
    for ck in reversed(c[:-1]):
        slope = slope * x + value
        value = value * x + ck
    return value, slope
