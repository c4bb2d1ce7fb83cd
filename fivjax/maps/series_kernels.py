"""Trajectories followed, and return maps evaluated, by kernels that step by Taylor series: any friction, several contacts.

A kernel does for one trajectory what `one_trajectory.with_step` says; those of the section are `section.by_kernel`.
"""

from concurrent.futures import Executor

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Float, Int

from ..foundation.carried import depending_on
from ..foundation.flattened import Flattened
from ..foundation.kernel_functions import KernelFunction
from ..foundation.kernel_text import Form
from ..model.scene import Scene
from ..section.by_kernel import SectionKernels, in_parts, numbers_in_rows
from ..steppers.event_exact import EventExact
from .groups import Shared, Task, with_values
from .matrix_kernels import for_conclusions
from .one_trajectory import Setting, with_step


class Following(eqx.Module):
    """What is the same for all trajectories of a batch."""

    scene: Scene
    names: tuple[str, ...] = eqx.field(static=True)
    history: tuple[str, ...] = eqx.field(static=True)
    method: EventExact = eqx.field(static=True)


def _follow_one(args, instants):
    """A trajectory so many steps further."""
    of_all, (values, mechanics, weights, longest), row, now, steps = args
    scene = with_values(with_values(of_all.scene, of_all.names, values), of_all.history, row)
    shared = Shared(values, mechanics, mechanics, None, None, weights, longest)
    setting = Setting(scene, of_all.method, shared)
    begin = depending_on((scene, mechanics), now)
    after = jax.lax.fori_loop(0, steps, lambda _, now: with_step(setting, now), begin)
    return jax.tree.leaves(after), ()


_follow = KernelFunction(_follow_one)


class SeriesKernels:
    """The kernels for a batch, with the data of its groups."""

    def __init__(self, task: Task, shared: Flattened, pool: Executor):
        tree = shared.tree
        self.pool = pool
        self.for_conclusions = for_conclusions(shared)
        self.of_all = Following(task.scene, task.names, task.history, task.method)
        self.of_group = (tree.values, tree.mechanics, tree.weights, tree.longest_return)
        self.table = numbers_in_rows(self.of_group)
        self.of_section = SectionKernels((tree.mechanics, tree.longest_return), pool)

    def follow(self, group: Int[np.ndarray, " m"], trajectories: Flattened, steps: int) -> None:
        """Trajectories so many steps further, in place."""
        columns, now = trajectories.tree
        now = eqx.tree_at(lambda now: now.steps, now, None, is_leaf=lambda leaf: leaf is None)
        first = jax.tree.map(lambda leaf: np.asarray(leaf)[0], (self.of_group, columns, now))
        form, _ = Form.of((self.of_all, *first, np.asarray(steps, np.int32)))
        of_all = _row((self.of_all,))
        own = trajectories.numbers
        size, begin = own.shape[1], columns.shape[-1]

        def found(rows: slice) -> None:
            count = len(group[rows])
            given = [np.broadcast_to(of_all, (count, len(of_all))), self.table[group[rows]], own[rows]]
            ends, _ = _follow.of_many(
                form, np.concatenate([*given, np.full((count, 1), float(steps))], axis=1), pool=self.pool
            )
            own[rows, begin:size] = np.concatenate([part.reshape(count, -1) for part in ends], axis=1)

        for rows in in_parts(len(group), 8 * (len(of_all) + self.table.shape[1] + size)):
            found(rows)


def _row(tree) -> Float[np.ndarray, " k"]:
    leaves = [np.ravel(np.asarray(leaf)).astype(float) for leaf in jax.tree.leaves(tree)]
    return np.concatenate([np.zeros(0), *leaves])
