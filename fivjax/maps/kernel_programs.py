"""The kernels themselves: one thread for each trajectory, or for each state whose return to the section is asked for.

What belongs to a trajectory is a row of numbers, which the kernels change in place.
"""

import enum
import functools
from typing import Any, NamedTuple

import numpy as np

from ..foundation.warp_library import compiler_flags, warp
from ..section.crossings import MOST_TO_CROSSING
from ..steppers.kernel_advance import stepping
from ..steppers.kernel_laws import Form


class ReturnColumn(enum.IntEnum):
    """Columns of the rows of `returned`: first what is asked, then what is found. The state is in all from `STATE` on."""

    CROSSINGS, LONGEST, STATUS, DIRECTION, EVENTS, CROSSED, TIME, PEAK, STATE = range(9)


class FollowColumn(enum.IntEnum):
    """Entries of what tells `followed` the columns of its rows."""

    T, Y, MODE, MODE_DIRECTION, CROSSING, STATUS_CHANGES, LAST_CHANGE, JUMPS, LOADS = range(9)


class Programs(NamedTuple):
    """Kernels for scenes of one form, in a Warp module."""

    module: Any
    returned: Any
    followed: Any
    columns: Any  # the type of what tells `followed` the columns of its rows


@functools.cache
def programs(form: Form) -> Programs:
    """The kernels for scenes of this form."""
    wp, of = warp(), stepping(form)
    real, integer, advance, peak = wp.float64, wp.int32, of.advance, of.peak
    state, mode_type, numbers = of.types.state, of.types.mode, of.types.mechanics
    size, columns_type = state._length_, wp.types.vector(9, int)
    zero, infinite = real(0.0), real(np.inf)
    module = wp.get_module(f"fivjax.maps.matrix_kernels.{of.name}")
    module.options.update(max_unroll=1, cpu_compiler_flags=compiler_flags())

    @wp.func
    def state_in(rows: wp.array2d(dtype=real), i: int, first: int) -> state:
        found = state()
        for k in range(size):
            found[k] = rows[i, first + k]
        return found

    @wp.func
    def put(rows: wp.array2d(dtype=real), i: int, first: int, y: state):
        for k in range(size):
            rows[i, first + k] = y[k]

    @wp.kernel(enable_backward=False, module=module)
    def returned(
        m: wp.array(dtype=real),
        mechanics: wp.array(dtype=numbers),
        interval: wp.array(dtype=real),
        group: wp.array(dtype=integer),
        rows: wp.array2d(dtype=real),
        path: wp.array2d(dtype=real),
        kept: int,
        peaks: int,
        first: int,
    ):
        i = first + wp.tid()
        g = group[i]
        own = mechanics[g]
        y = state_in(rows, i, ReturnColumn.STATE)
        mode = mode_type(rows[i, ReturnColumn.STATUS], rows[i, ReturnColumn.DIRECTION])
        crossings = int(rows[i, ReturnColumn.CROSSINGS])
        left = rows[i, ReturnColumn.LONGEST]
        ended = int(0)
        passed = int(0)
        count = int(0)
        top = real(0.0)
        while left > zero and passed < crossings and count < MOST_TO_CROSSING:
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
                put(path, i, size * (passed % kept), y)
                passed += 1
            count += 1
            if not wp.isfinite(after.h):
                left = zero
        put(rows, i, ReturnColumn.STATE, y)
        rows[i, ReturnColumn.STATUS] = mode[0]
        rows[i, ReturnColumn.DIRECTION] = mode[1]
        rows[i, ReturnColumn.EVENTS] = real(ended)
        rows[i, ReturnColumn.CROSSED] = real(passed)
        rows[i, ReturnColumn.TIME] = rows[i, ReturnColumn.LONGEST] - left
        rows[i, ReturnColumn.PEAK] = top

    @wp.kernel(enable_backward=False, module=module)
    def followed(
        m: wp.array(dtype=real),
        mechanics: wp.array(dtype=numbers),
        interval: wp.array(dtype=real),
        group: wp.array(dtype=integer),
        rows: wp.array2d(dtype=real),
        at: columns_type,
        jumps: int,
        steps: int,
        first: int,
    ):
        i = first + wp.tid()
        g = group[i]
        own = mechanics[g]
        t = rows[i, at[FollowColumn.T]]
        y = state_in(rows, i, at[FollowColumn.Y])
        mode = mode_type(rows[i, at[FollowColumn.MODE]], rows[i, at[FollowColumn.MODE_DIRECTION]])
        crossing = state_in(rows, i, at[FollowColumn.CROSSING])
        changes = int(rows[i, at[FollowColumn.STATUS_CHANGES]])
        last_change = rows[i, at[FollowColumn.LAST_CHANGE]]
        for _ in range(steps):
            past = int(0)
            for k in range(jumps):
                if rows[i, at[FollowColumn.JUMPS] + k] <= t:
                    past += 1
            until = real(infinite)
            if past < jumps:
                until = rows[i, at[FollowColumn.JUMPS] + past]
            after = advance(m, own, interval[g], g, y, mode, rows[i, at[FollowColumn.LOADS] + past], until - t)
            if after.h >= until - t:
                t = until
            else:
                t += after.h
            if after.mode[0] != mode[0]:
                changes += 1
                last_change = t
            y = after.y
            mode = after.mode
            # Crossings during the kick do not count for the motion after it.
            if after.crossed > 0 and past == jumps:
                crossing = y
        rows[i, at[FollowColumn.T]] = t
        put(rows, i, at[FollowColumn.Y], y)
        rows[i, at[FollowColumn.MODE]] = mode[0]
        rows[i, at[FollowColumn.MODE_DIRECTION]] = mode[1]
        put(rows, i, at[FollowColumn.CROSSING], crossing)
        rows[i, at[FollowColumn.STATUS_CHANGES]] = real(changes)
        rows[i, at[FollowColumn.LAST_CHANGE]] = last_change

    return Programs(module, returned, followed, columns_type)
