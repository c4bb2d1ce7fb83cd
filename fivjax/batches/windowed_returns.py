"""The return map of the Poincaré section by `Windowed`, for many motions of several groups, under constant friction."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from ..contact import Contact
from ..cycles.section_motion import MOST_TO_CROSSING
from ..foundation.kept_programs import kept
from ..steppers.windowed import Windowed
from .flattened import Flattened, flatten

# Number of motions of one group in a row. Where groups have few motions each, most of such rows were padding: then there is one
# in a row, and so many rows in a block.
SIDE_BY_SIDE, FEW = 8, 8
# Number of states on the section that are kept of a motion, the last ones.
KEPT = 16


def in_rows_of_several(group: Int[np.ndarray, " m"]) -> bool:
    """Whether these motions go by rows of several: not where those were mostly padding. Off the CPU blocks are large, and each
    row more has its group's matrices.
    """
    if jax.default_backend() != "cpu":
        return True
    _, count = np.unique(group, return_counts=True)
    return bool(SIDE_BY_SIDE * np.sum(-(-count // SIDE_BY_SIDE)) <= 2 * len(group))


def no_path(y: Float[Array, "*rows state"]) -> Float[Array, "*rows kept state"]:
    """The path of a motion that has not reached the section yet."""
    return jnp.full((*y.shape[:-1], KEPT, y.shape[-1]), jnp.nan, y.dtype)


def with_newest(
    path: Float[Array, "*rows kept state"], y: Float[Array, "*rows state"], crossed: Bool[Array, "*rows"]
) -> Float[Array, "*rows kept state"]:
    """The path, with this state added if the motion has `crossed` the section there."""
    longer = jnp.concatenate([path[..., 1:, :], y[..., None, :]], axis=-2)
    return jnp.where(crossed[..., None, None], longer, path)


@kept
def moved_in_windows(shared: Flattened, rows: Flattened) -> Flattened:
    """The motions from states of the section to the crossing asked for: the state there, its contact mode, the number of
    events, the time (s), the path, and the largest tangential speed (m/s; 0 unless asked for). NaN where the section is not
    reached.
    """
    windows, longest = shared.tree
    y, status, direction, crossings, peaks = rows.tree

    def side_by_side(of_one):
        return jax.vmap(lambda windows, *own: jax.vmap(functools.partial(of_one, windows))(*own))

    advance = side_by_side(functools.partial(Windowed().advance, at_section=True))
    highest = side_by_side(Windowed().peak)

    def going(left, crossed):
        return (left > 0) & (crossed < crossings)

    def further(carry):
        count, before = carry
        y, contact, left, crossed, events, path, peak = before
        none = jnp.zeros_like(left)
        after = advance(windows, contact, none, y, left)
        higher = jax.lax.cond(
            jnp.any(peaks), lambda: highest(windows, contact, none, y, after.h, after.end), lambda: none
        )
        now = (
            after.y,
            after.contact,
            jnp.where(after.h >= left, 0.0, left - after.h),
            crossed + after.rise.happened,
            events + jnp.any(after.ended, axis=-1),
            with_newest(path, after.y, after.rise.happened),
            jnp.maximum(peak, higher),
        )
        moves = going(left, crossed)

        def where_it_moves(new, old):
            return jnp.where(moves.reshape(*moves.shape, *[1] * (new.ndim - 2)), new, old)

        return count + 1, jax.tree.map(where_it_moves, now, before)

    def any_going(carry):
        count, (_, _, left, crossed, *_) = carry
        return (count < MOST_TO_CROSSING) & jnp.any(going(left, crossed))

    time, none = longest[:, None] * crossings, jnp.zeros(crossings.shape, jnp.int32)
    begin = y, Contact(status.astype(jnp.int32), direction), time, none, none, no_path(y), jnp.zeros_like(time)
    _, (y, contact, left, crossed, events, path, peak) = jax.lax.while_loop(any_going, further, (0, begin))
    arrived = (crossed >= crossings) & jnp.all(jnp.isfinite(y), axis=-1)
    y, peak = jnp.where(arrived[..., None], y, jnp.nan), jnp.where(arrived, peak, jnp.nan)
    return flatten((y, contact.status, contact.direction, events, time - left, path, peak), row_axes=2)
