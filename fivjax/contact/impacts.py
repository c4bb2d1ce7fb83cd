"""Velocities after the gap has closed."""

import jax.numpy as jnp

from .forces import State, degrees_of_freedom, gap, gap_rate, relative_velocity, with_contact_coordinates
from .mechanics import Mechanics
from .several_contacts import impulses_of_impact


def impact(mechanics: Mechanics, y: State) -> State:
    """The state after the gap has closed: Newton's restitution for the normal velocity, the scene's impact law for the rest.

    - "coulomb" (default): the tangential impulse obeys Coulomb's law: it ends the slip if it then lies in the friction cone
      (with the friction at the slip speed before the impact), else it lies on the cone's edge.
    - "frictionless": no tangential impulse; the normal one moves whatever the mass matrix couples to it.
    - "reset": only the normal velocity is changed, as in codes that reset this one number. Not consistent with momentum.

    With several contacts, all with a closed gap take part: an impulse on one may lift or stop another, or reverse its slip.

    Newton's restitution above zero together with friction can create energy where the normal impulse reverses the slip (Kane's
    paradox); that takes a strong coupling of the two coordinates in the mass matrix. Restitution 0 never creates energy.

    The paper does not state its law; its Table 2 comes out the same with all three.
    """
    n = degrees_of_freedom(y)
    approach = gap_rate(mechanics, y)
    if mechanics.impact_law == "reset":
        jump = -(1.0 + mechanics.restitution) * approach
        if mechanics.several:
            jump = jnp.where((gap(mechanics, y) <= 0) & (approach < 0), jump, 0.0)
        return y.at[n + mechanics.normal].add(jump)
    if mechanics.several:
        y, struck, ends_slip = impulses_of_impact(mechanics, y)
        # A contact on the belt that got no impulse: a gap rate that is negative by rounding only is set to zero.
        own = gap_rate(mechanics, y)
        own = jnp.where(gap(mechanics, y) <= 0, jnp.maximum(own, 0.0), own)
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
    g_tt, g_tn, g_nn = mechanics.compliance
    slip = relative_velocity(mechanics, y)
    jump = -(1.0 + mechanics.restitution) * gap_rate(mechanics, y)
    ends_slip = False
    if mechanics.impact_law == "frictionless":
        tangential_impulse, normal_impulse = jnp.zeros_like(jump), jump / g_nn
    else:
        mu = mechanics.friction(jnp.abs(slip))
        determinant = g_tt * g_nn - g_tn**2
        ending = (-g_nn * slip - g_tn * jump) / determinant
        ending_normal = (g_tn * slip + g_tt * jump) / determinant
        direction = jnp.sign(ending)
        dragging_normal = jump / mechanics.normal_compliance(direction, mu)
        ends_slip = jnp.abs(ending) <= mu * ending_normal
        tangential_impulse = jnp.where(ends_slip, ending, direction * mu * dragging_normal)
        normal_impulse = jnp.where(ends_slip, ending_normal, dragging_normal)
    kick = mechanics.from_tangential * tangential_impulse + mechanics.from_normal * normal_impulse
    return y.at[n:].add(kick), ends_slip
