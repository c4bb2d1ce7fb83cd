"""Exact motion through many contact events, fast in large batches; for constant friction.

Within one status the motion is then linear: the states at equally spaced later times are matrices times the present state. One
product of a small matrix with all trajectories that share their mechanics gives samples over a *window* of time ahead, and the
Bernstein control points of the guards between the samples. These show the interval in which the status may end. Only there is
the Taylor series, again a matrix times the state, searched for the instant. What ends a status and what follows comes from
`contact`, as everywhere.

Trajectories lie along the last axis, so these products are matrix-matrix products, which processors do fastest, and everything
else is elementwise arithmetic. `jax.vmap` over trajectories with common mechanics leads here, too.
"""

import functools
from collections.abc import Callable
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
from .window_roots import dipped, first_rise, first_root, highest


class Windowed(eqx.Module):
    """`EventExact` for many trajectories at once: the same motion to rounding, from matrices prepared for each scene.

    It needs constant friction and gives no derivatives. Maps use it in place of `EventExact` where they can: its `dt`, `round`,
    `prepare` and `advance` are those of a stepper.
    """

    # Whether maps leave the stepping to a kernel (`kernel_advance`).
    by_kernel: bool = eqx.field(static=True, default=False)

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
        return (_to_section if at_section else _advance_one)(prepared, contact, load, y, h)

    def peak(
        self, prepared: Propagators, contact: Contact, load: Float[Array, ""], y: State, h: Float[Array, ""], end: State
    ) -> Float[Array, ""]:
        """The largest tangential speed (m/s) within an advance of duration `h` (s) that ended at `end`; to rounding."""
        return _peak_of_one(prepared, contact, load, y, h, end)


def _side_by_side(advance: Callable):
    """From `advance`, which takes trajectories along the last axis, the function of one trajectory; its `jax.vmap` is
    `advance`.

    Where the mechanics are batched, too, nothing is shared, and the function of one trajectory is mapped.
    """

    @jax.custom_batching.custom_vmap
    def of_one(prepared: Propagators, *trajectory):
        alone = jax.tree.map(lambda leaf: leaf[..., None], trajectory)
        return jax.tree.map(lambda leaf: leaf[..., 0], advance(prepared, *alone))

    @of_one.def_vmap
    def _of_many(size: int, batched, prepared: Propagators, *trajectories):
        axes = jax.tree.map(lambda is_batched: 0 if is_batched else None, tuple(batched))
        if any(jax.tree.leaves(batched[0])):
            after = jax.vmap(of_one.fun, in_axes=axes)(prepared, *trajectories)
        else:

            def last(leaf, axis):
                if axis is None:
                    return jnp.broadcast_to(leaf[..., None], (*leaf.shape, size))
                return jnp.moveaxis(leaf, 0, -1)

            trajectories = [jax.tree.map(last, leaf, axis) for leaf, axis in zip(trajectories, axes[1:], strict=True)]
            after = jax.tree.map(lambda leaf: jnp.moveaxis(leaf, -1, 0), advance(prepared, *trajectories))
        return after, jax.tree.map(lambda _: True, after)

    return of_one


def _advance(
    prepared: Propagators,
    contact: Contact,
    load: Float[Array, " l"],
    y: Float[Array, "state l"],
    h: Float[Array, " l"],
    at_section: bool = False,
) -> Advance:
    """One advance of trajectories along the last axis: to the next event, the end of the step or that of the window, whichever
    comes first. With `at_section` to the first rise of the tangential velocity, if that comes before; a rise and fall between
    two samples of the window is missed.
    """
    mechanics, n = prepared.mechanics, y.shape[0] // 2
    steps = jnp.minimum(h / prepared.interval, INTERVALS)
    here = stacked(mechanics, contact, load, y)
    exact = physics.exactly_zero(contact)
    window = Window(prepared.window @ here, prepared.sizes @ jnp.abs(here), exact, n, mechanics.tangential)
    none, no_state = jnp.zeros_like(load), jnp.zeros_like(y)

    def first_of_all():
        safe = window.safe_intervals(steps)
        return jnp.minimum(safe, window.first_rise()) if at_section else safe

    interval = computed_once(first_of_all, none.astype(jnp.int32))
    state = computed_once(lambda: window.state_at(interval), no_state)
    rises, around = none > 0, (no_state, no_state)
    if not at_section:
        rises, around = computed_once(lambda: window.rise(interval), (rises, around))
    there = stacked(mechanics, contact, load, state)
    series = Series(prepared.series @ there, prepared.sizes @ jnp.abs(there), exact, n)
    no = jnp.zeros((2, *none.shape), bool)
    guess = jnp.zeros((2, *none.shape), none.dtype)
    like = Bracket(guess, no.astype(jnp.int32), guess, no, no, no)
    brackets = dipped(series, computed_once(lambda: series.brackets(interval < INTERVALS), like))
    end = jnp.where(interval == INTERVALS, 0.0, jnp.minimum(steps - interval, 1.0))
    share, fires = first_root(series, brackets, end)

    velocity = n + mechanics.tangential
    if at_section:
        rises, share = computed_once(lambda: first_rise(series, mechanics.tangential, share), (rises, share))

    def follow():
        reached = series.state(share)
        reached = jnp.where(jnp.arange(2 * n)[:, None] >= n, reached / prepared.interval, reached)
        if at_section:
            reached = reached.at[velocity].set(jnp.where(rises, 0.0, reached[velocity]))
        next_contact, y_next = over_trajectories(reached, contact, load, fires & ~rises)
        jumps = (reached[velocity] < 0) & (y_next[velocity] >= 0)
        if at_section:
            rise = Rise(rises | jumps, y_next)
        else:
            # The last rise counts: that in the last, partial interval, if there is one there, else that in the window.
            later = (state[velocity] < 0) & (reached[velocity] >= 0)
            before, after = jnp.where(later, state, around[0]), jnp.where(later, reached, around[1])
            at = _rise(before, after, prepared.interval * jnp.where(later, share, 1.0), mechanics.tangential)
            rise = Rise(rises | later | jumps, jnp.where(jumps, y_next, at))
        return next_contact, y_next, rise, reached

    @functools.partial(jax.vmap, in_axes=(-1, 0, 0, -1), out_axes=(0, -1))
    def over_trajectories(reached, contact, load, fires):
        state = physics.on_constraint(mechanics, contact, reached)
        return physics.transition(mechanics, contact, load, state, fires, RESTING[state.dtype.name] * prepared.interval)

    like = contact, no_state, Rise(none > 0, no_state), no_state
    next_contact, y_next, rise, end = computed_once(follow, like)
    return Advance(y_next, next_contact, (interval + share) * prepared.interval, rise, end, fires & ~rises)


def _peak(
    prepared: Propagators,
    contact: Contact,
    load: Float[Array, " l"],
    y: Float[Array, "state l"],
    h: Float[Array, " l"],
    end: Float[Array, "state l"],
) -> Float[Array, " l"]:
    mechanics, n = prepared.mechanics, y.shape[0] // 2
    steps, sizes, exact = h / prepared.interval, jnp.zeros((8, *load.shape)), physics.exactly_zero(contact)
    window = Window(prepared.window @ stacked(mechanics, contact, load, y), sizes, exact, n, mechanics.tangential)

    def near(sample):
        about = stacked(mechanics, contact, load, window.state_at(sample))
        speed = Series(prepared.series @ about, sizes, exact, n).speed(mechanics.tangential)
        return highest(speed, jnp.maximum(-1.0 * sample, -1.0), jnp.minimum(steps - sample, 1.0)) / prepared.interval

    # Parabolas may misjudge the fastest modes. The end lies between samples, and the speed there may be larger than at all.
    sampled = jnp.maximum(window.highest_sample(steps), jnp.abs(end[n + mechanics.tangential]))
    return jnp.maximum(jnp.maximum(near(window.fastest(steps, 1.0)), near(window.fastest(steps, -1.0))), sampled)


_advance_one = _side_by_side(_advance)
_to_section = _side_by_side(functools.partial(_advance, at_section=True))
_peak_of_one = _side_by_side(_peak)


def _rise(
    before: Float[Array, "state l"], after: Float[Array, "state l"], h: Float[Array, " l"], tangential: int
) -> Float[Array, "state l"]:
    """The state where the tangential velocity rises through zero between two states a time `h` (s) apart, on cubics through
    both.

    It is wrong by some thousandths, but always by the same ones in the same motion, so motions can be compared there as well as
    at the exact rise, at which an advance would have to end.
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
