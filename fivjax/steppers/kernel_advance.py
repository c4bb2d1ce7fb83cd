"""Exact motion through contact events under constant friction, as Warp functions that run on a CPU or a GPU.

In one contact mode the motion is then linear: the states at equally spaced later times are matrices times the present state
(`propagation`). They are samples over a *window* of time ahead, with the Bernstein control points of the guards between them.
A loop looks at the intervals one after the other and stops at the first that may have an event; only there the Taylor series,
again a matrix times the state, is searched for the instant. What ends a mode and what follows comes from `contact`.
"""

import functools
import math
from typing import Any, NamedTuple

import numpy as np

from ..contact import Status
from ..contact.rounding import RESTING
from ..foundation.warp_library import warp
from .kernel_arithmetic import arithmetic
from .kernel_laws import Form, laws
from .kernel_matrices import BLOCK, blocks_of, padded
from .kernel_roots import roots
from .kernel_types import Types
from .propagation import INTERVALS

# The matrices of structures with more degrees of freedom take megabytes for each scene, which are read in every step.
MOST_COORDINATES = 24


class Stepping(NamedTuple):
    """Warp functions for scenes of one form."""

    name: str  # a digest of the laws
    types: Types
    advance: Any
    peak: Any


@functools.cache
def stepping(form: Form) -> Stepping:
    """The Warp functions for scenes of this form.

    `advance` goes to the next event, crossing of the section, end of the time or of the window, whichever comes first; `peak`
    is the largest tangential speed on the way, or the one from before if that was larger.
    """
    wp, law = warp(), laws(form)
    t, like, real = law.types, law.mechanics, wp.float64
    n, velocity = like.free_load.shape[0], like.free_load.shape[0] + like.tangential
    held, next_mode, has_begun, is_safe = law.held, law.next_mode, law.has_begun, law.is_safe
    brackets, fastest_sample = law.brackets, law.fastest_sample
    of = arithmetic(n, like.tangential, like.normal, t)
    row_of, block, sample, hull, sizes = of.row_of, of.block, of.sample, of.hull, of.sizes
    guard_series, guard, series, speed_series = of.guard_series, of.guard, of.series, of.speed_series
    scan, speeds_in, speed_and_bend = of.scan, of.speeds, of.speed_and_bend
    value_at, state_at = of.value_at, of.state_at
    lowest_of, root_of, rise_of, highest_of = roots(t, of)
    state, row, pair = t.state, t.row, t.pair
    mode_of, ending, one_number = t.mode, t.ending, t.one
    at = blocks_of(n)
    hulls, samples, guards, displacements, bounds = at.hull, at.samples, at.guards, at.displacements, at.sizes
    of_sample = padded(2 * n) // BLOCK
    # Places of what `window.Bracket` has of both guards.
    ends, zeros, crossing, spent, dips = 4, 2, 6, 8, 10
    # Numbers in double precision: Warp takes Python's for single.
    zero, half, one, most, infinite = (real(x) for x in (0.0, 0.5, 1.0, INTERVALS, math.inf))
    rounding, resting = real(8.0 * np.finfo(float).eps), real(RESTING["float64"])
    stick, detach = real(Status.STICK), real(Status.DETACH)

    @wp.struct
    class Step:
        """An advance: the state and mode after it, its duration (s), whether the section was crossed, whether the mode has
        ended, and the tangential velocity (m/s) before what happened at its end.
        """

        y: state
        mode: mode_of
        h: real
        crossed: int
        ended: int
        last: real

    @wp.func
    def matrix_of(g: int, mode: mode_of) -> int:
        """The place of a mode's matrix among those of all groups."""
        if mode[0] == stick:
            return 4 * g
        if mode[0] == detach:
            return 4 * g + 3
        if mode[1] > zero:
            return 4 * g + 1
        return 4 * g + 2

    @wp.func
    def first_interval(m: t.matrices, w: int, mode: mode_of, here: row, steps: real) -> int:
        """The first interval that may have an event, in which the section is crossed, or in which the time ends."""
        size = sizes(m, w, bounds, here)
        whole = int(wp.floor(steps))
        proved = int(0)
        start = block(m, w, guards, here)
        if has_begun(mode, start, size)[0] > zero:
            # A guard that begins at zero is not above its limits: that it rises is told by its series.
            if is_safe(mode, start, hull(m, w, hulls, here), size)[0] > zero:
                proved = 1
            else:
                whole = 0
        return scan(m, w, here, size, proved, whole)

    @wp.func
    def advance(
        m: t.matrices,
        mechanics: t.mechanics,
        interval: real,
        g: int,
        y: state,
        mode: mode_of,
        load: real,
        h: real,
    ) -> Step:
        w = matrix_of(g, mode)
        steps = wp.min(h / interval, most)
        here = row_of(y, load)
        i = first_interval(m, w, mode, here, steps)
        began = y
        if i > 0:
            began = sample(m, w, samples + of_sample * i, here)
        share = zero
        fires_0 = int(0)
        fires_1 = int(0)
        crossed = int(0)
        reached = began
        if i < INTERVALS:
            there = row_of(began, load)
            both = guard_series(m, w, guards, there)
            b = brackets(mode, both, sizes(m, w, bounds, there))
            share = wp.min(steps - real(i), one)
            root = pair(infinite, infinite)
            slope = pair()
            same = pair()
            for q in range(2):
                crosses = b[crossing + q]
                end = b[ends + q]
                guess = b[q]
                if crosses > zero or b[dips + q] > zero:
                    c = guard(both, q, int(b[zeros + q]))
                    if b[dips + q] > zero:
                        low = lowest_of(c, guess)
                        if value_at(c, low)[0] <= zero:
                            crosses = one
                            end = low
                            guess = half * low
                    if crosses > zero:
                        found = root_of(c, b[zeros + q], guess, end)
                        root[q] = found[0]
                        slope[q] = found[1]
                        same[q] = rounding * (wp.abs(c[0]) + wp.abs(c[1]) + wp.abs(c[2]) + wp.abs(c[3]))
            first = wp.min(root[0], root[1])
            # Roots that differ by rounding are one event; the two guards of an open gap always are.
            if root[0] < infinite and (root[0] == first or (root[0] - first) * wp.abs(slope[0]) <= same[0]):
                fires_0 = 1
            if root[1] < infinite and (root[1] == first or (root[1] - first) * wp.abs(slope[1]) <= same[1]):
                fires_1 = 1
            if b[spent] > zero or b[spent + 1] > zero:
                first = zero
                fires_0 = int(b[spent])
                fires_1 = int(b[spent + 1])
            if first <= share:
                if fires_0 + fires_1 > 0:
                    share = first
            else:
                fires_0 = 0
                fires_1 = 0
            if share != zero:
                ahead = series(m, w, displacements, there)
                reached = state_at(ahead, share, interval)
                if began[velocity] < zero and reached[velocity] >= zero:
                    crossed = 1
                    share = rise_of(speed_series(ahead), share, reached[velocity] * interval)
                    reached = state_at(ahead, share, interval)
                    reached[velocity] = zero
                    fires_0 = 0
                    fires_1 = 0
        result = Step()
        result.last = reached[velocity]
        result.ended = wp.max(fires_0, fires_1)
        if result.ended > 0:
            how = ending(load, real(fires_0), real(fires_1), resting * interval)
            after = next_mode(mechanics, mode, reached, how)
            for k in range(2 * n):
                result.y[k] = after[k]
            result.mode = mode_of(after[2 * n], after[2 * n + 1])
        else:
            result.y = held(mechanics, mode, reached)
            result.mode = mode
        # An impact may make the velocity jump over zero.
        if reached[velocity] < zero and result.y[velocity] >= zero:
            crossed = 1
        result.crossed = crossed
        result.h = (real(i) + share) * interval
        return result

    @wp.func
    def highest_near(m: t.matrices, w: int, here: row, load: real, i: int, steps: real, interval: real) -> real:
        """The largest tangential speed next to a sample of the window."""
        about = row_of(sample(m, w, samples + of_sample * i, here), load)
        c = speed_series(series(m, w, displacements, about))
        return highest_of(c, wp.max(-real(i), -one), wp.min(steps - real(i), one)) / interval

    @wp.func
    def peak(
        m: t.matrices, interval: real, g: int, y: state, mode: mode_of, load: real, after: Step, before: real
    ) -> real:
        w = matrix_of(g, mode)
        here = row_of(y, load)
        steps = after.h / interval
        highest = wp.max(before, wp.abs(after.last))
        speeds = speeds_in(m, w, here)
        turned = -speeds
        # A parabola through three samples rises by less than half of their second difference above the highest of them. So
        # most advances have no higher peak than those before.
        rough = speed_and_bend(speeds, wp.min(int(steps) + 1, INTERVALS))
        if rough[0] + half * rough[1] <= highest:
            return highest
        for k in range(wp.min(int(steps), INTERVALS) + 1):
            highest = wp.max(highest, wp.abs(speeds[k]))
        # Parabolas through three samples tell peaks apart.
        upper = int(fastest_sample(speeds, one_number(steps))[0])
        lower = int(fastest_sample(turned, one_number(steps))[0])
        # Next to a sample that is much slower than others there is no highest peak.
        if speeds[upper] > half * highest:
            highest = wp.max(highest, highest_near(m, w, here, load, upper, steps, interval))
        if turned[lower] > half * highest:
            highest = wp.max(highest, highest_near(m, w, here, load, lower, steps, interval))
        return highest

    return Stepping(law.name, t, advance, peak)
