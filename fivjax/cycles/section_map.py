r"""The Poincaré section's return map, exact through every contact event, with its derivative.

On the section the tangential velocity rises through zero. The mean of this velocity over a period is zero, so every limit cycle
crosses the section. Where an impact makes the velocity jump over zero, the point of the section is the state just after the
impact.

States are deviations from the sliding equilibrium under the final load, so that a small cycle under a high load is as exact as
a large one.
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
from ..foundation.carried import depending_on
from ..foundation.compiling import compiled
from ..foundation.linear_solve import solve
from ..model.scene import Scene, steady_sliding
from ..model.sliding import contact_coordinates, free_in_sliding
from ..model.structure import Structure
from ..steppers.core import Followed, Segment, Total, follow
from ..steppers.event_exact import EventExact, for_derivatives

# The most segments from one point of the section to the next: enough for hundreds of events.
MOST_SEGMENTS = 4096
# The most segments from one point of the section to a later one.
MOST_TO_CROSSING = 64 * MOST_SEGMENTS


class Point(eqx.Module):
    """A state on the section, as a deviation from the sliding equilibrium, and the contact mode there."""

    y: State
    contact: Contact


class Return(NamedTuple):
    """The image of a point under the return map."""

    point: Point
    time: Float[Array, ""]  # time of return, s
    events: Int[Array, ""]  # number of contact events in that time
    segments: Int[Array, ""]  # number of segments in that time
    arrived: Bool[Array, ""]  # whether the section was reached


def mechanics_about_sliding(scene: Scene) -> Mechanics:
    """Mechanics for displacements and loads as deviations from the sliding equilibrium under the final load.

    With total displacements, a vibration of nanometres under a load that stretches the springs by metres would be lost in
    rounding.
    """
    load = scene.load.final
    _, normal_force = steady_sliding(scene, load)
    return Mechanics(scene).about(Rest(scene, load, normal_force), scene.structure)


def sliding_state(scene: Scene, load: Float[Array, ""]) -> State:
    """The state of steady sliding under a load (N)."""
    q, _ = steady_sliding(scene, load)
    return jnp.concatenate([q, jnp.zeros_like(q)])


def slowest_period(structure: Structure) -> Float[Array, ""]:
    """The period (s) of the slowest coordinate, if all others were held."""
    rates = jnp.diag(structure.stiffness) / jnp.diag(structure.mass)
    return 2 * math.pi / jnp.sqrt(jnp.min(jnp.where(rates > 0, rates, jnp.inf)))


def longest_return(scene: Scene) -> Float[Array, ""]:
    r"""A time (s) within which any sustained motion crosses the section.

    A hundred of the slowest natural periods, and twice the time for which a contact sticks on a slow belt, from one edge of the
    friction cone to the other: $2 μ N / (k |v|)$ with the normal force of steady sliding and the stiffness $k$ along the belt.
    """
    structure = scene.structure
    tangential, _ = contact_coordinates(structure)
    free = free_in_sliding(structure)
    stiffness = structure.stiffness[jnp.ix_(free, free)]
    along = np.searchsorted(free, tangential)
    compliance = solve(stiffness, jnp.eye(len(free))[:, along])[along]
    compliance = jnp.diag(compliance) if jnp.ndim(compliance) else compliance
    _, force = steady_sliding(scene, scene.load.final)
    sticking = 2 * scene.friction.static * jnp.abs(force) * compliance / jnp.abs(scene.belt_speed)
    # Nothing is known of a structure that is held by no spring.
    sticking = jnp.max(jnp.where(jnp.isfinite(sticking), sticking, 0.0))
    return 100 * slowest_period(structure) + 2 * sticking


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
    """The motion from a start to its `crossings`-th crossing of the section, for a time `longest` (s) or `most` segments at
    most.

    Returns whether it has crossed so often, the end of the motion, and the total of what `observe` adds for each segment.
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
    """The motion from a start to its `crossings`-th crossing of the section, or for a time `longest` (s) if that is shorter.

    `arrived` says which it was. Differentiable in forward mode.
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
    """The motion from a point of the section, or any other start, to its `crossings`-th crossing.

    NaN where the section is not crossed within `longest_return` for each crossing.
    """
    found = moved(stepper, mechanics, point, crossings, longest_return(scene) * crossings)
    y = jnp.where(found.arrived, found.point.y, jnp.nan)
    return found._replace(point=Point(y, found.point.contact))


def return_with_jacobian(
    scene: Scene, stepper: EventExact, point: Point, crossings: int
) -> tuple[Return, Float[np.ndarray, "state state"]]:
    """The return map at a point, and its derivative, with saltation at each event and at the section."""
    found, jacobian = _moved_with_jacobian(
        scene, stepper, point, jnp.asarray(crossings, jnp.int32), jnp.asarray(jnp.inf, jnp.float64)
    )
    return found, np.where(found.arrived, np.asarray(jacobian), np.nan)


def flow_with_jacobian(
    scene: Scene, stepper: EventExact, start: Point, time: float
) -> tuple[Point, Float[np.ndarray, "state state"]]:
    """The state after a given time (s), and its derivative by the start."""
    # The program of the return map, with a number of crossings that is never reached.
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
    """The next `count` points of the section from each of several starts (leading axis); NaN after a failure."""
    mechanics = mechanics_about_sliding(scene)

    def to_next(point, _):
        following = section_return(stepper, scene, mechanics, point, 1)
        return following.point, following

    def of_one(start):
        return jax.lax.scan(to_next, depending_on((mechanics, start), start), None, length=count)[1]

    return jax.vmap(of_one)(starts)
