"""Reading and writing the contacts' entries of a vector over all coordinates, for one contact and for several."""

from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from ..model.sliding import Places


def spread(columns: Float[Array, "n *contacts"], forces: Float[Array, "*contacts"]) -> Float[Array, " n"]:
    """The effect of contact forces on all coordinates: columns times forces, summed over the contacts."""
    return columns * forces if columns.ndim == 1 else columns @ forces


def at_places(size: int, places: Places, condition: Bool[Array, "*contacts"]) -> Bool[Array, " size"]:
    """Which entries of a vector belong to contacts for which the condition holds."""
    index = np.arange(size)
    if isinstance(places, np.ndarray):
        return jnp.any((index == places[:, None]) & condition[:, None], axis=0)
    return (index == places) & condition


def with_values(vector: Float[Array, " k"], values: Sequence[tuple[Places, Array]]) -> Float[Array, " k"]:
    """The vector with new values at the contacts' places."""
    index = np.arange(vector.shape[0])
    for places, value in values:
        if not isinstance(places, np.ndarray):
            vector = jnp.where(index == places, value, vector)
    several = [(places, value) for places, value in values if isinstance(places, np.ndarray)]
    if not several:
        return vector
    # One gather for all places.
    source = index.copy()
    at = len(index)
    for places, _ in several:
        source[places] = at + np.arange(len(places))
        at += len(places)
    return jnp.concatenate([vector, *(value for _, value in several)])[source]
