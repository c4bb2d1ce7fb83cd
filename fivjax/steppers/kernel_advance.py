"""`Windowed` for one trajectory at a time, as Warp functions that run on a CPU or a GPU.

The matrices are those of `propagation`, the laws of contact those of `contact`. A loop for one trajectory looks at the
intervals of the window one after the other and stops at the first that may have an event; arrays of trajectories, which
`Windowed` steps, have to look at all. Motions agree to rounding; advances may end elsewhere.
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
from .kernel_matrices import BLOCK, blocks_of, padded, places_of
from .kernel_roots import roots
from .kernel_types import Types
from .propagation import INTERVALS, ORDER

# Structures with more degrees of freedom would make kernels that take long to compile.
MOST_COORDINATES = 8


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
    of = arithmetic(n, t)
    block, sample, hull, guard_series, series = of.block, of.sample, of.hull, of.guard_series, of.series
    scan, speed_and_bend, value_at, state_at = of.scan, of.speed_and_bend, of.value_at, of.state_at
    lowest_of, root_of, rise_of, highest_of = roots(t, of)
    state, row, eight, pair, start_of_guards = t.state, t.row, t.block, t.pair, t.start
    mode_of, polynomial, ending, scan_of, one_number = t.mode, t.polynomial, t.ending, t.scan, t.one
    at = blocks_of(n)
    hulls, samples, guards, displacements, bounds = at.hull, at.samples, at.guards, at.displacements, at.sizes
    of_sample, of_row = padded(2 * n) // BLOCK, wp.types.vector(2 * n + 2, int)(*places_of(n, like.normal))
    speed_at = places_of(n, like.normal).index(velocity)
    # Places of displacements' series, which follow one another, and of what `window.Bracket` has of both guards.
    coordinate, tangential = ORDER + 2, like.tangential
    ends, zeros, crossing, spent, dips = 4, 2, 6, 8, 10
    # Numbers in double precision: Warp takes Python's for single.
    zero, half, one, most, infinite = (real(x) for x in (0.0, 0.5, 1.0, INTERVALS, math.inf))
    rounding, resting = real(8.0 * np.finfo(float).eps), real(RESTING["float64"])
    stick, detach = real(Status.STICK), real(Status.DETACH)

    @wp.struct
    class Step:
        """An advance: the state and mode after it, the state before what happened at its end, its duration (s), whether the
        section was crossed, whether the mode has ended, and the scan of the window before it.
        """

        y: state
        mode: mode_of
        end: state
        h: real
        crossed: int
        ended: int
        scan: scan_of

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
    def stacked(y: state, load: real) -> row:
        found = row()
        for k in range(2 * n + 2):
            place = of_row[k]
            if place < 2 * n:
                found[k] = y[place]
            elif place == 2 * n:
                found[k] = load
            else:
                found[k] = one
        return found

    @wp.func
    def sample_of(m: t.matrices, w: int, here: row, i: int) -> state:
        """The state at the beginning of an interval."""
        there = sample(m, w, samples + of_sample * i, here)
        found = state()
        for k in range(2 * n):
            found[k] = there[k]
        return found

    @wp.func
    def sizes_of(m: t.matrices, w: int, here: row) -> eight:
        """Bounds on the rounding of the guards' first coefficients, and on their difference from cubics."""
        size = row()
        for k in range(2 * n + 2):
            size[k] = wp.abs(here[k])
        return block(m, w, bounds, size)

    @wp.func
    def speed_series(c: t.series) -> polynomial:
        """The series of the tangential velocity, in m per interval."""
        found = polynomial()
        for k in range(ORDER + 1):
            found[k] = real(k + 1) * c[coordinate * tangential + k + 1]
        return found

    @wp.func
    def guard(c: t.guards, which: int, zeros_at_start: real) -> polynomial:
        """The series of a guard; its first coefficients, which are zero up to rounding, are exactly zero."""
        found = polynomial()
        for k in range(ORDER + 1):
            if real(k) >= zeros_at_start:
                found[k] = c[2 * k + which]
        return found

    @wp.func
    def first_interval(m: t.matrices, w: int, mode: mode_of, here: row, steps: real) -> scan_of:
        """The scan up to the first interval that may have an event, in which the section is crossed, or in which the time
        ends. Where the time ends, too, it has the sample behind the end, which tells peaks apart.
        """
        sizes = sizes_of(m, w, here)
        whole = int(wp.floor(steps))
        proved = int(0)
        start = block(m, w, guards, here)
        if has_begun(mode, start, sizes)[0] > zero:
            # A guard that begins at zero is not above its limits: that it rises is told by its series.
            if is_safe(mode, start, hull(m, w, hulls, here), sizes)[0] > zero:
                proved = 1
            else:
                whole = 0
        return scan(m, w, here, speed_at, sizes, proved, whole)

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
        here = stacked(y, load)
        seen = first_interval(m, w, mode, here, steps)
        i = int(seen[INTERVALS + 1])
        began = y
        if i > 0:
            began = sample_of(m, w, here, i)
        share = zero
        fires_0 = int(0)
        fires_1 = int(0)
        crossed = int(0)
        reached = began
        if i < INTERVALS:
            there = stacked(began, load)
            both = guard_series(m, w, guards, there)
            start = start_of_guards()
            for k in range(10):
                start[k] = both[k]
            last = pair(both[2 * ORDER + 2], both[2 * ORDER + 3])
            b = brackets(mode, start, last, sizes_of(m, w, there))
            share = wp.min(steps - real(i), one)
            root = pair(infinite, infinite)
            slope = pair()
            same = pair()
            for q in range(2):
                crosses = b[crossing + q]
                end = b[ends + q]
                guess = b[q]
                if crosses > zero or b[dips + q] > zero:
                    c = guard(both, q, b[zeros + q])
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
        result.end = reached
        result.scan = seen
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
        c = speed_series(series(m, w, displacements, stacked(sample_of(m, w, here, i), load)))
        return highest_of(c, wp.max(-real(i), -one), wp.min(steps - real(i), one)) / interval

    @wp.func
    def peak(
        m: t.matrices, interval: real, g: int, y: state, mode: mode_of, load: real, after: Step, before: real
    ) -> real:
        w = matrix_of(g, mode)
        here = stacked(y, load)
        steps = after.h / interval
        highest = wp.max(before, wp.abs(after.end[velocity]))
        speeds = after.scan
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
