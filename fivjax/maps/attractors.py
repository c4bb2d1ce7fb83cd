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

from ..contact import Status
from ..verdicts import ensemble as nominating
from ..verdicts import tube
from ..verdicts.tube_of_several import starts_of_several
from ..verdicts.verdict import Verdict
from .captures import MORE_CROSSINGS, Cycle, captured, distinct, is_new, stable_cycles
from .flattened import Flattened, flatten
from .section import ReturnMaps, Section
from .sharing import Batch
from .windowed_returns import KEPT

# Looks at an ensemble after which cycles are computed from where its members are.
NEWTON_AT = (24, 64, 128, 256)
# Crossings in which the starts about a torus have to be back: of a group's ensemble, and about a motion that has asked alone.
# What takes longer is left to the trajectories that meet it.
BACK_WITHIN, BACK_WITHIN_ALONE = 96, 384
# The peak on a torus is sought from one in so many of its states, for so many crossings: some trajectories have passed over.
PEAK_EVERY, PEAK_CROSSINGS = 2, 4
# Starts about a torus from which it is asked whether neighbours part, and over how many returns, twice: the first turn
# directions to where they grow. On a torus they part no faster than linearly; in chaos by so much per return, and more.
PARTING_FROM, PARTING_OVER, PARTING = 4, 48, 0.05
# Neighbours that close in on each other by so much per return are on a torus that is locked: on a cycle of many crossings.
LOCKED = -0.01
# How far neighbours are apart at first, relative to their size.
APART = 1e-7


class Torus(NamedTuple):
    """A set of crossing states about which everything was seen to come back."""

    states: Float[np.ndarray, "k 2n"]  # weighted deviations
    amplitude: float  # m/s
    period: float  # mean time between crossings, s


class Attractors(NamedTuple):
    """What was found of a group."""

    cycles: list[Cycle]
    torus: Torus | None


class Follower(NamedTuple):
    """How trajectories are begun and followed (`rounds`)."""

    begun: Callable
    follow: Callable


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
        starts = [_about(maps, state)[:members] for state in near]
        trajectories = _at(trajectories, np.concatenate(starts) / maps.weights, maps.normal)
    if near is None:
        tests, within = nominating.TESTS, BACK_WITHIN
    else:
        tests, within = nominating.TESTS_ALONE, BACK_WITHIN_ALONE
    most, size = max(tests), 2 * maps.structure.size
    deviations = np.full((most, len(own), size), np.nan)
    peaks, times, events = (np.full((most, len(own)), np.nan) for _ in range(3))
    decay = shared.tree.modes.slowest_decay
    found = [Attractors([] if cycles is None else list(cycles[k]), None) for k in range(len(groups))]
    looks = 0

    def met(k: int):
        mine = slice(k * members, (k + 1) * members)
        whole = nominating.Ensemble(deviations, peaks, times, events, moving)
        seen = nominating.Ensemble(*(part[:looks, mine] for part in whole[:-1]), moving=moving[mine])
        return nominating.met(seen, decay[groups[k]])

    while len(running) and looks < most:
        report(0)
        trajectories.tree[1].peak[:] = 0.0
        rounds.follow(batch, shared, own[running], trajectories, nominating.SEEN)
        _, now = trajectories.tree
        recent = slice(looks, looks + nominating.SEEN)
        deviations[recent, running] = np.moveaxis(now.approach.seen, 1, 0)[::-1]
        peaks[recent, running], times[recent, running] = now.peak, now.t
        # As of the last of these looks: enough to tell whether there were any since the looks before.
        events[recent, running] = now.events
        looks += nominating.SEEN
        moving[running] = now.verdict == Verdict.UNDECIDED
        if looks in NEWTON_AT:
            _add_cycles(maps, own, running, moving, now, found, members)
        if looks in tests:
            open_ = np.unique(running[moving[running]] // members)
            sets = [(k, set_) for k, set_ in zip(open_, batch.pool.map(met, open_), strict=True) if set_ is not None]
            if sets:
                locked = _add_tori(maps, groups, sets, found, within, report)
                done = [k for k, _ in sets if found[k].torus is not None or k in locked]
                moving[np.isin(np.arange(len(own)) // members, done)] = False
        left = moving[running]
        running, trajectories = running[left], trajectories.compacted(np.flatnonzero(left))
    return found


def _keep(maps: ReturnMaps, new: list[tuple[int, Cycle]], found: list[Attractors]) -> None:
    """Adds those cycles (each with the place of its group) that are not known yet."""
    for k, cycle in new:
        if is_new(maps, cycle, found[k].cycles):
            found[k].cycles.append(cycle)


def _add_cycles(maps: ReturnMaps, own, running, moving, now, found: list[Attractors], members: int) -> None:
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
    new = stable_cycles(maps, own[running[picked]], at.rows(picked), known)
    _keep(maps, [(running[picked[rows[0]]] // members, cycle) for _, rows, cycle in new], found)
    if new:
        take_captured()


def section_of(now) -> Section:
    """Where trajectories are."""
    return Section(np.array(now.y), np.array(now.contact.status), np.array(now.contact.direction))


def _add_tori(maps: ReturnMaps, groups, sets, found, within: int, report) -> list[int]:
    """Which of the sets that ensembles have met on (with the group's place) are tori; returns the places of groups whose torus
    is locked: there its cycle was found.
    """
    weights = maps.weights
    starts = [_about(maps, states[:: len(states) // tube.STARTS] / weights) for _, (states, _) in sets]
    count = tube.STARTS
    own = np.repeat([groups[k] for k, _ in sets], count)
    last = _section_at(np.concatenate(starts) / weights, maps.normal)
    running, ok, home = np.arange(len(own)), np.ones(len(sets), bool), np.zeros(len(own), bool)
    smallest = np.array([np.min(np.linalg.norm(states, axis=1)) for _, (states, _) in sets])
    for _ in range(0, within, KEPT):
        report(0)
        image = maps.returns(own[running], last.rows(running), KEPT)
        for whole, part in zip(last, image.at, strict=True):
            whole[running] = part
        ends = weights * np.moveaxis(image.path, 1, 0)
        # One that fades, or fails, does not come back.
        lost = ~(np.linalg.norm(ends[-1], axis=1) > 0.5 * smallest[running // count])
        ok[np.unique(running[lost] // count)] = False
        for k in np.unique(running // count):
            mine = running // count == k
            home[running[mine]] = tube.home(sets[k][1][0], ends[:, mine])
        running = running[ok[running // count] & ~home[running]]
        if not len(running):
            break
    tori = np.flatnonzero(np.all(home.reshape(-1, count), axis=1) & ok)
    if not len(tori):
        return []
    chosen = (count * tori[:, None] + np.arange(0, count, count // PARTING_FROM)).ravel()
    parting, period = (
        np.mean(part.reshape(-1, PARTING_FROM), axis=1) for part in _parting(maps, own[chosen], last.rows(chosen))
    )
    closing_in = np.flatnonzero(np.repeat(parting < LOCKED, PARTING_FROM))[::2]
    locked = _locked(
        maps, groups, last.rows(chosen[closing_in]), np.repeat(tori, PARTING_FROM)[closing_in], sets, found
    )
    led_to_cycle = [sets[k][0] for k in locked]
    with np.errstate(invalid="ignore"):
        kept = (parting < PARTING) & ~np.isin(tori, locked)
    tori, period = tori[kept], period[kept]
    if not len(tori):
        return led_to_cycle
    peaks = [
        _peak_on(maps, groups[sets[k][0]], sets[k][1][0], last.rows(slice(count * k, count * (k + 1)))) for k in tori
    ]
    for k, mean, peak in zip(tori, period, peaks, strict=True):
        place, (states, _) = sets[k]
        if np.isfinite(mean) and np.isfinite(peak):
            found[place] = found[place]._replace(torus=Torus(states, peak, float(mean)))
    return led_to_cycle


def _locked(maps: ReturnMaps, groups, at: Section, tori, sets, found) -> list[int]:
    """Which tori are locked: motions from here, each on the torus at its place, are near a cycle, which is added."""
    if not len(tori):
        return []
    places = [sets[k][0] for k in tori]
    known = {int(groups[place]): found[place].cycles for place in places}
    new = stable_cycles(maps, groups[places], at, known, MORE_CROSSINGS)
    _keep(maps, [(places[rows[0]], cycle) for _, rows, cycle in new], found)
    return sorted({int(tori[row]) for _, rows, _ in new for row in rows})


def _peak_on(maps: ReturnMaps, group: int, states: Float[np.ndarray, "k 2n"], last: Section) -> float:
    """The largest tangential speed (m/s) on a torus: of motions from states that lie all over it, for a few crossings."""
    if len(maps.structure.contacts) > 1:  # whose contact modes a state of the section does not tell
        at, crossings = last, PEAK_CROSSINGS * len(states) // (PEAK_EVERY * len(last.y))
    else:
        at, crossings = _section_at(states[::PEAK_EVERY] / maps.weights, maps.structure.normal), PEAK_CROSSINGS
    return float(np.max(maps.peaks(np.full(len(at.y), group), at, crossings)))


def _parting(maps: ReturnMaps, group, at: Section) -> tuple[Float[np.ndarray, " m"], Float[np.ndarray, " m"]]:
    """How fast neighbours part from motions that start here: the logarithm of the growth of their distance per return; and
    the mean time of a return (s).
    """
    weights = maps.weights
    size = np.linalg.norm(weights * at.y, axis=1, keepdims=True)
    # Away from the equilibrium, which keeps what the section and the contact hold at zero.
    beside, grown, time = at.y * (1 + APART), np.full(len(group), np.nan), np.zeros(len(group))
    for _ in range(2):
        pair = Section(*(np.concatenate(parts) for parts in zip(at, at._replace(y=beside), strict=True)))
        image = maps.returns(np.tile(group, 2), pair, PARTING_OVER)
        time = time + image.time[: len(group)]
        at, other = image.at.rows(slice(None, len(group))), image.at.rows(slice(len(group), None))
        away = weights * (other.y - at.y)
        distance = np.linalg.norm(away, axis=1, keepdims=True)
        with np.errstate(divide="ignore", invalid="ignore"):
            grown = np.log(distance[:, 0] / (APART * size[:, 0])) / PARTING_OVER
            beside = at.y + APART * size * away / distance / weights
    return grown, time / (2 * PARTING_OVER)


def _about(maps: ReturnMaps, states) -> Float[np.ndarray, "m 2n"]:
    """Weighted starts on the edge of the tube about states of the section, or about one."""
    structure = maps.structure
    if len(structure.contacts) > 1:
        section = maps.section / maps.weights[structure.size :]
        return starts_of_several(maps.weights * np.atleast_2d(states), section, np.asarray(maps.normal))
    velocity, rate = structure.size + structure.tangential, structure.size + structure.normal
    return tube.starts(maps.weights * np.atleast_2d(states), velocity, structure.normal, rate)


def _section_at(y, normal: int | np.ndarray) -> Section:
    status = np.where(y[:, normal] > 0, int(Status.DETACH), int(Status.SLIDE)).astype(np.int32)
    return Section(y, status, np.ones(status.shape))


def _at(begun: Flattened, y: Float[np.ndarray, "m 2n"], normal: int | np.ndarray) -> Flattened:
    """Trajectories that have begun, put to these states of the section."""
    columns, now = begun.tree
    contact = eqx.tree_at(
        lambda c: c.status, now.contact, _section_at(y, normal).status.astype(now.contact.status.dtype)
    )
    return flatten(jax.tree.map(np.asarray, (columns, eqx.tree_at(lambda n: (n.y, n.contact), now, (y, contact)))))
