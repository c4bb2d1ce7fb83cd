"""Exact motion through many contact events, fast in large batches; for constant friction.

Within one status the motion is then linear: states a little later, two littles later, … are matrices times the state
now. One product of a small matrix with all trajectories that share their mechanics samples a whole *window* of their future,
and the control points of the guards between the samples. They show the interval in which the status may end, and only
there its Taylor series, again a matrix times the state, is searched for the instant. What ends a status and what follows
is read from `contact`, as everywhere.

Trajectories stand side by side along the last axis: these products are then matrix-matrix products, which is what a
processor does best, and everything else is plain arithmetic on rows of them. `jax.vmap` over trajectories with common
mechanics leads here, too.
"""

import functools
from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .. import contact as physics
from ..contact import Contact, Mechanics, State
from ..contact.rounding import RESTING
from ..foundation.compiling import computed_once
from .base import Advance
from .propagation import INTERVALS, Propagators, propagators, stacked
from .section import Rise
from .window import Bracket, Series, Window, parabola_root
from .window_roots import dipped, first_root


class Windowed(eqx.Module):
    """`EventExact` for many trajectories at once: the same motion to rounding, from matrices prepared per scene.

    It needs constant friction and gives no derivatives. Maps use it in place of `EventExact` where they can, by the same
    three names as any stepper's: `round`, `prepare` and `advance`.
    """

    dt: ClassVar = np.inf
    round: ClassVar = 16

    def prepare(self, mechanics: Mechanics) -> Propagators:
        return propagators(mechanics)

    def advance(
        self,
        prepared: Propagators,
        contact: Contact,
        load: Float[Array, ""],
        y: State,
        h: Float[Array, ""],
        at_section: bool = False,
    ) -> Advance:
        del at_section  # the crossing is read off the window's samples
        return _advance_one(prepared, contact, load, y, h)


@jax.custom_batching.custom_vmap
def _advance_one(prepared: Propagators, contact: Contact, load, y: State, h) -> Advance:
    alone = jax.tree.map(lambda leaf: leaf[..., None], (contact, load, y, h))
    return jax.tree.map(lambda leaf: leaf[..., 0], _advance(prepared, *alone))


@_advance_one.def_vmap
def _advance_many(size: int, batched, prepared: Propagators, *trajectories):
    """Trajectories with common mechanics go side by side along the last axis; others have nothing to share."""
    axes = jax.tree.map(lambda is_batched: 0 if is_batched else None, tuple(batched))
    if any(jax.tree.leaves(batched[0])):
        after = jax.vmap(_advance_one.fun, in_axes=axes)(prepared, *trajectories)
    else:

        def side_by_side(leaf, axis):
            return jnp.broadcast_to(leaf[..., None], (*leaf.shape, size)) if axis is None else jnp.moveaxis(leaf, 0, -1)

        trajectories = [
            jax.tree.map(side_by_side, leaf, axis) for leaf, axis in zip(trajectories, axes[1:], strict=True)
        ]
        after = jax.tree.map(lambda leaf: jnp.moveaxis(leaf, -1, 0), _advance(prepared, *trajectories))
    return after, jax.tree.map(lambda _: True, after)


def _advance(
    prepared: Propagators, contact: Contact, load: Float[Array, " l"], y: Float[Array, "state l"], h: Float[Array, " l"]
) -> Advance:
    """One advance of trajectories side by side: to the next event, the end of the step or that of the window, whichever comes
    first.
    """
    mechanics, n = prepared.mechanics, y.shape[0] // 2
    steps = jnp.minimum(h / prepared.interval, INTERVALS)
    here = stacked(mechanics, contact, load, y)
    exact = physics.exactly_zero(contact)
    window = Window(prepared.window @ here, prepared.sizes @ jnp.abs(here), exact, n, mechanics.tangential)
    none, no_state = jnp.zeros_like(load), jnp.zeros_like(y)

    interval = computed_once(lambda: window.safe_intervals(steps), none.astype(jnp.int32))
    state, peak = computed_once(lambda: (window.state_at(interval), window.peak(interval)), (no_state, none))
    rises, around = computed_once(lambda: window.rise(interval), (none > 0, (no_state, no_state)))
    there = stacked(mechanics, contact, load, state)
    series = Series(prepared.series @ there, prepared.sizes @ jnp.abs(there), exact, n)
    no = jnp.zeros((2, *none.shape), bool)
    guess = jnp.zeros((2, *none.shape), none.dtype)
    like = Bracket(guess, no.astype(jnp.int32), guess, no, no, no)
    brackets = dipped(series, computed_once(lambda: series.brackets(interval < INTERVALS), like))
    end = jnp.where(interval == INTERVALS, 0.0, jnp.minimum(steps - interval, 1.0))
    share, fires = first_root(series, brackets, end)

    velocity = n + mechanics.tangential

    def follow():
        reached = series.state(share)
        reached = jnp.where(jnp.arange(2 * n)[:, None] >= n, reached / prepared.interval, reached)
        next_contact, y_next = over_trajectories(reached, contact, load, fires)
        # The last rise is the one that counts: in what is left of the interval, after the window's.
        later = (state[velocity] < 0) & (reached[velocity] >= 0)
        before, after = jnp.where(later, state, around[0]), jnp.where(later, reached, around[1])
        at = _rise(before, after, prepared.interval * jnp.where(later, share, 1.0), mechanics.tangential)
        jumps = (reached[velocity] < 0) & (y_next[velocity] >= 0)
        rise = Rise(rises | later | jumps, jnp.where(jumps, y_next, at))
        return jnp.maximum(peak, jnp.abs(reached[velocity])), next_contact, y_next, rise, reached

    @functools.partial(jax.vmap, in_axes=(-1, 0, 0, -1), out_axes=(0, -1))
    def over_trajectories(reached, contact, load, fires):
        state = physics.on_constraint(mechanics, contact, reached)
        return physics.transition(mechanics, contact, load, state, fires, RESTING[state.dtype.name] * prepared.interval)

    like = none, contact, no_state, Rise(none > 0, no_state), no_state
    peak, next_contact, y_next, rise, end = computed_once(follow, like)
    return Advance(y_next, next_contact, (interval + share) * prepared.interval, peak, rise, end, fires)


def _rise(
    before: Float[Array, "state l"], after: Float[Array, "state l"], h: Float[Array, " l"], tangential: int
) -> Float[Array, "state l"]:
    """Where the tangential velocity rises through zero between two states a time `h` (s) apart, on cubics through both.

    It is off by some thousandths, and by the same ones whenever the motion is the same: as good a place to compare orbits
    at as the rise itself, which an advance would have to end at.
    """
    n = before.shape[0] // 2
    h = jnp.where(h > 0, h, 1.0)
    way = (after[:n] - before[:n]) / h
    slope = 2 * (3 * way - 2 * before[n:] - after[n:])
    bend = 3 * (before[n:] + after[n:] - 2 * way)
    value, first, second = before[n + tangential], slope[tangential], bend[tangential]
    x = jnp.clip(parabola_root(-value, -first, -second), 0.0, 1.0)
    velocity = before[n:] + x * (slope + x * bend)
    velocity = jnp.where(jnp.arange(n)[:, None] == tangential, 0.0, velocity)
    return jnp.concatenate([before[:n] + h * x * (before[n:] + x * (slope / 2 + x * bend / 3)), velocity])
