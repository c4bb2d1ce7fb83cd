"""How large the rounding of guards and rates is, and which of them are zero exactly."""

from collections.abc import Sequence

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from .forces import State, by_status, degrees_of_freedom
from .guard import cone_margins
from .mechanics import Mechanics
from .mode import Contact, Status

# A guard whose first coefficient is this much smaller than all of them together starts at zero, but for rounding.
# If it does, the same goes for the next two: where a status begins, they are differences that cancel less well.
SHARES = {"float64": (1e-12, 1e-9, 1e-9), "float32": (5e-6, 1e-4, 1e-4)}
# Or if it is this many roundings of the terms that it is a sum of.
ROUNDINGS = 64
# Rebounds shorter than this share of an advance are at rest; what they would still change is below rounding.
RESTING = {"float64": 1e-7, "float32": 1e-4}


def largest_rounding(sizes: Array) -> Array:
    """What rounding may leave of sums whose largest terms have these sizes (see `magnitudes`)."""
    return ROUNDINGS * jnp.finfo(sizes.dtype).eps * sizes


def zero_at_start(
    c: Sequence[Array] | Array, size: Array, rounding: Sequence[Array] | Array, exact: Bool[Array, "..."]
) -> list[Bool[Array, "..."]]:
    """Whether the first, the first two and the first three Taylor coefficients of guards are zero but for rounding.

    `size` is that of all coefficients together, `rounding` what the first three may be rounded by; of a guard whose start is
    `exact`, little is not nothing.
    """
    zero, found = jnp.ones_like(size, bool), []
    for k, share in enumerate(SHARES[size.dtype.name]):
        relative = jnp.where(exact, 0.0, size * share) if k == 0 else size * share
        zero = zero & (jnp.abs(c[k]) <= jnp.maximum(relative, rounding[k]))
        found.append(zero)
    return found


def exactly_zero(contact: Contact) -> Bool[Array, "2 *batch"]:
    """Which guards are put at zero exactly where their status begins: slip and gap.

    If these are small, they are small, and not zero but for rounding: a slow belt under a high load has a slip that the
    motion outgrows a billionfold before it is used up.
    """
    sliding, detached = contact.status == Status.SLIDE, contact.status == Status.DETACH
    return jnp.stack([detached, sliding | detached])


def magnitudes(
    mechanics: Mechanics, contact: Contact, load: Float[Array, ""], y: State
) -> tuple[Float[Array, "2"], State]:
    """Sizes of the largest terms that the guards and the rates are sums of: their rounding is that share of these.

    `y` holds sizes, too. Where a stiff structure presses hard, forces are small differences of huge terms; whether one
    is zero is a question that only these sizes answer.
    """
    n = degrees_of_freedom(y)
    free = jnp.abs(mechanics.free_load) * jnp.abs(load)
    for j in range(n):
        free = free + jnp.abs(mechanics.free_position[:, j]) * y[j] + jnp.abs(mechanics.free_velocity[:, j]) * y[n + j]
    g_tt, g_tn, g_nn = map(jnp.abs, mechanics.compliance)
    _, tn, _ = mechanics.compliance
    free_t, free_n = free[mechanics.tangential], free[mechanics.normal]
    determinant = g_tt * g_nn - tn**2
    static = mechanics.friction.static
    compliance = jnp.abs(mechanics.normal_compliance(contact.direction, static))
    sliding_n = free_n / jnp.where(compliance > 0, compliance, 1.0)
    none = jnp.zeros_like(free_n)
    stick_t, stick_n = (g_tn * free_n + g_nn * free_t) / determinant, (g_tn * free_t + g_tt * free_n) / determinant
    tangential_force = by_status(contact, stick=stick_t, slide=static * sliding_n, detach=none)
    normal_force = by_status(contact, stick=stick_n, slide=sliding_n, detach=none)
    pressing, margins, onset = normal_force, jnp.zeros(2, normal_force.dtype), none
    if mechanics.rest is not None:
        at_rest, rest_t, rest_n = mechanics.rest, mechanics.rest.tangential_force, mechanics.rest.normal_force
        # What is added to the forces at rest is all that is rounded in the rates, but for forces that are not those.
        dragging = contact.direction * mechanics.friction(jnp.zeros_like(static))
        otherwise = jnp.abs(dragging - at_rest.friction) if mechanics.friction.constant else 2 * static
        tangential_force = tangential_force + by_status(
            contact, stick=none, slide=otherwise * jnp.abs(rest_n), detach=jnp.abs(rest_t)
        )
        normal_force = normal_force + by_status(
            contact, stick=none, slide=g_tn * otherwise * jnp.abs(rest_n) / compliance, detach=jnp.abs(rest_n)
        )
        pressing = normal_force + jnp.abs(rest_n)
        margins = jnp.abs(cone_margins(mechanics, none, none))
        # Slip sets out with the acceleration that rounding leaves of the margin at which sticking ended; were that taken for
        # more than nothing, the two would hand over to each other for ever.
        edge = static * stick_n + stick_t
        onset = jnp.where(contact.status == Status.SLIDE, edge * jnp.abs(determinant) / compliance, 0.0)
    slip = y[n + mechanics.tangential] + jnp.abs(mechanics.belt_speed)
    edge = static * normal_force + tangential_force
    guards = by_status(
        contact,
        stick=edge + margins,
        slide=jnp.stack([pressing, slip]),
        detach=jnp.stack([y[mechanics.normal]] * 2),
    )
    acceleration = (
        free + jnp.abs(mechanics.from_tangential) * tangential_force + jnp.abs(mechanics.from_normal) * normal_force
    )
    acceleration = acceleration + jnp.where(jnp.arange(n) == mechanics.tangential, onset, 0.0)
    return guards, on_constraint_rates(mechanics, contact, jnp.concatenate([y[n:], acceleration]))


def on_constraint_rates(mechanics: Mechanics, contact: Contact, rates: State) -> State:
    """Rates with what the status forbids set to exactly zero: those of the gap, and creep while sticking."""
    n = degrees_of_freedom(rates)
    touching, sticking = contact.status != Status.DETACH, contact.status == Status.STICK
    index = jnp.arange(2 * n)
    held = touching & ((index == mechanics.normal) | (index == n + mechanics.normal))
    return jnp.where(held | (sticking & (index == n + mechanics.tangential)), 0.0, rates)
