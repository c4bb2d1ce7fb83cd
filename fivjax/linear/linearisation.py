"""The sliding motion linearised about its equilibrium: its state matrix, and the two quantities that end it."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Complex, Float

from .. import contact as physics
from ..contact import Contact, Mechanics, ModeForces
from ..foundation.linear_solve import solve
from ..foundation.numpy_evaluation import by_numpy
from ..model.friction import slope_of
from ..model.scene import Scene, scene_in_contact_coordinates, sliding_friction, steady_sliding, steady_slip_speeds
from ..model.sliding import (
    contact_coordinates,
    free_in_sliding,
    sliding_coordinates,
    sliding_matrices,
    sliding_states,
)
from ..model.structure import Structure

# The proof for friction that depends on slip speed holds for slip speeds above this share of the belt speed.
LOWEST_SLIP = 0.5


class LinearSliding(eqx.Module):
    """The sliding motion linearised about its equilibrium, with the two quantities that end it where they reach zero.

    These are the pressing acceleration and the slip speed. `m` is twice the number of coordinates that sliding leaves free: all
    but the normal one. With several contacts, everything about a contact has an axis over the contacts, and normal forces (N)
    take the place of pressing accelerations.
    """

    equilibrium: Float[Array, " state"]  # the state from which the deviation z is measured
    matrix: Float[Array, "m m"]
    frictionless: Float[Array, "m m"]  # the same without friction
    pressing: Float[Array, "*contacts m"]  # derivative by z of the pressing acceleration, the free one towards the belt
    pressing_margin: Float[Array, "*contacts"]  # its size at equilibrium, m/s²
    slip: Float[Array, "*contacts m"]  # derivative by z of the slip speed
    slip_margin: Float[Array, "*contacts"]  # its size at equilibrium, m/s
    remainder: Float[Array, "*contacts m"]  # direction in which the remainder of the friction law acts
    remainder_slope: Float[Array, "*contacts"]  # bounds on that remainder, see `verdicts.sliding_proof`
    remainder_curvature: Float[Array, "*contacts"]
    reach: Float[Array, ""]  # the share of all margins up to which these bounds hold, and no contact lifts off
    direction: Float[Array, "*contacts"]  # of the friction force
    exists: Bool[Array, ""]  # whether there is steady sliding, with normal forces that press
    solvable: Bool[Array, ""]  # whether the contact problem has a unique solution in both directions of slip


def linear_sliding(scene: Scene) -> LinearSliding:
    """The state matrix of the sliding motion, and the two quantities that end it.

    The matrix is that of Eq. 3 (`model.sliding`), with the damping added by friction that varies with slip speed. The
    derivatives of the two quantities come from `contact`, by automatic differentiation.
    """
    mechanics = Mechanics(scene)
    n, load = scene.structure.size, scene.load.final
    q, normal_force = steady_sliding(scene, load)
    equilibrium = jnp.concatenate([q, jnp.zeros(n, q.dtype)])
    direction, mu = jnp.sign(mechanics.belt_speed), mechanics.friction(jnp.abs(mechanics.belt_speed))
    keep, mode = sliding_states(n, mechanics.normal), ModeForces(mechanics, Contact.sliding(direction), mu)

    def pressing(z):
        free = physics.free_acceleration(mechanics, load, equilibrium.at[keep].add(z))
        return mode.added(mechanics, free)[1] if mechanics.several else -free[mechanics.normal]

    def slip(z):
        return -direction * physics.relative_velocity(mechanics, equilibrium.at[keep].add(z))

    rest = jnp.zeros(len(keep), q.dtype)
    derivative = jax.jacfwd if mechanics.several else jax.grad
    remainder = _remainder_of_several if mechanics.several else _remainder
    columns, slope, curvature, reach = remainder(mechanics, direction * mu, normal_force)
    return LinearSliding(
        equilibrium=equilibrium,
        matrix=state_matrix(*steady_matrices(scene, normal_force)),
        # The motion without friction, which takes no energy from the belt.
        frictionless=state_matrix(*sliding_matrices(scene.structure, jnp.zeros_like(mu))),
        pressing=derivative(pressing)(rest),
        pressing_margin=pressing(rest),
        slip=derivative(slip)(rest),
        slip_margin=slip(rest),
        remainder=jnp.concatenate([jnp.zeros_like(columns), columns])[keep].T,
        remainder_slope=slope,
        remainder_curvature=curvature,
        reach=reach,
        direction=direction,
        exists=jnp.all((normal_force > 0) & (direction != 0)) & jnp.all(jnp.isfinite(q)),
        solvable=physics.slides_uniquely(mechanics),
    )


def _remainder(mechanics: Mechanics, friction: Float[Array, ""], _):
    r"""The direction in which the remainder of the friction law acts, the bounds on it, and their reach.

    Friction enters the accelerations as $a = (…) + a_{press} χ(μ) d$, $χ = σ(μ - μ_0) / (c(μ) c(μ_0))$, with $c$ the normal
    compliance and $d = G_{nn} M^{-1} e_t - G_{nt} M^{-1} e_n$. Bounds on $χ'$ and $χ''$ over slip speed follow from those on μ.
    """
    _, g_tn, g_nn = mechanics.compliance
    along = g_nn * mechanics.from_tangential - g_tn * mechanics.from_normal
    direction, speed = jnp.sign(mechanics.belt_speed), jnp.abs(mechanics.belt_speed)
    slope, curvature = mechanics.friction.bounds(LOWEST_SLIP * speed)
    # The bounds hold while slip changes by less than this share of the belt speed, and so friction by no more than this.
    most = jnp.abs(friction) + slope * LOWEST_SLIP * speed
    compliance = jnp.minimum(
        mechanics.normal_compliance(direction, jnp.zeros_like(most)), mechanics.normal_compliance(direction, most)
    )
    compliance = jnp.where(compliance > 0, compliance, 0.0)  # and then there is no bound
    bound = curvature / compliance**2 + 2 * jnp.abs(g_tn) * slope**2 / compliance**3
    return along, slope / compliance**2, bound, jnp.full_like(compliance, LOWEST_SLIP)


def _remainder_of_several(mechanics: Mechanics, friction: Float[Array, " c"], normal_force: Float[Array, " c"]):
    r"""`_remainder` of several contacts.

    With $D = \mathrm{diag}(σ_i μ_i)$, its value $D_0$ at equilibrium, $A_0 = G_{nn} + G_{nt} D_0$ and the forces
    $N_0(z) = -A_0^{-1} a_n(z)$ under $D_0$, the forces are $N = (I + X (D - D_0))^{-1} N_0$ with $X = A_0^{-1} G_{nt}$.
    Friction that differs from that at equilibrium adds the accelerations $M^{-1} P (D - D_0) N$, $P = W_t - (W_t D_0 + W_n) X$.
    The directions are the columns of $M^{-1} P$. The remainder of the linearisation in column i is at most the first bound plus
    half the second, times the square of the largest deviation relative to its margin (`verdicts.sliding_proof`). The other
    contacts' friction changes a contact's force through $X$, too: the reach says up to which deviation none can lift off.
    """
    _, g_tn, g_nn = mechanics.compliance
    handed_on = solve(g_nn + g_tn.T * friction, g_tn.T)
    columns = mechanics.from_tangential - (mechanics.from_tangential * friction + mechanics.from_normal) @ handed_on
    speed, forces = jnp.abs(mechanics.belt_speed), jnp.abs(normal_force)
    slope, curvature = mechanics.friction.bounds(LOWEST_SLIP * speed)
    changes = jnp.abs(handed_on) * (slope * speed)
    most = LOWEST_SLIP * jnp.max(jnp.sum(changes, axis=1))
    added = jnp.max(forces + changes @ forces) / jnp.where(most < 0.9, 1 - most, 0.0)
    # Contact by contact, the forces then change by no more than this times that deviation.
    each = forces + changes @ (forces + LOWEST_SLIP * added)
    reach = jnp.minimum(LOWEST_SLIP, jnp.min(forces / each))
    return columns, slope * speed * added, curvature * speed**2 * forces, reach


def sliding_rates(scene: Scene) -> Complex[np.ndarray, " m"]:
    """Eigenvalues of steady sliding, in 1/s, the fastest growing first; NaN where it has no finite state matrix."""
    matrix = np.asarray(sliding_matrix(scene))
    if not np.all(np.isfinite(matrix)):
        return np.full(len(matrix), complex(np.nan, np.nan))
    values = np.linalg.eigvals(matrix).astype(complex)
    return values[np.lexsort((-values.imag, -values.real))]


@by_numpy
def sliding_matrix(scene: Scene) -> Float[Array, "m m"]:
    """The state matrix of a scene's steady sliding."""
    return sliding_motion(scene)[0]


def sliding_motion(scene: Scene) -> tuple[Float[Array, "m m"], Float[Array, " c"]]:
    """The state matrix of a scene's steady sliding in contact coordinates, and its normal forces in N; not finite where there
    is none.
    """
    scene = scene_in_contact_coordinates(scene)
    _, normal_force = steady_sliding(scene, scene.load.final)
    return state_matrix(*steady_matrices(scene, normal_force)), jnp.atleast_1d(normal_force)


def state_matrix(
    mass: Float[Array, "k k"], damping: Float[Array, "k k"], stiffness: Float[Array, "k k"]
) -> Float[Array, "m m"]:
    """A of ż = A z for M q̈ + C q̇ + K q = 0 with z = (q, q̇); not finite where M is singular (Painlevé's paradox)."""
    k = mass.shape[0]
    lower = -solve(mass, jnp.concatenate([stiffness, damping], axis=1))
    return jnp.concatenate([jnp.eye(k, 2 * k, k, dtype=mass.dtype), lower])


def steady_matrices(
    scene: Scene, normal_force: Float[Array, "*contacts"]
) -> tuple[Float[Array, "k k"], Float[Array, "k k"], Float[Array, "k k"]]:
    """M, C and K of small motions about steady sliding, with the damping along the belt by friction that varies with slip
    speed, N dμ/dv in N·s/m: negative where friction falls.
    """
    structure = scene.structure
    mass, damping, stiffness = sliding_matrices(structure, sliding_friction(scene))
    # With constant friction the sliding motion is linear and the same about any state.
    if not scene.friction.constant:
        slopes = normal_force * slope_of(scene.friction, steady_slip_speeds(scene))
        along = free_in_sliding(structure)[:, None] == np.atleast_1d(contact_coordinates(structure)[0])
        # A product with a constant rather than an update in place: in a batch it stays elementwise.
        damping = damping + np.eye(len(along)) * jnp.sum(along * slopes, axis=1)
    return mass, damping, stiffness


def time_scale(structure: Structure) -> Float[Array, ""]:
    """ω₀ in rad/s: the root mean square of the uncoupled frequencies of the sliding coordinates, 1 if all are zero."""
    return time_scale_of(structure, sliding_coordinates(structure.size, structure.normal))


def time_scale_of(structure: Structure, chosen) -> Float[Array, ""]:
    """The same of the chosen coordinates."""
    squares = jnp.diagonal(structure.stiffness)[chosen] / jnp.diagonal(structure.mass)[chosen]
    mean = jax.lax.stop_gradient(jnp.mean(squares))
    return jnp.sqrt(jnp.where(mean > 0, mean, 1.0))
