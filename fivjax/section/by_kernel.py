"""Return maps by kernels that step by Taylor series: any friction, several contacts."""

from concurrent.futures import Executor

import jax
import numpy as np
from jaxtyping import Int

from ..contact import Contact
from ..foundation.argument_forms import Form
from ..foundation.flattened import flatten
from ..kernels.kernel import kernel_of
from ..model.scene import Scene
from ..steppers.event_exact import EXACT_STEPPER
from ..steppers.kernel_scope import goes_side_by_side, has_kernel
from .crossings import Arrival, Point, motion_to_section

# A kernel is launched for rows that take so many bytes at a time: GPUs have to hold no more at once.
AT_A_TIME = 2**26


class SectionKernels:
    """The return maps of groups, by their mechanics and longest returns (s), whose arrays have a leading axis over groups."""

    def __init__(self, whose, pool: Executor | None, side_by_side: bool = False):
        self.pool, self.side_by_side = pool, side_by_side
        self.table = flatten(jax.tree.map(np.asarray, whose)).numbers
        first = jax.tree.map(lambda leaf: np.asarray(leaf)[0], whose)
        mechanics, _ = first
        of_contacts = np.zeros(np.shape(mechanics.belt_speed))
        start = Point(np.zeros(2 * len(mechanics.free_load)), Contact(of_contacts.astype(np.int32), of_contacts))
        last = np.int32(1), np.float64(np.inf), np.bool_(False)
        self.form = Form.of((first, start, *last))[0].kept
        # The state comes after what is the group's; derivatives are by it.
        state = len(jax.tree.leaves(whose))
        self.wide = tuple(place == state for place in range(len(self.form.arrays)))
        self.size = len(start.y)
        # Differences of motions side by side take as long as derivatives of one. A kernel of tangents of several contacts is
        # compiled for a minute, and used for a few motions.
        self.has_derivatives = not (side_by_side or mechanics.several)

    def begin_building(self) -> None:
        """Begin to compile the kernel in a thread, before it is needed."""
        # An attractor takes some sixty motions to find.
        motions = 60 * len(self.table)
        if self.pool is not None:
            self.pool.submit(
                lambda: kernel_of(motion_to_section, self.form, side_by_side=self.side_by_side).of_lanes.compile_for(
                    motions
                )
            )

    def returns(self, group: Int[np.ndarray, " m"], y, status, direction, crossings, peaks: bool, kept: int):
        """The `crossings`-th crossing from each row: state, status, direction, numbers of events and of changes of status, time
        (s), the last `kept` crossings and, with `peaks`, the largest tangential speed (m/s) on the way. NaN where the section
        is not reached.
        """
        given = self._rows(group, y, status, direction, crossings, peaks)
        numbers = np.broadcast_to(crossings, len(y))[:, None] - np.arange(kept, dtype=float)[::-1]
        parts = [
            motion_to_section.of_many(
                self.form, given[rows], numbers[rows], self._pool_for(numbers[rows, -1]), self.side_by_side
            )
            for rows in in_parts(len(group), 8 * (given.shape[1] + kept * y.shape[1]))
        ]
        end, path = jax.tree.map(lambda *part: np.concatenate(part), *parts) if len(parts) > 1 else parts[0]
        (y, status, direction), (at, _, arrived, peak) = _on_section(end), end
        peak = np.where(arrived, peak, np.nan)
        events, changes = at.events.astype(np.int32), at.changes.astype(np.int32)
        return y, status, direction, events, changes, at.time, path.point.y, peak

    def derived(self, group: Int[np.ndarray, " m"], y, status, direction, crossings):
        """The same crossing: state, status, direction and time (s) there, and the derivative of the map."""
        given = self._rows(group, y, status, direction, crossings, False)
        last = np.broadcast_to(np.asarray(crossings, float), len(y))[:, None]
        found = motion_to_section.derived_of_many(
            self.form, given, last, self.wide, np.eye(self.size), self._pool_for(last)
        )
        (end, _), (slopes, _) = found
        return (*_on_section(end), end.at.time), slopes.at.point.y

    def _pool_for(self, crossings) -> Executor | None:
        # Returns in all that are shared out among threads.
        least_in_threads = 64
        return self.pool if np.sum(crossings) >= least_in_threads else None

    def _rows(self, group, y, status, direction, crossings, peaks: bool):
        # In the order of that tree.
        own = np.empty((len(y), 3))
        own[:, 0], own[:, 1], own[:, 2] = crossings, np.inf, peaks
        contact = (np.reshape(part, (len(y), -1)) for part in (status, direction))
        return np.concatenate([self.table[group], y, *contact, own], axis=1)


def section_kernels(
    scene: Scene, mechanics, longest_return, pool: Executor | None, side_by_side: bool = False
) -> SectionKernels | None:
    """The kernels of groups of scenes like this one, for many trajectories if they go `side_by_side`; None where there are
    none.
    """
    if not has_kernel(scene, EXACT_STEPPER, called_by_xla=False):
        return None
    return SectionKernels((mechanics, longest_return), pool, side_by_side and goes_side_by_side(scene))


def _on_section(end: Arrival):
    """State, status and direction on the section; the state is NaN where the section was not reached."""
    point, contact = end.at.point, end.at.point.contact
    return np.where(end.arrived[:, None], point.y, np.nan), contact.status.astype(np.int32), contact.direction


def in_parts(count: int, each: int) -> list[slice]:
    """So many rows in parts that take `AT_A_TIME` bytes, if a row takes `each`."""
    size = max(1, AT_A_TIME // max(each, 1))
    return [slice(start, start + size) for start in range(0, count, size)]
