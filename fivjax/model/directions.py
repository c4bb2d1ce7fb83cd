"""The scene's derivatives by its parameters, as scenes; and scenes moved along them."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..foundation.numpy_evaluation import by_numpy
from .scene import Scene


def directions_of(scene: Scene, names: tuple[str, ...]) -> Scene:
    """The scene's derivatives by several of its parameters, stacked along a first axis."""
    found = _directions_of(scene, names, np.array([float(scene.parameters[name]) for name in names]))
    # A builder of a structure may make the function of its matrices anew.
    return jax.tree.unflatten(jax.tree.structure(scene), jax.tree.leaves(found))


@by_numpy
def _directions_of(scene: Scene, names: tuple[str, ...], values: Float[Array, " k"]) -> Scene:
    def moved(values) -> Scene:
        return scene.replace(**dict(zip(names, values, strict=True)))

    # All in one, because each is traced.
    return jax.vmap(lambda along: jax.jvp(moved, (values,), (along,))[1])(jnp.eye(len(names)))


def direction_of(scene: Scene, name: str) -> Scene:
    """The scene's derivative by one of its parameters: one for that parameter, zero for all others."""
    return jax.tree.map(lambda leaf: np.asarray(leaf)[0], directions_of(scene, (name,)))


def moved_along(scene: Scene, direction: Scene, by: Float[Array, ""] | float) -> Scene:
    """The scene with a parameter changed, without the checks of `replace`, which take longer than a return of the section."""
    return jax.tree.map(lambda leaf, slope: np.asarray(leaf) + by * np.asarray(slope), scene, direction)
