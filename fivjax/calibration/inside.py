"""One advance of a motion with the channels of a recording along it."""

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from ..contact import Contact, Mechanics, State, Status, same_mode
from ..io.recordings import Channel
from ..steppers.base import AbstractStepper, Advance, rates
from ..steppers.event_exact import EventExact


def advance_with_channels(
    method: AbstractStepper,
    mechanics: Mechanics,
    contact: Contact,
    load: Float[Array, ""],
    y: State,
    h: Float[Array, ""],
    channels: tuple[Channel, ...],
) -> tuple[Advance, Float[Array, "terms k"], Float[Array, ""]]:
    """An advance by `h` (s) or less, the coefficients of the channels in time after its start, and the unit of that time (s).

    They are those of `EventExact`'s own series; else of a cubic between the ends of the step.
    """
    n = y.shape[0] // 2
    if isinstance(method, EventExact):
        after, series, unit = method.with_series(mechanics, contact, load, y, h)
    else:
        after = method.advance(mechanics, contact, load, y, h)
        unit = taken = jnp.where(after.h > 0, after.h, 1.0)
        begin, end = (rates(mechanics, contact, load, at) * taken for at in (y, after.end))
        change = after.end - y
        series = jnp.stack([y, begin, 3 * change - 2 * begin - end, begin + end - 2 * change])
    slope = jnp.concatenate([series[1:] * jnp.arange(1, len(series))[:, None], jnp.zeros((1, 2 * n))]) / unit
    columns = [
        slope[:, n + coordinate] if quantity == "acceleration" else series[:, coordinate + n * (quantity == "velocity")]
        for quantity, coordinate in channels
    ]
    return after, jnp.stack(columns, axis=1), unit


def terms_of(method: AbstractStepper) -> int:
    """The number of coefficients of such a series."""
    return method.order_ + 1 if isinstance(method, EventExact) else 4


def jumps(before: Contact, after: Contact) -> tuple[Bool[Array, ""], Bool[Array, ""]]:
    """Whether accelerations jump between two contact modes, because a contact changes its mode; and velocities, because one
    lands.
    """
    changed = ~same_mode(before.status, before.direction, after.status, after.direction)
    landed = (before.status == Status.DETACH) & (after.status != Status.DETACH)
    return jnp.any(changed), jnp.any(landed)
