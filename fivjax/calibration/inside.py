"""Displacements, velocities and accelerations of channels at any instants inside one segment of a motion."""

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from ..contact import Mechanics, Status, same_mode
from ..foundation.polynomial import value_and_rate
from ..io.recordings import Channel
from ..steppers.base import AbstractStepper, rates
from ..steppers.core import Segment
from ..steppers.event_exact import EventExact


def channels_inside(
    method: AbstractStepper,
    mechanics: Mechanics,
    segment: Segment,
    times: Float[Array, " q"],
    channels: tuple[Channel, ...],
) -> Float[Array, "q k"]:
    """The channels at `times` (s after the segment's start), as if its contact mode went on.

    By the series of `EventExact`, which its advance has computed already; else by a cubic between the ends of the step.
    """
    terms, unit = channel_series(method, mechanics, segment, channels)
    value, _ = value_and_rate(terms, unit, times[:, None])
    return value


def channel_series(
    method: AbstractStepper, mechanics: Mechanics, segment: Segment, channels: tuple[Channel, ...]
) -> tuple[Float[Array, "terms k"], Float[Array, ""]]:
    """The coefficients of the channels in time after the segment's start, and the unit of that time (s)."""
    n = segment.y.shape[0] // 2
    if isinstance(method, EventExact):
        series, unit = method.series(mechanics, segment.contact, segment.load, segment.y)
        slope = jnp.concatenate([series[1:] * jnp.arange(1, series.shape[0])[:, None], jnp.zeros((1, 2 * n))]) / unit
        terms = jnp.stack([_column(series, slope, n, channel) for channel in channels], axis=1)
    else:
        unit = h = jnp.where(segment.after.h > 0, segment.after.h, 1.0)
        y, later = segment.y, segment.after.end
        begin, end = (rates(mechanics, segment.contact, segment.load, at) * h for at in (y, later))
        cubic = jnp.stack([y, begin, 3 * (later - y) - 2 * begin - end, 2 * (y - later) + begin + end])
        slope = jnp.concatenate([cubic[1:] * jnp.arange(1, 4)[:, None], jnp.zeros((1, 2 * n))]) / h
        terms = jnp.stack([_column(cubic, slope, n, channel) for channel in channels], axis=1)
    return terms, unit


def terms_of(method: AbstractStepper) -> int:
    """The number of coefficients of such a series."""
    return method.order_ + 1 if isinstance(method, EventExact) else 4


def jumps(segment: Segment) -> tuple[Bool[Array, ""], Bool[Array, ""]]:
    """Whether accelerations jump at a segment's end, because a contact changes its mode; and velocities, because one lands."""
    before, after = segment.contact, segment.after.contact
    changed = ~same_mode(before.status, before.direction, after.status, after.direction)
    landed = (before.status == Status.DETACH) & (after.status != Status.DETACH)
    return jnp.any(changed), jnp.any(landed)


def _column(terms, slope, n: int, channel: Channel):
    quantity, coordinate = channel
    return slope[:, n + coordinate] if quantity == "acceleration" else terms[:, coordinate + n * channel.derivative]
