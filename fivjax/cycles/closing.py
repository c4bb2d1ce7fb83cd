"""Periodic motions by Newton's method on the Poincaré section, with the exact derivative of the return map."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from ..contact import same_mode
from ..model.scene import Scene
from ..steppers.event_exact import EventExact
from .section_map import Return, return_with_jacobian
from .section_motion import Point

MOST_ITERATIONS = 30
# A cycle is closed if the return map misses its start by less than this share of its size.
CLOSED = 1e-10
# Newton's method stops when the distance no longer falls, or is below this.
EXACT = 2e-15
HALVINGS = 5


class Closed(NamedTuple):
    """A fixed point of the return map."""

    point: Point
    crossings: int  # of the section, in one period
    period: float  # s
    jacobian: Float[np.ndarray, "state state"]  # of the return map there
    residual: float  # distance of the return from the start, relative to the cycle's size
    segments: int  # of motion, in one period
    events: int  # contact events in one period


def close(scene: Scene, stepper: EventExact, guess: Point, crossings: int) -> Closed | None:
    """The periodic motion near a guess that crosses the section `crossings` times a period; None if none is found.

    The unknown is the whole state on the section. Entries that the contact mode or the section sets to zero return as zero
    from any value, so Newton's method sets them to zero at once, and one program serves all modes.
    """
    weights = np.asarray(scene.structure.weights)
    best: tuple[float, Point, Return, np.ndarray] | None = None
    point, step, since = guess, None, 0
    for _ in range(MOST_ITERATIONS):
        found, jacobian = return_with_jacobian(scene, stepper, point, crossings)
        y, closure = np.asarray(point.y), missed_by(point, found, weights)
        gap = np.asarray(found.point.y) - y
        usable = np.isfinite(closure) and np.all(np.isfinite(jacobian))
        if usable and not _same_mode(found.point, point):
            # The guess has another contact mode than its image; go on from the image.
            point, step = found.point, None
            since += 1
            if since > HALVINGS:
                break
            continue
        if best is not None and not (usable and closure < best[0]):
            if best[0] <= CLOSED or step is None or since >= HALVINGS:
                break
            # The step was too long: half of it.
            step, since = 0.5 * step, since + 1
            point = Point(np.asarray(np.asarray(best[1].y) + step), best[1].contact)
            continue
        if not usable:
            return None
        best, since = (float(closure), point, found, jacobian), 0
        if closure <= EXACT:
            break
        step = _newton_step(jacobian, gap, len(scene.structure.contacts))
        if step is None:
            break
        point = Point(np.asarray(y + step), point.contact)
    if best is None or not best[0] <= CLOSED:
        return None
    _, point, found, jacobian = best
    # The period may be a fraction of the time that was asked for.
    for fewer in (count for count in range(1, crossings) if crossings % count == 0):
        sooner, derived = return_with_jacobian(scene, stepper, point, fewer)
        missed = missed_by(point, sooner, weights)
        if missed <= CLOSED and _same_mode(sooner.point, point):
            found, jacobian, crossings = sooner, derived, fewer
            break
    return closed_as(point, crossings, found, jacobian, weights)


def missed_by(point: Point, found: Return, weights: Float[np.ndarray, " state"]) -> float:
    """The distance of a return from the point it began at, relative to the point's size."""
    y = np.asarray(point.y)
    size = np.linalg.norm(weights * y)
    return float(np.linalg.norm(weights * (np.asarray(found.point.y) - y)) / size) if size > 0 else np.inf


def closed_as(point: Point, crossings: int, found: Return, jacobian, weights: Float[np.ndarray, " state"]) -> Closed:
    """The cycle with this return."""
    residual = missed_by(point, found, weights)
    return Closed(point, crossings, float(found.time), jacobian, residual, int(found.segments), int(found.events))


def _same_mode(a: Point, b: Point) -> bool:
    one, other = a.contact, b.contact
    return bool(np.all(same_mode(one.status, one.direction, other.status, other.direction)))


def _newton_step(jacobian: np.ndarray, gap: np.ndarray, contacts: int) -> np.ndarray | None:
    if contacts > 1:
        # Uncoupled oscillators may be shifted against each other in time, so the step is not unique: the shortest is taken.
        return np.linalg.lstsq(np.eye(len(gap)) - jacobian, gap, rcond=1e-9)[0]
    try:
        return np.linalg.solve(np.eye(len(gap)) - jacobian, gap)
    except np.linalg.LinAlgError:
        return None
