"""Motions from one state to later crossings of the Poincaré section: one JAX function, which kernels compute, or XLA.

On the section the tangential velocity rises through zero. Where an impact makes the velocity jump over zero, the point of the
section is the state just after the impact. States are deviations from the sliding equilibrium under the final load.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from ..contact import Contact, Mechanics, State
from ..foundation.carried import depending_on
from ..kernels.functions import KernelFunction
from ..kernels.tiered import SOMEWHAT
from ..model.scene import Scene
from ..steppers.core import left_after, next_part
from ..steppers.event_exact import EXACT_STEPPER, EventExact, for_derivatives
from .about_sliding import longest_return, mechanics_about_sliding
from .peak_speed import higher_peak

# The most segments with events from one point of the section to the next; and the most of all: slow motions of structures with
# fast modes have many without any event.
MOST_EVENTS = 4096
MOST_SEGMENTS = 64 * MOST_EVENTS


class Point(eqx.Module):
    """A state on the section, as a deviation from the sliding equilibrium, and the contact mode there."""

    y: State
    contact: Contact


class Crossing(NamedTuple):
    """Where a motion is when it crosses the section, or when its time is over; and what it has met on the way."""

    point: Point
    time: Float[Array, ""]  # s
    events: Int[Array, ""]  # rebounds among them
    changes: Int[Array, ""]  # of a contact's status


class Arrival(NamedTuple):
    """The end of a motion."""

    at: Crossing
    crossed: Int[Array, ""]  # how often it has crossed the section
    arrived: Bool[Array, ""]  # whether it has crossed the section so often as was asked
    peak: Float[Array, ""]  # the largest tangential speed on the way, m/s; zero unless asked for


class Kick(NamedTuple):
    """A load before the motion whose crossings count."""

    load: Float[Array, ""]  # N, as a deviation from the final one
    duration: Float[Array, ""]  # s


class _Carry(NamedTuple):
    y: State
    contact: Contact
    kick: Kick | None  # what is left of it
    left: Float[Array, ""]  # of the longest time, s
    crossed: Int[Array, ""]
    events: Int[Array, ""]
    changes: Int[Array, ""]
    segments: Int[Array, ""]  # since the last crossing; one with an event counts for many
    peak: Float[Array, ""]


def to_crossing(
    method: EventExact,
    mechanics: Mechanics,
    start: Point,
    crossings: Int[Array, ""],
    longest: Float[Array, ""],
    numbers: Float[Array, " k"],
    kick: Kick | None = None,
    peaks: bool | Bool[Array, ""] = False,
) -> tuple[Arrival, Crossing]:
    """The motion from a start to its `crossings`-th crossing of the section, for a time `longest` (s) at most, and with at most
    `MOST_SEGMENTS`, or `MOST_EVENTS`, from each crossing to the next; after a kick, if there is one.

    Returns its end, and a row for each crossing with one of these `numbers`, of which 1 is the first. They rise, up to
    `crossings` at least. States of rows are NaN where the motion has not been. The largest speed is sought if `peaks` says so.
    """
    none, zero = jnp.zeros((), jnp.int32), jnp.zeros((), start.y.dtype)
    contact = Contact(start.contact.status.astype(jnp.int32), start.contact.direction)
    # The longest wait for a return depends on the scene; the time of the return does not, so the wait has no derivative.
    longest = jax.lax.stop_gradient(longest)
    begin = _Carry(start.y, contact, kick, longest, none, none, none, none, zero)
    begin = depending_on((mechanics, longest), begin)

    def further(way: _Carry) -> _Carry:
        left, kicked = way.left, jnp.zeros((), bool)
        load = jnp.zeros_like(left)
        if way.kick is not None:
            kicked = way.kick.duration > 0
            left, load = jnp.where(kicked, way.kick.duration, left), jnp.where(kicked, way.kick.load, load)
        part, is_last = next_part(left, method.dt)
        after, states, unit = method.with_series(mechanics, way.contact, load, way.y, part, at_section=True)
        left = left_after(after, left, is_last)
        kick = None
        if way.kick is not None:
            kick = way.kick._replace(duration=jnp.where(kicked, left, 0.0))
            left = jnp.where(kicked, way.left, left)

        def higher() -> Float[Array, ""]:
            return higher_peak(mechanics, states, after.h, after.h / unit, way.peak)

        # Where it is known, XLA computes nothing for it.
        known = isinstance(peaks, bool)
        peak = jax.lax.cond(peaks, higher, lambda: way.peak) if not known else higher() if peaks else way.peak
        crosses, has_event = after.rise.happened & ~kicked, jnp.any(after.ended) & ~kicked
        counts_anew = crosses if kick is None else crosses | (kicked & (kick.duration <= 0))
        return _Carry(
            after.y,
            after.contact,
            kick,
            left,
            way.crossed + crosses,
            way.events + has_event,
            way.changes + (jnp.any(after.contact.status != way.contact.status) & ~kicked),
            jnp.where(counts_anew, 0, way.segments + jnp.where(has_event, MOST_SEGMENTS // MOST_EVENTS, 1)),
            peak,
        )

    def until(way: _Carry, crossed) -> _Carry:
        def going(way: _Carry):
            return (way.left > 0) & (way.crossed < crossed) & (way.segments < MOST_SEGMENTS)

        return jax.lax.while_loop(going, further, way)

    def here(way: _Carry) -> Crossing:
        return Crossing(Point(way.y, way.contact), longest - way.left, way.events, way.changes)

    def row(way: _Carry, number):
        number = number.astype(jnp.int32)
        way = until(way, jnp.minimum(number, crossings))
        there = (number > 0) & (way.crossed >= number)
        return way, eqx.tree_at(lambda at: at.point.y, here(way), jnp.where(there, way.y, jnp.nan))

    way, rows = jax.lax.scan(row, begin, numbers)
    arrived = (way.crossed >= crossings) & jnp.all(jnp.isfinite(way.y))
    return Arrival(here(way), way.crossed, arrived, way.peak), rows


def _to_section(args, numbers, method=EXACT_STEPPER):
    whose, start, crossings, time, peaks = args
    mechanics, longest = (mechanics_about_sliding(whose), longest_return(whose)) if isinstance(whose, Scene) else whose
    longest = jnp.minimum(time, longest * crossings)
    return to_crossing(method, mechanics, start, crossings, longest, numbers, peaks=peaks)


def _derived_to_section(args, numbers):
    return _to_section(args, numbers, for_derivatives(EXACT_STEPPER))


# Of (scene, start, crossings, the longest time in s, whether the largest speed is asked for). In place of the scene there
# may be what the motion needs of it: (mechanics, longest return in s).
motion_to_section = KernelFunction(_to_section, _derived_to_section, SOMEWHAT)
