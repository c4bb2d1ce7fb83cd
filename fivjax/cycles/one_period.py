"""One period of a cycle: its segments, its sequence of contact modes, its peak speed, harmonics and monodromy matrix."""

import functools
import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Complex, Float, Int
from numpy.polynomial.legendre import leggauss
from numpy.polynomial.polynomial import polyval

from ..contact import Contact, State, Status
from ..foundation.carried import depending_on
from ..foundation.precision import known_to_numpy
from ..kernels.functions import KernelFunction
from ..model.scene import Scene
from ..model.sliding import contact_coordinates
from ..section.about_sliding import mechanics_about_sliding
from ..section.crossings import MOST_SEGMENTS, Point, motion_to_section
from ..section.peak_speed import higher_peak
from ..section.return_maps import known_for_section
from ..steppers.event_exact import EXACT_STEPPER
from ..steppers.kernel_scope import has_kernel

HARMONICS = 16
# A number of crossings that is never reached.
NEVER = np.int32(np.iinfo(np.int32).max)


class Phase(NamedTuple):
    """One phase of a cycle: a contact mode and its duration."""

    status: Status | tuple[Status, ...]  # with several contacts, one for each
    duration: float  # s


class PeriodSegments(NamedTuple):
    """The segments of one period, in rows."""

    t: Float[np.ndarray, " s"]  # when each begins, s
    h: Float[np.ndarray, " s"]  # its duration, s
    y: Float[np.ndarray, "s state"]  # the state where it begins
    contact: Contact
    ended: Bool[np.ndarray, "s *contacts 2"]  # which guard ended it
    series: Float[np.ndarray, "s k state"]  # Taylor coefficients of the motion, in time measured in the unit
    unit: Float[np.ndarray, " s"]  # s


class PeriodSummary(NamedTuple):
    """Segments, peak speed and harmonics of one period."""

    segments: PeriodSegments
    amplitude: float  # m/s
    harmonics: Complex[np.ndarray, "count n"]  # m/s


class _Carry(NamedTuple):
    y: State
    contact: Contact
    left: Float[Array, ""]  # of the period, s
    peak: Float[Array, ""]  # m/s
    count: Int[Array, ""]


def _around(args, numbers):
    """The end of a motion from a point on a cycle over one period; and its segments with these numbers, from 0 onwards."""
    scene, point, period = args
    mechanics, zero = mechanics_about_sliding(scene), jnp.zeros((), point.y.dtype)
    contact = Contact(point.contact.status.astype(jnp.int32), point.contact.direction)
    begin = _Carry(point.y, contact, period, zero, jnp.zeros((), jnp.int32))
    begin = depending_on(mechanics, begin)

    def segment(way: _Carry, number):
        after, series, unit = EXACT_STEPPER.with_series(mechanics, way.contact, zero, way.y, way.left)
        goes = (way.left > 0) & (way.count == number)
        peak = higher_peak(mechanics, series, after.h, after.h / unit, way.peak)
        moved = _Carry(
            after.y, after.contact, jnp.where(after.h >= way.left, 0.0, way.left - after.h), peak, way.count + 1
        )
        row = PeriodSegments(period - way.left, after.h, way.y, way.contact, after.ended, series, unit)
        return jax.tree.map(lambda new, old: jnp.where(goes, new, old), moved, way), row

    way, rows = jax.lax.scan(segment, begin, numbers)
    return way, rows


_period = KernelFunction(_around)


def follow_period(scene: Scene, point: Point, period: float) -> PeriodSummary:
    """Segments, peak tangential speed and harmonics of one period from a point on it."""
    # Rows for the segments of a period at first; more where they are not enough.
    least_segments = 64
    args = scene, jax.tree.map(known_to_numpy, point), float(period)
    most = least_segments
    while True:
        end, rows = _period(args, np.arange(float(most)), by_kernel=has_kernel(scene, EXACT_STEPPER))
        # At rounding a motion may touch another mode again and again, and come no further.
        stands_still = not np.any(rows.h[-least_segments // 2 :])
        if end.count < most or most >= MOST_SEGMENTS or stands_still or not np.all(np.isfinite(end.y)):
            break
        most *= 4
    found = PeriodSegments(*jax.tree.map(lambda row: np.asarray(row)[: int(end.count)], rows))
    return PeriodSummary(found, float(end.peak), harmonics(found, period))


_gauss_points = functools.cache(leggauss)


def harmonics(segments: PeriodSegments, period: float) -> Complex[np.ndarray, "count n"]:
    r"""Fourier coefficients of the velocities, $v(t) = \mathrm{Re} \sum_h c_h e^{2πiht/T}$, over exactly one period; m/s.

    With this many Gauss points, a product of two series is integrated with an error far below that of the series itself.
    """
    order, n = segments.series.shape[1] - 1, segments.series.shape[2] // 2
    points, weights = _gauss_points(order // 2 + 2)
    times = 0.5 * (points + 1.0) * segments.h[:, None]
    powers = np.vander((times / segments.unit[:, None]).ravel(), order + 1, increasing=True)
    velocities = powers.reshape(*times.shape, order + 1) @ segments.series[..., n:]
    once = np.exp(-2j * math.pi / period * (segments.t[:, None] + times)).ravel()
    # All orders are powers of the first.
    waves = np.multiply.accumulate(np.broadcast_to(once, (HARMONICS, len(once))))
    weighted = (0.5 * segments.h[:, None] * weights)[..., None] * velocities
    return (2 / period) * waves @ weighted.reshape(len(once), n)


def word(segments: PeriodSegments) -> tuple[Phase, ...]:
    """The contact modes of a cycle in order, with their durations; a mode that the section cuts in two counts once.

    Sliding that reverses its direction is two phases. With several contacts, a phase lasts until the mode of one of them ends.
    """
    lasts = segments.h > 0
    status, direction = (part.reshape(len(lasts), -1) for part in (segments.contact.status, segments.contact.direction))
    mode = np.concatenate([status, np.where(status == Status.SLIDE, direction, 0.0)], axis=1)[lasts]
    # An event between two segments separates them also where the mode is the same: a rebound.
    ended = np.any(segments.ended.reshape(len(lasts), -1), axis=1)
    begins = np.any(mode != np.roll(mode, 1, axis=0), axis=1) | np.roll(ended, 1)[lasts]
    first = np.flatnonzero(begins | (np.arange(len(begins)) == 0))
    durations = np.add.reduceat(segments.h[lasts], first)
    if len(first) > 1 and not begins[0]:
        durations[0] += durations[-1]
        first, durations = first[:-1], durations[:-1]
    modes = [tuple(map(Status, row)) for row in status[lasts][first].tolist()]
    several = segments.contact.status.ndim > 1
    return tuple(
        Phase(mode if several else mode[0], duration) for mode, duration in zip(modes, durations.tolist(), strict=True)
    )


def floquet_multipliers(scene: Scene, segments: PeriodSegments, period: float) -> Complex[np.ndarray, " m"]:
    """Eigenvalues of the monodromy matrix, largest first: one is 1, for the direction along the cycle.

    The matrix is computed in the coordinates that the contact mode leaves free: sticking leaves fewer free, so that multipliers
    of 0 would be missing.
    """
    start = middle_of_longest(segments)
    matrix = _monodromy(scene, start, period)
    free = free_in_mode(scene, start.contact.status)
    values = np.linalg.eigvals(matrix[np.ix_(free, free)]).astype(complex)
    return values[np.argsort(-np.abs(values), kind="stable")]


def middle_of_longest(segments: PeriodSegments) -> Point:
    """The middle of the longest segment that does not stick. It is far from events: a motion from there meets each once."""
    stuck = segments.contact.status == Status.STICK
    moving = np.where(np.any(stuck.reshape(len(stuck), -1), axis=1), 1e-9, 1.0)
    longest = int(np.argmax(moving * segments.h))
    middle = polyval(0.5 * segments.h[longest] / segments.unit[longest], segments.series[longest])
    return Point(middle, jax.tree.map(lambda leaf: leaf[longest], segments.contact))


def _monodromy(scene: Scene, start: Point, period: float) -> Float[np.ndarray, "state state"]:
    """The derivative of the state a period (s) later by that at the start."""
    whose, last = known_for_section(scene), np.array([float(NEVER)])
    args = whose, start, NEVER, period, np.False_
    by_kernel = has_kernel(scene, EXACT_STEPPER)
    _, (slopes, _) = motion_to_section.derived_by(args, start.y, np.eye(len(start.y)), last, by_kernel=by_kernel)
    return slopes.at.point.y


def free_in_mode(scene: Scene, status: Int[np.ndarray, "*contacts"]) -> Int[np.ndarray, " m"]:
    """Indices in the state that a contact mode leaves free."""
    n, held = scene.structure.size, []
    places = contact_coordinates(scene.structure)
    for tangential, normal, one in zip(*map(np.atleast_1d, (*places, status)), strict=True):
        if one != Status.DETACH:
            held += [normal, n + normal]
        if one == Status.STICK:
            held.append(n + tangential)
    return np.delete(np.arange(2 * n), held)
