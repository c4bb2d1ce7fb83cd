"""Many trajectories begun and followed for some steps, in blocks or by kernels, with what can be concluded of each then.

`jax.vmap` makes of one trajectory a row of them that share a group, and a second `jax.vmap` makes that a block of rows.
"""

import functools

import jax
import numpy as np

from ..foundation.blocks import BLOCK_OF_SEVERAL, in_blocks
from ..foundation.flattened import Flattened, flatten
from ..foundation.kept_programs import kept
from .conclusion import conclude, may_be_concluded
from .groups import Batch, Shared, with_values
from .matrix_kernels import Kernels, for_conclusions
from .progress import Progress, Setting, begin, placed, released, step
from .series_kernels import SeriesKernels

# Trajectories that kernels have followed and that are asked for a verdict at a time: a critical kick has a dozen.
CONCLUDED = 32


def begun(batch: Batch, shared: Flattened, group: np.ndarray, columns: np.ndarray, releases=None) -> Flattened:
    """Trajectories at their beginning, each with its history; those that are released (from these multiples of their final
    load) after all kicks.
    """
    releases = np.full(len(group), np.nan) if releases is None else releases

    def function(*block):
        return _begin_block(
            batch.scene, batch.names, batch.history, batch.states, batch.energy, batch.by_kernel, *block
        )

    return in_blocks(function, shared, group, flatten((columns, releases)), batch.width, batch.pool, size=_block(batch))


def follow(
    batch: Batch,
    kernels: Kernels | SeriesKernels | None,
    shared: Flattened,
    group: np.ndarray,
    trajectories: Flattened,
    steps: int,
) -> None:
    """Trajectories so many steps further, in place."""
    if kernels is not None:
        _follow_by_kernel(batch, kernels, shared, group, trajectories, steps)
        return
    follow_block = _follow_block_of_many if batch.many else _follow_block

    def function(*block):
        return follow_block(batch.scene, batch.method, batch.names, batch.history, np.int32(steps), *block)

    in_blocks(function, shared, group, trajectories, batch.width, batch.pool, in_place=True, size=_block(batch))


def _follow_by_kernel(
    batch: Batch,
    kernels: Kernels | SeriesKernels,
    shared: Flattened,
    group: np.ndarray,
    trajectories: Flattened,
    steps: int,
) -> None:
    now = trajectories.tree[1]
    began, events = now.t.copy(), now.events
    kernels.follow(group, trajectories, steps)
    # While its mode changes again and again, nothing can be proved of a trajectory.
    asks = np.flatnonzero(may_be_concluded(shared, group, began, events, trajectories.tree[1]))
    if len(asks):
        columns, now = jax.tree.map(lambda leaf: np.asarray(leaf)[asks], trajectories.tree)
        concluded = _concluded(batch, kernels.for_conclusions, group[asks], columns, now, began[asks])
        trajectories.numbers[asks] = concluded.numbers


def _concluded(
    batch: Batch, shared: Flattened, group: np.ndarray, columns, now: Progress, began: np.ndarray
) -> Flattened:
    def function(*block):
        return _conclude_block(batch.scene, batch.method, batch.names, batch.history, *block)

    # They are few of each group, and what they share is little.
    return in_blocks(function, shared, group, flatten((columns, now, began)), 1, batch.pool, size=CONCLUDED)


def compile_conclusions(batch: Batch, shared: Flattened, trajectories: Flattened) -> None:
    """Compile what concludes where kernels follow trajectories, while these are being built."""
    columns, now = jax.tree.map(lambda leaf: np.asarray(leaf)[:1], trajectories.tree)
    _concluded(batch, for_conclusions(shared), np.zeros(1, int), columns, now, np.array(now.t))


def _block(batch: Batch) -> int | None:
    return BLOCK_OF_SEVERAL if len(batch.scene.structure.contacts) > 1 else None


@kept
def _begin_block(
    scene, names, history, states, energy: bool, for_kernel: bool, shared: Flattened, trajectories: Flattened
) -> Flattened:
    def group(shared, columns, releases):
        own = with_values(scene, names, shared.values)

        def one(row, release):
            scene = with_values(own, history, row)
            begun = placed(
                begin(scene, shared.mechanics, shared.modes, energy, for_kernel),
                scene,
                shared,
                states,
                row[len(history) :],
            )
            return released(own, shared.modes, begun, release)

        return jax.vmap(one)(columns, releases)

    columns, releases = trajectories.tree
    return flatten((columns, jax.vmap(group)(shared.tree, columns, releases)), row_axes=2)


def _followed(scene, method, names, history, steps, shared: Flattened, trajectories: Flattened) -> Flattened:
    columns, begun = trajectories.tree
    of_all = functools.partial(_of_all, scene, method, names, history, shared.tree, columns)
    # Loops about trajectories side by side, not trajectories side by side in loops: JAX traces the body of a loop that it
    # has to vectorise several times.
    a_step, concluded = map(of_all, (step, conclude))
    after = jax.lax.fori_loop(0, steps, lambda _, now: a_step(now), begun)
    return flatten((columns, concluded(begun.t, after)), row_axes=2)


_follow_block, _follow_block_of_many = kept(_followed), kept(_followed, quickly_compiled=False)


@kept
def _conclude_block(scene, method, names, history, shared: Flattened, trajectories: Flattened) -> Flattened:
    columns, after, began = trajectories.tree
    concluded = _of_all(scene, method, names, history, shared.tree, columns, conclude)
    return flatten((columns, concluded(began, after)), row_axes=2)


def _of_all(scene, method, names, history, everything: Shared, columns, function):
    """A function of a setting and of what is one trajectory's, for all trajectories of a block."""

    def of_group(shared, columns, *own):
        scene_of_group = with_values(scene, names, shared.values)

        def of_one(row, *own):
            setting = Setting(with_values(scene_of_group, history, row), method, shared)
            return function(setting, *own)

        return jax.vmap(of_one)(columns, *own)

    return lambda *own: jax.vmap(of_group)(everything, columns, *own)
