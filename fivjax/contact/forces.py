"""Contact forces and accelerations in a given contact mode, at one instant."""

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from ..foundation.linear_solve import product
from .coordinates import at_places, spread, with_values
from .mechanics import Mechanics
from .mode import Contact, Status
from .mode_forces import Each, ModeForces

State = Float[Array, " state"]  # displacements, then velocities


def relative_velocity(mechanics: Mechanics, y: State) -> Each:
    """Tangential velocity of the structure relative to the belt, in m/s."""
    return y[degrees_of_freedom(y) + mechanics.tangential] - mechanics.belt_speed


def slip_speed(mechanics: Mechanics, contact: Contact, y: State) -> Each:
    """Slip against the direction of the friction force, in m/s; positive while the contact slides as its mode says."""
    return -contact.direction * relative_velocity(mechanics, y)


def gap(mechanics: Mechanics, y: State) -> Each:
    """Distance from the belt, in m."""
    return y[mechanics.normal]


def gap_rate(mechanics: Mechanics, y: State) -> Each:
    """How fast the gap opens, in m/s."""
    return y[degrees_of_freedom(y) + mechanics.normal]


def free_acceleration(mechanics: Mechanics, load: Float[Array, ""], y: State) -> Float[Array, " n"]:
    """Accelerations without contact forces, or with those at `mechanics.rest`, in m/s²."""
    matrices, (displacement, velocity) = free_matrices(mechanics), measured(mechanics, y)
    return mechanics.free_load * load + (product(matrices[0], displacement) + product(matrices[1], velocity))


def free_matrices(mechanics: Mechanics) -> tuple[Float[Array, "n s"], Float[Array, "n n"]]:
    """What the free accelerations are of the displacements, as they are `measured`, and of the velocities."""
    from_springs = mechanics.from_springs
    return mechanics.free_position if from_springs is None else from_springs, mechanics.free_velocity


def measured(mechanics: Mechanics, y: State) -> tuple[Float[Array, " s"], Float[Array, " n"]]:
    """Displacements, or with `mechanics.springs` the stretches of these, and velocities."""
    n = degrees_of_freedom(y)
    return (y[:n] if mechanics.springs is None else mechanics.springs.stretches(y[:n])), y[n:]


def total_forces(mechanics: Mechanics, tangential_force: Each, normal_force: Each) -> tuple[Each, Each]:
    """The total (T, N) in N, from the forces added to those at rest."""
    if mechanics.rest is None:
        return tangential_force, normal_force
    return tangential_force + mechanics.rest.tangential_force, normal_force + mechanics.rest.normal_force


def contact_forces(mechanics: Mechanics, contact: Contact, load: Float[Array, ""], y: State) -> tuple[Each, Each]:
    """(T, N) in N in the given status; N is negative beyond the instant where contact is lost."""
    return total_forces(mechanics, *added_forces(mechanics, contact, load, y))


def added_forces(mechanics: Mechanics, contact: Contact, load: Float[Array, ""], y: State) -> tuple[Each, Each]:
    """(T, N) in N that the given status adds to the forces at rest."""
    mode = ModeForces(mechanics, contact, mechanics.friction(slip_speed(mechanics, contact, y)))
    return mode.added(mechanics, free_acceleration(mechanics, load, y))


def acceleration(mechanics: Mechanics, contact: Contact, load: Float[Array, ""], y: State) -> Float[Array, " n"]:
    """Accelerations in the given status, in m/s²; those that the status forbids are exactly zero."""
    free = free_acceleration(mechanics, load, y)
    return acceleration_under(mechanics, contact, free, *added_forces(mechanics, contact, load, y))


def acceleration_under(
    mechanics: Mechanics, contact: Contact, free: Float[Array, " n"], tangential_force: Each, normal_force: Each
) -> Float[Array, " n"]:
    """Accelerations from the free ones and the contact forces added to those at rest, in m/s²."""
    pushed = spread(mechanics.from_tangential, tangential_force)
    total = free + pushed + spread(mechanics.from_normal, normal_force)
    return jnp.where(constrained_coordinates(mechanics, contact), 0.0, total)


def constrained_coordinates(mechanics: Mechanics, contact: Contact) -> Bool[Array, " n"]:
    """Which coordinates the status keeps from being accelerated."""
    n = mechanics.free_load.shape[0]
    closed = at_places(n, mechanics.normal, contact.status != Status.DETACH)
    return closed | at_places(n, mechanics.tangential, contact.status == Status.STICK)


def degrees_of_freedom(y: State) -> int:
    """Number of degrees of freedom of a structure with this state."""
    return y.shape[0] // 2


def with_contact_coordinates(mechanics: Mechanics, y: State, *, gap, gap_rate, tangential_velocity) -> State:
    """The state with new values of gap (m), gap rate and tangential velocity (m/s)."""
    n = degrees_of_freedom(y)
    return with_values(
        y,
        [(mechanics.normal, gap), (n + mechanics.normal, gap_rate), (n + mechanics.tangential, tangential_velocity)],
    )
