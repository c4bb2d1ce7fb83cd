"""What follows an event of several contacts: their modes, from the forces, and the impulses where gaps have closed."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from .contact_problem import (
    BACKWARD,
    FORWARD,
    NONE,
    OPEN,
    STICK,
    ContactProblem,
    are_allowed,
    forces_of,
    margins,
    settled_states,
)
from .coordinates import spread
from .forces import State, degrees_of_freedom, free_acceleration, gap, gap_rate, relative_velocity
from .mechanics import Mechanics, Rest
from .mode import Contact, Status


def modes_from_forces(
    mechanics: Mechanics,
    load: Float[Array, ""],
    y: State,
    before: Contact | None = None,
    ended: Int[Array, " c"] | None = None,
) -> Contact:
    """The modes of a state on its constraints, from the forces that each mode would need.

    `before` is a guess. `ended` has the states that have just ended, as in `ContactProblem`: they must not be chosen again
    because of rounding.
    """
    problem = _mode_problem(mechanics, load, y, ended)
    away, slips, slip = problem.away, problem.slips, relative_velocity(mechanics, y)
    guess = jnp.where(away, OPEN, jnp.where(slips, jnp.where(slip < 0, FORWARD, BACKWARD), STICK))
    if before is not None:
        going_on = state_of(before)
        guess = jnp.where(are_allowed(problem, going_on), going_on, guess)
    found = settled_states(problem, guess.astype(jnp.int32))
    status = jnp.where(found == STICK, Status.STICK, jnp.where(found == OPEN, Status.DETACH, Status.SLIDE))
    return Contact(status.astype(jnp.int32), jnp.where(found == BACKWARD, -1.0, 1.0).astype(y.dtype))


def impulses_of_impact(
    mechanics: Mechanics, y: State, reached: Bool[Array, " c"] | bool = True
) -> tuple[State, Bool[Array, " c"], Bool[Array, " c"]]:
    """The state after gaps have closed, by Newton's and Coulomb's laws for all contacts on the belt at once; which of them got
    an impulse; and whose slip it ended.

    Every contact on the belt takes part that the impact has `reached` (`affected_by`): an impulse on one may lift or stop
    another, or reverse its slip.
    """
    n, frictionless = degrees_of_freedom(y), mechanics.impact_law == "frictionless"
    problem = _impact_problem(mechanics, y, reached)
    away = problem.away
    guess = jnp.where(away, OPEN, FORWARD if frictionless else STICK)
    found = settled_states(problem, guess.astype(jnp.int32))
    tangential_impulse, normal_impulse = forces_of(problem, found)
    kick = spread(mechanics.from_tangential, tangential_impulse) + spread(mechanics.from_normal, normal_impulse)
    return y.at[n:].add(kick), found != OPEN, found == STICK


def _mode_problem(
    mechanics: Mechanics, load: Float[Array, ""], y: State, ended: Int[Array, " c"] | None = None
) -> ContactProblem:
    """The problem of the forces in a state on its constraints."""
    slip = relative_velocity(mechanics, y)
    free = free_acceleration(mechanics, load, y)
    away = (gap(mechanics, y) > 0) | (gap_rate(mechanics, y) > 0)
    slips = slip != 0
    sliding, static = mechanics.friction(jnp.abs(slip)), mechanics.friction.static
    along, apart = _sizes_of_free(mechanics, load, y)
    force_size, change_size = _sizes(mechanics, along, apart, mechanics.rest)
    return ContactProblem(
        compliance=mechanics.compliance,
        tangential=free[mechanics.tangential],
        normal=free[mechanics.normal],
        sliding=sliding,
        static=static,
        **_of_rest(mechanics.rest, sliding, static),
        allowed=_allowed(away, slips, slip < 0),
        slips=slips,
        away=away,
        ended=jnp.full_like(away, NONE, jnp.int32) if ended is None else ended.astype(jnp.int32),
        force_size=force_size,
        change_size=change_size,
    )


def _impact_problem(mechanics: Mechanics, y: State, reached: Bool[Array, " c"] | bool) -> ContactProblem:
    """The problem of the impulses in a state whose gaps have closed."""
    approach, slip = gap_rate(mechanics, y), relative_velocity(mechanics, y)
    away = (gap(mechanics, y) > 0) | jnp.logical_not(reached)
    demanded = (1.0 + mechanics.restitution) * approach
    mu = mechanics.friction(jnp.abs(slip))
    frictionless = mechanics.impact_law == "frictionless"
    if frictionless:
        mu = jnp.zeros_like(mu)
    nobody = jnp.zeros_like(away)
    force_size, change_size = _sizes(mechanics, jnp.abs(slip), jnp.abs(demanded))
    return ContactProblem(
        compliance=mechanics.compliance,
        tangential=slip,
        normal=demanded,
        sliding=mu,
        static=mu,
        **_of_rest(None, mu, mu),
        # Without friction the only choice is whether there is an impulse.
        allowed=_allowed(away, jnp.full_like(away, frictionless), ~nobody),
        slips=jnp.full_like(away, frictionless),
        away=away,
        ended=jnp.full_like(away, NONE, jnp.int32),
        force_size=force_size,
        change_size=change_size,
    )


def clearness_of_modes(mechanics: Mechanics, load: Float[Array, ""], y: State, contact: Contact) -> Float[Array, " c"]:
    """Margins by which the modes of a state on its constraints are admissible, relative to the terms in their conditions."""
    return jnp.abs(jnp.minimum(*margins(_mode_problem(mechanics, load, y), state_of(contact))))


def clearness_of_impact(mechanics: Mechanics, y: State, reached: Bool[Array, " c"] | bool = True) -> Float[Array, " c"]:
    """The same for the impulses where gaps have closed."""
    problem = _impact_problem(mechanics, y, reached)
    found = settled_states(problem, jnp.where(problem.away, OPEN, STICK).astype(jnp.int32))
    # Slip that goes on, and what is off the belt, are no part of the impulses: an impact may be a trifle beside them.
    along = jnp.where(found == STICK, jnp.abs(problem.tangential), 0.0)
    force_size, change_size = _sizes(mechanics, along, jnp.where(problem.away, 0.0, jnp.abs(problem.normal)))
    return jnp.abs(jnp.minimum(*margins(problem._replace(force_size=force_size, change_size=change_size), found)))


def state_of(contact: Contact) -> Int[Array, " c"]:
    """The state in a `ContactProblem` that belongs to a mode."""
    slides = jnp.where(contact.direction > 0, FORWARD, BACKWARD)
    by = jnp.where(contact.status == Status.SLIDE, slides, OPEN)
    return jnp.where(contact.status == Status.STICK, STICK, by).astype(jnp.int32)


def affected_by(mechanics: Mechanics, ended: Bool[Array, " c"]) -> Bool[Array, " c"]:
    """Which contacts events at some of them affect at once, these included: those that the mass matrix couples with one."""
    g_tt, g_tn, g_nn = map(jnp.abs, mechanics.compliance)
    size = jnp.sqrt(jnp.diagonal(g_tt) * jnp.diagonal(g_nn))
    # Relative to the contacts' own compliances.
    coupling = g_tt + g_tn + g_tn.T + g_nn
    scale = jnp.diagonal(g_tt) + jnp.diagonal(g_nn) + size
    coupling = coupling / jnp.sqrt(scale[:, None] * scale)
    largest = jnp.max(jnp.where(ended[:, None], coupling, 0.0), axis=0)
    return ended | (largest > 64 * jnp.finfo(largest.dtype).eps)


def _allowed(away: Bool[Array, " c"], slips: Bool[Array, " c"], forward: Bool[Array, " c"]) -> Bool[Array, "c 4"]:
    """The states that each contact may be in, by its velocity; `forward` is the direction of friction where it slips."""
    closed = ~away
    return jnp.stack(
        [closed & ~slips, closed & (~slips | forward), closed & (~slips | ~forward), jnp.ones_like(away)], axis=-1
    )


def _of_rest(rest: Rest | None, sliding: Float[Array, " c"], static: Float[Array, " c"]) -> dict[str, Array]:
    """What the forces at rest, to which those sought are added, change in a problem, by field; zero where these are total."""
    none = jnp.zeros_like(sliding)
    if rest is None:
        edges, otherwise = jnp.stack([none] * 2, axis=-1), jnp.stack([none] * 4, axis=-1)
        return {"cone_edges": edges, "pressing": none, "otherwise": otherwise, "open_normal": none}
    n_0 = rest.normal_force
    edges = jnp.stack([static - rest.friction, static + rest.friction], axis=-1) * n_0[:, None]
    otherwise = [none, (sliding - rest.friction) * n_0, -(sliding + rest.friction) * n_0, -rest.tangential_force]
    return {"cone_edges": edges, "pressing": n_0, "otherwise": jnp.stack(otherwise, axis=-1), "open_normal": -n_0}


def _sizes(
    mechanics: Mechanics, along: Float[Array, " c"], apart: Float[Array, " c"], rest: Rest | None = None
) -> tuple[Float[Array, " c"], Float[Array, " c"]]:
    """Sizes of the terms in forces and in accelerations, from those of free accelerations along the belt and away from it."""
    g_tt, g_tn, g_nn = mechanics.compliance
    own_t, own_n = jnp.diagonal(g_tt), jnp.diagonal(g_nn)
    # A contact's forces: by its own free acceleration, and by the forces that other contacts pass on to it.
    alone = along / own_t + apart / own_n
    if rest is not None:
        alone = alone + jnp.abs(rest.normal_force) + jnp.abs(rest.tangential_force)
    handed_on = (jnp.abs(g_tt) + jnp.abs(g_tn) + jnp.abs(g_tn.T) + jnp.abs(g_nn)) @ alone
    tiny = jnp.finfo(apart.dtype).tiny
    return (
        jnp.maximum(alone + handed_on / jnp.minimum(own_t, own_n), tiny),
        jnp.maximum(along + apart + handed_on, tiny),
    )


def _sizes_of_free(mechanics: Mechanics, load, y: State) -> tuple[Float[Array, " c"], Float[Array, " c"]]:
    """Sizes of the terms in the contacts' free accelerations, along the belt and away from it."""
    mechanics, load, y = jax.lax.stop_gradient((mechanics, load, y))
    n = degrees_of_freedom(y)
    places = np.array(mechanics.places).T.ravel()
    sizes = jnp.abs(mechanics.free_load[places] * load)
    sizes = sizes + jnp.abs(mechanics.free_position[places]) @ jnp.abs(y[:n])
    sizes = sizes + jnp.abs(mechanics.free_velocity[places]) @ jnp.abs(y[n:])
    return sizes[: len(mechanics.places)], sizes[len(mechanics.places) :]
