"""The Poincaré section: the rises of the tangential velocity through zero, where motions are compared."""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool

from ..contact import Mechanics, State


class Rise(NamedTuple):
    """A rise of the tangential velocity through zero, where orbits are compared."""

    happened: Bool[Array, ""]
    at: State  # the state there; anything if there was none


def section_coordinate(mechanics: Mechanics) -> int:
    """The coordinate whose velocity defines the section: the tangential one, of several contacts that of the first."""
    return mechanics.places[0][0]


def rise_between(before: State, after: State, tangential: int) -> Rise:
    """The rise between two states close to each other, on a straight line."""
    velocity = before.shape[0] // 2 + tangential
    speed = before[velocity], after[velocity]
    rose = (speed[0] < 0) & (speed[1] >= 0)
    share = speed[0] / jnp.where(rose, speed[0] - speed[1], 1.0)
    return Rise(rose, before + jnp.where(rose, share, 0.0) * (after - before))
