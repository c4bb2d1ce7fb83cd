"""The real motion that starts on a computed cycle: its modes, its peak and its point on the section."""

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np

from ..attractors.cycles import CROSSINGS, MOST_CROSSINGS
from ..contact import Status
from ..cycles.one_period import PeriodSummary, follow_period
from ..model.scene import Scene
from ..model.sliding import contact_coordinates
from ..section.crossings import Point
from ..section.return_maps import ReturnMaps, Section
from .multiple_shooting import AT_SECTION, LOOKS, Inside, Phases, inside, phases_around

# A motion on the cycle returns to its start within this share of its size.
BACK = 1e-6


class RealMotion(NamedTuple):
    """One period of the motion that starts on a computed cycle."""

    start: Point  # its first state, in the middle of the longest phase
    seen: PeriodSummary
    phases: Phases | None

    def moves_as(self, computed: Phases) -> bool:
        """Whether it has the contact modes of the computed cycle: on a special point, rounding tells which way it goes."""
        return self.phases is not None and self.phases.has_the_modes_of(computed)


def real_motion(scene: Scene, phases: Phases) -> RealMotion | None:
    """One period of the real motion from a computed cycle; None if a computed phase has a negative duration."""
    # At a special point the duration of a vanishing phase is zero up to rounding.
    if not (np.all(np.isfinite(phases.y)) and np.all(phases.h > -1e-9 * phases.period)):
        return None
    # Started in the middle of a phase, far from events, so that none is met twice or missed.
    longest = int(np.argmax(np.where([Status.STICK in mode.status for mode in phases.modes], 0.0, phases.h)))
    whole = phases.modes[longest].ending == AT_SECTION
    start = (
        Point(phases.y[longest], phases.modes[longest].contact)
        if whole
        else _states(scene, phases, [LOOKS // 2])[longest]
    )
    seen = follow_period(scene, start, phases.period)
    comes_around = abs(np.sum(seen.segments.h) - phases.period) <= 1e-9 * phases.period
    return RealMotion(start, seen, phases_around(seen.segments) if comes_around else None)


def amplitude(scene: Scene, phases: Phases, real: RealMotion) -> float:
    """The peak tangential speed (m/s) of a cycle: of its real motion; unless rounding makes that touch again and again where
    the cycle grazes, so that it comes to no end, or go another way where that is about to change. Then of the computed phases.
    """
    if real.moves_as(phases):
        return float(real.seen.amplitude)
    tangential, _ = contact_coordinates(scene.structure)
    places = scene.structure.size + np.atleast_1d(tangential)
    # Looks at all phases, then twice finer ones about the highest speed: a parabola through three of them is then exact.
    for _ in range(3):
        states = inside(scene, phases).states
        speeds = np.abs(states[:, :, places])
        k, look, contact = np.unravel_index(np.argmax(speeds), speeds.shape)
        look, step = int(np.clip(look, 1, LOOKS - 1)), phases.h[k] / LOOKS
        phases = Phases((phases.modes[k],), states[[k], look - 1], np.array([2 * step]))
    before, at, after = speeds[k, look - 1 : look + 2, contact]
    if at < max(before, after):
        # At an end of the phase.
        return float(max(before, after))
    bend = before - 2 * at + after
    return float(at if bend == 0 else at - (after - before) ** 2 / (8 * bend))


def on_section(scene: Scene, phases: Phases, real: RealMotion) -> Point | None:
    """The first crossing of the section on a computed cycle; None if there is none."""
    if phases.modes[0].ending == AT_SECTION:
        return real.start
    # Where the real motion goes another way, from just before the section.
    maps = ReturnMaps.of(scene)
    starts = [real.start] if real.moves_as(phases) else _before_section(maps, inside(scene, phases), phases)
    return _reached(maps, starts) or _reached(maps, _states(scene, phases, range(1, LOOKS)))


def _before_section(maps: ReturnMaps, looked: Inside, phases: Phases) -> list[Point]:
    """The last states at which the guards were looked at before the section is crossed inside a phase."""
    speed = looked.states[:, :, maps.structure.size :] @ maps.section
    places = np.argwhere((speed[:, :-1] < 0) & (speed[:, 1:] >= 0)).tolist()
    return [Point(looked.states[k, look], phases.modes[k].contact) for k, look in places]


def _reached(maps: ReturnMaps, starts: list[Point]) -> Point | None:
    """The next crossing of the section from the first of these states from which there is one."""
    if not starts:
        return None
    found = maps.returns(np.zeros(len(starts), int), Section.of(*starts), 1).at
    reached = np.flatnonzero(np.all(np.isfinite(found.y), axis=1))
    return found.point(int(reached[0])) if len(reached) else None


def _states(scene: Scene, phases: Phases, looks: Iterable[int]) -> list[Point]:
    """The states at these instants, of `LOOKS`, of all phases."""
    states = inside(scene, phases).states
    return [Point(y, mode.contact) for look in looks for mode, y in zip(phases.modes, states[:, look], strict=True)]


def crossings_of(maps: ReturnMaps, point: Point) -> int | None:
    """How often a cycle crosses the section until it returns to the given point; None if it does not return."""
    y = maps.weights * np.asarray(point.y)
    # Most cycles have few.
    for most in (CROSSINGS, MOST_CROSSINGS):
        _, path = maps.path(np.zeros(1, int), Section.of(point), most)
        with np.errstate(invalid="ignore"):
            back = np.flatnonzero(np.linalg.norm(maps.weights * path[0] - y, axis=1) <= BACK * np.linalg.norm(y))
        if len(back):
            return int(back[0]) + 1
    return None
