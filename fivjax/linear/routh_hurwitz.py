r"""Stability of steady sliding without eigenvalues: the characteristic polynomial and Routh–Hurwitz.

The sliding motion has the rows of the structure without the normal one, with $\sigma\mu$ times the normal row subtracted from
the tangential row (Eq. 3). The signs of the Hurwitz determinants of $p(s) = \det(s^2 M + s C + K)$ say whether it is stable.
Eigenvalues are not smooth where two of them meet; these determinants are polynomials in the entries of the matrices, smooth
everywhere, and need only sums and products. So a batch of them fuses into one loop over points, on any device, whereas general
eigenvalues go through LAPACK point by point (and are not available on every accelerator).

Time is measured in $1/ω_0$, $ω_0$ a mean of the structure's own frequencies, so that the coefficients are of order one.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..foundation import arguments
from ..foundation.kept_programs import kept
from ..foundation.matrix_routines import log_determinant
from ..foundation.precision import real, returning_numpy
from ..model.contact_coordinates import in_contact_coordinates
from ..model.scene import refuse_several_contacts
from ..model.sliding import sliding_matrices
from ..model.structure import Structure
from .linearisation import state_matrix, time_scale
from .polynomials import characteristic_polynomial, determinant
from .system import checked_direction

# Up to this number of coordinates the determinant is expanded (2ᵐ minors); larger ones are left to matrix routines.
LARGEST_EXPANDED = 4


def hurwitz_determinants(coefficients) -> list[Float[Array, ""]]:
    """The Routh–Hurwitz conditions of a polynomial with leading coefficient 1: its roots decay if all are positive.

    All Hurwitz determinants but the last; in its place the last coefficient, its only new factor.
    """
    degree = len(coefficients) - 1
    zero = jnp.zeros_like(coefficients[-1])

    def entry(i, j):
        k = 2 * (j + 1) - (i + 1)
        return [coefficients[k] if 0 <= k <= degree else zero]

    _, leading = determinant([[entry(i, j) for j in range(degree - 1)] for i in range(degree - 1)])
    return [*(minor[0] for minor in leading), coefficients[-1]]


@returning_numpy
def margin(structure: Structure, mu, *, direction: int = 1) -> Float[Array, ""]:
    r"""A smooth measure of stability of steady sliding: positive where it is stable, zero at the limit.

    The smallest of the Routh–Hurwitz determinants of the characteristic polynomial, in units of $ω_0$. At the first
    limit it is $\prod_{i<j} -(λ_i + λ_j)$ (a pair of eigenvalues crosses: flutter) or $\prod λ_i$ (a real one
    crosses: divergence); it is smooth there and at a coalescence of modes. Above 4 sliding coordinates these two
    products are computed as determinants of the bialternate sum of the state matrix with itself and of the state matrix, each
    relative to its value without friction; the sign is then valid up to the first limit, not beyond it. An undamped structure
    is at the limit for any friction: 0, or NaN above 4 sliding coordinates.

    Only its sign and its zeros have a meaning. Differentiable; runs on any device and in batches (`jax.vmap`).

    **Arguments:** `structure`; `mu`, the friction coefficient, without unit; `direction`, +1 for a belt that moves
    along the tangential coordinate, -1 against it.

    **Raises:** `ValueError` for a negative `mu`, more than 32 coordinates, or several contacts.

    **Example:**

        >>> bool(fj.cea.margin(structure, 0.2) > 0), bool(fj.cea.margin(structure, 0.3) > 0)
        (True, False)
    """
    structure = in_contact_coordinates(structure)
    refuse_several_contacts(structure, "`margin`", "`growth_rate` takes several.")
    arguments.real_number("mu", mu, minimum=0)
    direction = checked_direction(direction)
    # The bialternate sum has N(N-1)/2 rows for N eigenvalues.
    largest_size = 32
    if structure.size > largest_size:
        raise ValueError(
            f"Argument `structure` must have at most {largest_size} coordinates here, but has {structure.size}. Use "
            f"`cea.growth_rate`, which has no such limit."
        )
    return _margin(structure, real(mu), real(direction))


@kept
def _margin(structure, mu, direction):
    scale = time_scale(structure)
    mass, damping, stiffness = sliding_matrices(structure, direction * mu)
    m = mass.shape[0]
    if m <= LARGEST_EXPANDED:
        coefficients = characteristic_polynomial(mass, damping, stiffness, scale)
        return jnp.min(jnp.stack(hurwitz_determinants(coefficients)))

    def in_natural_time(mass, damping, stiffness):
        return state_matrix(mass, damping / scale, stiffness / scale**2)

    state = in_natural_time(mass, damping, stiffness)
    without = in_natural_time(*sliding_matrices(structure, jnp.zeros_like(mu)))
    return jnp.minimum(
        _relative_determinant(bialternate_sum(state), bialternate_sum(without)), _relative_determinant(state, without)
    )


def _relative_determinant(matrix, reference):
    # In logarithms, because a determinant with hundreds of rows would often overflow or underflow.
    sign, size = log_determinant(matrix)
    reference_sign, reference_size = log_determinant(reference)
    return sign * reference_sign * jnp.exp(size - jax.lax.stop_gradient(reference_size))


def bialternate_sum(matrix: Float[Array, "n n"]) -> Float[Array, "k k"]:
    """The matrix whose eigenvalues are the sums λᵢ + λⱼ, i < j, of those of `matrix`: v ↦ Av + vAᵀ on skew v."""
    n = matrix.shape[0]
    p, q = (jnp.asarray(index) for index in np.triu_indices(n, 1))
    same = [[(a[:, None] == b[None, :]) for b in (p, q)] for a in (p, q)]
    a = [[matrix[i[:, None], j[None, :]] for j in (p, q)] for i in (p, q)]
    return (
        jnp.where(same[1][1], a[0][0], 0.0)
        - jnp.where(same[1][0], a[0][1], 0.0)
        + jnp.where(same[0][0], a[1][1], 0.0)
        - jnp.where(same[0][1], a[1][0], 0.0)
    )
