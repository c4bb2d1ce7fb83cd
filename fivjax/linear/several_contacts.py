r"""Steady sliding of several contacts at once: its state matrix, and the friction at which it becomes unstable.

All contacts slide, under one coefficient or with one each. With contacts at coordinates, the normal rows and columns are left
out, and σμ times its normal row is subtracted from each tangential row, as in Eq. 3; friction that varies with slip speed adds
a damper at each contact.

The feedback of one contact is of rank one, and all its limits are found at once (`crossings`). That of several contacts is not:
here the growth rate is computed for many coefficients, and the first limit is then refined. An interval of instability narrower
than the distance between two coefficients can be missed.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..foundation.matrix_routines import eigenvalues
from ..model.contact_coordinates import in_contact_coordinates
from ..model.friction import slope_of
from ..model.scene import Scene, sliding_friction, steady_sliding
from ..model.sliding import contact_coordinates, free_in_sliding, sliding_matrices
from ..model.structure import Structure
from .gradients import in_natural_units, significant_growth
from .linearisation import linear_sliding, state_matrix, time_scale_of
from .outcomes import ALWAYS, COALESCENCE, DIVERGENCE, FLUTTER, NEVER


def one_contact(structure: Structure) -> bool:
    """Whether there is one contact, at two coordinates, for which there are better methods than for several."""
    return len(structure.contacts) == 1 and structure.contacts_at_coordinates


def free_closed_coordinates(structure: Structure) -> np.ndarray:
    """The coordinates, of `in_contact_coordinates`, that closed contacts leave free."""
    return free_in_sliding(in_contact_coordinates(structure))


def sliding_motion(scene: Scene) -> tuple[Float[Array, "m m"], Float[Array, " c"]]:
    """The state matrix of a scene's steady sliding, and its normal forces in N; not finite where there is none."""
    forces = jnp.atleast_1d(steady_sliding(scene, scene.load.final)[1])
    if one_contact(scene.structure):
        return linear_sliding(scene).matrix, forces
    speed = jnp.broadcast_to(jnp.abs(scene.belt_speed), forces.shape)
    friction = jnp.broadcast_to(sliding_friction(scene), forces.shape)
    slopes = jnp.zeros_like(friction) if scene.friction.constant else forces * slope_of(scene.friction, speed)
    return sliding_state_matrix(scene.structure, friction, slopes), forces


def sliding_state_matrix(
    structure: Structure, friction: Float[Array, " c"], slopes: Float[Array, " c"]
) -> Float[Array, "m m"]:
    """A of ż = A z with z = (x, ẋ), x the coordinates that closed contacts leave free.

    `friction` is σμ of each contact, `slopes` the damping by friction that varies with slip speed, N dμ/dv in N·s/m.
    """
    structure = in_contact_coordinates(structure)
    tangential, _ = contact_coordinates(structure)
    mass, damping, stiffness = sliding_matrices(structure, friction)
    along = free_closed_coordinates(structure)[:, None] == np.atleast_1d(tangential)
    return state_matrix(mass, damping + jnp.diag(along @ slopes), stiffness)


def _growth(structure: Structure, mu, direction) -> Float[Array, ""]:
    matrix = sliding_state_matrix(structure, direction * mu, jnp.zeros_like(direction))
    return significant_growth(in_natural_units(matrix, time_scale_of(structure, slice(None))))


def first_limit_of_several(structure: Structure, direction: Float[Array, " c"]):
    """Friction, frequency (rad/s) and code of the first limit up to 2; infinite friction where there is none."""
    # The largest coefficient that is tried, larger than those of any common surfaces, and the number of coefficients tried.
    largest, count = 2.0, 400
    looks = jnp.linspace(0.0, largest, count + 1)
    unstable = jax.lax.map(lambda mu: _growth(structure, mu, direction) > 0, looks, batch_size=50)
    # Not by `argmax`, which has another type where a program in single precision compiles it.
    place = jnp.min(jnp.where(unstable, np.arange(count + 1, dtype=np.int32), np.int32(count)))
    found, always = jnp.any(unstable), unstable[0] | unstable[1] & _nearly_at_zero(structure, direction)

    def bisect(_, ends):
        low, high = ends
        middle = 0.5 * (low + high)
        above = _growth(structure, middle, direction) > 0
        return jnp.where(above, low, middle), jnp.where(above, middle, high)

    ends = (looks[jnp.maximum(place - 1, 0)], looks[place])
    # Halvings of the distance between two coefficients: to the last digit.
    halvings = 50
    low, high = jax.lax.fori_loop(0, halvings, bisect, ends)
    mu = jnp.where(always, 0.0, jnp.where(found, 0.5 * (low + high), jnp.inf))
    values = eigenvalues(sliding_state_matrix(structure, direction * high, jnp.zeros_like(direction)))
    omega = jnp.max(jnp.where(values.real == jnp.max(values.real), jnp.abs(values.imag), 0.0))
    undamped = jnp.all(structure.damping == 0)
    flutter = jnp.where(undamped, COALESCENCE, FLUTTER)
    code = jnp.where(omega > 1e-6 * time_scale_of(structure, slice(None)), flutter, DIVERGENCE)
    code = jnp.where(always, ALWAYS, jnp.where(found, code, NEVER))
    return mu, jnp.where(found & ~always, omega, jnp.nan), code


def _nearly_at_zero(structure: Structure, direction):
    return _growth(structure, jnp.asarray(1e-9), direction) > 0


@jax.custom_jvp
def critical_friction_of_several(structure: Structure, direction: Float[Array, " c"]) -> Float[Array, ""]:
    """The friction at the first limit. Its derivative is that of the implicit function, growth rate = 0."""
    return first_limit_of_several(structure, direction)[0]


@critical_friction_of_several.defjvp
def _(primals, tangents):
    structure, direction = primals
    mu = critical_friction_of_several(structure, direction)
    # Undamped modes meet at the limit, beyond which the growth rate rises like a square root: no derivative.
    usable = jnp.isfinite(mu) & (mu > 0) & jnp.any(structure.damping != 0)
    at = jnp.where(usable, mu, 0.1)

    def growth(structure, mu):
        matrix = sliding_state_matrix(structure, direction * mu, jnp.zeros_like(direction))
        return jnp.max(eigenvalues(matrix).real)

    _, along_structure = jax.jvp(lambda s: growth(s, at), (structure,), (tangents[0],))
    _, along_mu = jax.jvp(lambda m: growth(structure, m), (at,), (jnp.ones_like(at),))
    # NaN as a factor, because in reverse mode the branch of a `where` that is not taken would give zero instead of NaN.
    return mu, jnp.where(usable, 1.0, jnp.nan) * -along_structure / along_mu
