r"""Grazings: cycles at which a sequence of contact modes ends, because a guard touches zero inside a phase.

Of the two sequences that meet there, the one with fewer phases has a smooth curve of cycles beyond that point. On this curve
the grazing is a simple root of the cycle's equations together with $g = 0$ and $\dot g = 0$ at one instant of one phase.
Newton's method finds it to rounding, and the implicit function theorem differentiates it.
"""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from ..contact import Status
from ..foundation.numpy_evaluation import by_numpy
from ..model.scene import Scene
from ..model.sliding import contact_coordinates
from ..section.about_sliding import mechanics_about_sliding
from .multiple_shooting import AT_SECTION, Mode, PhaseImages, Phases, images_of_phases, inside, one_after_another
from .pseudo_arclength import ComputedCycle, Curve, assembled, scaled

NAMES = {
    (Status.SLIDE, 0): "grazing of N",
    (Status.SLIDE, 1): "grazing of slip",
    (Status.DETACH, 0): "grazing of the gap",
    (Status.STICK, 0): "edge of the friction cone",
    (Status.STICK, 1): "edge of the friction cone",
}


def touch(mode: Mode, guard: int) -> str:
    """What it is called that a guard touches zero."""
    return NAMES[mode.of_guard(guard)] + where(mode, guard // 2)


def where(mode: Mode, contact: int) -> str:
    """Which contact something happens at, if there are several."""
    return f" at contact {contact}" if len(mode.status) > 1 else ""


class GuardMinimum(NamedTuple):
    """A minimum of a guard inside a phase; or a guard at the start of a phase, where it decides which mode follows, or at its
    end, where another contact's event changes it.
    """

    phase: int
    mode: Mode  # that of the phase, or one that it could have begun with, ending at the guard
    time: float  # s after the phase's start
    value: float  # relative to the guard's largest value
    bend: float  # the guard's second derivative in time; zero at the start and the end, where the instant is fixed
    at_end: bool = False

    @property
    def guard(self) -> int:
        return self.mode.ending


class Grazing(NamedTuple):
    """A cycle with a guard that touches zero."""

    cycle: ComputedCycle
    minimum: GuardMinimum
    row: Float[np.ndarray, " m"]  # derivative of the guard's minimum by the unknowns


def guard_minima(curve: Curve, cycle: ComputedCycle) -> list[GuardMinimum]:
    """All minima of guards in the phases of a cycle, the lowest first."""
    family, phases = curve.family, cycle.phases
    looked = inside(family.at(cycle.parameter), phases)
    found = _static_edges(curve, cycle)
    for k, mode in enumerate(phases.modes):
        step = phases.h[k] / (looked.guards.shape[1] - 1)
        for j in range(looked.guards.shape[2]):
            guard, (status, which) = looked.guards[k, :, j], mode.of_guard(j)
            size = np.max(np.abs(guard))
            # Both guards of a detached contact are its gap.
            if not size > 0 or step == 0 or (status == Status.DETACH and which == 1):
                continue
            own = mode._replace(ending=j)
            if status == Status.STICK or (status == Status.SLIDE and which == 0):
                found.append(GuardMinimum(k, own, 0.0, float(guard[0] / size), 0.0))
            if mode.ending != AT_SECTION and mode.ending // 2 != j // 2:
                found.append(GuardMinimum(k, own, float(phases.h[k]), float(guard[-1] / size), 0.0, at_end=True))
            inner = guard[1:-1]
            for i in np.flatnonzero((inner <= guard[:-2]) & (inner <= guard[2:])) + 1:
                bend = float(guard[i - 1] - 2 * guard[i] + guard[i + 1]) / step**2
                if bend <= 0:
                    continue
                slope = (guard[i + 1] - guard[i - 1]) / (2 * step)
                shift = -slope / bend
                value = guard[i] + 0.5 * slope * shift
                found.append(GuardMinimum(k, own, float(i * step + shift), float(value / size), float(bend)))
    return sorted(found, key=lambda minimum: minimum.value)


@by_numpy
def _belts_that_may_hold(scene: Scene):
    """Belt speeds of the contacts, NaN where static friction is no larger than that of sliding."""
    mechanics = mechanics_about_sliding(scene)
    belts = mechanics.belt_speed
    sliding = mechanics.friction(jnp.zeros_like(belts)) * (1 + 1e-12)  # what differs by rounding is the same
    return jnp.where(mechanics.friction.static > sliding, belts, jnp.nan)


def _static_edges(curve: Curve, cycle: ComputedCycle) -> list[GuardMinimum]:
    """Where a contact slides on though its slip has ended, by itself or by an impact: the edges of the cone of static friction,
    if that is larger.
    """
    family, phases = curve.family, cycle.phases
    scene = family.at(cycle.parameter)
    belts = np.atleast_1d(_belts_that_may_hold(scene))
    tangential = np.atleast_1d(contact_coordinates(scene.structure)[0])
    velocities = phases.y[:, scene.structure.size + tangential]
    at_rest = np.abs(velocities - belts) <= 1e-9 * np.max(np.abs(velocities))
    places, modes = [], []
    for k, mode in enumerate(phases.modes):
        before = phases.modes[k - 1]
        contact = before.ending // 2
        if before.ending == AT_SECTION or before.status[contact] == Status.STICK:
            continue
        if mode.status[contact] == Status.SLIDE and at_rest[k, contact]:
            held = mode.with_mode_of(contact, (int(Status.STICK), 0.0))
            places += [k, k]
            modes += [held._replace(ending=2 * contact + which) for which in range(2)]
    if not places:
        return []
    none = np.zeros(len(places))
    margins = images_of_phases(scene, family.direction, modes, modes, phases.y[places], none).guard
    width = np.repeat(np.abs(margins[::2] + margins[1::2]), 2)
    shares = np.divide(margins, width, out=np.full_like(margins, np.inf), where=width > 0)
    return [GuardMinimum(k, mode, 0.0, float(share), 0.0) for k, mode, share in zip(places, modes, shares, strict=True)]


def images_up_to_minimum(
    curve: Curve, parameter: float, phases: Phases, minimum: GuardMinimum
) -> tuple[PhaseImages, PhaseImages]:
    """Images of all phases, and of the phase with the minimum up to its instant."""
    family = curve.family
    found = images_of_phases(family.at(parameter), family.direction, *up_to_minimum(phases, minimum))
    return without_minimum(found)


def up_to_minimum(phases: Phases, minimum: GuardMinimum):
    """All phases and, behind them, that with the minimum up to its instant: modes, those that follow, states, durations."""
    k, partial = minimum.phase, minimum.mode
    time = phases.h[k] if minimum.at_end else minimum.time
    modes, following, y, h = one_after_another(phases)
    return (*modes, partial), (*following, partial), np.concatenate([y, y[k : k + 1]]), np.append(h, time)


def without_minimum(found: PhaseImages) -> tuple[PhaseImages, PhaseImages]:
    """Images of the phases themselves, and that of the phase behind them."""
    return PhaseImages(*(part[:-1] for part in found)), PhaseImages(*(part[-1:] for part in found))


def row_of(curve: Curve, phases: Phases, minimum: GuardMinimum, partial: PhaseImages) -> Float[np.ndarray, " m"]:
    """The derivative of a guard's minimum by the unknowns; inside a phase, a change of its instant has no effect to first
    order.
    """
    size = phases.y.shape[1]
    row = np.zeros(len(curve.scales))
    row[minimum.phase * size : (minimum.phase + 1) * size] = partial.guard_y[0]
    if minimum.at_end:
        row[phases.y.size + minimum.phase] = partial.guard_h[0]
    row[-1] = partial.guard_parameter[0]
    return row * curve.scales


def grazing_near(curve: Curve, guess: ComputedCycle, minimum: GuardMinimum) -> Grazing | None:
    """The cycle near a guess on which this guard touches zero."""
    most_iterations = 12
    exact = 1e-13
    # The longest first step, in sizes and periods of the cycle: a phase of thousands of periods takes minutes to follow.
    first_step = 4.0
    u, last = guess.u.copy(), np.inf
    for iteration in range(most_iterations):
        phases, parameter = curve.phases(u)
        found, partial = images_up_to_minimum(curve, parameter, phases, minimum)
        residuals, rows = assembled(found, phases)
        residuals, rows = np.append(residuals, partial.guard[0]), rows * curve.scales
        row = row_of(curve, phases, minimum, partial)
        system = np.vstack([rows, row])
        if not (np.all(np.isfinite(system)) and np.all(np.isfinite(residuals))):
            return None
        system, sizes = scaled(system)
        try:
            step = -np.linalg.solve(system, residuals / sizes)
        except np.linalg.LinAlgError:
            return None
        size = float(np.max(np.abs(step)))
        slope = float(partial.guard_h[0])
        shift = -slope / minimum.bend if minimum.bend > 0 else 0.0
        limit = 0.25 * phases.h[minimum.phase]
        shift = float(np.clip(shift, -limit, limit))
        if (size < exact and abs(shift) < 1e-9 * curve.time) or (last < 1e-10 and size > 0.5 * last):
            cycle = ComputedCycle(u, rows / sizes[:-1, None], found, phases, parameter, iteration)
            return Grazing(cycle, minimum, row / sizes[-1])
        if size > (first_step if iteration == 0 else 0.5):
            return None
        u, last = u + step, size
        if minimum.bend > 0:
            minimum = minimum._replace(time=minimum.time + shift, bend=_bend(curve, u, minimum, shift))
    return None


def _bend(curve: Curve, u, minimum: GuardMinimum, shift: float) -> float:
    """The guard's second derivative in time, by a difference of its slopes."""
    phases, parameter = curve.phases(u)
    apart = 1e-4 * curve.time
    slopes = [
        images_up_to_minimum(curve, parameter, phases, minimum._replace(time=minimum.time + shift + side * apart))[
            1
        ].guard_h[0]
        for side in (-1.0, 1.0)
    ]
    bend = float(slopes[1] - slopes[0]) / (2 * apart)
    return bend if bend > 0 else minimum.bend
