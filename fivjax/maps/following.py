"""Many trajectories at a time: how they begin, are followed for some steps (in blocks or by kernels), and get the verdicts that
can be proved by then.

`jax.vmap` makes of one trajectory (`one_trajectory`) a row of them that share a group, and a second `jax.vmap` makes that a
block of rows.
"""

import functools
from concurrent.futures import Executor
from functools import cached_property

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from ..contact import Contact, Mechanics
from ..foundation.blocks import BLOCK_OF_SEVERAL, in_blocks
from ..foundation.flattened import Flattened, flatten
from ..foundation.kept_programs import kept
from ..section.by_kernel import SectionKernels, section_kernels
from ..section.return_maps import BLOCK, Section, of_block
from ..simulation.ending import UNBOUNDED_FROM
from ..verdicts.sliding_proof import SlidingModes, margin_share_bound
from .groups import GroupConstants, Task, constants_of, kick_of
from .one_trajectory import (
    NOTHING,
    Progress,
    TaskConstants,
    conclude,
    with_step,
)
from .one_trajectory import (
    begin as begin_one,
)
from .trajectory_kernels import TrajectoryKernels


class Batch:
    """Groups whose trajectories are followed together: their task, the data that each of them shares, and what computes."""

    def __init__(self, task: Task, of_groups: Float[np.ndarray, "g k"], pool: Executor):
        self.task, self.pool = task, pool
        self.shared = constants_of(task, of_groups)
        self.constants: GroupConstants = self.shared.tree
        # Of several contacts a trajectory takes more memory.
        self.block = BLOCK_OF_SEVERAL if len(task.scene.structure.contacts) > 1 else None

    @cached_property
    def kernels(self) -> TrajectoryKernels | None:
        """The kernels of trajectories, if there are any."""
        return TrajectoryKernels(self.task, self.shared, self.pool) if self.task.by_kernel else None

    @cached_property
    def section_kernels(self) -> SectionKernels | None:
        """Those of return maps, which are exact whatever follows the trajectories."""
        own = self.constants
        return section_kernels(self.task.scene, own.mechanics, own.longest_return, self.pool, side_by_side=True)


def begin_all(batch: Batch, group: Int[np.ndarray, " m"], columns: Float[np.ndarray, "m h"]) -> Flattened:
    """Trajectories at their beginning, each with the values in `columns` of the parameters of the kick and initial values that
    differ between them.
    """
    task = batch.task
    kick, initial = _starts(task, columns)
    if batch.kernels is not None:
        begun = batch.kernels.begin(group, kick, initial)
        if task.from_afar and batch.section_kernels is not None:
            batch.section_kernels.begin_building()
        return begun

    def function(*block):
        return _begin_block(TaskConstants.of(task), *block)

    return in_blocks(function, batch.shared, group, flatten((kick, initial)), task.width, batch.pool, size=batch.block)


def _starts(
    task: Task, columns: Float[np.ndarray, "m h"]
) -> tuple[Float[np.ndarray, "m k"], Float[np.ndarray, "m state"]]:
    """All parameters of the kick of each trajectory, and its initial state: NaN where that is the equilibrium's; no numbers if
    it is that in all.
    """
    kick_of_scene, own = kick_of(task.scene), dict(zip((*task.of_kick, *task.states), columns.T, strict=True))
    kick = [own.get(name, np.full(len(columns), value)) for name, value in kick_of_scene.items()]
    initial = np.full((len(columns), 2 * task.scene.structure.size if task.states else 0), np.nan)
    for name, place in task.states.items():
        initial[:, place] = own[name]
    return np.array(kick).reshape(len(kick), len(columns)).T.copy(), initial


def advance_all(batch: Batch, group: Int[np.ndarray, " m"], trajectories: Flattened, steps: int) -> None:
    """Trajectories so many steps further, in place."""
    task = batch.task
    if batch.kernels is not None:
        _follow_by_kernel(batch, batch.kernels, group, trajectories, steps)
        return
    follow_block = _follow_block_of_many if task.many else _follow_block

    def function(*block):
        return follow_block(TaskConstants.of(task), np.int32(steps), *block)

    in_blocks(function, batch.shared, group, trajectories, task.width, batch.pool, in_place=True, size=batch.block)


def _follow_by_kernel(
    batch: Batch, kernels: TrajectoryKernels, group: np.ndarray, trajectories: Flattened, steps: int
) -> None:
    now = trajectories.tree[1]
    began, events = now.t.copy(), now.events
    kernels.follow(group, trajectories, steps)
    asks = np.flatnonzero(_may_be_concluded(batch.constants, group, began, events, trajectories.tree[1]))
    if len(asks):
        kernels.conclude(group, trajectories, asks, began)


def _may_be_concluded(
    shared: GroupConstants, group: Int[np.ndarray, " m"], began: Float[np.ndarray, " m"], events, now: Progress
) -> np.ndarray:
    """Which trajectories (leading axis) may have a verdict by `conclude`, or may be taken to their next event, after a round of
    steps: those whose mode has not changed in it, or not for half a period, after the last jump of the load, and those that
    have not moved, have come to rest, are too large or are not finite. Cheap. `began` and `events` are the time (s) and the
    number of events before the round.
    """
    largest = np.max(np.abs(shared.weights[group] * now.y), axis=1)
    # While its mode changes again and again, nothing can be proved of a trajectory.
    since = now.t - np.maximum(now.last_event, now.last_jump)
    calm = (now.events == events) | (since >= 0.5 * np.asarray(shared.modes.slowest_period)[group])
    rests = (now.t <= began) | (largest < NOTHING * now.yardstick)
    return ((now.last_jump <= now.t) & calm) | rests | ~(largest <= UNBOUNDED_FROM * now.yardstick)


def bounds(batch: Batch, group: Int[np.ndarray, " m"], at: Section) -> Float[np.ndarray, " m"]:
    """Bounds on the shares of their margins that motions from these states can use up under their final loads: those below 1
    slide for ever.
    """
    own = batch.constants
    return in_blocks(
        _bounds, flatten((own.mechanics, own.modes)), group, at.flattened(), 1, batch.pool, size=BLOCK
    ).tree


@kept
def _bounds(shared: Flattened, rows: Flattened) -> Flattened:
    def one(shared: tuple[Mechanics, SlidingModes], y, status, direction):
        mechanics, modes = shared
        return margin_share_bound(mechanics, modes, Contact(status.astype(jnp.int32), direction), y, jnp.asarray(True))

    return of_block(one, shared, rows)


@kept
def _begin_block(of_task: TaskConstants, shared: Flattened, trajectories: Flattened) -> Flattened:
    def group(shared, kick, initial):
        def one(kick, initial):
            return begin_one(of_task.setting(shared, kick).scene, shared, initial, energy=of_task.energy)

        return jax.vmap(one)(kick, initial)

    kick, initial = trajectories.tree
    return flatten((kick, jax.vmap(group)(shared.tree, kick, initial)), row_axes=2)


def _follow_rows(of_task: TaskConstants, steps, shared: Flattened, trajectories: Flattened) -> Flattened:
    kick, begun = trajectories.tree
    of_all = functools.partial(_of_all, of_task, shared.tree, kick)
    # Loops about trajectories side by side, not trajectories side by side in loops: JAX traces the body of a loop that it
    # has to vectorise several times.
    a_step, concluded = map(of_all, (with_step, conclude))
    after = jax.lax.fori_loop(0, steps, lambda _, now: a_step(now), begun)
    return flatten((kick, concluded(begun.t, after)), row_axes=2)


_follow_block, _follow_block_of_many = kept(_follow_rows), kept(_follow_rows, quickly_compiled=False)


def _of_all(of_task: TaskConstants, everything: GroupConstants, kick, function):
    """A function of a setting and of what is one trajectory's, for all trajectories of a block."""

    def of_group(shared, kick, *own):
        return jax.vmap(lambda row, *own: function(of_task.setting(shared, row), *own))(kick, *own)

    return lambda *own: jax.vmap(of_group)(everything, kick, *own)
