"""Many trajectories begun and followed for some steps, in blocks or by kernels, with what can be concluded of each then.

`jax.vmap` makes of one trajectory a row of them that share a group, and a second `jax.vmap` makes that a block of rows.
"""

import functools

import jax
import jax.numpy as jnp
import numpy as np

from ..foundation.kept_programs import kept
from ..verdicts.ensemble import SEEN
from .blocks import BLOCK_OF_SEVERAL, in_blocks
from .conclusion import STEPS_PER_LOOK, conclude, distance_to_torus, look, may_be_concluded
from .flattened import Flattened, flatten
from .kernels import Kernels, Looks
from .progress import Setting, begin, placed, released, step
from .sharing import Batch, Shared, with_values

# Trajectories that kernels have followed and that are asked for a verdict at a time.
CONCLUDED = 256


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
    batch: Batch, kernels: Kernels | None, shared: Flattened, group: np.ndarray, trajectories: Flattened, looks: int
) -> None:
    """Trajectories `looks` looks further, in place."""
    if kernels is not None:
        _follow_by_kernel(batch, kernels, shared, group, trajectories, looks)
        return
    follow_block = _follow_block_of_many if batch.many else _follow_block

    def function(*block):
        return follow_block(batch.scene, batch.method, batch.names, batch.history, np.int32(looks), *block)

    in_blocks(function, shared, group, trajectories, batch.width, batch.pool, in_place=True, size=_block(batch))


def _follow_by_kernel(
    batch: Batch, kernels: Kernels, shared: Flattened, group, trajectories, looks: int, recorded: bool = False
) -> Looks:
    after, reached, record = kernels.follow(group, trajectories, looks, recorded)
    before = trajectories.tree[1]
    began = np.array(before.t)
    # While its mode changes again and again, nothing can be proved of a trajectory.
    asks = np.flatnonzero(reached | may_be_concluded(shared, group, before, after.tree[1]))
    trajectories.numbers[:] = after.numbers
    if not len(asks):
        return record

    def function(*block):
        return _conclude_block(batch.scene, batch.method, batch.names, batch.history, *block)

    rows = flatten((*jax.tree.map(lambda leaf: np.asarray(leaf)[asks], after.tree), began[asks], reached[asks]))
    # They are few of each group, and what they share is little.
    concluded = in_blocks(function, kernels.for_conclusions, group[asks], rows, 1, batch.pool, size=CONCLUDED)
    trajectories.numbers[asks] = concluded.numbers
    return record


def observed(
    batch: Batch, kernels: Kernels | None, shared: Flattened, group: np.ndarray, trajectories: Flattened, looks: int
) -> Looks:
    """Trajectories `looks` looks further, in place; and what was seen of them."""
    if kernels is not None:
        return _follow_by_kernel(batch, kernels, shared, group, trajectories, looks, recorded=True)
    parts = []
    for start in range(0, looks, SEEN):
        follow(batch, None, shared, group, trajectories, min(SEEN, looks - start))
        now = trajectories.tree[1]
        each = np.ones((1, SEEN))
        # As of the last of these looks: enough to tell whether there were any since the looks before.
        parts.append(Looks(now.approach.seen[:, ::-1].copy(), now.t[:, None] * each, now.events[:, None] * each))
    return Looks(*(np.concatenate(part, axis=1) for part in zip(*parts, strict=True)))


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


def _followed(scene, method, names, history, looks, shared: Flattened, trajectories: Flattened) -> Flattened:
    columns, begun = trajectories.tree
    everything = shared.tree
    of_all = functools.partial(_of_all, scene, method, names, history, everything, columns)
    # Loops about trajectories side by side, not trajectories side by side in loops: JAX traces the body of a loop that it
    # has to vectorise several times.
    a_step, a_distance, a_look, concluded = map(of_all, (step, distance_to_torus, look, conclude))
    known, nothing = jnp.any(everything.attractor.known), jnp.full(begun.t.shape, jnp.inf, begun.t.dtype)

    def until_look(_, carry):
        now, reached = carry
        now = jax.lax.fori_loop(0, STEPS_PER_LOOK, lambda _, now: a_step(now), now)
        # Until a torus is known, which is seldom, there is no distance to compute.
        return a_look(now, jax.lax.cond(known, a_distance, lambda _: nothing, now), reached)

    none = jnp.zeros(begun.t.shape, bool)
    after, reached = jax.lax.fori_loop(0, looks, until_look, (begun, none))
    return flatten((columns, concluded(begun.t, after, reached)), row_axes=2)


_follow_block, _follow_block_of_many = kept(_followed), kept(_followed, quickly_compiled=False)


@kept
def _conclude_block(scene, method, names, history, shared: Flattened, trajectories: Flattened) -> Flattened:
    columns, after, began, reached = trajectories.tree
    values, mechanics, modes, drift = shared.tree
    everything = Shared(values, mechanics, None, modes, drift, None, None, None)  # pyright: ignore[reportArgumentType]
    concluded = _of_all(scene, method, names, history, everything, columns, conclude)
    return flatten((columns, concluded(began, after, reached)), row_axes=2)


def _of_all(scene, method, names, history, everything, columns, function):
    """A function of a setting and of what is one trajectory's, for all trajectories of a block."""

    def of_group(shared, columns, *own):
        scene_of_group = with_values(scene, names, shared.values)

        def of_one(row, *own):
            setting = Setting(
                with_values(scene_of_group, history, row),
                method,
                shared.mechanics,
                shared.prepared,
                shared.modes,
                shared.drift,
                shared.attractor,
            )
            return function(setting, *own)

        return jax.vmap(of_one)(columns, *own)

    return lambda *own: jax.vmap(of_group)(everything, columns, *own)
