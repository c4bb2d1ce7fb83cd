r"""Eigenvalues of steady sliding, point by point.

The linearised motion has eigenvalues $λ$ with frequency $|\mathrm{Im}\,λ|/2π$ and growth rate $\mathrm{Re}\,λ$. Friction that
falls with slip speed acts as a negative damper (`linearisation`).
"""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float

from ..foundation import arguments, matrix_routines
from ..foundation.kept_programs import kept
from ..foundation.numpy_evaluation import by_numpy
from ..foundation.precision import is_known, real, returning_numpy
from ..model.scene import Scene, sliding_equilibrium
from ..model.structure import Structure
from .gradients import with_own_gradient
from .linearisation import sliding_matrix, sliding_motion
from .system import as_scene, checked_direction

# Points whose matrices are in memory together.
POINTS_AT_ONCE = 256


@returning_numpy
def linearisation(system: Structure | Scene, mu=None, *, direction: int = 1) -> Float[Array, "m m"]:
    """State matrix A of small motions about steady sliding, ż = A z (Eq. 3), with the damping by friction that varies with
    speed.

    z holds the deviations of the displacements (m) without the normal coordinate, then their velocities (m/s);
    m = 2(n - 1). With several contacts all normal coordinates are left out, and displacements are those of
    `fj.in_contact_coordinates`.

    **Arguments:** `system`, a scene, or a structure with constant friction `mu`; `direction`, for a structure, +1 for a
    belt that moves along the tangential coordinate, -1 against it.

    **Raises:** `ValueError` for a scene that has no steady sliding, or where friction is missing or given twice.

    **Example:**

        >>> fj.cea.linearisation(structure, 0.2).shape
        (4, 4)
    """
    return sliding_matrix(_check(system, mu, direction))


def _check(system, mu, direction) -> Scene:
    if mu is not None:
        arguments.real_number("mu", mu, minimum=0)
    scene = as_scene(system, mu, direction)
    if isinstance(system, Scene):
        sliding_equilibrium(scene)
    return scene


@returning_numpy
def eigenvalues(system: Structure | Scene, mu=None, *, direction: int = 1) -> Complex[Array, "... m"]:
    """The 2(n - 1) eigenvalues of steady sliding, in 1/s, sorted by frequency; 2(n - c) where c contacts slide.

    Order: by |Im λ|, then by Re λ, then by Im λ; so the two of a conjugate pair are neighbours, the one with negative
    imaginary part first.

    **Arguments:** as in `linearisation`; for a structure `mu` may also be an array, whose shape then comes first in the
    result. Differentiable where the eigenvalues are distinct; near a coalescence the derivative grows without bound. Without
    double precision turned on, differentiate `growth_rate` instead (JAX's backward pass cannot carry complex double precision
    there).

    **Example:**

        >>> (abs(fj.cea.eigenvalues(structure, 0.2).imag) / (2 * np.pi)).round(1).tolist()  # Hz, in pairs
        [67.4, 67.4, 68.5, 68.5]
    """
    if mu is not None and np.ndim(mu) > 0:
        arguments.instance("system", system, Structure, "a Structure where `mu` is an array")
        direction = checked_direction(direction)
        _check_frictions(mu)
        mu = real(mu)
        return _eigenvalues_over(system, mu.ravel(), direction).reshape(*mu.shape, -1)
    return _eigenvalues(_check(system, mu, direction))


def _check_frictions(mu) -> None:
    if is_known(mu):
        values = arguments.numeric_array("mu", mu)
        if not values.size:
            raise ValueError("Argument `mu` must hold at least one value, but is empty.")
        bad = values[~(np.isfinite(values) & (values >= 0))]
        if bad.size:
            raise ValueError(f"Argument `mu` must be non-negative and finite, but holds {bad[0]:g}.")


@by_numpy
def _eigenvalues(scene):
    found = matrix_routines.eigenvalues(sliding_motion(scene)[0])
    return found[jnp.lexsort((found.imag, found.real, jnp.abs(found.imag)))]


@kept
def _eigenvalues_over(structure, mu, direction):
    return jax.lax.map(lambda value: _eigenvalues(as_scene(structure, value, direction)), mu, batch_size=POINTS_AT_ONCE)


@with_own_gradient
def _growth_rate(scene):
    return jnp.max(matrix_routines.eigenvalues(sliding_motion(scene)[0]).real)


@returning_numpy
def growth_rate(system: Structure | Scene, mu=None, *, direction: int = 1) -> Float[Array, ""]:
    """The largest real part of the eigenvalues of steady sliding, in 1/s: positive where it is unstable.

    Arguments as in `linearisation`. Differentiable in every parameter, with or without double precision turned on, and twice
    (`jax.hessian`). Derivatives are those of eigenvalues, which grow without bound towards a coalescence; `margin` is smooth
    there.

    **Example:**

        >>> bool(fj.cea.growth_rate(structure, 0.3) > 0)
        True
    """
    return _growth_rate(_check(system, mu, direction))
