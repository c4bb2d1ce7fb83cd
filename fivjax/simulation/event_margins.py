"""One advance of a trajectory: how close its guards come to zero, and how close the decisions at its end are."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from .. import contact as physics
from ..contact import Contact, Mechanics, Status
from ..foundation.polynomial import value_and_rate
from ..steppers.base import AbstractStepper, rates
from ..steppers.core import left_after, next_part
from ..steppers.event_exact import EventExact

# Instants within one advance at which the guards are evaluated; between two of them, derivatives tell a guard's course.
LOOKS = 32
# The decisions that follow an event, and how to describe one that is nearly a tie.
DECISIONS = (
    "an impact at the edge of the friction cone, where it either ends slip or does not",
    "the slip running out at the edge of the friction cone, where the contact either sticks or slips back",
    "sliding that begins without a normal force",
)
# The first two for several contacts, which are decided together.
DECISIONS_OF_SEVERAL = (
    "impulses of several contacts at the edge of a friction cone, or of none",
    "an event of one contact that decides by a hair what another does",
    DECISIONS[2],
)


class AdvanceMargins(eqx.Module):
    """One advance, with the guards of each contact at equally spaced instants."""

    y: Float[Array, " state"]
    contact: Contact
    h: Float[Array, ""]
    left: Float[Array, ""]  # of the time that was given, s
    turned: Bool[Array, " c"]  # whether the contact has reversed its slip
    ended: Bool[Array, " c"]  # whether one of the contact's guards ran out
    guards: Float[Array, "l c 2"]
    turns: Bool[Array, "l c 2"]  # whether the guard has a minimum close to this instant
    lowest: Float[Array, "l c 2"]  # that value
    slope: Float[Array, "c 2"]  # of the guards at the end, per s, and per s²
    bend: Float[Array, "c 2"]
    size: Float[Array, "c 2"]  # of the terms that the guards are sums of
    # Relative margins of the decisions at the end; infinite for those that were not needed.
    decisions: Float[Array, "3"]
    # Relative margin by which the friction of sliding holds a contact that has landed and sticks; infinite if none has.
    held: Float[Array, ""]


def advance_margins(method: AbstractStepper, mechanics: Mechanics, contact: Contact, load, y, h) -> AdvanceMargins:
    # Just before the end, where the status is still the same.
    shares = jnp.linspace(0.0, 1.0, LOOKS + 1)[1:] * (1 - 1e-9)
    if isinstance(method, EventExact):
        part, is_last = next_part(h, method.dt)
        after, series, unit = method.with_series(mechanics, contact, load, y, part)
        inside = jax.lax.map(lambda share: value_and_rate(series, unit, share * after.h)[0], shares)
    else:
        after, is_last = method.advance(mechanics, contact, load, y, h), jnp.ones((), bool)
        inside = jax.vmap(lambda share: method.advance(mechanics, contact, load, y, share * after.h).y)(shares)
    states = jnp.concatenate([y[None], inside])

    def along(function):
        return lambda state: jax.jvp(function, (state,), (rates(mechanics, contact, load, state),))[1]

    # With an axis over the contacts, even if there is only one.
    orders = [lambda state: physics.guards(mechanics, contact, load, state).reshape(-1, 2)]
    for _ in range(3):
        orders.append(along(orders[-1]))
    # A loop, which a kernel keeps as one.
    value, slope, bend, third = jax.lax.map(lambda state: tuple(order(state) for order in orders), states)
    # Where the slope is zero, by a parabola; at most half an interval to either side, and not beyond the ends.
    to_turn = -slope / jnp.where(bend > 0, bend, 1.0)
    spacing = after.h / LOOKS
    near = (bend > 0) & (jnp.abs(to_turn) <= 0.5 * spacing * (1 + 1e-6))
    look = jnp.arange(LOOKS + 1)[:, None, None]
    near = near & ((look > 0) | (to_turn > 0)) & ((look < LOOKS) | (to_turn < 0))
    # A guard that starts at zero, because the status has just begun, has no minimum at its start.
    begins = jnp.abs(value[0]) <= 1e-9 * jnp.max(jnp.abs(value), axis=0)
    near = near & ~(begins & (look <= 1))
    lowest = value + to_turn * (slope + to_turn * (bend / 2 + to_turn * third / 6))
    turned = (contact.status == Status.SLIDE) & (after.contact.direction != contact.direction)
    turned = jnp.atleast_1d(turned & (after.contact.status == Status.SLIDE))
    ended = jnp.any(after.ended.reshape(-1, 2), axis=-1)
    size, _ = physics.magnitudes(mechanics, contact, load, jnp.max(jnp.abs(states), axis=0))
    if mechanics.several:
        decisions = _decisions_of_several(mechanics, contact, load, after)
    else:
        decisions = _decisions(mechanics, contact, load, states[-1], after.contact, after.y)
    landed = (contact.status == Status.DETACH) & (after.contact.status == Status.STICK)
    return AdvanceMargins(
        after.y,
        after.contact,
        after.h,
        left_after(after, h, is_last),
        turned,
        ended,
        value,
        near,
        lowest,
        slope[-1],
        bend[-1],
        size.reshape(-1, 2),
        decisions,
        jnp.min(jnp.where(landed, held_by_sliding(mechanics, after.contact, load, after.y), jnp.inf)),
    )


def held_by_sliding(mechanics: Mechanics, contact: Contact, load, y) -> Float[Array, "*c"]:
    """The relative margin by which the friction of sliding holds each contact in this mode; below zero it does not."""
    tangential, normal = physics.contact_forces(mechanics, contact, load, y)
    held, need = mechanics.friction(jnp.zeros_like(normal)) * normal, jnp.abs(tangential)
    return (held - need) / jnp.where(held + need > 0, held + need, 1.0)


def _decisions(mechanics: Mechanics, contact: Contact, load, before, following: Contact, after) -> Float[Array, "3"]:
    """Relative margins of the decisions after an event, in the order of `DECISIONS`: the friction cone at an impact, the
    friction cone where a contact comes to rest on the belt, and the normal force where it goes on to slide."""
    n = before.shape[0] // 2
    landed = (contact.status == Status.DETACH) & (following.status != Status.DETACH)
    # In an impact, impulses take the place of forces, and changes of velocity that of accelerations.
    demanded = jnp.zeros(n).at[mechanics.tangential].set(physics.relative_velocity(mechanics, before))
    demanded = demanded.at[mechanics.normal].set((1 + mechanics.restitution) * before[n + mechanics.normal])
    dragged = mechanics.friction(jnp.abs(physics.relative_velocity(mechanics, before)))
    at_impact = margin_from_cone(dragged, *physics.sticking_forces(mechanics, demanded))
    by_impulse = landed & (mechanics.impact_law == "coulomb")
    came_to_rest = (contact.status != Status.STICK) & (physics.relative_velocity(mechanics, after) == 0)
    holding = physics.sticking_forces(mechanics, physics.free_acceleration(mechanics, load, after))
    at_rest = margin_from_cone(mechanics.friction.static, *holding)
    pressed = physics.guards(mechanics, following, load, after)[0]
    terms, _ = physics.magnitudes(mechanics, following, load, jnp.abs(after))
    slides = (following.status == Status.SLIDE) & (contact.status != Status.SLIDE)
    return jnp.stack(
        [
            jnp.where(by_impulse, at_impact, jnp.inf),
            jnp.where(came_to_rest & (following.status != Status.DETACH), at_rest, jnp.inf),
            jnp.where(slides, jnp.abs(pressed) / jnp.where(terms[0] > 0, terms[0], 1.0), jnp.inf),
        ]
    )


def _decisions_of_several(mechanics: Mechanics, contact: Contact, load, after) -> Float[Array, "3"]:
    """The same for several contacts: margins by which the states of the contacts affected by the event are admissible."""
    own = jnp.any(after.ended, axis=-1)
    feels = physics.affected_by(mechanics, own)
    touched = (contact.status == Status.DETACH) & after.ended[:, 0]
    reached = physics.affected_by(mechanics, touched)
    struck = reached & (mechanics.impact_law == "coulomb")
    stopped = physics.stopped(mechanics, contact, after.end, after.ended)
    at_impact = physics.clearness_of_impact(mechanics, stopped, reached)
    following = after.contact
    at_rest = physics.clearness_of_modes(mechanics, load, after.y, following)
    # A mode that follows sticking, or sliding that lost its normal force, begins with zero margin.
    lifted = (contact.status == Status.SLIDE) & after.ended[:, 0]
    asked = feels & ~(own & ((contact.status == Status.STICK) | lifted))
    begins = own & (following.status == Status.SLIDE) & (contact.status != Status.SLIDE)
    pressed = physics.guards(mechanics, following, load, after.y)[:, 0]
    terms, _ = physics.magnitudes(mechanics, following, load, jnp.abs(after.y))
    pressing = jnp.abs(pressed) / jnp.where(terms[:, 0] > 0, terms[:, 0], 1.0)
    return jnp.stack(
        [
            jnp.min(jnp.where(which, margin, jnp.inf))
            for which, margin in ((struck, at_impact), (asked, at_rest), (begins, pressing))
        ]
    )


def margin_from_cone(mu, tangential, normal) -> Float[Array, ""]:
    """The relative distance of a force from the edge of the friction cone; infinite without friction or without force."""
    held, need = mu * jnp.abs(normal), jnp.abs(tangential)
    return jnp.where(held + need > 0, jnp.abs(held - need) / jnp.where(held + need > 0, held + need, 1.0), jnp.inf)
