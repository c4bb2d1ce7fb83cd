"""The Taylor series of motion in one contact mode, and of what ends it."""

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .. import contact as physics
from ..contact import Contact, Mechanics, ModeForces, State
from ..contact.rounding import largest_rounding
from ..foundation.linear_solve import product


class MotionSeries(NamedTuple):
    """Taylor coefficients, in time measured in a unit; and the forces of the mode at the start."""

    states: Float[Array, "k state"]
    guards: Float[Array, "k *contacts 2"]
    slip: Float[Array, "k *contacts"]
    friction: Float[Array, "j *contacts"]  # of μ; only its value, if it is constant
    mode: ModeForces


def series_of(
    mechanics: Mechanics, contact: Contact, load: Float[Array, ""], y: State, order: int, unit: Float[Array, ""]
) -> MotionSeries:
    """Taylor coefficients of the motion in one contact mode, in time measured in `unit` (s).

    The physics is linear in the state except for T = σμN, so it maps coefficients to coefficients; the constant terms (load,
    belt speed) enter with the first. T = σμN is the product of two series.
    """
    n, count = y.shape[0] // 2, len(mechanics.places)
    slip = physics.slip_speed(mechanics, contact, y)
    friction = [mechanics.friction(slip)]
    mode = ModeForces(mechanics, contact, friction[0])

    changes = mechanics.homogeneous
    # Everything is linear in the state and in what friction has besides σμN: matrices, worked out once for all coefficients.
    under = functools.partial(_under, changes, contact, mode)
    matrices = [jax.vmap(under, in_axes=1, out_axes=1)(matrix) for matrix in physics.free_matrices(changes)]
    beside = None
    if not mechanics.friction.constant:
        ones = jnp.eye(count, dtype=y.dtype).reshape(count, *slip.shape)
        beside = jax.vmap(lambda one: under(jnp.zeros(n, y.dtype), one), out_axes=1)(ones)

    one, zero = jnp.ones_like(slip), jnp.zeros_like(slip)
    of_slip = physics.guards_under(changes, contact, zero, zero, one, zero)
    of_gap = physics.guards_under(changes, contact, zero, zero, zero, one)

    def further(state: State, slip, other_friction, divisor):
        """What follows from one coefficient of the state: the next, and those of the guards and of N."""
        of_displacements, of_velocities = map(product, matrices, physics.measured(changes, state))
        found = of_displacements + of_velocities
        if beside is not None:
            found = found + product(beside, jnp.ravel(other_friction))
        acceleration, guards, normal_force = jnp.split(found, (n, n + 2 * count))
        guards = guards.reshape(of_slip.shape) + of_slip * slip[..., None]
        guards = guards + of_gap * physics.gap(changes, state)[..., None]
        return jnp.concatenate([state[n:], acceleration]) * (unit / divisor), guards, normal_force.reshape(slip.shape)

    free = physics.free_acceleration(mechanics, load, y)
    forces = mode.added(mechanics, free)
    guards = physics.guards_under(mechanics, contact, *forces, slip, physics.gap(mechanics, y))
    state = unit * jnp.concatenate([y[n:], physics.acceleration_under(mechanics, contact, free, *forces)])
    if mechanics.friction.constant:

        def next_one(state: State, divisor):
            slip = physics.slip_speed(changes, contact, state)
            following, guards, _ = further(state, slip, None, divisor)
            return following, (state, guards, slip)

        # A loop that XLA unrolls, and that kernels keep.
        _, rows = jax.lax.scan(next_one, state, np.arange(2.0, order + 2.0, dtype=y.dtype), unroll=True)
        first = y, guards, slip
        states, guards, slips = (jnp.concatenate([one[None], more]) for one, more in zip(first, rows, strict=True))
        return MotionSeries(states, guards, slips, friction[0][None], mode)
    next_term = mechanics.friction.in_time(slip, order)
    states, all_guards, slips = [y], [guards], [slip]
    normal_forces = [physics.total_forces(mechanics, *forces)[1]]
    for k in range(1, order + 1):
        states.append(state)
        slips.append(physics.slip_speed(changes, contact, state))
        friction.append(next_term(slips, friction))
        other_friction = contact.direction * sum(
            (friction[j] * normal_forces[k - j] for j in range(2, k + 1)), friction[1] * normal_forces[k - 1]
        )
        state, guards, normal_force = further(state, slips[k], other_friction, k + 1)
        all_guards.append(guards)
        normal_forces.append(normal_force)
    return MotionSeries(jnp.stack(states), jnp.stack(all_guards), jnp.stack(slips), jnp.stack(friction), mode)


def fastest_in_mode(mechanics: Mechanics, contact: Contact, mode: ModeForces) -> Float[Array, ""]:
    """A bound on how fast deviations vibrate in a mode, in 1/s: that of the coordinates that it leaves free."""
    mechanics, contact, mode = jax.lax.stop_gradient((mechanics.homogeneous, contact, mode))
    free = ~physics.constrained_coordinates(mechanics, contact)

    def largest(matrix):
        rates = jax.vmap(functools.partial(_under, mechanics, contact, mode), in_axes=1, out_axes=1)(matrix)
        return jnp.max(jnp.where(free, jnp.abs(rates[: len(free)]), 0.0))

    return jnp.maximum(jnp.sqrt(largest(mechanics.free_position)), largest(mechanics.free_velocity))


def _under(
    mechanics: Mechanics, contact: Contact, mode: ModeForces, free: Float[Array, " n"], other_friction=None
) -> Float[Array, " k"]:
    """Accelerations in a mode from the free ones; in the rows below, the part of all guards that depends on forces, and N."""
    forces = mode.added(mechanics, free, other_friction)
    zero = jnp.zeros_like(forces[0])
    guards = physics.guards_under(mechanics, contact, *forces, zero, zero)
    parts = physics.acceleration_under(mechanics, contact, free, *forces), guards, forces[1]
    return jnp.concatenate(list(map(jnp.ravel, parts)))


def guard_rounding(
    mechanics: Mechanics,
    contact: Contact,
    load: Float[Array, ""],
    y: State,
    unit: Float[Array, ""],
    mode: ModeForces,
) -> Float[Array, "3 *contacts 2"]:
    """Bounds on the rounding of the first three coefficients of the guards."""
    mechanics, contact, load, y, mode = jax.lax.stop_gradient((mechanics, contact, load, y, mode))

    def following(own: Mechanics, force, sizes: State, divisor):
        guards, rates = physics.magnitudes(own, contact, force, sizes, mode)
        return rates * (unit / divisor), largest_rounding(guards)

    sizes, first = following(mechanics, load, jnp.abs(y), 1)
    changes, none = mechanics.homogeneous, jnp.zeros_like(load)
    _, rest = jax.lax.scan(
        lambda sizes, divisor: following(changes, none, sizes, divisor),
        sizes,
        np.array([2.0, 3.0], y.dtype),
        unroll=True,
    )
    return jnp.concatenate([first[None], rest])
