"""Velocities after the gap has closed."""

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from .coordinates import spread
from .forces import (
    State,
    acceleration,
    contact_forces,
    degrees_of_freedom,
    gap,
    gap_rate,
    relative_velocity,
    with_contact_coordinates,
)
from .mechanics import Mechanics
from .mode import Contact, Status
from .mode_forces import holding_forces
from .several_contacts import impulses_of_impact


def impact(mechanics: Mechanics, y: State, reached: Bool[Array, " c"] | bool = True) -> State:
    """The state after the gap has closed: Newton's restitution for the normal velocity, the scene's impact law for the rest.

    - "coulomb" (default): the tangential impulse obeys Coulomb's law: it ends the slip if it then lies in the friction cone
      (with the friction at the slip speed before the impact), else it lies on the cone's edge.
    - "frictionless": no tangential impulse; the normal one moves whatever the mass matrix couples to it.
    - "reset": only the normal velocity is changed, as in codes that reset this one number. Not consistent with momentum.

    With several contacts, all with a closed gap take part that the impact has `reached`, by the mass matrix: an impulse on one
    may lift or stop another, or reverse its slip.

    Newton's restitution above zero together with friction can create energy where the normal impulse reverses the slip (Kane's
    paradox); that takes a strong coupling of the two coordinates in the mass matrix. Restitution 0 never creates energy.

    The paper does not state its law; its Table 2 comes out the same with all three.
    """
    n = degrees_of_freedom(y)
    approach = gap_rate(mechanics, y)
    if mechanics.impact_law == "reset":
        jump = -(1.0 + mechanics.restitution) * approach
        if mechanics.several:
            jump = jnp.where((gap(mechanics, y) <= 0) & (approach < 0) & reached, jump, 0.0)
        return y.at[n + mechanics.normal].add(jump)
    if mechanics.several:
        y, struck, ends_slip = impulses_of_impact(mechanics, y, reached)
        # A contact on the belt that got no impulse: a gap rate that is negative by rounding only is set to zero.
        own = gap_rate(mechanics, y)
        own = jnp.where((gap(mechanics, y) <= 0) & reached, jnp.maximum(own, 0.0), own)
        rate = jnp.where(struck, -mechanics.restitution * approach, own)
    else:
        y, ends_slip = _one(mechanics, y)
        rate = -mechanics.restitution * approach
    # The law's demands are set exactly, without rounding: a mass that comes to rest on the belt has the belt's speed.
    tangential_velocity = y[n + mechanics.tangential]
    if mechanics.impact_law == "coulomb":
        tangential_velocity = jnp.where(ends_slip, mechanics.belt_speed, tangential_velocity)
    return with_contact_coordinates(
        mechanics, y, gap=gap(mechanics, y), gap_rate=rate, tangential_velocity=tangential_velocity
    )


def _one(mechanics: Mechanics, y: State):
    """The state after the impulse on one contact, and whether it ends slip."""
    n = degrees_of_freedom(y)
    _, _, g_nn = mechanics.compliance
    slip = relative_velocity(mechanics, y)
    jump = -(1.0 + mechanics.restitution) * gap_rate(mechanics, y)
    ends_slip = False
    if mechanics.impact_law == "frictionless":
        tangential_impulse, normal_impulse = jnp.zeros_like(jump), jump / g_nn
    else:
        mu = mechanics.friction(jnp.abs(slip))
        ending, ending_normal = holding_forces(mechanics, slip, -jump)
        direction = jnp.sign(ending)
        dragging_normal = jump / mechanics.normal_compliance(direction, mu)
        ends_slip = jnp.abs(ending) <= mu * ending_normal
        tangential_impulse = jnp.where(ends_slip, ending, direction * mu * dragging_normal)
        normal_impulse = jnp.where(ends_slip, ending_normal, dragging_normal)
    kick = mechanics.from_tangential * tangential_impulse + mechanics.from_normal * normal_impulse
    return y.at[n:].add(kick), ends_slip


def after_brief_flights(mechanics: Mechanics, contact: Contact, load: Float[Array, ""], y: State) -> Float[Array, " n"]:
    """How velocities differ, per m/s of a rebound that counts as rest, from those of one contact that stays on the belt.

    That is the derivative of what follows a landing by the speed of its rebound. A rebound of speed v flies for 2 v / a under
    the acceleration a towards the belt, and with restitution e again with e v, e² v, ... Meanwhile the forces of the mode
    `contact` are missing, and impacts end the flights. Where the impulses of all impacts lie on the same edge of the friction
    cone as these forces do, or all end the slip, they make up for exactly what is missing, with that of the landing.
    """
    g_tt, g_tn, g_nn = mechanics.compliance
    tangential_force, normal_force = contact_forces(mechanics, contact, load, y)
    pressing = g_tn * tangential_force + g_nn * normal_force
    # With hardly any loss they never end, and no rebound counts as rest.
    e = jnp.where(mechanics.restitution < 1 - 1e-6, mechanics.restitution, 0.0)
    # In all, per m/s: the time of the flights, in s, and the changes of the gap's rate by the impacts that end them.
    flight, jump = 2.0 / (1 - e) / jnp.where(pressing > 0, pressing, 1.0), (1 + e) / (1 - e)
    if mechanics.impact_law == "reset":
        tangential = normal = jnp.zeros_like(flight)
    elif mechanics.impact_law == "frictionless":
        tangential, normal = jnp.zeros_like(flight), jump / g_nn
    else:
        slip = relative_velocity(mechanics, y)
        mu = mechanics.friction(jnp.abs(slip))
        # After an impact that ended the slip, it is what the flight leaves: without contact forces.
        along = acceleration(mechanics, contact, load, y)[mechanics.tangential]
        left = (along - g_tt * tangential_force - g_tn * normal_force) * flight
        ending, ending_normal = holding_forces(mechanics, left, -jump)
        ends_slip = (slip == 0) & (jnp.abs(ending) <= mu * ending_normal)
        dragging = jump / mechanics.normal_compliance(contact.direction, mu)
        tangential = jnp.where(ends_slip, ending, contact.direction * mu * dragging)
        normal = jnp.where(ends_slip, ending_normal, dragging)
    tangential, normal = tangential - tangential_force * flight, normal - normal_force * flight
    # A contact that sticks is held: whatever the impulses in between, they add up to none.
    held, held_normal = holding_forces(mechanics, jnp.zeros_like(flight), jnp.ones_like(flight))
    sticks = contact.status == Status.STICK
    tangential, normal = jnp.where(sticks, held, tangential), jnp.where(sticks, held_normal, normal)
    return spread(mechanics.from_tangential, tangential) + spread(mechanics.from_normal, normal)
