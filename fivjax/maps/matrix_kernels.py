"""Trajectories followed, and return maps evaluated, by Warp kernels: one thread for each, on a CPU or on GPUs.

No trajectory waits for the slowest of a block, as by XLA, and nothing is padded.
"""

import enum
import functools
from concurrent.futures import Executor
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jaxtyping import Int

from ..foundation.blocks import workers
from ..foundation.flattened import Flattened
from ..kernels.lane_functions import AT_A_TIME, LaneFunction
from ..kernels.warp_library import gpus_for, warp
from ..section.about_sliding import mechanics_about_sliding
from ..section.by_kernel import numbers_in_rows
from ..section.crossings import MOST_SEGMENTS
from ..steppers.kernel_matrices import matrices
from ..steppers.matrix_kernel import MechanicsForm, motion_in_cpp
from .groups import Task, with_values

# Forms of batches, by what all jobs of a run have in common: a trace takes as long as thousands of returns.
_FORMS: dict[Any, MechanicsForm] = {}


class ReturnColumn(enum.IntEnum):
    """Columns of a row on its way to the section: first what is asked, then what is found, and the state from `STATE` on."""

    CROSSINGS, LONGEST, STATUS, DIRECTION, EVENTS, CROSSED, TIME, PEAK, STATE = range(9)


class FollowColumn(enum.IntEnum):
    """Entries of what tells a kernel the columns of a trajectory's row."""

    T, Y, MODE, MODE_DIRECTION, CROSSING, STATUS_CHANGES, LAST_CHANGE, JUMPS, LOADS = range(9)


# What is one group's; what is one lane's; and what all lanes have in common, with the numbers that a kernel is told.
OF_GROUPS, OF_LANES = ("matrices", "mechanics", "intervals"), ("groups", "rows", "path")
NUMBERS = ("width", "to_section", "kept", "peaks", "count_of_jumps", "steps")


@functools.cache
def kernel(form: MechanicsForm) -> LaneFunction:
    """The kernel for scenes of this form: `matrix_kernels.cpp`."""
    columns = {column.name: int(column) for kind in (ReturnColumn, FollowColumn) for column in kind}
    enums = ", ".join(f"{name} = {value}" for name, value in {**columns, "MOST_SEGMENTS": MOST_SEGMENTS}.items())
    text = (Path(__file__).parent / "matrix_kernels.cpp").read_text(encoding="utf-8")
    body = f"{motion_in_cpp(form)}\nenum {{ {enums} }};\n{text}"
    return LaneFunction(body, (*OF_GROUPS, *OF_LANES, "columns"), NUMBERS)


def begin_building(task: Task, pool: Executor) -> None:
    """Begin to compile the kernel for a task in one of these threads."""

    def mechanics(row):
        return mechanics_about_sliding(with_values(task.scene, task.names, row))

    leaves, structure = jax.tree.flatten(task.scene)
    key = structure, tuple(np.shape(leaf) for leaf in leaves), task.names
    if key not in _FORMS:
        # Without values: those of a group may be none that a scene could have.
        _FORMS[key] = MechanicsForm.of(jax.eval_shape(mechanics, np.zeros(len(task.names))))
    pool.submit(lambda: kernel(_FORMS[key]).on_cpu)


class MatrixKernels:
    """The kernel for a batch, with the data of its groups on each device."""

    def __init__(self, shared: Flattened, pool: Executor):
        mechanics, prepared = shared.tree.mechanics, shared.tree.prepared
        self.pool, self.kernel = pool, kernel(MechanicsForm.of(mechanics, leading=1))
        self.longest = np.asarray(shared.tree.longest_return)
        numbers = numbers_in_rows(mechanics)
        windows = matrices(prepared, mechanics.free_load.shape[-1], mechanics.tangential, mechanics.normal)
        self.of_groups = [np.ascontiguousarray(part, float) for part in (windows, numbers, prepared.interval)]
        self.on_device: dict[tuple, list] = {}  # the same on a device, and columns

    def returns(self, group: Int[np.ndarray, " m"], y, status, direction, crossings, peaks: bool, kept: int):
        """As `return_maps.Kernels.returns`."""
        (count, size), of = y.shape, ReturnColumn
        rows = np.empty((count, of.STATE + size))
        rows[:, of.CROSSINGS], rows[:, of.STATE :] = crossings, y
        rows[:, of.STATUS], rows[:, of.DIRECTION] = status, direction
        rows[:, of.LONGEST] = self.longest[group] * rows[:, of.CROSSINGS]
        path = np.full((count, kept * size), np.nan)
        # From one crossing to the next there are roughly nine steps.
        each = int(9 * np.mean(rows[:, of.CROSSINGS]))
        self._launch(group, rows, path, each, to_section=1, kept=kept, peaks=int(peaks))
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
        columns = (
            *(at.t, at.y, at.contact.status, at.contact.direction, at.crossing, at.events, at.last_event),
            *(at.steps.jumps, at.steps.loads),
        )
        jumps, rows = trajectories.tree[1].steps.jumps.shape[-1], trajectories.numbers
        self._launch(group, rows, np.zeros((1, 1)), steps, columns, count_of_jumps=jumps, steps=steps)

    def _launch(
        self,
        group: Int[np.ndarray, " m"],
        rows: np.ndarray,
        path: np.ndarray,
        each: int,
        columns: tuple = (0,),
        **told: int,
    ) -> None:
        """Run the kernel for each of these rows, which are changed in place. A row takes some `each` steps."""
        # The least steps that are worth a part of a call's work of its own.
        least_steps = 4096
        count, group = len(group), np.ascontiguousarray(group, np.int32)
        at = np.array(columns, np.int32)
        assert rows.flags.c_contiguous
        numbers = [{"width": rows.shape[1], **told}.get(name, 0) for name in NUMBERS]
        devices = gpus_for(count)
        if not devices:
            arrays = (*self.of_groups, group, rows, path, at)
            parts = max(1, min(count, AT_A_TIME * workers(), count * each // least_steps))
            self.kernel.in_parts([*(array.ctypes.data for array in arrays), *numbers], count, parts, self.pool)
            return

        def call(device: str, own: list) -> list[int]:
            for key, parts in ((device,), self.of_groups), ((device, *columns), [at]):
                if key not in self.on_device:
                    self.on_device[key] = [warp().array(part, device=device) for part in parts]
            nothing = [0] * (len(OF_LANES) - len(own))
            groups, (place,) = self.on_device[device,], self.on_device[device, *columns]
            return [*(array.ptr for array in (*groups, *own)), *nothing, place.ptr, *numbers]

        self.kernel.on_gpus(devices, [group], [rows, path] if len(path) == count else [rows], call)
