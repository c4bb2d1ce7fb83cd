r"""The Poincaré section's return map, exact through every contact event, with its derivative.

On the section the tangential velocity rises through zero. The mean of this velocity over a period is zero, so every limit cycle
crosses the section.
"""

from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Bool, Float, Int

from ..foundation.precision import known_to_numpy
from ..model.scene import Scene
from ..steppers.event_exact import EventExact
from ..steppers.kernel_scope import has_kernel
from .section_motion import How, Point, motion_of_scene

# A number of crossings that is never reached.
NEVER = np.int32(np.iinfo(np.int32).max)


class Return(NamedTuple):
    """The image of a point under the return map."""

    point: Point
    time: Float[np.ndarray, ""]  # time of return, s
    events: Int[np.ndarray, ""]  # number of contact events in that time
    segments: Int[np.ndarray, ""]  # number of segments in that time
    arrived: Bool[np.ndarray, ""]  # whether the section was reached


def return_with_jacobian(
    scene: Scene, stepper: EventExact, point: Point, crossings: int
) -> tuple[Return, Float[np.ndarray, "state state"]]:
    """The return map at a point, and its derivative, with saltation at each event and at the section.

    The derivative is NaN where the section is not reached within `longest_return` for each crossing.
    """
    found, jacobian = _moved_with_jacobian(scene, stepper, point, np.int32(crossings), np.inf)
    return found, np.where(found.arrived, jacobian, np.nan)


def flow_with_jacobian(
    scene: Scene, stepper: EventExact, start: Point, time: float
) -> tuple[Point, Float[np.ndarray, "state state"]]:
    """The state after a given time (s), and its derivative by the start."""
    found, jacobian = _moved_with_jacobian(scene, stepper, start, NEVER, float(time))
    return found.point, jacobian


def _moved_with_jacobian(scene: Scene, stepper: EventExact, point: Point, crossings: np.int32, time: float):
    start = jax.tree.map(known_to_numpy, point)
    args, last = (How(stepper), scene, start, crossings, time), np.array([float(crossings)])
    by_kernel = has_kernel(scene, stepper)
    (found, _), (slopes, _) = motion_of_scene.derived_by(args, last, start.y, np.eye(len(start.y)), by_kernel=by_kernel)
    at = found.at
    return Return(at.point, at.time, at.events, at.segments, found.arrived), slopes.at.point.y


def points_along(scene: Scene, stepper: EventExact, starts: Point, count: int) -> Return:
    """The next `count` points of the section from each of several starts (leading axis); NaN after a failure.

    Times, events and segments are those of one return.
    """
    starts = jax.tree.map(known_to_numpy, starts)
    own = starts, *(np.full(len(starts.y), last) for last in (np.int32(count), np.inf))
    numbers = np.arange(1.0, count + 1)
    _, rows = motion_of_scene((How(stepper), scene), numbers, own=own, by_kernel=has_kernel(scene, stepper))
    time, events, segments = (np.diff(part, axis=1, prepend=0) for part in (rows.time, rows.events, rows.segments))
    return Return(rows.point, time, events, segments, np.all(np.isfinite(rows.point.y), axis=-1))
