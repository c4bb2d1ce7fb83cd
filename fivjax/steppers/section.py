"""The Poincaré section: the tangential velocity rises through zero.

With several contacts, a weighted sum of their tangential velocities rises through zero. Over a period the mean of each velocity
is zero, and so is that of the sum. All weights differ, so that contacts which move against each other do not cancel.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from ..contact import Mechanics, State

# A state is on the section if the sum of velocities is no larger than this share of the motion.
ON_SECTION = {"float64": 1e-13, "float32": 1e-6}


class Rise(NamedTuple):
    """A rise of the tangential velocity through zero: a point of the Poincaré section."""

    happened: Bool[Array, ""]
    at: State  # the state there; without meaning if there was none


# A motion without events has faded if its size is below this share of the belt's motion. What closes upon itself there is the
# sliding equilibrium, or what the rounding of friction makes of it.
FADED = 1e-6


def section_weights(contacts: int) -> Float[np.ndarray, " c"]:
    """The weight of each contact's tangential velocity in the section; 1 for a single contact."""
    golden = 0.5 * (5**0.5 - 1)
    return 1.0 + np.mod(golden * np.arange(contacts), 1.0)


def section_speed(mechanics: Mechanics, y: State) -> Float[Array, ""]:
    """The velocity that rises through zero on the section, in m/s; linear in the state."""
    n = y.shape[0] // 2
    if mechanics.several:
        return jnp.dot(jnp.asarray(section_weights(len(mechanics.places)), y.dtype), y[n + mechanics.tangential])
    return y[n + mechanics.tangential]


def before_section(mechanics: Mechanics, y: State) -> Bool[Array, ""]:
    """Whether a state lies before the section, and not on it. A sum of velocities is zero on the section only up to
    rounding.
    """
    return well_before_section(mechanics, y) if mechanics.several else section_speed(mechanics, y) < 0


def well_before_section(mechanics: Mechanics, y: State) -> Bool[Array, ""]:
    """The same by more than rounding of a state."""
    speed = section_speed(mechanics, y)
    n = y.shape[0] // 2
    rate = jnp.sqrt(jnp.max(jnp.abs(mechanics.free_position)))
    size = jnp.max(jnp.abs(y[n:])) + rate * jnp.max(jnp.abs(y[:n]))
    return speed < jax.lax.stop_gradient(-ON_SECTION[y.dtype.name] * size)


def rise_between(mechanics: Mechanics, before: State, end: State, after: State) -> Rise:
    """The rise between two states close to each other, by linear interpolation; or at the `end` of the motion between them,
    where an impact makes the velocity jump over zero.
    """
    begins, ends = before_section(mechanics, before), before_section(mechanics, end)
    speed = section_speed(mechanics, before), section_speed(mechanics, after)
    rose = ~before_section(mechanics, after) & jnp.isfinite(speed[1])
    share = jnp.where(begins, speed[0] / jnp.where(begins & rose, speed[0] - speed[1], 1.0), 1.0)
    return Rise(rose & (begins | ends), before + jnp.where(rose, share, 0.0) * (after - before))
