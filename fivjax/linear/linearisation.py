"""The sliding motion linearised about its equilibrium: its state matrix, and the signals that end it."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from .. import contact as physics
from ..contact import Mechanics
from ..foundation.linear_solve import solve
from ..model.scene import Scene, steady_sliding
from ..model.sliding import sliding_coordinates, sliding_matrices, sliding_states
from ..model.structure import Structure

# The proof for speed-dependent friction speaks of slip speeds above this share of the belt's.
LOWEST_SLIP = 0.5


class LinearSliding(eqx.Module):
    """The sliding motion linearised about its equilibrium, with the two signals that end it.

    `m` is twice the number of coordinates that sliding leaves free: the structure's without the normal one.
    """

    equilibrium: Float[Array, " state"]  # the state about which the deviation z is measured
    matrix: Float[Array, "m m"]
    frictionless: Float[Array, "m m"]  # the same without friction
    pressing: Float[Array, " m"]  # row: how z changes the pressing acceleration, the free one towards the belt
    pressing_margin: Float[Array, ""]  # its size at equilibrium, m/s²
    slip: Float[Array, " m"]  # row: how z changes the slip speed
    slip_margin: Float[Array, ""]  # its size at equilibrium, m/s
    remainder: Float[Array, " m"]  # direction in which the remainder of the friction law acts
    remainder_slope: Float[Array, ""]  # bounds on that remainder, see `decays_nonlinearly`
    remainder_curvature: Float[Array, ""]
    direction: Float[Array, ""]  # of the friction force
    exists: Bool[Array, ""]  # steady sliding exists and presses
    solvable: Bool[Array, ""]  # the contact problem has one solution in either direction of slip


def linear_sliding(scene: Scene) -> LinearSliding:
    """The sliding motion's state matrix, and the two signals that end it.

    The matrix is that of Eq. 3 (`model.sliding`), with the damping that friction which varies with speed adds. The signals
    are derivatives of `contact`, by automatic differentiation.
    """
    mechanics = Mechanics(scene)
    n, load = scene.structure.size, scene.load.final
    q, normal_force = steady_sliding(scene, load)
    equilibrium = jnp.concatenate([q, jnp.zeros(n, q.dtype)])
    direction = jnp.sign(scene.belt_speed)
    keep = sliding_states(n, mechanics.normal)
    friction = direction * mechanics.friction(jnp.abs(scene.belt_speed))
    mass, damping, stiffness = sliding_matrices(scene.structure, friction)
    damping = damping + slope_damping(scene, normal_force) * tangential_corner(scene.structure)

    def pressing(z):
        return -physics.free_acceleration(mechanics, load, equilibrium.at[keep].add(z))[mechanics.normal]

    def slip(z):
        return -direction * physics.relative_velocity(mechanics, equilibrium.at[keep].add(z))

    rest = jnp.zeros(len(keep), q.dtype)
    # Friction enters the accelerations as  a = (…) + a_press χ(μ) d,  χ = σ(μ - μ₀) / (c(μ) c(μ₀)),  with c the normal
    # compliance and d = G_nn M⁻¹e_t - G_nt M⁻¹e_n. Bounds on χ' and χ'' over slip speed follow from those on μ.
    _, g_tn, g_nn = mechanics.compliance
    along = g_nn * mechanics.from_tangential - g_tn * mechanics.from_normal
    slope, curvature = mechanics.friction.variation(LOWEST_SLIP * jnp.abs(scene.belt_speed))
    static = mechanics.friction.static
    compliance = jnp.minimum(
        mechanics.normal_compliance(direction, jnp.zeros_like(static)), mechanics.normal_compliance(direction, static)
    )
    return LinearSliding(
        equilibrium=equilibrium,
        matrix=state_matrix(mass, damping, stiffness),
        # Whatever sustains a vibration, this damps it.
        frictionless=state_matrix(*sliding_matrices(scene.structure, jnp.zeros_like(friction))),
        pressing=jax.grad(pressing)(rest),
        pressing_margin=pressing(rest),
        slip=jax.grad(slip)(rest),
        slip_margin=slip(rest),
        remainder=jnp.concatenate([jnp.zeros(n, q.dtype), along])[keep],
        remainder_slope=slope / compliance**2,
        remainder_curvature=curvature / compliance**2 + 2 * jnp.abs(g_tn) * slope**2 / compliance**3,
        direction=direction,
        exists=(normal_force >= 0) & jnp.all(jnp.isfinite(q)) & (direction != 0),
        solvable=(compliance > 0) & (mechanics.normal_compliance(-direction, static) > 0),
    )


def state_matrix(
    mass: Float[Array, "k k"], damping: Float[Array, "k k"], stiffness: Float[Array, "k k"]
) -> Float[Array, "m m"]:
    """A of ż = A z for M q̈ + C q̇ + K q = 0 with z = (q, q̇); not finite where M is singular (Painlevé's paradox)."""
    k = mass.shape[0]
    lower = -solve(mass, jnp.concatenate([stiffness, damping], axis=1))
    return jnp.concatenate([jnp.eye(k, 2 * k, k, dtype=mass.dtype), lower])


def slope_damping(scene: Scene, normal_force: Float[Array, ""]) -> Float[Array, ""]:
    """What friction that varies with slip speed adds to damping along the belt, N dμ/dv in N·s/m: negative where it falls."""
    speed = jnp.abs(scene.belt_speed)
    if scene.friction.constant:
        # The sliding motion is linear then, about whatever state.
        return jnp.zeros_like(speed)
    return normal_force * jax.grad(lambda v: scene.friction(v))(speed)


def tangential_corner(structure: Structure) -> np.ndarray:
    """One on the tangential diagonal of a matrix of the sliding motion, zero elsewhere."""
    along = sliding_coordinates(structure.size, structure.normal) == structure.tangential
    return np.outer(along, along).astype(np.float64)


def time_scale(structure: Structure) -> Float[Array, ""]:
    """ω₀ in rad/s: the root mean square of the uncoupled frequencies of the sliding coordinates, 1 if all are zero."""
    keep = sliding_coordinates(structure.size, structure.normal)
    squares = jnp.diagonal(structure.stiffness)[keep] / jnp.diagonal(structure.mass)[keep]
    mean = jax.lax.stop_gradient(jnp.mean(squares))
    return jnp.sqrt(jnp.where(mean > 0, mean, 1.0))
