"""Kernels that begin, follow and conclude trajectories: each of their threads does for one what `one_trajectory` says."""

from concurrent.futures import Executor

import jax
import numpy as np
from jaxtyping import Float, Int

from ..foundation.argument_forms import Form
from ..foundation.carried import depending_on
from ..foundation.complex_pairs import in_pairs
from ..foundation.flattened import Flattened, flatten
from ..kernels.functions import KernelFunction
from ..kernels.kernel import Groups, kernel_of
from ..section.by_kernel import in_parts
from ..steppers.kernel_scope import goes_side_by_side
from .groups import Task
from .one_trajectory import Progress, TaskConstants, begin, conclude, with_step


def _begin_one(args, instants):
    of_task, shared, kick, initial = args
    return begin(of_task.setting(shared, kick).scene, shared, initial, energy=of_task.energy), ()


def _follow_one(args, instants):
    """So many steps further."""
    of_task, shared, kick, now, steps = args
    setting = of_task.setting(shared, kick)
    begin = depending_on((setting.scene, shared.mechanics), now)
    return jax.lax.fori_loop(0, steps, lambda _, now: with_step(setting, now), begin), ()


def _conclude_one(args, instants):
    of_task, shared, kick, now, began = args
    after = conclude(of_task.setting(shared, kick), began, now)
    return (after.t, after.skipped, after.y, after.verdict, after.bound), ()


_begin, _follow, _conclude = map(KernelFunction, (_begin_one, _follow_one, _conclude_one))


class TrajectoryKernels:
    """The kernels for a batch, with the data of its groups."""

    def __init__(self, task: Task, shared: Flattened, pool: Executor):
        self.of_task, self.side_by_side = TaskConstants.of(task), goes_side_by_side(task.scene)
        of_groups = in_pairs(jax.tree.map(np.asarray, shared.tree))
        self.first = jax.tree.map(lambda leaf: leaf[0], of_groups)
        self.table = flatten(of_groups).numbers
        self.shared, self.pool = len(jax.tree.leaves(self.first)), pool
        self.forms: dict[KernelFunction, Form] = {}

    def begin(self, group: Int[np.ndarray, " m"], kick: Float[np.ndarray, "m k"], initial) -> Flattened:
        """Trajectories at their beginning, each with its kick and initial state."""
        progress: Progress = self._of_each(_begin, group, (kick, initial))
        to_follow = self._form(_follow, (kick, progress, np.zeros(len(kick), np.int32)))
        to_conclude = self._form(_conclude, (kick, progress, progress.t))

        def build():
            following = kernel_of(_follow, to_follow, shared=self.shared, side_by_side=self.side_by_side)
            for kernel in (following, kernel_of(_conclude, to_conclude, shared=self.shared)):
                kernel.of_lanes.compile_for(len(kick))

        # What comes later is compiled meanwhile.
        self.pool.submit(build)
        return flatten((kick, progress))

    def follow(self, group: Int[np.ndarray, " m"], trajectories: Flattened, steps: int) -> None:
        """Trajectories so many steps further, in place."""
        kick, now = trajectories.tree
        given = kick, now, np.full(len(group), steps, np.int32)
        after = self._of_each(_follow, group, given, on_gpus=True, side_by_side=self.side_by_side)
        trajectories.numbers[:, kick.shape[-1] :] = flatten(after).numbers

    def conclude(
        self, group: Int[np.ndarray, " m"], trajectories: Flattened, rows: Int[np.ndarray, " r"], began
    ) -> None:
        """These trajectories with their verdicts, where they can be proved by now, in place. `began` is the time (s) at which
        the present round of steps began.
        """
        kick, now = jax.tree.map(lambda leaf: np.asarray(leaf)[rows], trajectories.tree)
        found = self._of_each(_conclude, group[rows], (kick, now, began[rows]))
        _, at = trajectories.starts
        for start, part in zip((at.t, at.skipped, at.y, at.verdict, at.bound), found, strict=True):
            part = part.reshape(len(rows), -1)
            trajectories.numbers[rows, start : start + part.shape[1]] = part

    def _form(self, function: KernelFunction, own: tuple) -> Form:
        """The form of a function's arguments, which is that of all calls."""
        if function not in self.forms:
            first = jax.tree.map(lambda leaf: np.asarray(leaf)[0], own)
            self.forms[function] = Form.of((self.of_task, self.first, *first))[0]
        return self.forms[function]

    def _of_each(
        self,
        function: KernelFunction,
        group: np.ndarray,
        own: tuple,
        on_gpus: bool = False,
        side_by_side: bool = False,
    ):
        """The results of a kernel for each trajectory, of its group's data and its own. What takes few steps is over on a CPU
        before another kernel is compiled.
        """
        form, given, parts = self._form(function, own), flatten(jax.tree.map(np.asarray, own)).numbers, []
        for rows in in_parts(len(group), 8 * given.shape[1]):
            groups = Groups.of(self.table, group[rows])
            run = function.of_groups(form, self.shared, groups, given[rows], self.pool, on_gpus, side_by_side)
            parts.append(run[0])
        return jax.tree.map(lambda *part: np.concatenate(part), *parts) if len(parts) > 1 else parts[0]
