"""The friction at which steady sliding of several contacts at once becomes unstable, under one coefficient.

The feedback of one contact is of rank one, and all its limits are found at once (`crossings`). That of several contacts is not:
here the growth rate is computed for many coefficients, and the first limit is then refined. An interval of instability narrower
than the distance between two coefficients can be missed.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..foundation.matrix_routines import eigenvalues
from ..model.sliding import sliding_matrices
from ..model.structure import Structure
from .gradients import in_natural_units, significant_growth
from .linearisation import state_matrix, time_scale_of
from .outcomes import ALWAYS, COALESCENCE, DIVERGENCE, FLUTTER, NEVER


def _growth(structure: Structure, mu, direction) -> Float[Array, ""]:
    matrix = state_matrix(*sliding_matrices(structure, direction * mu))
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
    values = eigenvalues(state_matrix(*sliding_matrices(structure, direction * high)))
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
        matrix = state_matrix(*sliding_matrices(structure, direction * mu))
        return jnp.max(eigenvalues(matrix).real)

    _, along_structure = jax.jvp(lambda s: growth(s, at), (structure,), (tangents[0],))
    _, along_mu = jax.jvp(lambda m: growth(structure, m), (at,), (jnp.ones_like(at),))
    # NaN as a factor, because in reverse mode the branch of a `where` that is not taken would give zero instead of NaN.
    return mu, jnp.where(usable, 1.0, jnp.nan) * -along_structure / along_mu
