"""Contact forces and accelerations in a given contact mode, at one instant."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from .mechanics import Mechanics
from .mode import Contact, Status

State = Float[Array, " state"]  # displacements, then velocities


def relative_velocity(mechanics: Mechanics, y: State) -> Float[Array, ""]:
    """Tangential velocity of the structure relative to the belt, in m/s."""
    return y[degrees_of_freedom(y) + mechanics.tangential] - mechanics.belt_speed


def slip_speed(mechanics: Mechanics, contact: Contact, y: State) -> Float[Array, ""]:
    """Slip against the friction force, in m/s; positive while the contact slides in the direction of its status."""
    return -contact.direction * relative_velocity(mechanics, y)


def gap(mechanics: Mechanics, y: State) -> Float[Array, ""]:
    """Distance from the belt, in m."""
    return y[mechanics.normal]


def free_acceleration(mechanics: Mechanics, load: Float[Array, ""], y: State) -> Float[Array, " n"]:
    """Accelerations without contact forces, or with those at `mechanics.rest`, in m/s²."""
    n = degrees_of_freedom(y)
    # Sums over columns rather than matrix products: in a batch these become one fused loop over trajectories.
    acceleration = mechanics.free_load * load
    position, displacement = mechanics.free_position, y[:n]
    if mechanics.springs is not None and mechanics.from_springs is not None:
        position, displacement = mechanics.from_springs, mechanics.springs.stretches(displacement)
    for j in range(n):
        acceleration = acceleration + position[:, j] * displacement[j] + mechanics.free_velocity[:, j] * y[n + j]
    return acceleration


def sticking_forces(mechanics: Mechanics, free: Float[Array, " n"]) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """(T, N) in N that hold the contact still, added to those at rest."""
    g_tt, g_tn, g_nn = mechanics.compliance
    free_t, free_n = free[mechanics.tangential], free[mechanics.normal]
    determinant = g_tt * g_nn - g_tn**2
    return (g_tn * free_n - g_nn * free_t) / determinant, (g_tn * free_t - g_tt * free_n) / determinant


def sliding_forces(
    mechanics: Mechanics, free: Float[Array, " n"], direction: Float[Array, ""], slip: Float[Array, ""]
) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """(T, N) in N while sliding, the friction force pointing in `direction`; added to those at rest."""
    mu = mechanics.friction(slip)
    if mechanics.rest is None:
        normal_force = -free[mechanics.normal] / mechanics.normal_compliance(direction, mu)
        return direction * mu * normal_force, normal_force
    _, g_tn, _ = mechanics.compliance
    # What friction pulls otherwise than at rest under the same pressing force: exactly zero where friction is constant.
    otherwise = (direction * mu - mechanics.rest.friction) * mechanics.rest.normal_force
    added = -(free[mechanics.normal] + g_tn * otherwise) / mechanics.normal_compliance(direction, mu)
    return direction * mu * added + otherwise, added


def total_forces(
    mechanics: Mechanics, tangential_force: Float[Array, ""], normal_force: Float[Array, ""]
) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """(T, N) in N from what is added to those at rest."""
    if mechanics.rest is None:
        return tangential_force, normal_force
    return tangential_force + mechanics.rest.tangential_force, normal_force + mechanics.rest.normal_force


def contact_forces(
    mechanics: Mechanics, contact: Contact, load: Float[Array, ""], y: State
) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """(T, N) in N in the given status; N is negative beyond the instant where contact is lost."""
    return total_forces(mechanics, *added_forces(mechanics, contact, load, y))


def added_forces(
    mechanics: Mechanics, contact: Contact, load: Float[Array, ""], y: State
) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """(T, N) in N in the given status, what is added to those at rest."""
    free = free_acceleration(mechanics, load, y)
    sliding = sliding_forces(mechanics, free, contact.direction, slip_speed(mechanics, contact, y))
    return forces_by_status(mechanics, contact, free, sliding)


def forces_by_status(
    mechanics: Mechanics,
    contact: Contact,
    free: Float[Array, " n"],
    sliding: tuple[Float[Array, ""], Float[Array, ""]],
) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """(T, N) in the given status from the free accelerations and the forces of sliding; added to those at rest."""
    stick_t, stick_n = sticking_forces(mechanics, free)
    slide_t, slide_n = sliding
    open_t = open_n = jnp.zeros_like(slide_n)
    if mechanics.rest is not None:
        open_t, open_n = -mechanics.rest.tangential_force, -mechanics.rest.normal_force
    return (
        by_status(contact, stick=stick_t, slide=slide_t, detach=open_t),
        by_status(contact, stick=stick_n, slide=slide_n, detach=open_n),
    )


def acceleration(mechanics: Mechanics, contact: Contact, load: Float[Array, ""], y: State) -> Float[Array, " n"]:
    """Accelerations in the given status, in m/s²; those that the status forbids are exactly zero."""
    free = free_acceleration(mechanics, load, y)
    return acceleration_under(mechanics, contact, free, *added_forces(mechanics, contact, load, y))


def acceleration_under(
    mechanics: Mechanics,
    contact: Contact,
    free: Float[Array, " n"],
    tangential_force: Float[Array, ""],
    normal_force: Float[Array, ""],
) -> Float[Array, " n"]:
    """Accelerations from the free ones and the contact forces added to those at rest, in m/s²."""
    total = free + mechanics.from_tangential * tangential_force + mechanics.from_normal * normal_force
    index = jnp.arange(free.shape[0])
    held = (index == mechanics.normal) & (contact.status != Status.DETACH)
    held = held | ((index == mechanics.tangential) & (contact.status == Status.STICK))
    return jnp.where(held, 0.0, total)


def by_status(contact: Contact, *, stick, slide, detach):
    """What belongs to the contact's status, of three values."""
    return jnp.where(contact.status == Status.STICK, stick, jnp.where(contact.status == Status.SLIDE, slide, detach))


def degrees_of_freedom(y: State) -> int:
    """Of a structure with this state."""
    return y.shape[0] // 2


def with_contact_coordinates(mechanics: Mechanics, y: State, *, gap, gap_rate, tangential_velocity) -> State:
    """The state with other values of what the contact holds or changes."""
    n = degrees_of_freedom(y)
    index = jnp.arange(2 * n)
    y = jnp.where(index == mechanics.normal, gap, y)
    y = jnp.where(index == n + mechanics.normal, gap_rate, y)
    return jnp.where(index == n + mechanics.tangential, tangential_velocity, y)
