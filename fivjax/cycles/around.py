"""One period of a cycle: its segments, its sequence of contact modes, its peak speed, harmonics and monodromy matrix."""

import functools
import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Complex, Float, Int

from ..contact import Contact, Mechanics, State, Status
from ..foundation.compiling import compiled, power_of_4
from ..foundation.polynomial import extremum, value_and_slope
from ..foundation.precision import known_to_numpy
from ..model.scene import Scene
from ..model.sliding import contact_coordinates
from ..steppers.core import Followed, Segment, follow
from ..steppers.event_exact import EventExact
from .section_map import Point, flow_with_jacobian, mechanics_about_sliding, to_crossing

# Samples of the tangential speed in a segment; Newton's method finds the peak from the largest.
SAMPLES = 24
PEAK_STEPS = 6
HARMONICS = 16


class Phase(NamedTuple):
    """One phase of a cycle: a contact mode and its duration."""

    status: Status | tuple[Status, ...]  # with several contacts, one for each
    duration: float  # s


class Round(NamedTuple):
    """The segments of one period; rows beyond `count` are empty."""

    t: Float[Array, " s"]  # when each begins, s
    h: Float[Array, " s"]  # its duration, s; zero where empty
    y: Float[Array, "s state"]  # the state where it begins
    contact: Contact
    ended: Bool[Array, "s *contacts 2"]  # which guard ended it
    count: Int[Array, ""]


def once_around(stepper: EventExact, mechanics: Mechanics, point: Point, period: Float[Array, ""], most: int) -> Round:
    """The segments of a motion that starts at a point, over a time `period` (s); at most `most` of them are kept."""
    n2 = point.y.shape[0]
    none, shape = jnp.zeros(most, point.y.dtype), point.contact.status.shape
    empty = Round(
        none,
        none,
        jnp.zeros((most, n2), point.y.dtype),
        Contact(jnp.zeros((most, *shape), jnp.int32), jnp.ones((most, *shape), point.y.dtype)),
        jnp.zeros((most, *shape, 2), bool),
        jnp.zeros((), jnp.int32),
    )

    def record(total: Round, segment: Segment) -> Round:
        row = Round(segment.t, segment.after.h, segment.y, segment.contact, segment.after.ended, total.count + 1)
        kept = jax.tree.map(lambda all_, one: all_.at[total.count].set(one), total[:-1], row[:-1])
        return Round._make((*kept, row.count))

    zero = jnp.zeros((), point.y.dtype)
    return follow(
        stepper, mechanics, point.contact, zero, point.y, period, total=empty, observe=record, most=most, kind="lax"
    ).total


def peak_speed(stepper: EventExact, mechanics: Mechanics, segments: Round) -> Float[Array, ""]:
    """The largest tangential speed of any contact in all segments, in m/s, to rounding."""

    def of_segment(y, contact, h):
        return _peak_within(stepper, mechanics, y, contact, h)

    return jnp.max(jax.vmap(of_segment)(segments.y, segments.contact, segments.h))


def peak_speed_along(
    stepper: EventExact,
    mechanics: Mechanics,
    point: Point,
    crossings: Int[Array, ""],
    longest: Float[Array, ""],
    most: int,
) -> tuple[Float[Array, ""], Followed]:
    """The largest tangential speed in m/s, to rounding, of a motion from a point to its `crossings`-th crossing of the section;
    and the end of that motion.

    The speed is NaN if that takes longer than `longest` (s), or more than `most` segments. The segments are not kept.
    """

    def observe(peak, segment: Segment):
        own = _peak_within(stepper, mechanics, segment.y, segment.contact, segment.after.h)
        return jnp.maximum(peak, own)

    zero = jnp.zeros((), point.y.dtype)
    crossed, after, peak = to_crossing(stepper, mechanics, point, crossings, longest, zero, observe, most)
    return jnp.where(crossed, peak, jnp.nan), after


def _peak_within(stepper: EventExact, mechanics: Mechanics, y: State, contact: Contact, h) -> Float[Array, ""]:
    coefficients, unit = stepper.series(mechanics, contact, jnp.zeros((), y.dtype), y)
    of_contacts = [
        _peak_of_series(coefficients[:, y.shape[0] // 2 + tangential], h, h / unit)
        for tangential, _ in mechanics.places
    ]
    return functools.reduce(jnp.maximum, of_contacts)


def higher_peak(
    mechanics: Mechanics, coefficients: Float[Array, "k state"], h, end, before: Float[Array, ""]
) -> Float[Array, ""]:
    """The largest tangential speed in m/s within an advance, or the one from `before` if that was larger.

    `coefficients` are those of the motion's Taylor series, `h` is the advance's duration in s and `end` the same in the unit
    of the series.
    """
    n, powers = coefficients.shape[1] // 2, end ** np.arange(len(coefficients))
    for tangential, _ in mechanics.places:
        speeds = coefficients[:, n + tangential]
        # Most advances have no higher peak than those before them.
        most = jnp.sum(jnp.abs(speeds) * powers)
        before = jax.lax.cond(
            most <= before,
            lambda speeds, before: before,
            lambda speeds, before: jnp.maximum(before, _peak_of_series(speeds, h, end)),
            speeds,
            before,
        )
    return before


def _peak_of_series(speeds: Float[Array, " order"], h: Float[Array, ""], end: Float[Array, ""]) -> Float[Array, ""]:
    samples = end * jnp.linspace(0.0, 1.0, SAMPLES)
    values, _ = value_and_slope(speeds, samples)
    # To first order the value at the peak does not depend on the instant of the peak.
    sizes = jnp.abs(values)
    # Not `argmax`, which JAX lowers in single precision when a caller's own `jit` is in it.
    largest = jax.lax.stop_gradient(jnp.max(jnp.where(sizes == jnp.max(sizes), samples, 0.0)))
    x = jax.lax.stop_gradient(extremum(speeds, largest, 0.0, end, PEAK_STEPS))
    refined, _ = value_and_slope(speeds, x)
    ends = jnp.stack([jnp.max(sizes), jnp.abs(refined)])
    return jnp.where(h > 0, jnp.max(ends), 0.0)


def harmonics(
    stepper: EventExact, mechanics: Mechanics, segments: Round, period: Float[Array, ""]
) -> Complex[Array, "count n"]:
    r"""Fourier coefficients of the velocities, $v(t) = \mathrm{Re} \sum_h c_h e^{2πiht/T}$, over exactly one period; m/s."""
    n = segments.y.shape[1] // 2
    zero = jnp.zeros((), segments.y.dtype)

    def of_segment(t, h, y, contact):
        within = stepper.within(mechanics, contact, zero, y, h)
        turns = 2 * math.pi * jnp.arange(1, HARMONICS + 1)[:, None] * ((t + within.times) / period)
        weights = jnp.where(h > 0, within.weights, 0.0)
        states = jnp.where(h > 0, within.states[:, n:], 0.0)
        return (jnp.cos(turns) * weights) @ states, (jnp.sin(turns) * weights) @ states

    real, imaginary = jax.vmap(of_segment)(segments.t, segments.h, segments.y, segments.contact)
    return (2 / period) * (jnp.sum(real, axis=0) - 1j * jnp.sum(imaginary, axis=0))


class Seen(NamedTuple):
    """Segments, peak speed and harmonics of one period."""

    segments: Round
    amplitude: Float[Array, ""]  # m/s
    lines: Complex[Array, "count n"]  # m/s


@compiled
def read_period(scene: Scene, stepper: EventExact, point: Point, period: Float[Array, ""], most: int) -> Seen:
    """Segments, peak tangential speed and harmonics of one period from a point on it."""
    mechanics = mechanics_about_sliding(scene)
    segments = once_around(stepper, mechanics, point, period, most)
    return Seen(
        segments,
        peak_speed(stepper, mechanics, segments),
        harmonics(stepper, mechanics, segments, period),
    )


def seen_around(scene: Scene, stepper: EventExact, point: Point, period: float, segments: int) -> Seen:
    """`read_period` as NumPy arrays; compiled for few different numbers of segments."""
    most = power_of_4(max(segments + 4, 64))
    seen = read_period(scene, stepper, point, jnp.asarray(period), most)
    return jax.tree.map(known_to_numpy, seen)


def word(segments: Round) -> tuple[Phase, ...]:
    """The contact modes of a cycle in order, with their durations; a mode that the section cuts in two counts once.

    Sliding that reverses its direction is two phases. With several contacts, a phase lasts until the mode of one of them ends.
    """
    count = int(segments.count)
    letters: list[tuple[tuple[tuple, tuple], float]] = []
    for k in range(count):
        status, direction = (np.atleast_1d(part[k]) for part in (segments.contact.status, segments.contact.direction))
        key = tuple(status.tolist()), tuple(np.where(status == Status.SLIDE, direction, 0.0).tolist())
        broken = k > 0 and bool(np.any(segments.ended[k - 1]))
        duration = float(segments.h[k])
        if letters and letters[-1][0] == key and not broken:
            letters[-1] = key, letters[-1][1] + duration
        elif duration > 0:
            letters.append((key, duration))
    if len(letters) > 1 and letters[0][0] == letters[-1][0] and not bool(np.any(segments.ended[count - 1])):
        letters = [(letters[0][0], letters[0][1] + letters[-1][1]), *letters[1:-1]]
    several = segments.contact.status.ndim > 1
    phases = [(tuple(map(Status, status)), duration) for (status, _), duration in letters]
    return tuple(Phase(modes if several else modes[0], duration) for modes, duration in phases)


def floquet_multipliers(scene: Scene, stepper: EventExact, segments: Round, period: float) -> Complex[np.ndarray, " m"]:
    """Eigenvalues of the monodromy matrix, largest first: one is 1, for the direction along the cycle.

    The matrix is computed from the middle of the longest segment that does not stick, in the coordinates that the contact mode
    leaves free: sticking leaves fewer free, so that multipliers of 0 would be missing.
    """
    stuck = segments.contact.status == Status.STICK
    moving = np.where(np.any(stuck.reshape(len(stuck), -1), axis=1), 1e-9, 1.0)
    longest = int(np.argmax(moving * segments.h))
    contact = jax.tree.map(lambda leaf: jnp.asarray(leaf[longest]), segments.contact)
    start = Point(jnp.asarray(segments.y[longest]), contact)
    middle, _ = flow_with_jacobian(scene, stepper, start, 0.5 * float(segments.h[longest]))
    _, matrix = flow_with_jacobian(scene, stepper, middle, period)
    free = free_coordinates(scene, segments.contact.status[longest])
    values = np.linalg.eigvals(matrix[np.ix_(free, free)]).astype(complex)
    return values[np.argsort(-np.abs(values), kind="stable")]


def free_coordinates(scene: Scene, status: Int[np.ndarray, "*contacts"]) -> Int[np.ndarray, " m"]:
    """Indices in the state that a contact mode leaves free."""
    n, held = scene.structure.size, []
    places = contact_coordinates(scene.structure)
    for tangential, normal, one in zip(*map(np.atleast_1d, (*places, status)), strict=True):
        if one != Status.DETACH:
            held += [normal, n + normal]
        if one == Status.STICK:
            held.append(n + tangential)
    return np.delete(np.arange(2 * n), held)
