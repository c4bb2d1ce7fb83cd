"""What must stay positive for a contact mode to last."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from .forces import Each, State, added_forces, gap, slip_speed, total_forces
from .mechanics import Mechanics
from .mode import Contact
from .mode_forces import by_status


def guards(mechanics: Mechanics, contact: Contact, load: Float[Array, ""], y: State) -> Float[Array, "*contacts 2"]:
    """What must stay positive for the status to last.

    stick: distances of T from both edges of the friction cone (N); slide: N (N) and the slip speed (m/s); detach: the gap (m),
    twice.
    """
    forces = added_forces(mechanics, contact, load, y)
    return guards_under(mechanics, contact, *forces, slip_speed(mechanics, contact, y), gap(mechanics, y))


def guards_under(
    mechanics: Mechanics, contact: Contact, tangential_force: Each, normal_force: Each, slip: Each, height: Each
) -> Float[Array, "*contacts 2"]:
    """`guards` from the contact forces added to those at rest, the slip speed and the gap; linear in all of them."""
    _, pressing = total_forces(mechanics, tangential_force, normal_force)
    return by_status(
        contact,
        stick=cone_margins(mechanics, tangential_force, normal_force),
        slide=jnp.stack([pressing, slip], axis=-1),
        detach=jnp.stack([height, height], axis=-1),
    )


def cone_margins(mechanics: Mechanics, tangential_force: Each, normal_force: Each) -> Float[Array, "*contacts 2"]:
    """Distances of T from both edges of the friction cone, in N, from the contact forces added to those at rest."""
    static = mechanics.friction.static
    edge = static * normal_force
    margins = jnp.stack([edge - tangential_force, edge + tangential_force], axis=-1)
    if mechanics.rest is None:
        return margins
    # The margins at rest are worked out from the coefficients, not as a difference of rounded forces: unless static friction is
    # larger, one of them is exactly zero.
    friction = mechanics.rest.friction
    widths = jnp.stack([static - friction, static + friction], axis=-1)
    return margins + widths * mechanics.rest.normal_force[..., None]
