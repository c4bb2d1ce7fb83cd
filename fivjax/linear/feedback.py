r"""Friction as a feedback loop around the sliding structure, and its transfer function.

The normal force, by friction, moves the structure along the belt, and that motion changes the normal force. One gain γ
multiplies the whole loop, so with $D(s) = s^2 M + s C + K$ of the sliding coordinates

$$\det(D - γ\, e\, b^T) = \det D\; (1 - γ L(s)), \qquad L(s) = b(s)^T D(s)^{-1} e .$$

For friction γ = μ, $e$ is the tangential unit vector and $b(s)$ the normal row of the structure (times σ): Eq. 3. For a
friction law that falls with slip speed, γ is the damping that its slope takes away, in N·s/m, and $b = s\, e$.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Complex, Float

from ..foundation.linear_solve import solve
from ..foundation.matrix_routines import eigenvectors
from ..model.sliding import sliding_coordinates, sliding_matrices
from ..model.structure import Structure
from .linearisation import time_scale


class Loop(eqx.Module):
    """A structure in steady sliding without one rank-one feedback $e\\, b(s)^T$: the open loop."""

    mass: Float[Array, "m m"]
    damping: Float[Array, "m m"]
    stiffness: Float[Array, "m m"]
    column: Float[Array, " m"]
    row_mass: Float[Array, " m"]
    row_damping: Float[Array, " m"]
    row_stiffness: Float[Array, " m"]

    def matrix(self, s):
        """D(s), of the open loop."""
        return self.stiffness + s * self.damping + s**2 * self.mass

    def row(self, s):
        """b(s)."""
        return self.row_stiffness + s * self.row_damping + s**2 * self.row_mass

    def matrix_slope(self, s):
        """dD/ds."""
        return self.damping + 2 * s * self.mass

    def row_slope(self, s):
        """db/ds."""
        return self.row_damping + 2 * s * self.row_mass

    def __call__(self, s: Complex[Array, ""]) -> Complex[Array, ""]:
        """L(s), the transfer function of the loop at gain one."""
        return self.row(s) @ solve(self.matrix(s), self.column.astype(complex))

    def slope(self, s: Complex[Array, ""]) -> Complex[Array, ""]:
        """dL/ds."""
        return jax.jvp(self, (s,), (jnp.ones_like(s),))[1]

    @property
    def held(self) -> Float[Array, "m m"]:
        """The stiffness, with a spring for each rigid-body mode that the loop does not move: L(0) is the same with it."""
        stiffness, column = jax.lax.stop_gradient((self.stiffness, self.column))
        values, left, right = eigenvectors(stiffness)
        sizes = jnp.abs(values)
        free = (sizes < 1e-12 * jnp.max(sizes)) & (jnp.abs(left.conj().T @ column) < 1e-9)
        return self.stiffness + jnp.max(sizes) * (jnp.where(free, left, 0.0) @ right.conj().T).real

    @property
    def limits(self) -> tuple[Float[Array, ""], Float[Array, ""]]:
        """L(0), the static response, and L(∞), the response to an impulse."""
        return self.row_stiffness @ solve(self.held, self.column), self.row_mass @ solve(self.mass, self.column)


def friction_loop(structure: Structure, direction: Float[Array, ""]) -> tuple[Loop, Float[Array, ""]]:
    """The loop whose gain is μ, and its unit of frequency ω₀ in rad/s."""
    matrices = sliding_matrices(structure, jnp.zeros_like(direction))
    keep = sliding_coordinates(structure.size, structure.normal)
    free = (structure.mass, structure.damping, structure.stiffness)
    rows = [direction * matrix[structure.normal][keep] for matrix in free]
    return _in_natural_units(Loop(*matrices, _tangential(structure), *rows), time_scale(structure))


def slope_loop(
    structure: Structure, mu: Float[Array, ""], direction: Float[Array, ""]
) -> tuple[Loop, Float[Array, ""]]:
    """The loop at constant friction μ whose gain is the damping taken away (N·s/m), and its unit of frequency."""
    matrices = sliding_matrices(structure, direction * mu)
    column = _tangential(structure)
    zero = jnp.zeros_like(column)
    return _in_natural_units(Loop(*matrices, column, zero, column, zero), time_scale(structure))


def _tangential(structure: Structure):
    keep = sliding_coordinates(structure.size, structure.normal)
    return jnp.asarray(keep == structure.tangential, structure.mass.dtype)


def _in_natural_units(loop: Loop, scale) -> tuple[Loop, Float[Array, ""]]:
    # Unit masses and frequencies of order one, so that fixed tolerances make sense. L keeps its value.
    size = 1 / jnp.sqrt(jnp.abs(jnp.diagonal(loop.mass)))
    both = jnp.outer(size, size)
    return Loop(
        mass=loop.mass * both,
        damping=loop.damping * both / scale,
        stiffness=loop.stiffness * both / scale**2,
        column=loop.column * size,
        row_mass=loop.row_mass * size,
        row_damping=loop.row_damping * size / scale,
        row_stiffness=loop.row_stiffness * size / scale**2,
    ), scale
