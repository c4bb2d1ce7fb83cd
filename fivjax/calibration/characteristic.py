r"""Measured poles and mode shapes in a scene's characteristic equation: residuals for parameters that are far from the answer.

The equation is linear in springs and dampers, so these residuals have no false minima a period away.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Complex, Float

from ..foundation import linear_solve
from ..io.recordings import Channel
from ..linear.linearisation import linear_sliding
from ..model.scene import Scene
from ..model.sliding import free_in_sliding
from .misfit import finite

# The units of coarse residuals: mode shapes are known to some per cent, poles ten times better.
COARSE_SHAPE = 0.03
COARSE_POLE = 3e-3


def characteristic_residual(
    scene: Scene, poles: Complex[Array, " j"], shapes: Complex[Array, "j k"], channels: tuple[Channel, ...]
) -> Float[Array, " c"]:
    r"""Residuals of measured poles and shapes in $(λ^2 - A_{22}λ - A_{21})\,φ = 0$, relative to $λ^2 φ$; and of its
    determinant.

    Poles that are NaN were not measured and contribute zero.
    """
    matrix = linear_sliding(scene).matrix
    m = matrix.shape[0] // 2
    found = jnp.isfinite(poles.real)
    poles, shapes = jnp.where(found, poles, 1j), jnp.where(found[:, None], shapes, 1.0)
    keep = free_in_sliding(scene.structure).tolist()

    def dynamic(pole):
        return jnp.eye(m) * pole**2 - matrix[m:, m:] * pole - matrix[m:, :m]

    def determinant(pole):
        # A measure of the distance from the scene's nearest pole: the other measured poles are divided out.
        apart = jnp.abs(pole - poles)
        apart = jnp.prod(jnp.where((apart == 0) | ~found, 1.0, jnp.maximum(apart, 1e-3 * jnp.abs(pole))))
        scale = (2 * jnp.abs(pole)) ** m * jnp.abs(pole) ** (m - jnp.sum(found))
        return linear_solve.determinant(dynamic(pole)) / (apart * scale * COARSE_POLE * jnp.abs(pole))

    residual = [jnp.where(found, jax.vmap(determinant)(poles), 0.0)]
    measured = {}
    for k, channel in enumerate(channels):
        measured.setdefault(channel.coordinate, shapes[:, k] / poles**channel.derivative)
    if set(keep) <= set(measured):
        shape = jnp.stack([measured[coordinate] for coordinate in keep], axis=1)
        shape = shape / jnp.linalg.norm(shape, axis=1, keepdims=True)
        unbalanced = jax.vmap(lambda pole, phi: dynamic(pole) @ phi / jnp.abs(pole) ** 2)(poles, shape)
        residual.append(jnp.where(found[:, None], unbalanced / COARSE_SHAPE, 0.0).ravel())
    residual = jnp.concatenate(residual)
    return finite(jnp.concatenate([residual.real, residual.imag]))
