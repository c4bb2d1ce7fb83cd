"""The kernels themselves: one thread for each trajectory, or for each state whose return to the section is asked for."""

import functools
from typing import Any, NamedTuple

import numpy as np

from ..cycles.section_map import MOST_TO_CROSSING
from ..foundation.warp_library import warp
from ..steppers.kernel_advance import stepping
from ..steppers.kernel_laws import Form
from ..verdicts.ensemble import LOOKS_NEAR, REACHED, SEEN
from .conclusion import STEPS_PER_LOOK
from .windowed_returns import KEPT


class Programs(NamedTuple):
    """Kernels for scenes of one form, in a Warp module."""

    module: Any
    returned: Any
    followed: Any


@functools.cache
def programs(form: Form) -> Programs:
    """The kernels for scenes of this form."""
    wp, of = warp(), stepping(form)
    real, integer, advance, peak = wp.float64, wp.int32, of.advance, of.peak
    state, mode_type, numbers = of.types.state, of.types.mode, of.types.mechanics
    size = state._length_
    zero, infinite, reached_at = real(0.0), real(np.inf), real(REACHED)
    module = wp.get_module(f"fivjax.maps.kernels.{of.name}")
    # Products and sums in one: a tenth faster.
    flags = f"{wp.config.cpu_compiler_flags or ''} -ffp-contract=fast".strip()
    module.options.update(max_unroll=1, cpu_compiler_flags=flags)

    @wp.kernel(enable_backward=False, module=module)
    def returned(
        m: wp.array(dtype=real),
        mechanics: wp.array(dtype=numbers),
        interval: wp.array(dtype=real),
        weights: wp.array(dtype=state),
        group: wp.array(dtype=integer),
        crossings: wp.array(dtype=integer),
        longest: wp.array(dtype=real),
        states: wp.array(dtype=state),
        modes: wp.array(dtype=mode_type),
        events: wp.array(dtype=integer),
        crossed: wp.array(dtype=integer),
        time: wp.array(dtype=real),
        path: wp.array2d(dtype=state),
        highest: wp.array(dtype=real),
        peaks: int,
        first: int,
    ):
        i = first + wp.tid()
        g = group[i]
        own = mechanics[g]
        y = states[i]
        mode = modes[i]
        left = longest[i]
        ended = int(0)
        passed = int(0)
        count = int(0)
        top = real(0.0)
        while left > zero and passed < crossings[i] and count < MOST_TO_CROSSING:
            after = advance(m, own, interval[g], g, y, mode, zero, left)
            if peaks > 0:
                top = wp.max(top, peak(m, interval[g], g, y, mode, zero, after.h, after.end))
            y = after.y
            mode = after.mode
            ended += after.ended
            if after.h >= left:
                left = zero
            else:
                left -= after.h
            if after.crossed > 0:
                path[i, passed % KEPT] = y
                passed += 1
            count += 1
            if not wp.isfinite(after.h):
                left = zero
        states[i] = y
        modes[i] = mode
        events[i] = ended
        crossed[i] = passed
        highest[i] = top
        time[i] = longest[i] - left

    @wp.func
    def distance(known: wp.array2d(dtype=state), g: int, crossing: state) -> real:
        """Of a weighted crossing state to the nearest one of a torus, relative to its size."""
        nearest = real(infinite)
        for k in range(known.shape[1]):
            apart = crossing - known[g, k]
            nearest = wp.min(nearest, wp.dot(apart, apart))
        return wp.sqrt(nearest / wp.dot(crossing, crossing))

    @wp.kernel(enable_backward=False, module=module)
    def followed(
        m: wp.array(dtype=real),
        mechanics: wp.array(dtype=numbers),
        interval: wp.array(dtype=real),
        weights: wp.array(dtype=state),
        known: wp.array2d(dtype=state),
        amplitude: wp.array(dtype=real),
        group: wp.array(dtype=integer),
        jumps: wp.array2d(dtype=real),
        loads: wp.array2d(dtype=real),
        times: wp.array(dtype=real),
        states: wp.array(dtype=state),
        modes: wp.array(dtype=mode_type),
        crossings: wp.array(dtype=state),
        events: wp.array(dtype=integer),
        last_event: wp.array(dtype=real),
        seen: wp.array2d(dtype=state),
        near: wp.array(dtype=integer),
        reached: wp.array(dtype=integer),
        seen_at: wp.array2d(dtype=state),
        time_at: wp.array2d(dtype=real),
        events_at: wp.array2d(dtype=integer),
        looks: int,
        first: int,
    ):
        i = first + wp.tid()
        g = group[i]
        own = mechanics[g]
        t = times[i]
        y = states[i]
        mode = modes[i]
        crossing = crossings[i]
        for at in range(looks):
            for _ in range(STEPS_PER_LOOK):
                past = int(0)
                for k in range(jumps.shape[1]):
                    if jumps[i, k] <= t:
                        past += 1
                until = real(infinite)
                if past < jumps.shape[1]:
                    until = real(jumps[i, past])
                after = advance(m, own, interval[g], g, y, mode, loads[i, past], until - t)
                if after.h >= until - t:
                    t = until
                else:
                    t += after.h
                if after.mode[0] != mode[0]:
                    events[i] = events[i] + 1
                    last_event[i] = t
                y = after.y
                mode = after.mode
                # Crossings during the kick do not count for the motion after it.
                if after.crossed > 0 and past == jumps.shape[1]:
                    crossing = y
            look = wp.cw_mul(weights[g], crossing)
            fresh = int(0)
            for k in range(size):
                if look[k] != seen[i, 0][k]:
                    fresh = 1
            if fresh > 0:
                for k in range(SEEN - 1):
                    seen[i, SEEN - 1 - k] = seen[i, SEEN - 2 - k]
                seen[i, 0] = look
                close = int(0)
                if amplitude[g] > zero and distance(known, g, look) <= reached_at:
                    close = 1
                near[i] = close * (near[i] + 1)
                if near[i] >= LOOKS_NEAR:
                    reached[i] = 1
            if at < seen_at.shape[1]:
                seen_at[i, at] = look
                time_at[i, at] = t
                events_at[i, at] = events[i]
        times[i] = t
        states[i] = y
        modes[i] = mode
        crossings[i] = crossing

    return Programs(module, returned, followed)
