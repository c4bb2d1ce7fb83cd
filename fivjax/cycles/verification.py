"""The real motion that starts on a computed cycle: its modes, its peak and its point on the section."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from ..contact import Contact, Status
from ..model.scene import Scene
from ..steppers.event_exact import EventExact
from .around import Seen, seen_around
from .multiple_shooting import AT_SECTION, LOOKS, Phases, inside, phases_around, same_modes
from .section_map import return_with_jacobian
from .section_motion import Point

# The most crossings of the section in one period.
MOST_CROSSINGS = 24
# A motion on the cycle returns to its start within this share of its size.
BACK = 1e-6


class Real(NamedTuple):
    """One period of the motion that starts on a computed cycle."""

    start: Point  # its first state, in the middle of the longest phase
    seen: Seen
    phases: Phases | None

    def has_the_modes_of(self, phases: Phases) -> bool:
        """Whether it goes through the same modes as these phases."""
        return self.phases is not None and same_modes(self.phases.modes, phases.modes)


def real_motion(scene: Scene, stepper: EventExact, phases: Phases) -> Real | None:
    """One period of the real motion from a computed cycle; None if a computed phase has a negative duration."""
    # At a special point the duration of a vanishing phase is zero up to rounding.
    if not (np.all(np.isfinite(phases.y)) and np.all(phases.h > -1e-9 * phases.period)):
        return None
    # Started in the middle of a phase, far from events, so that none is met twice or missed.
    longest = int(np.argmax(np.where([mode.status == Status.STICK for mode in phases.modes], 0.0, phases.h)))
    status, direction, ending = phases.modes[longest]
    states = phases.y if ending == AT_SECTION else inside(scene, stepper, phases).states[:, LOOKS // 2]
    contact = Contact(np.asarray(status, np.int32), np.asarray(direction if direction else 1.0, np.float64))
    start = Point(np.asarray(states[longest]), contact)
    seen = seen_around(scene, stepper, start, phases.period, 60)
    return Real(start, seen, phases_around(seen.segments))


def on_section(scene: Scene, stepper: EventExact, real: Real) -> Point | None:
    """The first crossing of the section; None if there is none."""
    if float(real.start.y[scene.structure.size + scene.structure.tangential]) == 0.0:
        return real.start
    found, _ = return_with_jacobian(scene, stepper, real.start, 1)
    return found.point if bool(found.arrived) else None


def crossings_of(scene: Scene, stepper: EventExact, point: Point, weights: Float[np.ndarray, " state"]) -> int | None:
    """How often a cycle crosses the section until it returns to the given point; None if it does not return."""
    y = weights * np.asarray(point.y)
    now = point
    for count in range(1, MOST_CROSSINGS + 1):
        found, _ = return_with_jacobian(scene, stepper, now, 1)
        now = found.point
        if np.linalg.norm(weights * np.asarray(now.y) - y) <= BACK * np.linalg.norm(y):
            return count
    return None
