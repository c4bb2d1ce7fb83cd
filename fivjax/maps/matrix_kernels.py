"""Trajectories followed, and return maps evaluated, by Warp kernels: one thread for each, on a CPU or on GPUs.

No trajectory waits for the slowest of a block, as by XLA, and nothing is padded.
"""

from concurrent.futures import Executor
from itertools import pairwise
from typing import Any

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Int

from ..foundation.blocks import workers
from ..foundation.flattened import Flattened, flatten
from ..foundation.warp_library import ONE_AT_A_TIME, gpus, gpus_for, load, warp
from ..section.about_sliding import mechanics_about_sliding
from ..steppers.kernel_advance import stepping
from ..steppers.kernel_laws import Form
from ..steppers.kernel_matrices import matrices
from .groups import Task, with_values
from .kernel_programs import Programs, ReturnColumn, programs

# Forms of batches, by what all jobs of a run have in common: a trace takes as long as thousands of returns.
_FORMS: dict[Any, Form] = {}


def begin_building(task: Task, pool: Executor) -> None:
    """Begin to compile the kernels for a task in one of these threads."""

    def mechanics(row):
        return mechanics_about_sliding(with_values(task.scene, task.names, row))

    leaves, structure = jax.tree.flatten(task.scene)
    key = structure, tuple(np.shape(leaf) for leaf in leaves), task.names
    if key not in _FORMS:
        # Without values: those of a group may be none that a scene could have.
        _FORMS[key] = Form.of(jax.eval_shape(mechanics, np.zeros(len(task.names))))
    pool.submit(_build, _FORMS[key])


def _build(form: Form) -> Programs:
    with ONE_AT_A_TIME:
        found = programs(form)
        load(found.module, ["cpu", *gpus()])
    return found


def for_conclusions(shared: Flattened) -> Flattened:
    """What the proofs that are not left to kernels need: not the matrices."""
    without = eqx.tree_at(lambda shared: shared.prepared, shared.tree, None, is_leaf=lambda leaf: leaf is None)
    return flatten(jax.tree.map(np.asarray, without))


class MatrixKernels:
    """The kernels for a batch, with the data of its groups on each device."""

    def __init__(self, shared: Flattened, pool: Executor):
        wp, tree = warp(), shared.tree
        mechanics, prepared = tree.mechanics, tree.prepared
        form = Form.of(mechanics, leading=1)
        self.pool, self.wp = pool, wp
        self.types, self.programs = stepping(form).types, _build(form)
        self.for_conclusions = for_conclusions(shared)
        self.longest = np.asarray(tree.longest_return)
        numbers = np.concatenate([leaf.reshape(len(leaf), -1) for leaf in jax.tree.leaves(mechanics)], axis=1)
        windows = matrices(prepared, mechanics.free_load.shape[-1], mechanics.tangential, mechanics.normal)
        of_groups = [
            (windows.ravel(), wp.float64),
            (numbers, self.types.mechanics),
            (np.array(prepared.interval), wp.float64),
        ]
        self.threads = workers()
        self.of_groups = {
            device: [wp.array(part, dtype=kind, device=device) for part, kind in of_groups]
            for device in ("cpu", *gpus())
        }

    def returns(self, group: Int[np.ndarray, " m"], y, status, direction, crossings, peaks: bool, kept: int):
        """The `crossings`-th crossing from each row: state, status, direction, number of events, time (s), the last `kept`
        crossings and, with `peaks`, the largest tangential speed (m/s) on the way. NaN where the section is not reached.
        """
        (count, size), of = y.shape, ReturnColumn
        rows = np.empty((count, of.STATE + size))
        rows[:, of.CROSSINGS], rows[:, of.STATE :] = crossings, y
        rows[:, of.STATUS], rows[:, of.DIRECTION] = status, direction
        rows[:, of.LONGEST] = self.longest[group] * rows[:, of.CROSSINGS]
        path = np.full((count, kept * size), np.nan)
        # From one crossing to the next there are roughly nine steps.
        each = int(9 * np.mean(rows[:, of.CROSSINGS]))
        self._launch(self.programs.returned, group, [rows, path], each, [kept, int(peaks)])
        path, y, crossed = path.reshape(count, kept, size), rows[:, of.STATE :], rows[:, of.CROSSED].astype(int)
        lost = (crossed < rows[:, of.CROSSINGS]) | ~np.all(np.isfinite(y), axis=1)
        rows[lost, of.PEAK], rows[lost, of.STATE :] = np.nan, np.nan
        # The states were kept in a ring; the newest comes last.
        turned = np.flatnonzero(crossed % kept)
        if len(turned):
            places = (crossed[turned, None] + np.arange(kept)) % kept
            path[turned] = path[turned[:, None], places]
        status, events = (rows[:, column].astype(np.int32) for column in (of.STATUS, of.EVENTS))
        return y, status, rows[:, of.DIRECTION], events, rows[:, of.TIME], path, rows[:, of.PEAK]

    def follow(self, group: Int[np.ndarray, " m"], trajectories: Flattened, steps: int) -> None:
        """Trajectories so many steps further, in place."""
        _, at = trajectories.starts
        columns = self.programs.columns(
            *(at.t, at.y, at.contact.status, at.contact.direction, at.crossing, at.events, at.last_event),
            *(at.steps.jumps, at.steps.loads),
        )
        jumps = trajectories.tree[1].steps.jumps.shape[-1]
        self._launch(self.programs.followed, group, [trajectories.numbers], steps, [columns, jumps, steps])

    def _launch(self, kernel, group: Int[np.ndarray, " m"], rows: list[np.ndarray], steps: int, values: list) -> None:
        """Run a kernel for each row of these arrays, which are changed in place. A row takes some `steps` steps."""
        count, wp, group = len(group), self.wp, group.astype(np.int32)
        # Parts of a call's work on a CPU for each thread, because some take longer; and the least steps that are worth a
        # part.
        at_a_time, least_steps = 4, 4096
        devices = gpus_for(count)
        if not devices:
            given = [
                *self.of_groups["cpu"],
                *(wp.array(part, device="cpu", copy=False) for part in (group, *rows)),
                *values,
            ]
            parts = max(1, min(count, at_a_time * self.threads, count * steps // least_steps))
            ends = np.linspace(0, count, parts + 1).astype(int).tolist()

            def run(part: tuple[int, int]) -> None:
                wp.launch(kernel, dim=part[1] - part[0], inputs=[*given, part[0]], device="cpu")
        else:
            ends = np.linspace(0, count, len(devices) + 1).astype(int).tolist()

            def run(part: tuple[int, int]) -> None:
                device = devices[ends.index(part[0])]
                own = slice(*part)
                moved = [wp.array(whole[own], device=device) for whole in (group, *rows)]
                given = [*self.of_groups[device], *moved, *values, 0]
                wp.launch(kernel, dim=part[1] - part[0], inputs=given, device=device)
                for whole, array in zip(rows, moved[1:], strict=True):
                    whole[own] = array.numpy()

        parts = [part for part in pairwise(ends) if part[0] < part[1]]
        if len(parts) == 1:
            run(parts[0])
            return
        for _ in self.pool.map(run, parts):
            pass
