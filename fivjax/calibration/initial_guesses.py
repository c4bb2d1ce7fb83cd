"""First guesses for fits: a scene's own parameters, and others around them."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..foundation.compiling import compiled
from ..linear.linearisation import linear_sliding
from ..model.scene import Scene
from .parameters import FreeParameters


def latin_hypercube(
    parameters: FreeParameters, scene: Scene, count: int, spread: float, seed: int
) -> Float[np.ndarray, "s k"]:
    """The scene's own values, then others within `spread` (relative) of them, as unbounded numbers."""
    from scipy.stats import qmc

    own = _own_values(parameters, scene)
    shares = qmc.LatinHypercube(len(own), rng=seed).random(count - 1)
    return _unbounded(parameters, np.vstack([own, own * (1 + spread * (2 * shares - 1))]))


def near_frequencies(
    parameters: FreeParameters, scene: Scene, frequencies: list[float], count: int, spread: float, seed: int
) -> Float[np.ndarray, "s k"]:
    """The scene's own values, then values around them whose sliding modes lie at the measured frequencies (Hz).

    A guess that is too low by the share `spread` has to be multiplied by `1/(1 - spread)`, so guesses are drawn up to that
    factor. If fewer than `count` have two modes close to the frequency, those that come closest are taken.
    """
    # Number of scenes whose sliding modes are computed, for each one that is followed to its limit cycle.
    tried_per_guess = 128
    # Two sliding modes are sought this close to the measured frequency (relative), because limit cycles arise from mode
    # coupling.
    close = 0.03
    from scipy.stats import qmc

    own = _own_values(parameters, scene)
    widest = -np.log1p(-spread)
    shares = qmc.LatinHypercube(len(own), rng=seed).random(tried_per_guess * count)
    tried = _unbounded(parameters, own * np.exp(widest * (2 * shares - 1)))
    matrices = np.asarray(state_matrices(parameters, scene, jnp.asarray(tried)))
    modes = np.abs(np.linalg.eigvals(matrices).imag) / (2 * np.pi)
    apart = np.zeros(len(tried))
    for frequency in frequencies:
        # Both eigenvalues of a pair count, so the second nearest mode has index 2.
        away = np.sort(np.abs(modes - frequency), axis=1)[:, min(2, modes.shape[1] - 1)]
        apart = np.maximum(apart, away / frequency)
    order = np.argsort(np.maximum(apart, close), kind="stable")[: count - 1]
    return np.concatenate([parameters.unbounded(own)[None], tried[order]])


def _own_values(parameters: FreeParameters, scene: Scene) -> Float[np.ndarray, " k"]:
    return np.array([float(scene.parameters[name]) for name in parameters.names])


def _unbounded(parameters: FreeParameters, values: Float[np.ndarray, "s k"]) -> Float[np.ndarray, "s k"]:
    return np.array([parameters.unbounded(row) for row in values])


@compiled
def state_matrices(parameters: FreeParameters, scene: Scene, u: Float[Array, "s k"]) -> Float[Array, "s m m"]:
    """State matrices of steady sliding, for a batch of unbounded parameters."""
    return jax.vmap(lambda u: linear_sliding(parameters.scene(scene, u)).matrix)(u)
