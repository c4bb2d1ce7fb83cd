"""Jumps of the load that coincide with another instant, the start of a run or a row: as derivatives see them.

The time between the two instants is zero, and has a derivative: a jump that comes a little later leaves the motion under the
load before it for that long.
"""

from collections.abc import Callable
from typing import Generic, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from .. import contact as physics
from ..contact import Contact, Mechanics, State
from ..model.scene import Scene
from ..steppers.base import advance_between, rates
from ..steppers.core import Segment, nothing

Total = TypeVar("Total")


class StartOfRun(eqx.Module, Generic[Total]):
    """Where the motion under the first load begins."""

    t: Float[Array, ""]  # s
    y: State
    total: Total


def load_before(scene: Scene, t: Float[Array, ""]) -> Float[Array, ""]:
    """The load (N) from the last jump before an instant (s) up to it."""
    jumps = scene.load.jumps
    since = jnp.max(jnp.where(jumps < t, jumps, -jnp.inf), initial=-jnp.inf)
    return scene.load(jnp.where(jnp.isfinite(since), 0.5 * (since + t), t - 1.0))


def moment(mechanics: Mechanics, contact: Contact, load: Float[Array, ""], y: State, h: Float[Array, ""]) -> Segment:
    """A motion of zero duration `h`, which has a derivative by `h` all the same."""
    after = y + jax.lax.stop_gradient(rates(mechanics, contact, load, y)) * h
    none = jnp.zeros((*contact.status.shape, 2), bool)
    return Segment(jnp.zeros_like(h), load, contact, y, advance_between(y, after, none, after, contact, h, mechanics))


def start_of_run(
    scene: Scene,
    mechanics: Mechanics,
    contact: Contact,
    y0: State,
    begin: Float[Array, ""],
    total: Total = None,
    observe: Callable[[Total, Segment], Total] = nothing,
) -> StartOfRun[Total]:
    """The start of a run at `begin` (s) in the mode `contact`, with its derivative by a jump of the load at that instant.

    It is the derivative towards later jumps: the load before the jump acts until then, in the mode which it demands. `observe`
    adds that time to `total`, as in `follow`.
    """
    jumps = scene.load.jumps
    if jumps.shape[0] == 0:
        return StartOfRun(begin, physics.stuck(mechanics, contact, y0), total)
    at = jnp.max(jnp.where(jumps == begin, jumps, -jnp.inf))
    jumped = jnp.isfinite(at)
    t = jnp.where(jumped, at, begin)

    def waited() -> tuple[State, Total]:
        load = load_before(scene, begin)
        before = physics.status_from_forces(mechanics, load, y0)
        segment = moment(mechanics, before, load, y0, t - begin)
        return segment.after.y, observe(total, segment)

    y, total = jax.lax.cond(jumped, waited, lambda: (y0, total))
    return StartOfRun(t, physics.stuck(mechanics, contact, y), total)
