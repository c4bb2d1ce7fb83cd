"""The Poincaré section's return map for many states of many groups in one batch, exact through every contact event.

The programs here know nothing of a map's axes: all maps of structures of one size and friction of one kind share them.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from ..contact import Contact
from ..cycles.around import peak_speed_along
from ..cycles.section_map import MOST_SEGMENTS, Point, moved
from ..foundation.compiling import compiled
from ..model.sliding import contact_coordinates
from ..steppers.event_exact import EventExact
from ..steppers.section import section_weights
from .blocks import BLOCK_OF_SEVERAL, in_blocks
from .flattened import Flattened, flatten
from .sharing import Batch

# States in a block: few, because often there are few.
BLOCK = 64
DERIVED_BLOCK = 16


class Section(NamedTuple):
    """States on the section or on the way to it, in rows; deviations from the sliding equilibrium."""

    y: Float[np.ndarray, "m 2n"]
    status: Int[np.ndarray, "m *contacts"]
    direction: Float[np.ndarray, "m *contacts"]

    def rows(self, chosen) -> "Section":
        return Section(*(part[chosen] for part in self))


class Images(NamedTuple):
    """Where the return map leads from several states; NaN where the section is not met."""

    at: Section
    events: Int[np.ndarray, " m"]  # contact events on the way
    time: Float[np.ndarray, " m"]  # s


class ReturnMaps:
    """The return maps of all groups of a batch."""

    def __init__(self, batch: Batch, shared: Flattened):
        tree = shared.tree
        self.mechanics = flatten((tree.mechanics, np.asarray(tree.longest_return)))
        self.pool = batch.pool
        self.structure = batch.scene.structure
        self.weights = np.asarray(batch.scene.structure.weights)
        self.block = BLOCK if len(self.structure.contacts) == 1 else BLOCK_OF_SEVERAL
        # Of several contacts, places of all of them.
        self.tangential, self.normal = contact_coordinates(self.structure)

    @property
    def section(self) -> Float[np.ndarray, " n"]:
        """The row of velocities that is zero on the section."""
        row = np.zeros(self.structure.size)
        row[self.tangential] = section_weights(len(self.structure.contacts))
        return row

    def returns(self, group, at: Section, crossings) -> Images:
        """The `crossings`-th crossing from each row."""
        found = in_blocks(_returned, self.mechanics, group, _rows(at, crossings), 1, self.pool, size=self.block).tree
        return _images(found)

    def derived(self, group, at: Section, crossings) -> tuple[Images, Float[np.ndarray, "m 2n 2n"]]:
        """The same, and the return map's derivatives."""
        rows = _rows(at, crossings)
        found, derivatives = in_blocks(_derived, self.mechanics, group, rows, 1, self.pool, size=DERIVED_BLOCK).tree
        return _images(found), derivatives

    def peaks(self, group, at: Section, crossings) -> Float[np.ndarray, " m"]:
        """The largest tangential speed (m/s) on the way to the `crossings`-th crossing from each row."""
        return in_blocks(_peaks, self.mechanics, group, _rows(at, crossings), 1, self.pool, size=DERIVED_BLOCK).tree


def _rows(at: Section, crossings) -> Flattened:
    status, direction = np.asarray(at.status, np.int32), np.asarray(at.direction, float)
    crossings = np.broadcast_to(np.asarray(crossings, np.int32), len(status))
    return flatten((np.asarray(at.y), status, direction, crossings.copy()))


def _images(found) -> Images:
    y, status, direction, *rest = found
    return Images(Section(y, status, direction), *rest)


def _one(shared, y, status, direction, crossings):
    mechanics, longest = shared
    point = Point(y, Contact(status.astype(jnp.int32), direction))
    found = moved(EventExact(), mechanics, point, crossings, longest * crossings)
    y = jnp.where(found.arrived, found.point.y, jnp.nan)
    contact = found.point.contact
    return y, contact.status, contact.direction, found.events, found.time


def _of_block(one, shared: Flattened, rows: Flattened) -> Flattened:
    of_group = jax.vmap(one, in_axes=(None, 0, 0, 0, 0))
    return flatten(jax.vmap(of_group)(shared.tree, *rows.tree), row_axes=2)


@compiled
def _returned(shared: Flattened, rows: Flattened) -> Flattened:
    return _of_block(_one, shared, rows)


@compiled
def _derived(shared: Flattened, rows: Flattened) -> Flattened:
    def one(shared, y, *row):
        def along(direction):
            def state(y):
                found = _one(shared, y, *row)
                return found[0], found

            _, tangent, found = jax.jvp(state, (y,), (direction,), has_aux=True)
            return found, tangent

        return jax.vmap(along, out_axes=(None, 1))(jnp.eye(y.shape[0], dtype=y.dtype))

    return _of_block(one, shared, rows)


@compiled
def _peaks(shared: Flattened, rows: Flattened) -> Flattened:
    def one(shared, y, status, direction, crossings):
        mechanics, longest = shared
        point = Point(y, Contact(status.astype(jnp.int32), direction))
        return peak_speed_along(EventExact(), mechanics, point, crossings, longest * crossings, MOST_SEGMENTS)

    return _of_block(one, shared, rows)
