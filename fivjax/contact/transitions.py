"""What follows when a contact mode ends: the next mode, chosen from the forces, and the state on its constraint."""

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from .forces import (
    State,
    degrees_of_freedom,
    free_acceleration,
    gap,
    relative_velocity,
    sliding_forces,
    sticking_forces,
    total_forces,
    with_contact_coordinates,
)
from .guard import cone_margins
from .impacts import impact
from .mechanics import Mechanics
from .mode import Contact, Status


def on_constraint(mechanics: Mechanics, contact: Contact, y: State) -> State:
    """The state with what the status forbids set to exactly zero: gap and its rate, and creep while sticking."""
    touching = contact.status != Status.DETACH
    sticking = contact.status == Status.STICK
    return with_contact_coordinates(
        mechanics,
        y,
        gap=jnp.where(touching, 0.0, gap(mechanics, y)),
        gap_rate=jnp.where(touching, 0.0, y[degrees_of_freedom(y) + mechanics.normal]),
        tangential_velocity=jnp.where(sticking, mechanics.belt_speed, y[degrees_of_freedom(y) + mechanics.tangential]),
    )


def transition(
    mechanics: Mechanics,
    contact: Contact,
    load: Float[Array, ""],
    y: State,
    ended: Bool[Array, "2"],
    resolution: Float[Array, ""],
) -> tuple[Contact, State]:
    """What follows where the guards in `ended` are used up: the next status, and the state on its constraint.

    Where none is, nothing changes. A rebound that would be back on the belt within the time `resolution` (s) is taken
    to have come to rest: with restitution, bounces get shorter without end, and a stepper can follow only so many.
    """
    n = degrees_of_freedom(y)
    detached = contact.status == Status.DETACH
    sliding = contact.status == Status.SLIDE
    lifted = sliding & ended[0]
    touched = detached & ended[0]
    # Slip that has run out is put at exactly zero; sticking has none to begin with.
    stopped = (sliding & ended[1]) | (contact.status == Status.STICK)
    stopped_velocity = jnp.where(stopped, mechanics.belt_speed, y[n + mechanics.tangential])
    y_stopped = with_contact_coordinates(
        mechanics,
        y,
        gap=jnp.where(touched, 0.0, gap(mechanics, y)),
        gap_rate=y[n + mechanics.normal],
        tangential_velocity=stopped_velocity,
    )
    y_next = jnp.where(touched, _resting(mechanics, load, impact(mechanics, y_stopped), resolution), y_stopped)
    # At the edge of the friction cone, or where N has just reached zero, rounding alone would decide whether the status
    # that has ended goes on. It does not.
    following = status_from_forces(mechanics, load, y_next, may_stick=contact.status != Status.STICK)
    following = Contact(
        status=jnp.where(lifted, Status.DETACH, following.status).astype(following.status.dtype),
        direction=following.direction,
    )
    y_next = on_constraint(mechanics, following, y_next)
    any_ended = jnp.any(ended)
    return (
        Contact(
            status=jnp.where(any_ended, following.status, contact.status),
            direction=jnp.where(any_ended, following.direction, contact.direction),
        ),
        jnp.where(any_ended, y_next, y),
    )


def status_from_forces(
    mechanics: Mechanics, load: Float[Array, ""], y: State, may_stick: Bool[Array, ""] | bool = True
) -> Contact:
    """The status that a state on its constraints is in, found from the forces that each status would need.

    Open or opening: detached. Slipping: sliding if pressed, else detached. At rest on the belt: sticking if the holding
    force lies in the friction cone, else sliding the way it is pushed, else detached.
    """
    free = free_acceleration(mechanics, load, y)
    slip = relative_velocity(mechanics, y)
    open_ = (gap(mechanics, y) > 0) | (y[degrees_of_freedom(y) + mechanics.normal] > 0)
    holds = sticking_forces(mechanics, free)
    held = jnp.all(cone_margins(mechanics, *holds) >= 0)
    holding, pressing = total_forces(mechanics, *holds)
    sticks = may_stick & (slip == 0) & (pressing > 0) & held
    pushed = jnp.where(slip == 0, jnp.sign(holding), -jnp.sign(slip))
    direction = jnp.where(pushed == 0, 1.0, pushed).astype(y.dtype)
    _, sliding_normal_force = total_forces(mechanics, *sliding_forces(mechanics, free, direction, jnp.abs(slip)))
    status = jnp.where(
        open_,
        Status.DETACH,
        jnp.where(sticks, Status.STICK, jnp.where(sliding_normal_force > 0, Status.SLIDE, Status.DETACH)),
    )
    return Contact(status=status.astype(jnp.int32), direction=direction)


def _resting(mechanics: Mechanics, load: Float[Array, ""], y: State, resolution: Float[Array, ""]) -> State:
    rate = y[degrees_of_freedom(y) + mechanics.normal]
    free_n = free_acceleration(mechanics, load, y)[mechanics.normal]
    if mechanics.rest is not None:
        _, g_tn, g_nn = mechanics.compliance
        free_n = free_n - g_tn * mechanics.rest.tangential_force - g_nn * mechanics.rest.normal_force
    rests = rate + 0.5 * free_n * resolution <= 0
    return jnp.where(jnp.arange(y.shape[0]) == degrees_of_freedom(y) + mechanics.normal, jnp.where(rests, 0.0, rate), y)
