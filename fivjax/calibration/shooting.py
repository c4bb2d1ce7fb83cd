r"""Periodic motion by shooting: one period through every contact event, and the equations that close it.

A state of a limit cycle returns to itself after one period. With $Φ(y, T)$ the motion from y over a time T,

$$Φ(y, T) - y = 0$$

determines the period and all components of the state but one: the tangential velocity, of several contacts that of the first,
whose value only chooses a point of the cycle. Newton's method solves it to rounding even if the motion settles slowly, and the
same equation gives the derivatives, over a single period. (In the derivative of a transient, the phase would change by
thousands of degrees.)

Fourier coefficients are integrals over exactly one period. Where the contact closes, velocities jump and accelerations are
impulses; the coefficients of an acceleration follow from those of its velocity by differentiation. Samples at points in time
see no impulse, so its share is known apart.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float, Int

from ..contact import Contact, Mechanics, State, Status, status_from_forces
from ..contact.coordinates import at_places
from ..foundation.carried import depending_on
from ..foundation.polynomial import value_and_rate
from ..io.recordings import Channel
from ..kernels.functions import KernelFunction
from ..model.scene import Scene, steady_sliding
from ..model.sliding import contact_coordinates
from ..model.structure import Structure
from ..steppers.base import MOST_ADVANCES, AbstractStepper, Within
from ..steppers.core import Segment, follow, left_after, next_part
from ..steppers.event_exact import for_derivatives
from ..steppers.kernel_scope import has_kernel
from .inside import advance_with_channels, jumps, terms_of

# A settled motion's state is sampled so often per expected period, to see where it returns to itself.
LOOKS = 48
# The shortest and the longest period tried, relative to the expected one.
SHORTEST, LONGEST = 0.6, 1.7


class Cycle(NamedTuple):
    """A guess of a periodic motion: a state and the period. NaN where there is none."""

    y: State
    contact: Contact
    period: Float[Array, ""]  # s

    def unknowns(self, tangential: int) -> Float[Array, " state"]:
        """The unknowns that close the cycle: the state, with the period in place of the tangential velocity."""
        return self.y.at[self.y.shape[0] // 2 + tangential].set(self.period)

    def at(self, unknowns: Float[Array, " state"], tangential: int) -> "Cycle":
        """The cycle with these unknowns."""
        where = unknowns.shape[0] // 2 + tangential
        return Cycle(unknowns.at[where].set(self.y[where]), self.contact, unknowns[where])


class OnePeriod(NamedTuple):
    """One period of a motion that may not be closed yet."""

    y: State  # at the end of the period
    contact: Contact
    lines: Complex[Array, "count n"]  # of the velocities: v(t) = Re sum of c_h exp(2πi h t / period), m/s
    impulses: Complex[Array, "count n"]  # the part of the accelerations' lines that is impulses, m/s²
    fractions: Float[Array, "2"]  # of time, sticking and detached
    events: "Events"


class Events(NamedTuple):
    """When contacts change their modes in a period, s after its start; infinite where there are no more."""

    changes: Float[Array, " e"]
    landings: Float[Array, " e"]  # those of them in which one lands

    def away(self, instants: Float[Array, " q"], period: Float[Array, ""]) -> tuple[Array, Array]:
        """How far instants are from each of them in time (s), before or after; without derivatives."""
        instants, half = jax.lax.stop_gradient(instants), 0.5 * period

        def from_one(event):
            found = jnp.abs(jnp.mod(instants - event + half, period) - half)
            return jnp.where(jnp.isinf(event), jnp.inf, found)

        changes, landings = (jax.lax.stop_gradient(jax.vmap(from_one)(part)) for part in self)
        return changes, landings


def first_tangential(structure: Structure) -> int:
    """The tangential coordinate of the only or the first contact."""
    return int(np.ravel(contact_coordinates(structure)[0])[0])


class PeriodAsked(eqx.Module):
    """How a period is followed and what of it is kept, fixed when it is traced."""

    method: AbstractStepper = eqx.field(static=True)
    count: int = eqx.field(static=True, default=0)  # of lines
    channels: tuple[Channel, ...] = eqx.field(static=True, default=())


def guess_limit_cycle(scene: Scene, method: AbstractStepper, frequency: Float[Array, ""]) -> Cycle:
    """A guess of the limit cycle under the final load: of the motions from a few starts, after they have settled, the one that
    returns closest to `frequency` (Hz) among those that return to themselves.

    Its state where the tangential velocity rises through zero, and the time after which it is closest to that state again.
    """
    # A motion is followed for so many periods before it counts as nearly periodic.
    settling_periods = 80
    # A motion returns to itself if it comes as close as this, relative to its size.
    closed = 0.02
    n, tangential, longest = scene.structure.size, first_tangential(scene.structure), int(LONGEST * LOOKS) + 1
    instants = (settling_periods + jnp.arange(2 * longest + 2) / LOOKS) / frequency
    q, _ = steady_sliding(scene, scene.load.final)
    normal = jnp.asarray(np.isin(np.arange(n), contact_coordinates(scene.structure)[1]))
    along = jnp.arange(n) == tangential
    # All kicks away from the belt.
    kicks = jnp.stack([0.9 * along, -2.0 * along, jnp.full(n, 2.0), jnp.where(normal, 2.0, -2.0)])
    starts = jax.vmap(lambda v: jnp.concatenate([q, jnp.max(jnp.abs(scene.belt_speed)) * v]))(kicks)

    def from_one(y0):
        args = scene, y0, PeriodAsked(method)
        _, (states, contacts) = _settling(args, instants, by_kernel=has_kernel(scene, method))
        speed = states[:, n + tangential]
        rises = (speed[: longest - 1] < 0) & (speed[1:longest] >= 0)
        begin = jnp.argmax(rises) + 1
        # The distance from the line between two looks, which are farther apart than a closed motion is from itself.
        y, scale = states[begin], scene.structure.weights
        gap, way = scale * (states[:-1] - y), scale * jnp.diff(states, axis=0)
        length = jnp.sum(way**2, axis=1)
        share = jnp.clip(-jnp.sum(gap * way, axis=1) / jnp.where(length > 0, length, 1.0), 0.0, 1.0)
        distance = jnp.sqrt(jnp.sum((gap + share[:, None] * way) ** 2, axis=1))
        later = jnp.arange(len(gap)) - begin
        tried = (later >= SHORTEST * LOOKS) & (later <= LONGEST * LOOKS) & jnp.isfinite(distance)
        back = jnp.argmin(jnp.where(tried, distance, jnp.inf))
        # A motion that has died out is no cycle.
        moves = jnp.any(rises) & (jnp.max(jnp.abs(speed)) > 1e-3 * jnp.max(jnp.abs(scene.belt_speed)))
        period = jnp.where(moves, (back + share[back] - begin) / (LOOKS * frequency), jnp.nan)
        returns = distance[back] < closed * jnp.max(jnp.where(tried, distance, 0.0))
        off = jnp.abs(period * frequency - 1.0) + jnp.where(returns, 0.0, LONGEST)
        return jnp.where(moves, off, jnp.inf), Cycle(y, jax.tree.map(lambda leaf: leaf[begin], contacts), period)

    off, cycles = jax.vmap(from_one)(starts)
    nearest = jnp.argmin(off)
    return jax.tree.map(lambda leaf: leaf[nearest], cycles)


def _settle(args, instants: Float[Array, " q"]):
    scene, y0, how = args
    mechanics, load = Mechanics(scene), scene.load.final

    def to_next(carry, instant):
        t, y, contact = carry
        after = follow(how.method, mechanics, contact, load, y, instant - t, kind="lax")
        y = jnp.where(after.enough, after.y, jnp.nan)
        return (instant, y, after.contact), (y, after.contact)

    return (), jax.lax.scan(to_next, (jnp.zeros(()), y0, status_from_forces(mechanics, load, y0)), instants)[1]


_settling = KernelFunction(_settle)


def around(scene: Scene, method: AbstractStepper, cycle: Cycle, count: int) -> OnePeriod:
    """A guess of a cycle followed for its period, with `count` lines of its velocities. Differentiable in forward mode."""
    args = scene, cycle, PeriodAsked(for_derivatives(method), count)
    (after, lines, impulses), _ = _period(args, by_kernel=has_kernel(scene, method))
    lines, impulses = ((2 / cycle.period) * (part[:, 0] - 1j * part[:, 1]) for part in (lines, impulses))
    return after._replace(lines=lines, impulses=impulses)


def _once_around(args, _):
    """An `OnePeriod` without its lines and impulses, and the integrals that these are made of."""
    # The most contact events in a period beside which samples can be told.
    most_events = 64
    scene, cycle, how = args
    mechanics, load = Mechanics(scene), scene.load.final
    method, count, codes = how.method, how.count, jnp.array([Status.STICK, Status.DETACH])

    def add(total, segment: Segment):
        lines, impulses, spent, seen, changes, landings = total
        within = method.within(mechanics, segment.contact, load, segment.y, segment.after.h)
        # With several contacts, those of the first; fractions in a recording are refused then.
        status = segment.contact.status[0] if mechanics.several else segment.contact.status
        spent = spent + jnp.where(status == codes, segment.after.h, 0.0)
        n = scene.structure.size
        jump = (segment.after.y - segment.after.end)[n:]
        end = segment.t + segment.after.h
        turns = 2 * jnp.pi * jnp.arange(1, count + 1) * (end / cycle.period)
        impulses = impulses + jnp.stack([jnp.cos(turns), jnp.sin(turns)], axis=1)[..., None] * jump
        changed, landed = jumps(segment.contact, segment.after.contact)
        end, here = jax.lax.stop_gradient(end), (jnp.arange(most_events) == seen) & changed
        changes, landings = jnp.where(here, end, changes), jnp.where(here & landed, end, landings)
        lines = lines + _integrals(within, segment.t, cycle.period, count)
        return lines, impulses, spent, seen + changed, changes, landings

    zeros, none = jnp.zeros((count, 2, scene.structure.size)), jnp.full(most_events, jnp.inf)
    total = (zeros, zeros, jnp.zeros(2), jnp.zeros((), jnp.int32), none, none)
    after = follow(method, mechanics, cycle.contact, load, cycle.y, cycle.period, total=total, observe=add, kind="lax")
    *sums, spent, seen, changes, landings = after.total
    # With more events than can be noted, nothing is known of them.
    noted = Events(jnp.where(seen <= most_events, changes, jnp.nan), landings)
    y = jnp.where(after.enough, after.y, jnp.nan)
    return (OnePeriod(y, after.contact, None, None, spent / cycle.period, noted), *sums), ()


_period = KernelFunction(_once_around)


def waveform(
    scene: Scene, method: AbstractStepper, cycle: Cycle, instants: Float[Array, " q"], channels: tuple[Channel, ...]
) -> Float[Array, "q k"]:
    """Channels of a cycle at instants between 0 and its period (s), in any order. Differentiable in forward mode."""
    fixed = jax.lax.stop_gradient(instants)
    order = jnp.argsort(fixed)
    args = scene, cycle, PeriodAsked(for_derivatives(method), channels=channels)
    _, rows = _along_period(args, fixed[order], by_kernel=has_kernel(scene, method))
    values, slopes = (jnp.zeros_like(part).at[order].set(part) for part in rows)
    # The rows are those of fixed instants.
    return values + jax.lax.stop_gradient(slopes) * (instants - fixed)[:, None]


class _Step(NamedTuple):
    """One step of a motion: the channels' series, and its end."""

    t: Float[Array, ""]  # s
    terms: Float[Array, "c k"]
    unit: Float[Array, ""]  # of their time, s
    y: State  # at its end
    contact: Contact
    left: Float[Array, ""]  # of the period then, s
    taken: Int[Array, ""]


def _channels_along(args, instants: Float[Array, " q"]):
    """The channels of a cycle at instants that rise, and their derivatives by time."""
    scene, cycle, how = args
    mechanics, load, period = Mechanics(scene), scene.load.final, jax.lax.stop_gradient(cycle.period)

    def step(now: _Step) -> _Step:
        part, is_last = next_part(now.left, how.method.dt)
        after, terms, unit = advance_with_channels(how.method, mechanics, now.contact, load, now.y, part, how.channels)
        left = left_after(after, now.left, is_last)
        return _Step(period - now.left, terms, unit, after.y, after.contact, left, now.taken + 1)

    def row(now: _Step, instant):
        def going(now: _Step):
            return (period - now.left <= instant) & (now.left > 0) & (now.taken < MOST_ADVANCES)

        now = jax.lax.while_loop(going, step, now)
        value, rate = value_and_rate(now.terms, now.unit, instant - now.t)
        return now, (jnp.where(now.taken < MOST_ADVANCES, value, jnp.nan), rate)

    zero, none = jnp.zeros_like(period), jnp.zeros((terms_of(how.method), len(how.channels)))
    begin = _Step(zero, none, zero + 1, cycle.y, cycle.contact, period, jnp.zeros((), jnp.int32))
    return (), jax.lax.scan(row, depending_on((scene, cycle), begin), instants)[1]


_along_period = KernelFunction(_channels_along)


def unclosed(scene: Scene, cycle: Cycle, after: OnePeriod) -> State:
    """What closes the cycle where it is zero: the state after the period less that before it.

    With several contacts, one of them may have no event in the whole period. What it holds then returns whatever it was, which
    is no equation. So for contacts that begin and end in the same status, it is that the gap is closed and nothing slips.
    """
    gap = after.y - cycle.y
    tangential, normal = contact_coordinates(scene.structure)
    if not isinstance(normal, np.ndarray):
        return gap
    n, status = scene.structure.size, cycle.contact.status
    same = status == after.contact.status
    touching, sticking = same & (status != Status.DETACH), same & (status == Status.STICK)
    held = at_places(2 * n, normal, touching) | at_places(2 * n, n + normal, touching)
    # The velocity of the first contact is no unknown.
    stuck = at_places(2 * n, n + tangential, sticking & (np.arange(len(normal)) > 0))
    belt = jnp.zeros(2 * n).at[n + tangential].set(scene.belt_speed)
    return jnp.where(stuck, belt - cycle.y, jnp.where(held, -cycle.y, gap))


def _integrals(within: Within, t, period, count: int) -> Float[Array, "count 2 n"]:
    """Integrals of velocities times cosines and sines over one advance that begins at t (s), in m."""
    n = within.states.shape[1] // 2
    turns = 2 * jnp.pi * jnp.arange(1, count + 1)[:, None] * ((t + within.times) / period)
    waves = jnp.stack([jnp.cos(turns), jnp.sin(turns)], axis=1)
    return (waves * within.weights) @ within.states[:, n:]
