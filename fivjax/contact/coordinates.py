"""Reading and writing the contacts' coordinates in vectors that have all of them; the same of one contact and of several."""

from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

Places = int | np.ndarray


def spread(columns: Float[Array, "n *contacts"], forces: Float[Array, "*contacts"]) -> Float[Array, " n"]:
    """What contact forces do to all coordinates: columns times forces, summed over the contacts."""
    return columns * forces if columns.ndim == 1 else columns @ forces


def at_places(size: int, places: Places, condition: Bool[Array, "*contacts"]) -> Bool[Array, " size"]:
    """Where a vector belongs to contacts of which something is true."""
    index = np.arange(size)
    if isinstance(places, np.ndarray):
        return jnp.any((index == places[:, None]) & condition[:, None], axis=0)
    return (index == places) & condition


def with_values(vector: Float[Array, " k"], values: Sequence[tuple[Places, Array]]) -> Float[Array, " k"]:
    """The vector with other values in the contacts' places."""
    index = np.arange(vector.shape[0])
    for places, value in values:
        if not isinstance(places, np.ndarray):
            vector = jnp.where(index == places, value, vector)
    several = [(places, value) for places, value in values if isinstance(places, np.ndarray)]
    if not several:
        return vector
    # One gather for all of them.
    source = index.copy()
    at = len(index)
    for places, _ in several:
        source[places] = at + np.arange(len(places))
        at += len(places)
    return jnp.concatenate([vector, *(value for _, value in several)])[source]
