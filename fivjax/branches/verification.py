"""The real motion that starts on a computed cycle: its modes, its peak and its point on the section."""

from typing import NamedTuple

import numpy as np

from ..contact import Contact, Status
from ..cycles.around import Seen, seen_around
from ..model.scene import Scene
from ..section.crossings import Point
from ..section.return_maps import ReturnMaps, Section
from ..steppers.event_exact import EventExact
from .multiple_shooting import AT_SECTION, LOOKS, Phases, inside, phases_around, same_modes

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
    seen = seen_around(scene, stepper, start, phases.period)
    return Real(start, seen, phases_around(seen.segments))


def on_section(scene: Scene, real: Real) -> Point | None:
    """The first crossing of the section; None if there is none."""
    if float(real.start.y[scene.structure.size + scene.structure.tangential]) == 0.0:
        return real.start
    found = ReturnMaps.of(scene).returns(np.zeros(1, int), Section.of(real.start), 1).at
    return found.point(0) if np.all(np.isfinite(found.y)) else None


def crossings_of(maps: ReturnMaps, point: Point) -> int | None:
    """How often a cycle crosses the section until it returns to the given point; None if it does not return."""
    y = maps.weights * np.asarray(point.y)
    _, path = maps.path(np.zeros(1, int), Section.of(point), MOST_CROSSINGS)
    with np.errstate(invalid="ignore"):
        back = np.flatnonzero(np.linalg.norm(maps.weights * path[0] - y, axis=1) <= BACK * np.linalg.norm(y))
    return int(back[0]) + 1 if len(back) else None
