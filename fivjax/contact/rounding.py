"""How large the rounding errors of guards and rates are, and which guards start at exactly zero."""

from collections.abc import Sequence

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from ..foundation.linear_solve import product
from .coordinates import at_places, spread, with_values
from .forces import Each, State, degrees_of_freedom
from .guard import cone_margins
from .mechanics import Mechanics
from .mode import Contact, Status
from .mode_forces import ModeForces, by_status

# A guard starts at zero, up to rounding, if its first Taylor coefficient is no larger than this share of all of them together.
# The other two shares are for the next two coefficients, which are differences that cancel less well where a status begins.
SHARES = {"float64": (1e-12, 1e-9, 1e-9), "float32": (5e-6, 1e-4, 1e-4)}
# Rebounds shorter than this share of the time in which the fastest vibration advances by about one rad count as rest. Not of an
# advance: what follows from a rebound more or less is far above rounding, and would depend on where advances end.
RESTING = {"float64": 1e-8, "float32": 1e-4}


def largest_rounding(sizes: Array) -> Array:
    """Bound on the rounding error of sums whose largest terms have these sizes (see `magnitudes`)."""
    # So many roundings of the largest of the terms that it is a sum of.
    roundings = 64
    return roundings * jnp.finfo(sizes.dtype).eps * sizes


def zero_at_start(
    c: Sequence[Array] | Array, size: Array, rounding: Sequence[Array] | Array, exact: Bool[Array, "..."]
) -> list[Bool[Array, "..."]]:
    """Whether the first, the first two and the first three Taylor coefficients of guards are zero up to rounding.

    `size` is that of all coefficients together, `rounding` the bound on the rounding of each of the first three. Where the
    start of a guard is `exact`, its first coefficient is compared with `rounding` only: a small value is not zero.
    """
    zero, found = jnp.ones_like(size, bool), []
    for k, share in enumerate(SHARES[size.dtype.name]):
        relative = jnp.where(exact, 0.0, size * share) if k == 0 else size * share
        zero = zero & (jnp.abs(c[k]) <= jnp.maximum(relative, rounding[k]))
        found.append(zero)
    return found


def exactly_zero(contact: Contact) -> Bool[Array, "2 *batch"]:
    """Which guards are set to exactly zero where their status begins: the slip speed while sliding, the gap while detached.

    A small value of these is no rounding error: on a slow belt under a high load the slip speed starts a billion times smaller
    than it becomes before it is used up.
    """
    sliding, detached = contact.status == Status.SLIDE, contact.status == Status.DETACH
    return jnp.stack([detached, sliding | detached])


def magnitudes(
    mechanics: Mechanics, contact: Contact, load: Float[Array, ""], y: State, mode: ModeForces | None = None
) -> tuple[Float[Array, "*contacts 2"], State]:
    """Sizes of the largest terms in the sums that make guards and rates; rounding errors are proportional to them.

    `y` holds sizes, too. In a stiff structure under a high load, forces are small differences of huge terms; only these sizes
    tell whether such a force is zero. `mode` holds the forces of the contact's mode, where they are known already.
    """
    n = degrees_of_freedom(y)
    free = jnp.abs(mechanics.free_load) * jnp.abs(load)
    free = free + product(jnp.abs(mechanics.free_position), y[:n]) + product(jnp.abs(mechanics.free_velocity), y[n:])
    static = mechanics.friction.static
    of = _several_sizes if mechanics.several else _one_size
    tangential_force, normal_force, resting_n, onset = of(mechanics, contact, free, mode)
    none = jnp.zeros_like(normal_force)
    pressing, margins = normal_force, jnp.zeros((*none.shape, 2), none.dtype)
    if mechanics.rest is not None:
        at_rest = mechanics.rest
        # In the rates only the forces added to those at rest are rounded, and the part by which others replace those at rest.
        tangential_force = tangential_force + by_status(
            contact,
            stick=none,
            slide=_other_friction(mechanics, contact) * jnp.abs(at_rest.normal_force),
            detach=jnp.abs(at_rest.tangential_force),
        )
        normal_force = normal_force + resting_n
        pressing = normal_force + jnp.abs(at_rest.normal_force)
        margins = jnp.abs(cone_margins(mechanics, none, none))
    slip = y[n + mechanics.tangential] + jnp.abs(mechanics.belt_speed)
    edge = static * normal_force + tangential_force
    guards = by_status(
        contact,
        stick=edge[..., None] + margins,
        slide=jnp.stack([pressing, slip], axis=-1),
        detach=jnp.stack([y[mechanics.normal]] * 2, axis=-1),
    )
    acceleration = (
        free
        + spread(jnp.abs(mechanics.from_tangential), tangential_force)
        + spread(jnp.abs(mechanics.from_normal), normal_force)
    )
    acceleration = acceleration + with_values(jnp.zeros_like(free), [(mechanics.tangential, onset)])
    return guards, on_constraint_rates(mechanics, contact, jnp.concatenate([y[n:], acceleration]))


def _other_friction(mechanics: Mechanics, contact: Contact) -> Each:
    """How far σμ may be from its value at rest."""
    assert mechanics.rest is not None
    static = mechanics.friction.static
    signed_friction = contact.direction * mechanics.friction(jnp.zeros_like(static))
    return jnp.abs(signed_friction - mechanics.rest.friction) if mechanics.friction.constant else 2 * static


def _one_size(mechanics: Mechanics, contact: Contact, free: Float[Array, " n"], mode) -> tuple[Each, Each, Each, Each]:
    """Sizes of T and N of one contact, of the part of N by which the mode replaces the force at rest, and of the acceleration
    with which slip begins.
    """
    del mode
    g_tt, g_tn, g_nn = map(jnp.abs, mechanics.compliance)
    _, tn, _ = mechanics.compliance
    free_t, free_n = free[mechanics.tangential], free[mechanics.normal]
    determinant = g_tt * g_nn - tn**2
    static = mechanics.friction.static
    compliance = jnp.abs(mechanics.normal_compliance(contact.direction, static))
    # All coefficients of a series have these divisors.
    over_compliance, over_determinant = 1.0 / jnp.where(compliance > 0, compliance, 1.0), 1.0 / determinant
    sliding_n = free_n * over_compliance
    none = jnp.zeros_like(free_n)
    stick_t = (g_tn * free_n + g_nn * free_t) * over_determinant
    stick_n = (g_tn * free_t + g_tt * free_n) * over_determinant
    tangential_force = by_status(contact, stick=stick_t, slide=static * sliding_n, detach=none)
    normal_force = by_status(contact, stick=stick_n, slide=sliding_n, detach=none)
    if mechanics.rest is None:
        return tangential_force, normal_force, none, none
    rest_n = jnp.abs(mechanics.rest.normal_force)
    replaced = g_tn * _other_friction(mechanics, contact) * rest_n * over_compliance
    resting_n = by_status(contact, stick=none, slide=replaced, detach=rest_n)
    # Slip begins with an acceleration that is the rounding error of the margin at which sticking ended. If it counted as more
    # than zero, sticking and sliding would follow each other for ever.
    edge = static * stick_n + stick_t
    onset = jnp.where(contact.status == Status.SLIDE, edge * jnp.abs(determinant) * over_compliance, 0.0)
    return tangential_force, normal_force, resting_n, onset


def _several_sizes(
    mechanics: Mechanics, contact: Contact, free: Float[Array, " n"], mode: ModeForces | None
) -> tuple[Each, Each, Each, Each]:
    """The same for several contacts."""
    static = mechanics.friction.static
    mode = ModeForces(mechanics, contact, static) if mode is None else mode
    assert mode.inverse is not None
    inverse, count = jnp.abs(mode.inverse), len(mechanics.places)
    free_t, free_n = free[mechanics.tangential], free[mechanics.normal]
    sticking, closed = contact.status == Status.STICK, contact.status != Status.DETACH
    right = jnp.concatenate([jnp.where(sticking, free_t, 0.0), jnp.where(closed, free_n, 0.0)])
    forces = inverse @ right
    none = jnp.zeros_like(free_t)
    if mechanics.rest is None:
        return forces[:count], forces[count:], none, none
    rest_t, rest_n = jnp.abs(mechanics.rest.tangential_force), jnp.abs(mechanics.rest.normal_force)
    missing_t = by_status(contact, stick=none, slide=_other_friction(mechanics, contact) * rest_n, detach=rest_t)
    missing = inverse @ jnp.concatenate([missing_t, jnp.where(closed, 0.0, rest_n)])
    g_tt, _, g_nn = mechanics.compliance
    alone = free_n / jnp.diagonal(g_nn)
    onset = jnp.abs(jnp.diagonal(g_tt)) * (static * alone + free_t / jnp.diagonal(g_tt))
    onset = jnp.where(contact.status == Status.SLIDE, onset, 0.0)
    return forces[:count], forces[count:], missing[count:], onset


def on_constraint_rates(mechanics: Mechanics, contact: Contact, rates: State) -> State:
    """Rates with those that the status forbids set to exactly zero: those of a closed gap, and slip while sticking."""
    n = degrees_of_freedom(rates)
    touching, sticking = contact.status != Status.DETACH, contact.status == Status.STICK
    held = at_places(2 * n, mechanics.normal, touching) | at_places(2 * n, n + mechanics.normal, touching)
    return jnp.where(held | at_places(2 * n, n + mechanics.tangential, sticking), 0.0, rates)
