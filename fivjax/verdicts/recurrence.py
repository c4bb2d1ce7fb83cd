"""The recurrence test: the orbit is seen to return to its section. It nominates where a cycle is computed, and proves nothing.

The state at successive upward zero crossings of the tangential velocity comes back to within a tolerance, at the same
lag again and again, with contact events in between and without drifting off. Two kinds of return count:

- *tight*: the states are the same to within the method's error, as on a periodic orbit;
- *loose*: the state went away and came back close. Above 1.7 m/s the paper's limit cycle is not periodic: it winds
  around a torus, its amplitude beats over some 14 periods of 68 Hz for ever, and no two crossings are the same. So do
  impacts and stick-slip that die out slowly in a structure that is hardly damped; so loose returns have to go on for long
  enough to tell, and the motion has to keep its size meanwhile.

Merely being close to an earlier state proves nothing. Right at the critical perturbation trajectories linger near an
unstable cycle for seconds, almost periodic, before they decide. They stay close without going away, so they are no loose
return, and they drift, so they are no tight one: a chain whose distances grow does not count.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from ..contact import State
from ..foundation.compiling import computed_once
from ..steppers.section import Resolution, Rise

# A chain of returns counts when it is at least this long.
LEAST_RETURNS = 3
SHORTEST_SEARCH = 32
LONGEST_SEARCH = 64
# A loose return: this close relative to the orbit's size, and to how far it had gone meanwhile.
LOOSE_DISTANCE = 0.02
LOOSE_SHARE = 0.15
LOOSE_CROSSINGS = 16
ALLOWANCE = 1.5
# Loose returns go on for so long that what is not sustained would have decayed by this much: more than they may be apart.
DECAYED = 0.2
# And what is sustained does not change in size by more than this share of what it would have decayed by.
SUSTAINED = 0.1
# Loose returns each this much further than the one before drift off; on a torus they scatter, or stay the same.
DRIFT = 0.02


class Recurrence(eqx.Module):
    """What has to be remembered of a trajectory to see that it returns: one earlier state and a few counts."""

    latest: Float[Array, " state"]  # the last crossing state
    anchor: Float[Array, " state"]  # the crossing state that later ones are compared with
    crossings: Int[Array, ""]  # since the anchor was set
    search_length: Int[Array, ""]  # crossings after which a search starts again from a newer anchor
    changes: Int[Array, ""]  # status changes since the anchor was set
    lag: Int[Array, ""]  # crossings per return; 0 while none is known
    returns: Int[Array, ""]  # returns in a row at that lag
    since: Float[Array, ""]  # when the first of these returns set out, s
    set_out: Float[Array, ""]  # when the anchor was set, s
    first_distance: Float[Array, ""]  # of the first of these returns, relative
    last_distance: Float[Array, ""]  # of the last of them
    rising: Bool[Array, ""]  # each of them further than the one before
    excursion: Float[Array, ""]  # largest distance from the anchor since it was set, relative
    peak: Float[Array, ""]  # largest tangential speed since the anchor was set, m/s
    first_peak: Float[Array, ""]  # the same over the first of these returns
    amplitude: Float[Array, ""]  # the same over the returns in a row
    returned: Bool[Array, ""]  # seen to return: a limit cycle


def new_recurrence(y: State) -> Recurrence:
    zero, none = jnp.zeros((), y.dtype), jnp.zeros((), jnp.int32)
    # No anchor yet: an infinite one is never returned to, and a search of one crossing replaces it at the first crossing.
    return Recurrence(
        latest=jnp.full_like(y, jnp.nan),
        anchor=jnp.full_like(y, jnp.inf),
        crossings=none,
        search_length=none + 1,
        changes=none,
        lag=none,
        returns=none,
        since=zero,
        set_out=zero,
        first_distance=zero,
        last_distance=zero,
        rising=jnp.zeros((), bool),
        excursion=zero,
        peak=zero,
        first_peak=zero,
        amplitude=zero,
        returned=jnp.zeros((), bool),
    )


def observe(
    memory: Recurrence,
    weights: Float[Array, " state"],
    equilibrium: State,
    rise: Rise,
    changed: Bool[Array, ""],
    peak: Float[Array, ""],
    t: Float[Array, ""],
    decay: Float[Array, ""],
    resolution: Resolution,
) -> Recurrence:
    """The memory after one more step, in which the velocity rose through zero or not.

    `weights` make displacements and velocities comparable; distances are relative to that from `equilibrium`. `changed`
    says whether the status changed in the step, `peak` is the largest tangential speed in it, `t` is the time at its end,
    and `decay` the slowest rate (1/s) at which a vibration decays that nothing sustains.
    """
    crossed, at = rise
    distance = computed_once(
        lambda: _length(weights * (at - memory.anchor)) / _length(weights * (at - equilibrium)), jnp.zeros_like(peak)
    )

    crossings = memory.crossings + 1
    changes = memory.changes + changed
    peak = jnp.maximum(memory.peak, peak)
    # While the anchor is not set, the distance is infinite and says nothing.
    excursion = jnp.where(jnp.isfinite(distance), jnp.maximum(memory.excursion, distance), memory.excursion)
    # On a torus distances at one lag scatter a little; a lag once found may scatter by more.
    allowance = jnp.where(memory.lag == 0, 1.0, ALLOWANCE)
    loose = (distance <= allowance * LOOSE_DISTANCE) & (distance <= allowance * LOOSE_SHARE * excursion)
    loose = loose & (excursion >= resolution.floor)
    close = ((distance <= resolution.tight) | loose) & (changes > 0)
    searching = memory.lag == 0
    due = crossings == memory.lag
    again = ~searching & due & close
    found = searching & close
    lost = ~searching & due & ~close
    in_vain = searching & ~close & (crossings >= memory.search_length)

    returns = jnp.where(found, 1, jnp.where(lost, 0, memory.returns + again))
    lag = jnp.where(found, crossings, jnp.where(lost, 0, memory.lag))
    crossings_needed = jnp.where(loose, LOOSE_CROSSINGS, resolution.span)
    needed = jnp.maximum(LEAST_RETURNS, -(-crossings_needed // jnp.maximum(lag, 1)))
    # A vibration that merely decays slowly comes back loosely, too.
    faded = (t - memory.since) * decay
    change = jnp.abs(jnp.log(peak / jnp.where(memory.first_peak > 0, memory.first_peak, 1.0)))
    sustained = (faded >= DECAYED) & (change <= SUSTAINED * faded)
    complete = again & (returns >= needed) & (~loose | sustained)
    # Below a hundredth of the method's error there is nothing left to drift.
    further = distance > jnp.maximum(memory.first_distance, 0.01 * resolution.tight)
    rising = jnp.where(again, memory.rising & (distance > (1 + DRIFT) * memory.last_distance), memory.rising)
    drifting = jnp.where(loose, rising, further)
    restart = found | (complete & drifting)
    amplitude = jnp.where(found, peak, jnp.where(again, jnp.maximum(memory.amplitude, peak), memory.amplitude))
    new_anchor = found | again | lost | in_vain
    search_length = jnp.where(
        lost,
        SHORTEST_SEARCH,
        jnp.where(in_vain, jnp.clip(2 * memory.search_length, SHORTEST_SEARCH, LONGEST_SEARCH), memory.search_length),
    )
    seen = Recurrence(
        latest=at,
        anchor=jnp.where(new_anchor, at, memory.anchor),
        crossings=jnp.where(new_anchor, 0, crossings),
        search_length=search_length,
        changes=jnp.where(new_anchor, 0, changes),
        lag=lag,
        returns=jnp.where(restart, 1, returns),
        since=jnp.where(restart, memory.set_out, memory.since),
        set_out=jnp.where(new_anchor, t, memory.set_out),
        first_distance=jnp.where(restart, distance, memory.first_distance),
        last_distance=jnp.where(found | again, distance, memory.last_distance),
        rising=restart | rising,
        excursion=jnp.where(new_anchor, 0.0, excursion),
        peak=jnp.where(new_anchor, 0.0, peak),
        first_peak=jnp.where(restart, peak, memory.first_peak),
        amplitude=amplitude,
        returned=memory.returned | (complete & ~drifting),
    )
    between = eqx.tree_at(lambda m: (m.changes, m.peak), memory, (changes, peak))
    return jax.tree.map(lambda new, old: jnp.where(crossed, new, old), seen, between)


def _length(x: Float[Array, " k"]) -> Float[Array, ""]:
    # Term by term: in a batch that is one fused loop over trajectories.
    return jnp.sqrt(sum(x[k] ** 2 for k in range(x.shape[0])))
