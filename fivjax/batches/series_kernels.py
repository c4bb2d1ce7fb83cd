"""Trajectories followed, and return maps evaluated, by kernels that step by Taylor series: any friction, several contacts.

A kernel does for one trajectory what `progress.step` says; those of the section are `cycles.section_motion`.
"""

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Float, Int

from ..contact import Contact
from ..cycles.section_motion import Arrival, How, Point, motion_of_mechanics
from ..foundation.carried import depending_on
from ..foundation.kernel_functions import KernelFunction
from ..foundation.kernel_text import Form
from ..model.scene import Scene
from ..steppers.event_exact import EventExact
from .flattened import Flattened
from .kernels import for_conclusions
from .progress import Setting, step
from .sharing import Batch, Shared, with_values

# Rows of numbers for a kernel are put together for so many bytes at a time.
AT_A_TIME = 2**26


class Following(eqx.Module):
    """What is the same for all trajectories of a batch."""

    scene: Scene
    names: tuple[str, ...] = eqx.field(static=True)
    history: tuple[str, ...] = eqx.field(static=True)
    method: EventExact = eqx.field(static=True)


def _followed(args, instants):
    """A trajectory so many steps further."""
    of_all, (values, mechanics, weights, longest), row, now, steps = args
    scene = with_values(with_values(of_all.scene, of_all.names, values), of_all.history, row)
    shared = Shared(values, mechanics, mechanics, None, None, weights, longest)
    setting = Setting(scene, of_all.method, shared)
    begin = depending_on((scene, mechanics), now)
    after = jax.lax.fori_loop(0, steps, lambda _, now: step(setting, now), begin)
    return jax.tree.leaves(after), ()


_follow = KernelFunction(_followed)


class SeriesKernels:
    """The kernels for a batch, with the data of its groups."""

    def __init__(self, batch: Batch, shared: Flattened):
        tree = shared.tree
        self.pool = batch.pool
        self.for_conclusions = for_conclusions(shared)
        self.of_all = Following(batch.scene, batch.names, batch.history, batch.method)
        self.of_group = (tree.values, tree.mechanics, tree.weights, tree.longest_return)
        self.table = _table(self.of_group)
        self.on_section = (tree.mechanics, tree.longest_return)
        self.section_table = _table(self.on_section)

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
                form, np.concatenate([*given, np.full((count, 1), float(steps))], axis=1), np.zeros(1), self.pool
            )
            own[rows, begin:size] = np.concatenate([part.reshape(count, -1) for part in ends], axis=1)

        for rows in _parts(len(group), 8 * (len(of_all) + self.table.shape[1] + size)):
            found(rows)

    def returns(self, group: Int[np.ndarray, " m"], y, status, direction, crossings, peaks: bool, kept: int):
        """The `crossings`-th crossing from each row, as `Kernels.returns` gives it."""
        form, given = self._section_rows(group, y, status, direction, crossings, peaks)
        numbers = np.broadcast_to(crossings, len(y))[:, None] - np.arange(kept, dtype=float)[::-1]
        parts = [
            motion_of_mechanics.of_many(form, given[rows], numbers[rows], self.pool)
            for rows in _parts(len(group), 8 * (given.shape[1] + kept * y.shape[1]))
        ]
        end, path = jax.tree.map(lambda *part: np.concatenate(part), *parts)
        (y, status, direction), (at, _, arrived, peak) = _on_section(end), end
        peak = np.where(arrived, peak, np.nan)
        return y, status, direction, at.events.astype(np.int32), at.time, path.point.y, peak

    def derived(self, group: Int[np.ndarray, " m"], y, status, direction, crossings):
        """The same crossing: state, status, direction and time (s) there, and the derivative of the map."""
        form, given = self._section_rows(group, y, status, direction, crossings, False)
        size = y.shape[1]
        # The state comes after what is the group's.
        state = len(jax.tree.leaves(self.on_section))
        wide = tuple(place == state for place in range(len(form.arrays)))
        last = np.broadcast_to(np.asarray(crossings, float), len(y))[:, None]
        _, (slopes, _) = motion_of_mechanics.derived_of_many(form, given, last, wide, np.eye(size), self.pool)
        end, _ = motion_of_mechanics.of_many(form, given, last, self.pool)
        return (*_on_section(end), end.at.time), slopes.at.point.y

    def _section_rows(self, group, y, status, direction, crossings, peaks: bool):
        crossings = np.broadcast_to(np.asarray(crossings, np.int32), len(y))
        contact = Contact(np.asarray(status, np.int32), np.asarray(direction, float))
        rows = Point(np.asarray(y), contact), crossings
        first = jax.tree.map(lambda leaf: np.asarray(leaf)[0], (*self.on_section, *rows))
        form, _ = Form.of((How(EventExact(), peaks), *first))
        own = [part.reshape(len(y), -1).astype(float) for part in jax.tree.leaves(rows)]
        return form, np.concatenate([self.section_table[group], *own], axis=1)


def _on_section(end: Arrival):
    """State, status and direction on the section; the state is NaN where the section was not reached."""
    point = end.at.point
    y = np.where(end.arrived[:, None], point.y, np.nan)
    return y, point.contact.status.astype(np.int32), point.contact.direction


def _table(tree) -> Float[np.ndarray, "g k"]:
    """All numbers of each group's part of a tree, in a row."""
    leaves = [np.asarray(leaf) for leaf in jax.tree.leaves(tree)]
    return np.concatenate([leaf.reshape(len(leaf), -1).astype(float) for leaf in leaves], axis=1)


def _row(tree) -> Float[np.ndarray, " k"]:
    leaves = [np.ravel(np.asarray(leaf)).astype(float) for leaf in jax.tree.leaves(tree)]
    return np.concatenate([np.zeros(0), *leaves])


def _parts(count: int, each: int) -> list[slice]:
    size = max(1, AT_A_TIME // each)
    return [slice(start, start + size) for start in range(0, count, size)]
