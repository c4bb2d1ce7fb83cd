"""A stiffness matrix as independent springs, none of which is stretched by a rigid motion."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..foundation.linear_solve import product
from ..foundation.precision import state_for_pickle, state_from_pickle


class Springs(eqx.Module):
    r"""A stiffness matrix as n springs, $K = B^T \mathrm{diag}(k) B$ with a triangular $B$.

    A structure may be free to move as a whole. In $Kq$ its stiff springs then cancel only to rounding; far from the origin this
    leaves a force that pulls it back. The stretches $Bq$ of a rigid motion are zero, and so are the forces computed from them.
    """

    __getstate__, __setstate__ = state_for_pickle, state_from_pickle

    stretch: Float[Array, "n n"]  # B, how displacements stretch the springs
    rates: Float[Array, " n"]  # k, N/m; exactly zero where the structure is free

    def __init__(self, stiffness: Float[Array, "n n"]):
        n, left, columns, rates = stiffness.shape[0], stiffness, [], []
        eps = float(jnp.finfo(stiffness.dtype).eps)
        for k in range(n):
            rate = left[k, k]
            # A remainder of the elimination that is no larger than its rounding stands for zero.
            rate = jnp.where(rate > 16 * n * eps * stiffness[k, k], rate, 0.0)
            column = jnp.where(jnp.arange(n) > k, left[:, k] / jnp.where(rate > 0, rate, 1.0), 0.0)
            column = jnp.where(rate > 0, column, 0.0).at[k].set(1.0)
            left = left - rate * column[:, None] * column[None, :]
            columns.append(column)
            rates.append(rate)
        self.stretch, self.rates = jnp.stack(columns), jnp.stack(rates)

    def stretches(self, displacement: Float[Array, " n"]) -> Float[Array, " n"]:
        """How far each spring is stretched, in m."""
        return product(self.stretch, displacement)

    def energy(self, displacement: Float[Array, " n"]) -> Float[Array, ""]:
        """The energy stored in them, in J."""
        return 0.5 * jnp.sum(self.rates * self.stretches(displacement) ** 2)
