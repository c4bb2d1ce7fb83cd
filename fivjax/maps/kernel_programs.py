"""The kernels themselves: one thread for each trajectory, or for each state whose return to the section is asked for."""

import functools
from typing import Any, NamedTuple

import numpy as np

from ..cycles.section_map import MOST_TO_CROSSING
from ..foundation.warp_library import warp
from ..steppers.kernel_advance import stepping
from ..steppers.kernel_laws import Form


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
    zero, infinite = real(0.0), real(np.inf)
    module = wp.get_module(f"fivjax.maps.kernels.{of.name}")
    # Products and sums in one, and more of the compiler's thought: each makes steps a tenth faster.
    flags = f"{wp.config.cpu_compiler_flags or ''} -O3 -ffp-contract=fast".strip()
    module.options.update(max_unroll=1, cpu_compiler_flags=flags)

    @wp.kernel(enable_backward=False, module=module)
    def returned(
        m: wp.array(dtype=real),
        mechanics: wp.array(dtype=numbers),
        interval: wp.array(dtype=real),
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
                top = peak(m, interval[g], g, y, mode, zero, after, top)
            y = after.y
            mode = after.mode
            ended += after.ended
            if after.h >= left:
                left = zero
            else:
                left -= after.h
            if after.crossed > 0:
                path[i, passed % path.shape[1]] = y
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

    @wp.kernel(enable_backward=False, module=module)
    def followed(
        m: wp.array(dtype=real),
        mechanics: wp.array(dtype=numbers),
        interval: wp.array(dtype=real),
        group: wp.array(dtype=integer),
        jumps: wp.array2d(dtype=real),
        loads: wp.array2d(dtype=real),
        times: wp.array(dtype=real),
        states: wp.array(dtype=state),
        modes: wp.array(dtype=mode_type),
        crossings: wp.array(dtype=state),
        events: wp.array(dtype=integer),
        last_event: wp.array(dtype=real),
        steps: int,
        first: int,
    ):
        i = first + wp.tid()
        g = group[i]
        own = mechanics[g]
        t = times[i]
        y = states[i]
        mode = modes[i]
        crossing = crossings[i]
        for _ in range(steps):
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
        times[i] = t
        states[i] = y
        modes[i] = mode
        crossings[i] = crossing

    return Programs(module, returned, followed)
