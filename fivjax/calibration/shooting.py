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

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float

from ..contact import Contact, Mechanics, State, Status, status_from_forces
from ..contact.coordinates import at_places
from ..io.recordings import Channel
from ..model.scene import Scene, steady_sliding
from ..model.sliding import contact_coordinates
from ..model.structure import Structure
from ..steppers.base import AbstractStepper, Within
from ..steppers.core import Segment, follow
from ..steppers.event_exact import for_derivatives
from .inside import channels_inside, jumps

# A motion is followed for so many periods before it counts as nearly periodic.
SETTLING_PERIODS = 80
# Then its state is sampled so often per expected period, to see where it returns to itself.
LOOKS = 48
# The shortest and the longest period tried, relative to the expected one.
SHORTEST, LONGEST = 0.6, 1.7
# The most contact events in a period beside which samples can be told.
MOST_EVENTS = 64


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


class Around(NamedTuple):
    """One period of a motion that may not be closed yet."""

    y: State  # at the end of the period
    contact: Contact
    lines: Complex[Array, "count n"]  # of the velocities: v(t) = Re sum of c_h exp(2πi h t / period), m/s
    impulses: Complex[Array, "count n"]  # the part of the accelerations' lines that is impulses, m/s²
    fractions: Float[Array, "2"]  # of time, sticking and detached


def first_tangential(structure: Structure) -> int:
    """The tangential coordinate of the only or the first contact."""
    return int(np.ravel(contact_coordinates(structure)[0])[0])


def settled(scene: Scene, method: AbstractStepper, frequency: Float[Array, ""]) -> Cycle:
    """A guess of the limit cycle under the final load: the motion that starts with 0.9 of the belt's speed, after it has
    settled.

    Its state where the tangential velocity rises through zero, and the time, near 1/`frequency` (Hz), after which it is closest
    to that state again.
    """
    mechanics, load = Mechanics(scene), scene.load.final
    n, tangential = scene.structure.size, first_tangential(scene.structure)
    q, _ = steady_sliding(scene, load)
    y0 = jnp.concatenate([q, jnp.zeros(n)]).at[n + mechanics.tangential].set(0.9 * scene.belt_speed)

    def to_next(carry, h):
        y, contact = carry
        after = follow(method, mechanics, contact, load, y, h, kind="lax")
        y = jnp.where(after.enough, after.y, jnp.nan)
        return (y, after.contact), (y, after.contact)

    longest = int(LONGEST * LOOKS) + 1
    durations = jnp.full(2 * longest + 1, 1 / (LOOKS * frequency)).at[0].set(SETTLING_PERIODS / frequency)
    _, (states, contacts) = jax.lax.scan(to_next, (y0, status_from_forces(mechanics, load, y0)), durations)
    speed = states[:, n + tangential]
    rises = (speed[: longest - 1] < 0) & (speed[1:longest] >= 0)
    begin = jnp.argmax(rises) + 1
    y = states[begin]
    apart = jnp.sum((scene.structure.weights * (states - y)) ** 2, axis=1)
    later = jnp.arange(states.shape[0]) - begin
    tried = (later >= SHORTEST * LOOKS) & (later <= LONGEST * LOOKS)
    back = jnp.argmin(jnp.where(tried & jnp.isfinite(apart), apart, jnp.inf))
    # A motion that has died out is no cycle.
    moves = jnp.any(rises) & (jnp.max(jnp.abs(speed)) > 1e-3 * jnp.max(jnp.abs(scene.belt_speed)))
    period = jnp.where(moves, (back - begin) / (LOOKS * frequency), jnp.nan)
    return Cycle(y, jax.tree.map(lambda leaf: leaf[begin], contacts), period)


def around(scene: Scene, method: AbstractStepper, cycle: Cycle, count: int) -> Around:
    """A guess of a cycle followed for its period, with `count` lines of its velocities. Differentiable in forward mode."""
    mechanics, load = Mechanics(scene), scene.load.final
    method, codes = for_derivatives(method), jnp.array([Status.STICK, Status.DETACH])

    def add(total, segment: Segment):
        lines, impulses, spent = total
        within = method.within(mechanics, segment.contact, load, segment.y, segment.after.h)
        # With several contacts, those of the first; fractions in a recording are refused then.
        status = segment.contact.status[0] if mechanics.several else segment.contact.status
        spent = spent + jnp.where(status == codes, segment.after.h, 0.0)
        n = scene.structure.size
        jump = (segment.after.y - segment.after.end)[n:]
        turns = 2 * jnp.pi * jnp.arange(1, count + 1) * ((segment.t + segment.after.h) / cycle.period)
        impulses = impulses + jnp.stack([jnp.cos(turns), jnp.sin(turns)], axis=1)[..., None] * jump
        return lines + _integrals(within, segment.t, cycle.period, count), impulses, spent

    zeros = jnp.zeros((count, 2, scene.structure.size))
    total = (zeros, zeros, jnp.zeros(2))
    after = follow(method, mechanics, cycle.contact, load, cycle.y, cycle.period, total=total, observe=add, kind="lax")
    *sums, spent = after.total
    lines, impulses = ((2 / cycle.period) * (part[:, 0] - 1j * part[:, 1]) for part in sums)
    return Around(jnp.where(after.enough, after.y, jnp.nan), after.contact, lines, impulses, spent / cycle.period)


class Waveform(NamedTuple):
    """A cycle at instants of its period, and how far in time each is from the contact's events."""

    values: Float[Array, "q k"]
    from_changes: Float[
        Array, "e q"
    ]  # to each of the first events in which a contact changes its mode, s; infinite if none
    from_landings: Float[Array, "e q"]  # to those of them in which one lands


def waveform(
    scene: Scene,
    method: AbstractStepper,
    cycle: Cycle,
    instants: Float[Array, " q"],
    channels: tuple[Channel, ...],
) -> Waveform:
    """Channels of a cycle at instants between 0 and its period (s), in any order. Differentiable in forward mode."""
    mechanics, load = Mechanics(scene), scene.load.final
    method = for_derivatives(method)

    def add(total, segment: Segment):
        values, seen, changes, landings = total
        here = (instants >= segment.t) & (instants < segment.t + segment.after.h)
        times = jnp.where(here, instants - segment.t, 0.0)
        found = channels_inside(method, mechanics, segment, times, channels)
        values = jnp.where(here[:, None], found, values)
        changed, landed = jumps(segment)
        end = jax.lax.stop_gradient(segment.t + segment.after.h)
        place = jnp.where(changed, seen, MOST_EVENTS)
        changes = changes.at[place].set(end, mode="drop")
        landings = landings.at[place].set(jnp.where(landed, end, jnp.inf), mode="drop")
        return values, seen + changed, changes, landings

    none = jnp.full(MOST_EVENTS, jnp.inf)
    total = (jnp.zeros((len(instants), len(channels))), jnp.zeros((), jnp.int32), none, none)
    after = follow(method, mechanics, cycle.contact, load, cycle.y, cycle.period, total=total, observe=add, kind="lax")
    values, seen, *events = after.total
    # With more events than can be noted, nothing is known.
    values = jnp.where(after.enough & (seen <= MOST_EVENTS), values, jnp.nan)
    half = 0.5 * cycle.period

    def away(event):
        found = jnp.abs(jnp.mod(jax.lax.stop_gradient(instants) - event + half, cycle.period) - half)
        return jnp.where(jnp.isfinite(event), found, jnp.inf)

    return Waveform(values, *(jax.lax.stop_gradient(jax.vmap(away)(part)) for part in events))


def unclosed(scene: Scene, cycle: Cycle, after: Around) -> State:
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
