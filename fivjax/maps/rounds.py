"""Many trajectories followed together: begun, followed round by round, concluded.

`jax.vmap` makes of one trajectory a row of them that share a group, and a second `jax.vmap` makes that a block of rows.
After each round of steps the decided ones leave and the undecided ones are compacted: work is spent only where the
verdict is open.
"""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from ..foundation.compiling import compiled
from ..verdicts import ensemble as attractors
from ..verdicts.verdict import Verdict
from .blocks import in_blocks
from .conclusion import STEPS_PER_LOOK, conclude, look
from .flattened import Flattened, flatten
from .progress import Setting, begin, released, step
from .results import Verdicts, record
from .sharing import Batch, grouped, shared_by, with_values

# Rounds after which trajectories want to know their limit cycle, and trajectories of a group for which it is worth the work.
KNOWN_FROM = 4
WORTH_KNOWING = 32
# Ensembles that are followed at once: what is kept of them takes memory, some 0.1 MB each.
ENSEMBLES = 128
# Looks at a trajectory's verdict while its time grows e-fold.
LOOKS = 8


def follow_all(
    batch: Batch,
    values: dict[str, np.ndarray],
    company: np.ndarray,
    t_max: float,
    max_steps: int,
    verdicts: Verdicts,
    index: np.ndarray,
    report: Callable[[int], None],
) -> None:
    """Follow trajectories that fit in memory together; writes the results of those not run yet at `index`.

    `company` says how many trajectories of the whole run are in each one's group; `report` is told how many have ended.
    """
    distinct, group = grouped(values)
    shared = shared_by(batch, distinct)
    columns = np.stack([np.zeros(len(index)), *(values[name] for name in batch.history)], axis=-1)[:, 1:]
    # What trajectories share is worked out for finished ones too: the rest is then the same as without an interruption.
    pending = np.flatnonzero(verdicts.pending[index])
    trajectories = _begun(batch, shared, group[pending], columns[pending])
    done = 0
    while True:
        _, now = trajectories.tree
        verdict = now.verdict
        if done >= max_steps:
            verdict = np.where((verdict == Verdict.UNDECIDED) & (now.t < t_max), Verdict.STEP_FAILURE, verdict)
            now = eqx.tree_at(lambda progress: progress.verdict, now, verdict.astype(np.int8))
        finished = (verdict != Verdict.UNDECIDED) | (now.t >= t_max)
        record(verdicts, index[pending[finished]], jax.tree.map(lambda leaf, done=finished: leaf[done], now))
        report(int(finished.sum()))
        if finished.all():
            return
        pending, trajectories = pending[~finished], trajectories.compacted(np.flatnonzero(~finished))
        if done == KNOWN_FROM * batch.method.round:
            many = pending[company[pending] >= WORTH_KNOWING]
            groups, first = np.unique(group[many], return_index=True)
            for start in range(0, len(groups), ENSEMBLES):
                part = slice(start, start + ENSEMBLES)
                _find_attractors(batch, shared, groups[part], columns[many[first[part]]], report)
        # Trajectories that have taken long may take longer: looks at their verdicts grow rarer, in proportion.
        steps = min(max(batch.method.round, done // LOOKS), max(max_steps - done, 1))
        looks = -(-steps // STEPS_PER_LOOK)
        _follow(batch, shared, group[pending], trajectories, looks)
        done += looks * STEPS_PER_LOOK


def _find_attractors(batch: Batch, shared: Flattened, groups: np.ndarray, columns: np.ndarray, report) -> None:
    """Writes the limit cycles of these groups into what they share, where their ensembles meet on one.

    `columns` are those of any trajectory of each group.
    """
    structure, members = batch.scene.structure, len(attractors.RELEASES)
    cycles, slowest_decay = shared.tree.attractor, shared.tree.modes.slowest_decay
    own, columns = np.repeat(groups, members), np.repeat(columns, members, axis=0)
    running, moving = np.arange(len(own)), np.ones(len(own), bool)
    trajectories = _begun(batch, shared, own, columns, np.tile(attractors.RELEASES, len(groups)))
    most = max(attractors.TESTS)
    deviations = np.full((most, len(own), 2 * structure.size), np.nan)
    peaks, times, events = (np.full((most, len(own)), np.nan) for _ in range(3))
    looks = 0

    def cycle_of(k: int):
        mine = slice(k * members, (k + 1) * members)
        seen = (array[:looks, mine] for array in (deviations, peaks, times, events))
        return attractors.met(attractors.Ensemble(*seen, moving[mine]), slowest_decay[groups[k]])

    while len(running) and looks < most:
        report(0)
        trajectories.tree[1].recurrence.peak[:] = 0.0
        _follow(batch, shared, own[running], trajectories, attractors.SEEN)
        _, now = trajectories.tree
        recent = slice(looks, looks + attractors.SEEN)
        deviations[recent, running] = np.moveaxis(now.approach.seen, 1, 0)[::-1]
        peaks[recent, running], times[recent, running] = now.recurrence.peak, now.t
        # As of the last of these looks: enough to tell whether there were any since the looks before.
        events[recent, running] = now.events
        looks += attractors.SEEN
        moving[running] = (now.verdict == Verdict.UNDECIDED) | (now.verdict == Verdict.LIMIT_CYCLE)
        over = ~moving[running]
        if looks in attractors.TESTS:
            open_ = np.unique(running // members)
            for k, cycle in zip(open_, batch.pool.map(cycle_of, open_), strict=True):
                if cycle is not None:
                    cycles.crossings[groups[k]], cycles.amplitude[groups[k]] = cycle
            over |= cycles.known[own[running]]
        running, trajectories = running[~over], trajectories.compacted(np.flatnonzero(~over))


def _begun(batch: Batch, shared: Flattened, group: np.ndarray, columns: np.ndarray, releases=None) -> Flattened:
    """Trajectories at their beginning, each with its history; those that are released (from these multiples of their final
    load) after all kicks.
    """
    releases = np.full(len(group), np.nan) if releases is None else releases

    def function(*block):
        return _begin_block(batch.scene, batch.names, batch.history, batch.energy, *block)

    return in_blocks(function, shared, group, flatten((columns, releases)), batch.width, batch.pool)


def _follow(batch: Batch, shared: Flattened, group: np.ndarray, trajectories: Flattened, looks: int) -> None:
    """Trajectories `looks` looks further, in place."""
    follow_block = _follow_block_of_many if batch.many else _follow_block

    def function(*block):
        return follow_block(
            batch.scene, batch.method, batch.resolution, batch.names, batch.history, np.int32(looks), *block
        )

    in_blocks(function, shared, group, trajectories, batch.width, batch.pool, in_place=True)


@compiled
def _begin_block(scene, names, history, energy: bool, shared: Flattened, trajectories: Flattened) -> Flattened:
    def group(shared, columns, releases):
        own = with_values(scene, names, shared.values)

        def one(row, release):
            begun = begin(with_values(own, history, row), shared.mechanics, shared.modes, energy)
            return released(own, shared.modes, begun, release)

        return jax.vmap(one)(columns, releases)

    columns, releases = trajectories.tree
    return flatten((columns, jax.vmap(group)(shared.tree, columns, releases)), row_axes=2)


def _followed(
    scene, method, resolution, names, history, looks, shared: Flattened, trajectories: Flattened
) -> Flattened:
    columns, begun = trajectories.tree
    everything = shared.tree

    def of_all(function):
        """A function of a setting and of what is one trajectory's, for all trajectories of the block."""

        def of_group(shared, columns, *own):
            scene_of_group = with_values(scene, names, shared.values)

            def of_one(row, *own):
                setting = Setting(
                    with_values(scene_of_group, history, row),
                    method,
                    resolution,
                    shared.mechanics,
                    shared.prepared,
                    shared.modes,
                    shared.drift,
                    shared.attractor,
                )
                return function(setting, *own)

            return jax.vmap(of_one)(columns, *own)

        return lambda *own: jax.vmap(of_group)(everything, columns, *own)

    # Loops about trajectories side by side, not trajectories side by side in loops: JAX traces the body of a loop that it
    # has to vectorise several times.
    a_step, a_look, concluded = of_all(step), of_all(look), of_all(conclude)

    def until_look(_, carry):
        now, reached = carry
        now = jax.lax.fori_loop(0, STEPS_PER_LOOK, lambda _, now: a_step(now), now)
        return a_look(now, reached)

    none = jnp.zeros(begun.t.shape, bool)
    after, reached = jax.lax.fori_loop(0, looks, until_look, (begun, none))
    return flatten((columns, concluded(begun.t, after, reached)), row_axes=2)


_follow_block, _follow_block_of_many = compiled(_followed), eqx.filter_jit(_followed)
