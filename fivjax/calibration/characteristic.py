r"""Measured poles and mode shapes in a scene's own characteristic equation: residuals that lead to the right period from afar.

That equation is linear in springs and dampers, so there is no neighbouring period to fall into.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Complex, Float

from ..io.recordings import Channel
from ..linear.linearisation import linear_sliding
from ..model.scene import Scene
from .misfit import finite, sliding_coordinates

# Errors that coarse residuals are measured in: shapes are known to some per cent, poles ten times better.
COARSE_SHAPE = 0.03
COARSE_POLE = 3e-3


def characteristic_residual(
    scene: Scene, poles: Complex[Array, " j"], shapes: Complex[Array, "j k"], channels: tuple[Channel, ...]
) -> Float[Array, " c"]:
    r"""Measured poles and shapes in $(λ^2 - A_{22}λ - A_{21})\,φ = 0$, relative to $λ^2 φ$; and its determinant."""
    matrix = linear_sliding(scene).matrix
    m = matrix.shape[0] // 2
    if poles.shape[0] == 0:
        return jnp.zeros(0)
    keep = sliding_coordinates(scene)

    def dynamic(pole):
        return jnp.eye(m) * pole**2 - matrix[m:, m:] * pole - matrix[m:, :m]

    def determinant(pole, others):
        # How far the pole is from the scene's nearest one: others that were measured too are divided out.
        apart = jnp.abs(pole - others)
        apart = jnp.prod(jnp.where(apart == 0, 1.0, jnp.maximum(apart, 1e-3 * jnp.abs(pole))))
        missing = m - others.shape[0]
        distance = jnp.linalg.det(dynamic(pole)) / (apart * (2 * jnp.abs(pole)) ** m * jnp.abs(pole) ** missing)
        return distance / (COARSE_POLE * jnp.abs(pole))

    found = [jax.vmap(lambda pole: determinant(pole, poles))(poles)]
    measured = {}
    for k, (quantity, coordinate) in enumerate(channels):
        measured.setdefault(coordinate, shapes[:, k] / (poles**2 if quantity == "acceleration" else poles))
    if set(keep) <= set(measured):
        shape = jnp.stack([measured[coordinate] for coordinate in keep], axis=1)
        shape = shape / jnp.linalg.norm(shape, axis=1, keepdims=True)
        unbalanced = jax.vmap(lambda pole, phi: dynamic(pole) @ phi / jnp.abs(pole) ** 2)(poles, shape)
        found.append(unbalanced.ravel() / COARSE_SHAPE)
    found = jnp.concatenate(found)
    return finite(jnp.concatenate([found.real, found.imag]))
