"""The attractors of a group: computed from where an ensemble of released trajectories nominates them.

What is found depends on the group alone: on no trajectory of the map, nor on their number. Cycles are computed
(`captures`); where none is found although the members stay in motion, the set that they have met on is tried as a torus: starts
about it, further in and further out, must all come back to it.
"""

from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Float, Int

from ..verdicts import ensemble as nominating
from ..verdicts.verdict import Verdict
from .captures import Cycle, captured, distinct, is_new, stable_cycles
from .flattened import Flattened, flatten
from .section import ReturnMaps, Section
from .sharing import Batch
from .tori import BACK_WITHIN, BACK_WITHIN_ALONE, Torus, about, section_at, tori_among

# Looks at an ensemble after which cycles are computed from where its members are.
NEWTON_AT = {24: 0.1, 64: 0.03, 128: 0.01, 256: 0.003}


class Attractors(NamedTuple):
    """What was found of a group."""

    cycles: list[Cycle]
    torus: Torus | None


class Follower(NamedTuple):
    """How trajectories are begun and followed (`rounds`)."""

    begun: Callable
    observed: Callable


def search(
    batch: Batch,
    shared: Flattened,
    maps: ReturnMaps,
    rounds: Follower,
    groups: Int[np.ndarray, " g"],
    columns: Float[np.ndarray, "g h"],
    report,
    near: Float[np.ndarray, "g 2n"] | None = None,
    cycles: list[list[Cycle]] | None = None,
) -> list[Attractors]:
    """The attractors of these groups. `columns` are the load's histories of any trajectory of each.

    With `near`, states of the section, members begin about these instead of being released. `cycles` of each are known.
    """
    members = len(nominating.RELEASES)
    own, each = np.repeat(groups, members), np.repeat(columns, members, axis=0)
    # The ensemble's own states, not those of a trajectory.
    each[:, len(batch.history) :] = np.nan
    running, moving = np.arange(len(own)), np.ones(len(own), bool)
    trajectories = rounds.begun(batch, shared, own, each, np.tile(nominating.RELEASES, len(groups)))
    if near is not None:
        starts = [about(maps, state)[:members] for state in near]
        trajectories = _at(trajectories, np.concatenate(starts) / maps.weights, maps.normal)
    if near is None:
        tests, within = nominating.TESTS, BACK_WITHIN
    else:
        tests, within = nominating.TESTS_ALONE, BACK_WITHIN_ALONE
    most, size = max(tests), 2 * maps.structure.size
    deviations = np.full((most, len(own), size), np.nan)
    times, events = (np.full((most, len(own)), np.nan) for _ in range(2))
    decay = shared.tree.modes.slowest_decay
    found = [Attractors([] if cycles is None else list(cycles[k]), None) for k in range(len(groups))]
    looks = 0

    def met(k: int):
        mine = slice(k * members, (k + 1) * members)
        whole = nominating.Ensemble(deviations, times, events, moving)
        seen = nominating.Ensemble(*(part[:looks, mine] for part in whole[:-1]), moving=moving[mine])
        return nominating.met(seen, decay[groups[k]], thin=near is not None)

    for stop in sorted({*NEWTON_AT, *tests}):
        if not len(running) or stop > most:
            break
        report(0)
        seen = rounds.observed(shared, own[running], trajectories, stop - looks)
        _, now = trajectories.tree
        for whole, part in zip((deviations, times, events), seen, strict=True):
            whole[looks:stop, running] = part.swapaxes(0, 1)
        looks = stop
        moving[running] = now.verdict == Verdict.UNDECIDED
        if looks in NEWTON_AT:
            _add_cycles(maps, own, running, moving, now, found, members, NEWTON_AT[looks])
        if looks in tests:
            open_ = np.unique(running[moving[running]] // members)
            sets = [(k, set_) for k, set_ in zip(open_, batch.pool.map(met, open_), strict=True) if set_ is not None]
            if sets:
                tori, of_locked = tori_among(maps, groups, sets, [one.cycles for one in found], within, report)
                for k, torus in tori.items():
                    found[k] = found[k]._replace(torus=torus)
                _keep(maps, of_locked, found)
                done = [*tori, *(k for k, _ in of_locked)]
                moving[np.isin(np.arange(len(own)) // members, np.array(done, int))] = False
        left = moving[running]
        running, trajectories = running[left], trajectories.compacted(np.flatnonzero(left))
    return found


def _keep(maps: ReturnMaps, new: list[tuple[int, Cycle]], found: list[Attractors]) -> None:
    """Adds those cycles (each with the place of its group) that are not known yet."""
    for k, cycle in new:
        if is_new(maps, cycle, found[k].cycles):
            found[k].cycles.append(cycle)


def _add_cycles(
    maps: ReturnMaps, own, running, moving, now, found: list[Attractors], members: int, nearly: float
) -> None:
    """Cycles where members are by now; those that are captured by them need not be followed any further."""
    latest = np.array(now.crossing)
    usable = moving[running] & np.all(np.isfinite(latest), axis=1) & (now.events > 0)
    at = section_of(now)

    def take_captured():
        known = [(np.flatnonzero(usable & (running // members == k)), c) for k, a in enumerate(found) for c in a.cycles]
        inside = captured(maps, own[running], at, latest, known) >= 0
        moving[running[inside]] = False
        return usable & ~inside

    left = take_captured() if any(a.cycles for a in found) else usable
    picked = distinct(maps.weights * np.where(usable[:, None], latest, 0.0), running // members, left)
    if not len(picked):
        return
    known = {int(own[members * k]): one.cycles for k, one in enumerate(found)}
    new = stable_cycles(maps, own[running[picked]], at.rows(picked), known, nearly=nearly)
    _keep(maps, [(running[picked[rows[0]]] // members, cycle) for _, rows, cycle in new], found)
    if new:
        take_captured()


def section_of(now) -> Section:
    """Where trajectories are."""
    return Section(np.array(now.y), np.array(now.contact.status), np.array(now.contact.direction))


def _at(begun: Flattened, y: Float[np.ndarray, "m 2n"], normal: int | np.ndarray) -> Flattened:
    """Trajectories that have begun, put to these states of the section."""
    columns, now = begun.tree
    # They have been released: friction points the way it does on the section.
    status = section_at(y, normal, np.asarray(now.contact.direction)).status.astype(now.contact.status.dtype)
    contact = eqx.tree_at(lambda c: c.status, now.contact, status)
    return flatten(jax.tree.map(np.asarray, (columns, eqx.tree_at(lambda n: (n.y, n.contact), now, (y, contact)))))
