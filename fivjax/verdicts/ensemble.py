"""Nominations of a torus: the set of crossing states on which many trajectories of the same structure meet.

An *ensemble* per structure is released from rest under loads of different sizes. Its members have different energies;
where they come to be where others were (`met`) may be an attractor, and never is an unstable cycle, which is met by nobody.
That is no proof: the ghost of a fold is met by all that pass it. Cycles are computed from where members are
(`maps.captures`), and a set on which nothing repeats is checked to be attracting (`tube`).

A trajectory is on a torus once its crossing states, sixteen in a row, are in the tube about the set. A crossing is one of the
tangential velocity through zero, upwards.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from ..contact import State

# Loads that the ensemble is released from, in final loads.
RELEASES = np.linspace(1.5, 6.0, 8)
# Crossing states that a trajectory keeps: an ensemble is followed for as many looks at a time.
SEEN = 4
# When an ensemble is asked whether it has met, in looks, multiples of `SEEN`; later ones are not waited for. Second, of an
# ensemble about a motion that has asked for an attractor of its own: it may be one that closes in slowly.
TESTS, TESTS_ALONE = (64, 96, 128), (64, 128, 512)
# The stretches of its looks that are compared: whether in the later one all are where others were in the earlier one.
EARLIER, LATER = (0.5, 0.7), (0.8, 1.0)
# Of its states, so many have to be where others were.
MOSTLY = 0.9
# Members that have to meet.
LEAST_MEMBERS = 3
# Crossing states that are kept: enough for neighbours on a torus to be closer together than `REACHED`.
KEPT = 256
# Sets that so few balls of the size `REACHED` cover are thin: most are periodic, or drift.
LEAST_SPREAD = 6
# Between the two stretches a vibration that nothing sustains would have decayed by so much at least, and theirs has changed in
# size by no more than this share of that.
DECAYED, SUSTAINED = 0.2, 0.1
# A torus' mean size, in the first and in the last third of the looks of late, is the same but for this share.
KEEPS_SIZE = 0.02
# This close, relative to the own distance from equilibrium, it is the same limit cycle.
REACHED = 0.02
# Crossing states in a row that have to be as close.
LOOKS_NEAR = 16


class Attractor(eqx.Module):
    """A torus that is known: what trajectories are compared with."""

    # Deviations from equilibrium at crossings, weighted, see `Structure.weights`.
    crossings: Float[Array, "s state"]
    amplitude: Float[Array, ""]  # its largest tangential speed, m/s; zero while it is not known

    @property
    def known(self) -> Bool[Array, ""]:
        return self.amplitude > 0


class Approach(eqx.Module):
    """How near a trajectory has been to the known torus lately."""

    seen: Float[Array, "k state"]  # the crossing states that were looked at last, newest first
    near: Int[Array, ""]  # crossing states in a row that were close


class Ensemble(NamedTuple):
    """The last crossing states of `e` members, look by look; NaN where a member was not followed any more."""

    deviations: Float[np.ndarray, "k e state"]  # weighted
    times: Float[np.ndarray, "k e"]  # s
    events: Int[np.ndarray, "k e"]  # contact events so far
    moving: Bool[np.ndarray, " e"]  # members that are still followed: without another verdict


def unknown(groups: int, size: int) -> Attractor:
    """Of several groups (leading axis), none known yet; `size` is the state's."""
    return Attractor(np.zeros((groups, KEPT, size)), np.zeros(groups))


def no_approach(y: State) -> Approach:
    none = jnp.full((SEEN, y.shape[0]), jnp.nan, y.dtype)
    return Approach(none, jnp.zeros((), jnp.int32))


def met(ensemble: Ensemble, decay: float, thin: bool = False) -> Float[np.ndarray, "s 2n"] | None:
    """Crossing states of what the ensemble has met on, if it has and if that may be a torus.

    Members have met when nine in ten of their crossing states of late are close to states that *others* were in some time ago.
    In between, a vibration that nothing sustains would have decayed by more than a fifth (`decay` is its slowest rate in
    1/s); theirs has changed in size by no more than a tenth of that. A set that is thin counts only if so asked: next to the
    bifurcation that it was born in, a torus is.
    """
    looks = len(ensemble.times)
    earlier, later = (slice(*(round(looks * share) for share in stretch)) for stretch in (EARLIER, LATER))
    if not np.all(np.isfinite(ensemble.deviations[earlier.start :, ensemble.moving])):
        return None
    # A vibration that grows from nothing meets on its growing mode long before its first event.
    eventful = ensemble.moving & (ensemble.events[later.stop - 1] > ensemble.events[later.start])
    members = []
    for member in np.flatnonzero(eventful):
        others = ensemble.moving & (np.arange(len(ensemble.moving)) != member)
        known = ensemble.deviations[earlier, others].reshape(-1, ensemble.deviations.shape[-1])
        if len(known) and np.mean(_distance(known, ensemble.deviations[later, member]) <= REACHED) >= MOSTLY:
            members.append(member)
    if len(members) < LEAST_MEMBERS:
        return None
    lasting = decay * (np.mean(ensemble.times[later, members]) - np.mean(ensemble.times[earlier, members]))
    sizes = [np.mean(np.linalg.norm(ensemble.deviations[part][:, members], axis=-1)) for part in (earlier, later)]
    if lasting < DECAYED or abs(np.log(sizes[1] / sizes[0])) > SUSTAINED * lasting:
        return None
    states, before = (
        ensemble.deviations[part][:, members].reshape(-1, ensemble.deviations.shape[-1]) for part in (later, earlier)
    )
    third = (later.stop - earlier.start) // 3
    thirds = (slice(earlier.start, earlier.start + third), slice(later.stop - third, later.stop))
    first, last = (np.mean(np.linalg.norm(ensemble.deviations[part][:, members], axis=-1)) for part in thirds)
    if abs(last / first - 1) > KEEPS_SIZE:
        return None
    # The more of them, the closer together they are on a torus.
    states = np.concatenate([before[_distance(states, before) <= REACHED], states])
    chosen = _spread(states, thin)
    return None if chosen is None else states[chosen]


def _spread(states: Float[np.ndarray, "m 2n"], thin: bool) -> Int[np.ndarray, " KEPT"] | None:
    """Places of states as far from each other as can be; none where a few are close to all, unless sets may be `thin`."""
    size = np.mean(np.linalg.norm(states, axis=-1))
    chosen = [0]
    away = np.linalg.norm(states - states[0], axis=-1)
    while len(chosen) < KEPT:
        if not thin and len(chosen) == LEAST_SPREAD and np.max(away) < REACHED * size:
            return None
        chosen.append(int(np.argmax(away)))
        away = np.minimum(away, np.linalg.norm(states - states[chosen[-1]], axis=-1))
    # In no order: a sample of them is one of the whole set.
    return np.array(chosen)[np.random.default_rng(0).permutation(KEPT)]


def _distance(known: Float[np.ndarray, "k state"], states: Float[np.ndarray, "m state"]) -> Float[np.ndarray, " m"]:
    size = np.sum(states**2, axis=-1)
    apart = size[:, None] - 2 * states @ known.T + np.sum(known**2, axis=-1)
    return np.sqrt(np.maximum(np.min(apart, axis=1), 0.0) / size)


def distance_to(attractor: Attractor, crossing: State) -> Float[Array, ""]:
    """Of a crossing state (a weighted deviation) to the nearest one of a torus, relative to its size; infinite to none."""
    size = jnp.sum(crossing**2)
    apart = size - 2 * attractor.crossings @ crossing + jnp.sum(attractor.crossings**2, axis=-1)
    return jnp.where(attractor.known, jnp.sqrt(jnp.maximum(jnp.min(apart), 0.0) / size), jnp.inf)


def approached(approach: Approach, crossing: State, distance: Float[Array, ""]) -> tuple[Approach, Bool[Array, ""]]:
    """The approach after a look at a crossing state at a distance of the known torus, and whether that is reached."""
    close = distance <= REACHED
    near = jnp.where(close, approach.near + 1, 0)
    reached = near >= LOOKS_NEAR
    fresh = jnp.any(crossing != approach.seen[0])
    look = Approach(jnp.concatenate([crossing[None], approach.seen[:-1]]), near)
    return jax.tree.map(lambda new, old: jnp.where(fresh, new, old), look, approach), fresh & reached
