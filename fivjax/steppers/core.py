"""The stepping core: a trajectory as a sequence of segments, with observers.

A *segment* is one advance of a stepper: motion in one contact mode under one load, up to where a guard runs out, the series is
no longer accurate, or the time asked for has passed. `follow` joins segments. The energy ledger, distances to events, Poincaré
sections and Fourier coefficients are computed on the way by observers: functions that add one segment's contribution to a
total.
"""

from collections.abc import Callable
from typing import Generic, NamedTuple, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from ..contact import Contact, Mechanics, State
from ..foundation.carried import depending_on
from .base import MOST_ADVANCES, AbstractStepper, Advance

Total = TypeVar("Total")


class Segment(NamedTuple):
    """Motion in one contact mode, and what follows from its end."""

    t: Float[Array, ""]  # when it began, s after the start of `follow`
    load: Float[Array, ""]  # N
    contact: Contact
    y: State  # where it began
    after: Advance


class Followed(eqx.Module, Generic[Total]):
    """The end of a trajectory that was followed."""

    y: State
    contact: Contact
    left: Float[Array, ""]  # time that is left of the time asked for, s; zero where the end was reached
    total: Total
    enough: Bool[Array, ""]  # whether the number of segments allowed was enough


def nothing(total: Total, segment: Segment) -> Total:
    """The observer that adds nothing."""
    del segment
    return total


def next_part(left: Float[Array, ""], dt) -> tuple[Float[Array, ""], Bool[Array, ""]]:
    """The longest that the next advance may take of the time that is left: one of equal parts of at most `dt`; and whether that
    is all of it.
    """
    # The 1e-6 keeps rounding from adding another part of vanishing length.
    parts = jnp.where(jnp.isfinite(left), jnp.maximum(jnp.ceil(left / dt - 1e-6), 1.0), 1.0)
    return left / parts, parts == 1


def left_after(after: Advance, left: Float[Array, ""], is_last: Bool[Array, ""]) -> Float[Array, ""]:
    """The time that is left after an advance: exactly none after one to the end."""
    return jnp.where(is_last & (after.h >= left), 0.0, left - after.h)


def end_after(
    after: Advance, t: Float[Array, ""], until: Float[Array, ""], is_last: Bool[Array, ""]
) -> Float[Array, ""]:
    """When an advance from `t` (s) ends: exactly at the end of the time asked for, if it comes that far."""
    return jnp.where(is_last & (after.h >= until - t), until, t + after.h)


def follow(
    stepper: AbstractStepper,
    mechanics: Mechanics,
    contact: Contact,
    load: Float[Array, ""],
    y: State,
    h: Float[Array, ""],
    *,
    total: Total = None,
    observe: Callable[[Total, Segment], Total] = nothing,
    until: Callable[[Total], Bool[Array, ""]] | None = None,
    at_section: bool = False,
    most: int | Array = MOST_ADVANCES,
    kind: str = "bounded",
) -> Followed[Total]:
    """A trajectory under a constant load, segment by segment, for a time `h` (s).

    `observe` adds each segment to `total`; `until` may end the motion early, after the segment that makes it true. With
    `at_section` segments also end on the Poincaré section. At most `most` segments are taken. `kind` of loop: "bounded" can be
    differentiated in forward and reverse mode; "lax" only in forward mode, and costs less.
    """
    h = jnp.asarray(h, y.dtype)

    def body(carry):
        y, contact, left, total = carry
        part, is_last = next_part(left, stepper.dt)
        after = stepper.advance(mechanics, contact, load, y, part, at_section)
        total = observe(total, Segment(h - left, load, contact, y, after))
        return after.y, after.contact, left_after(after, left, is_last), total

    def going(carry):
        _, _, left, total = carry
        return (left > 0) if until is None else (left > 0) & ~until(total)

    begin = depending_on((stepper, mechanics, load, y, h), (y, contact, h, total))
    if kind == "lax":
        # The bound may be an array: then one program serves for all.
        _, last = jax.lax.while_loop(
            lambda carry: going(carry[1]) & (carry[0] < most),
            lambda carry: (carry[0] + 1, body(carry[1])),
            (jnp.zeros((), jnp.int32), begin),
        )
    else:
        last = eqx.internal.while_loop(going, body, begin, max_steps=most, kind=kind)
    y, contact, left, total = last
    return Followed(y, contact, left, total, ~going(last))
