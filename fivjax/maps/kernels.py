"""Trajectories followed, and return maps evaluated, by Warp kernels: one thread for each, on a CPU or on GPUs.

A kernel does for one trajectory what `rounds` and `windowed_returns` do for blocks of them by XLA, with the same matrices and
laws. No trajectory waits for the slowest of a block, and nothing is padded.
"""

import functools
import threading
from concurrent.futures import Executor
from itertools import pairwise
from typing import Any, NamedTuple

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Bool, Float, Int

from ..cycles.section_map import MOST_TO_CROSSING
from ..steppers.scalar_windows import Form, functions, matrices, warp
from ..verdicts.ensemble import LOOKS_NEAR, REACHED, SEEN
from .blocks import workers
from .conclusion import STEPS_PER_LOOK
from .flattened import Flattened, flatten
from .windowed_returns import KEPT

# Parts of a call's work on a CPU for each thread, because some take longer; and the least steps that are worth a part.
AT_A_TIME, LEAST_STEPS = 4, 4096
# Steps from one crossing of the section to the next, roughly.
STEPS_TO_CROSSING = 9


class Looks(NamedTuple):
    """What was seen of trajectories at each look: the last crossing of the section, weighted; the time (s); events so far."""

    states: Float[np.ndarray, "m looks 2n"]
    times: Float[np.ndarray, "m looks"]
    events: Int[np.ndarray, "m looks"]


class Kernels:
    """The kernels for a batch, with the data of its groups on each device."""

    def __init__(self, shared: Flattened, pool: Executor):
        wp, tree = warp(), shared.tree
        mechanics, prepared = tree.mechanics, tree.prepared
        form = Form.of(mechanics, leading=1)
        self.pool, self.shared, self.wp = pool, shared, wp
        self.types, self.programs = functions(form), _programs(form)
        # The proofs that are not left to kernels do not need the matrices.
        self.for_conclusions = flatten(jax.tree.map(np.asarray, (tree.values, mechanics, tree.modes, tree.drift)))
        self.longest = np.asarray(tree.longest_return)
        numbers = np.concatenate([leaf.reshape(len(leaf), -1) for leaf in jax.tree.leaves(mechanics)], axis=1)
        windows = matrices(prepared, mechanics.free_load.shape[-1], mechanics.tangential, mechanics.normal)
        of_groups = [
            (windows.ravel(), wp.float64),
            (numbers, self.types.mechanics),
            (np.array(prepared.interval), wp.float64),
            (np.array(tree.weights), self.types.state),
        ]
        self.devices = [device.alias for device in wp.get_cuda_devices()] or ["cpu"]
        self.of_groups = {
            device: [wp.array(part, dtype=kind, device=device) for part, kind in of_groups] for device in self.devices
        }
        _load(wp, self.programs.module, self.devices)

    def returns(self, group: Int[np.ndarray, " m"], y, status, direction, crossings, peaks: bool):
        """What `moved_in_windows` gives, for motions from these states of the section."""
        count, size = y.shape
        wp, state = self.wp, self.types.state
        crossings = np.array(np.broadcast_to(crossings, count), np.int32)
        mode, y = np.stack([status, direction], axis=1).astype(float), np.array(y, float)
        (events, crossed), (time, peak) = np.zeros((2, count), np.int32), np.zeros((2, count))
        path, longest = np.full((count, KEPT, size), np.nan), self.longest[group] * crossings
        given = [(group.astype(np.int32), wp.int32), (crossings, wp.int32), (longest, wp.float64)]
        moved = [(y, state), (mode, self.types.mode), (events, wp.int32), (crossed, wp.int32), (time, wp.float64)]
        each = int(STEPS_TO_CROSSING * np.mean(crossings)) if count else 0
        self._launch(self.programs.returned, [*given, *moved, (path, state), (peak, wp.float64)], each, [int(peaks)])
        arrived = (crossed >= crossings) & np.all(np.isfinite(y), axis=1)
        y[~arrived], peak[~arrived] = np.nan, np.nan
        # The states were kept in a ring; the newest comes last.
        path = np.take_along_axis(path, ((crossed[:, None] + np.arange(KEPT)) % KEPT)[..., None], axis=1)
        return y, mode[:, 0].astype(np.int32), mode[:, 1], events, time, path, peak

    def follow(
        self, group: Int[np.ndarray, " m"], trajectories: Flattened, looks: int, recorded: bool = False
    ) -> tuple[Flattened, Bool[np.ndarray, " m"], Looks]:
        """Trajectories `looks` looks further; which of them have reached the known torus of their group; and what was seen
        at each look, if that is to be `recorded`.
        """
        wp, state, count = self.wp, self.types.state, looks if recorded else 0
        columns, now = trajectories.tree
        mode = np.stack([now.contact.status, now.contact.direction], axis=1).astype(float)
        t, y, crossing, last, seen = (
            np.array(part, float) for part in (now.t, now.y, now.crossing, now.last_event, now.approach.seen)
        )
        events, near = (np.array(part, np.int32) for part in (now.events, now.approach.near))
        reached, torus = np.zeros(len(group), np.int32), self.shared.tree.attractor
        record = Looks(
            np.zeros((len(group), count, y.shape[1])), np.zeros((len(group), count)), np.zeros((len(group), count), np.int32)
        )
        known = np.ascontiguousarray(torus.crossings if np.any(torus.amplitude > 0) else torus.crossings[:1, :1])
        rows = [
            (group.astype(np.int32), wp.int32),
            (np.ascontiguousarray(now.steps.jumps), wp.float64),
            (np.ascontiguousarray(now.steps.loads), wp.float64),
            *((t, wp.float64), (y, state), (mode, self.types.mode), (crossing, state)),
            *((events, wp.int32), (last, wp.float64), (seen, state), (near, wp.int32), (reached, wp.int32)),
            *((record.states, state), (record.times, wp.float64), (record.events, wp.int32)),
        ]
        tori = [(known, state), (np.array(torus.amplitude), wp.float64)]
        self._launch(self.programs.followed, rows, looks * STEPS_PER_LOOK, [int(looks)], tori)
        after = eqx.tree_at(
            lambda now: (
                *(now.t, now.y, now.contact.status, now.contact.direction, now.crossing, now.events),
                *(now.last_event, now.approach.seen, now.approach.near),
            ),
            now,
            (t, y, mode[:, 0].astype(now.contact.status.dtype), mode[:, 1], crossing, events, last, seen, near),
        )
        return flatten((columns, after)), reached != 0, record

    def _launch(self, kernel, rows: list[tuple[np.ndarray, Any]], steps: int, values: list, more=()) -> None:
        """Run a kernel for each row of these arrays, which are changed in place; `more` are arrays of the groups. A row takes
        some `steps` steps.
        """
        count, wp = len(rows[0][0]), self.wp
        if self.devices == ["cpu"]:
            arrays = [wp.array(part, dtype=kind, device="cpu", copy=False) for part, kind in (*more, *rows)]
            given = [*self.of_groups["cpu"], *arrays, *values]
            parts = max(1, min(count, AT_A_TIME * workers(), count * steps // LEAST_STEPS))
            ends = np.linspace(0, count, parts + 1).astype(int).tolist()

            def run(part: tuple[int, int]) -> None:
                wp.launch(kernel, dim=part[1] - part[0], inputs=[*given, part[0]], device="cpu")
        else:
            ends = np.linspace(0, count, len(self.devices) + 1).astype(int).tolist()

            def run(part: tuple[int, int]) -> None:
                device = self.devices[ends.index(part[0])]
                own = slice(*part)
                arrays = [wp.array(whole[own], dtype=kind, device=device) for whole, kind in rows]
                also = [wp.array(whole, dtype=kind, device=device) for whole, kind in more]
                given = [*self.of_groups[device], *also, *arrays, *values, 0]
                wp.launch(kernel, dim=part[1] - part[0], inputs=given, device=device)
                for (whole, _), array in zip(rows, arrays, strict=True):
                    whole[own] = array.numpy()

        parts = [part for part in pairwise(ends) if part[0] < part[1]]
        if len(parts) == 1:
            run(parts[0])
            return
        for _ in self.pool.map(run, parts):
            pass


class _Programs(NamedTuple):
    module: Any
    returned: Any
    followed: Any


_ONE_AT_A_TIME = threading.Lock()


def _load(wp, module, devices: list[str]) -> None:
    """Compile the kernels, or find them in Warp's cache, without a word."""
    with _ONE_AT_A_TIME:
        before = wp.config.log_level
        wp.config.log_level = max(before, wp.LOG_WARNING)
        try:
            for device in devices:
                wp.load_module(module, device, block_dim=1 if device == "cpu" else None)
        finally:
            wp.config.log_level = before


@functools.cache
def _programs(form: Form) -> _Programs:
    wp, of = warp(), functions(form)
    real, integer = wp.float64, wp.int32
    state, mode_type, numbers, advance, peak = of.state, of.mode, of.mechanics, of.advance, of.peak
    size = state._length_
    one, zero = real(1.0), real(0.0)
    infinite, reached_at = real(np.inf), real(REACHED)
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
                while past < jumps.shape[1] and jumps[i, past] <= t:
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

    return _Programs(module, returned, followed)
