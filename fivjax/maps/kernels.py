"""Trajectories followed, and return maps evaluated, by Warp kernels: one thread for each, on a CPU or on GPUs.

A kernel does for one trajectory what `rounds` and `windowed_returns` do for blocks of them by XLA, with the same matrices and
laws. No trajectory waits for the slowest of a block, and nothing is padded.
"""

from concurrent.futures import Executor
from itertools import pairwise
from typing import Any, NamedTuple

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Bool, Float, Int

from ..foundation.warp_library import ONE_AT_A_TIME, devices, load, warp
from ..steppers.kernel_advance import stepping
from ..steppers.kernel_laws import Form
from ..steppers.kernel_matrices import matrices
from .blocks import workers
from .conclusion import STEPS_PER_LOOK
from .flattened import Flattened, flatten
from .kernel_programs import programs
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
        with ONE_AT_A_TIME:
            self.types, self.programs = stepping(form).types, programs(form)
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
        self.devices = devices()
        self.of_groups = {
            device: [wp.array(part, dtype=kind, device=device) for part, kind in of_groups] for device in self.devices
        }
        load(self.programs.module, self.devices)

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
            np.zeros((len(group), count, y.shape[1])),
            np.zeros((len(group), count)),
            np.zeros((len(group), count), np.int32),
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
