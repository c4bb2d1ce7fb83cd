"""The sliding motion linearised about its equilibrium, by automatic differentiation of the one physics."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from .. import contact as physics
from ..contact import Contact, Mechanics, Status
from ..model.friction import Coulomb
from ..model.scene import Scene, steady_sliding

# The proof for speed-dependent friction speaks of slip speeds above this share of the belt's.
LOWEST_SLIP = 0.5


class LinearSliding(eqx.Module):
    """The sliding motion linearised about its equilibrium, with the two signals that end it.

    `m` is twice the number of coordinates that sliding leaves free: the structure's without the normal one.
    """

    equilibrium: Float[Array, " 2n"]  # the state about which the deviation z is measured
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
    """The sliding motion's Jacobian and the two signals that end it, from `contact` by automatic differentiation."""
    mechanics = Mechanics(scene)
    n, load = scene.structure.size, scene.load.final
    q, normal_force = steady_sliding(scene, load)
    equilibrium = jnp.concatenate([q, jnp.zeros(n, q.dtype)])
    direction = jnp.sign(scene.belt_speed)
    contact = Contact(jnp.asarray(Status.SLIDE, jnp.int32), direction)
    keep = sliding_coordinates(n, mechanics.normal)

    def rates(z, mechanics):
        y = equilibrium.at[keep].add(z)
        return jnp.concatenate([y[n:], physics.acceleration(mechanics, contact, load, y)])[keep]

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
        matrix=jax.jacfwd(rates)(rest, mechanics),
        # Whatever sustains a vibration, this damps it.
        frictionless=jax.jacfwd(rates)(rest, eqx.tree_at(lambda m: m.friction, mechanics, Coulomb(0.0))),
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


def sliding_coordinates(n: int, normal: int) -> np.ndarray:
    """Places in the state of what sliding leaves free: all but the normal coordinate and its rate."""
    return np.array([i for i in range(2 * n) if i not in (normal, n + normal)])
