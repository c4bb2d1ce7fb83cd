r"""The Poincaré section's return map, exact through every contact event, with its derivative.

The section is where the tangential velocity rises through zero. Over a period of any motion its mean is zero, so every
limit cycle crosses the section, one that sticks, slips back or takes off as much as one that only slides. Where an impact
throws the velocity over zero, the state just after the impact is the point.

States are deviations from the sliding equilibrium under the final load: a small cycle under a high load is then as exact
as a large one.
"""

import math
from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from ..contact import Contact, Mechanics, Rest, State
from ..foundation.compiling import compiled
from ..model.scene import Scene, steady_sliding
from ..steppers.core import Followed, Segment, Total, follow
from ..steppers.event_exact import EventExact, for_derivatives

# Segments on the way from one point of the section to the next, at most: hundreds of events in one swing.
MOST_SEGMENTS = 4096
# The same on the way to a later one.
MOST_TO_CROSSING = 64 * MOST_SEGMENTS


class Point(eqx.Module):
    """A state on the section, as a deviation from the sliding equilibrium, and the contact mode there."""

    y: State
    contact: Contact


class Return(NamedTuple):
    """Where the return map leads."""

    point: Point
    time: Float[Array, ""]  # how long it took, s
    events: Int[Array, ""]  # contact events on the way
    segments: Int[Array, ""]  # segments on the way
    arrived: Bool[Array, ""]  # whether the section was met


def mechanics_about_sliding(scene: Scene) -> Mechanics:
    """Mechanics for displacements and loads as deviations from the sliding equilibrium under the final load.

    A vibration of nanometres under a load that bends the springs by metres would be lost in the rounding of totals.
    """
    load = scene.load.final
    _, normal_force = steady_sliding(scene, load)
    return Mechanics(scene).about(Rest(scene, load, normal_force), scene.structure)


def sliding_state(scene: Scene, load: Float[Array, ""]) -> State:
    """The state of steady sliding under a load (N)."""
    q, _ = steady_sliding(scene, load)
    return jnp.concatenate([q, jnp.zeros_like(q)])


def longest_return(scene: Scene) -> Float[Array, ""]:
    """A time (s) in which a motion that goes on has long met the section: a hundred of its slowest natural periods."""
    structure = scene.structure
    rates = jnp.diag(structure.stiffness) / jnp.diag(structure.mass)
    return 100 * 2 * math.pi / jnp.sqrt(jnp.min(jnp.where(rates > 0, rates, jnp.inf)))


def to_crossing(
    stepper: EventExact,
    mechanics: Mechanics,
    start: Point,
    crossings: Int[Array, ""] | int,
    longest: Float[Array, ""],
    total: Total,
    observe: Callable[[Total, Segment], Total],
    most: int,
) -> tuple[Bool[Array, ""], Followed, Total]:
    """A motion from a start to its `crossings`-th crossing of the section, or for a time `longest` (s), or `most` segments.

    Returns whether it has crossed so often, where it has come to, and the total of what `observe` adds of each segment.
    """

    def observe_crossings(counted, segment: Segment):
        crossed, total = counted
        return crossed + segment.after.rise.happened, observe(total, segment)

    after = follow(
        stepper,
        mechanics,
        start.contact,
        jnp.zeros((), start.y.dtype),
        start.y,
        longest,
        total=(jnp.zeros((), jnp.int32), total),
        observe=observe_crossings,
        until=lambda counted: counted[0] >= crossings,
        at_section=True,
        most=most,
        kind="lax",
    )
    crossed, total = after.total
    return crossed >= crossings, after, total


def moved(
    stepper: EventExact,
    mechanics: Mechanics,
    start: Point,
    crossings: Int[Array, ""] | int,
    longest: Float[Array, ""],
) -> Return:
    """The motion from a start to its `crossings`-th crossing of the section, or for a time `longest` (s).

    Whichever comes first, and `arrived` says which. Differentiable forward.
    """
    none = jnp.zeros((), jnp.int32)

    def observe(total, segment: Segment):
        events, segments = total
        return events + jnp.any(segment.after.ended), segments + 1

    crossed, after, (events, segments) = to_crossing(
        stepper, mechanics, start, crossings, longest, (none, none), observe, MOST_TO_CROSSING
    )
    arrived = crossed & jnp.all(jnp.isfinite(after.y))
    return Return(Point(after.y, after.contact), longest - after.left, events, segments, arrived)


def section_return(
    stepper: EventExact, scene: Scene, mechanics: Mechanics, point: Point, crossings: Int[Array, ""] | int
) -> Return:
    """From a point of the section, or any other start, to its `crossings`-th crossing.

    Not a number where the section is not met within `longest_return` for each crossing.
    """
    found = moved(stepper, mechanics, point, crossings, longest_return(scene) * crossings)
    y = jnp.where(found.arrived, found.point.y, jnp.nan)
    return found._replace(point=Point(y, found.point.contact))


def return_with_jacobian(
    scene: Scene, stepper: EventExact, point: Point, crossings: int
) -> tuple[Return, Float[np.ndarray, "state state"]]:
    """The return map at a point, and its derivative: saltation at each event and at the section included."""
    found, jacobian = _moved_with_jacobian(
        scene, stepper, point, jnp.asarray(crossings, jnp.int32), jnp.asarray(jnp.inf, jnp.float64)
    )
    return found, np.where(found.arrived, np.asarray(jacobian), np.nan)


def flow_with_jacobian(
    scene: Scene, stepper: EventExact, start: Point, time: float
) -> tuple[Point, Float[np.ndarray, "state state"]]:
    """Where the motion is after a time (s), and its derivative in the start at that fixed time."""
    # The same program as the return map's, with crossings that are never reached.
    never = jnp.asarray(np.iinfo(np.int32).max, jnp.int32)
    found, jacobian = _moved_with_jacobian(scene, stepper, start, never, jnp.asarray(time, jnp.float64))
    return found.point, np.asarray(jacobian)


@compiled
def _moved_with_jacobian(scene: Scene, stepper: EventExact, point: Point, crossings, time):
    mechanics = mechanics_about_sliding(scene)
    longest = jnp.minimum(time, longest_return(scene) * crossings)
    stepper = for_derivatives(stepper, mechanics)

    def along(direction):
        def state(y):
            found = moved(stepper, mechanics, Point(y, point.contact), crossings, longest)
            return found.point.y, found

        _, tangent, found = jax.jvp(state, (point.y,), (direction,), has_aux=True)
        return found, tangent

    size = point.y.shape[0]
    found, jacobian = jax.vmap(along, out_axes=(None, 1))(jnp.eye(size, dtype=point.y.dtype))
    return found, jacobian


@compiled
def points_along(scene: Scene, stepper: EventExact, starts: Point, count: int) -> Return:
    """The next `count` points of the section from each of several starts (leading axis); after a failure, not a number."""
    mechanics = mechanics_about_sliding(scene)

    def to_next(point, _):
        following = section_return(stepper, scene, mechanics, point, 1)
        return following.point, following

    def of_one(start):
        return jax.lax.scan(to_next, start, None, length=count)[1]

    return jax.vmap(of_one)(starts)
