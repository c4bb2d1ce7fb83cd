"""Tori of many groups: whether sets on which ensembles have met attract, whether neighbours part on them, how high they go."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from ..contact import Status
from ..cycles.torus import extent, smooth_mean
from ..verdicts import tube
from ..verdicts.tube import nearest
from ..verdicts.tube_of_several import starts_of_several
from .captures import MORE_CROSSINGS, NOMINATED, Cycle, stable_cycles
from .section import ReturnMaps, Section
from .windowed_returns import KEPT

# Crossings in which the starts about a torus have to be back: of a group's ensemble, and about a motion that has asked alone.
# What takes longer is left to the trajectories that meet it.
BACK_WITHIN, BACK_WITHIN_ALONE = 96, 384
# Starts about a torus that are followed further. Over so many returns, twice, it is asked whether neighbours part: the first
# turn directions to where they grow. On a torus they part no faster than linearly; in chaos by so much per return, and more.
FURTHER, PARTING_OVER, PARTING = 8, 48, 0.05
# Neighbours that close in on each other by so much per return are on a torus that is locked: on a cycle of many crossings.
LOCKED = -0.01
# On the way, motions that are on one torus have the same mean, but for so much of its extent, and come to where others were, to
# within so many distances between neighbours. A slow fade is a line of states: each motion is at a place of its own.
SAME_MEAN, NEAR_OTHERS, ROUNDING = 0.2, 8.0, 1e-7
# A motion that nothing has captured in its time is followed on for so many times as many returns at most: until neighbours
# have parted by so many e-folds since they were closest, or have closed in by so many since they were furthest apart. On a
# torus they part and close in by turns, by two or three e-folds. Where they have parted by more before they close in, the
# motion was chaotic for a time: another solver's rounding may lead to another attractor.
PARTING_TIMES, PARTED, CLOSED_IN, AS_ON_A_TORUS = 128, 30.0, 15.0, 7.0
# How far neighbours are apart at first, relative to their size.
APART = 1e-7
# The largest speed in so many returns is the torus' amplitude if it has changed by no more than this share since before it was
# asked whether neighbours part, or in as many returns as starts about the torus have to come back in, if these are more. Else
# the motions settle, each time for twice as long, so often at most: a set whose amplitude still drifts is not accepted. (What
# shrinks slowly beats more than it shrinks in a short time, and may seem to stand still.)
PEAK_OVER, SETTLED, SETTLE_TIMES = 32, 7.5e-4, 6


class Torus(NamedTuple):
    """A set of crossing states about which everything was seen to come back."""

    states: Float[np.ndarray, "k 2n"]  # weighted deviations
    amplitude: float  # m/s
    period: float  # mean time between crossings, s


def tori_among(
    maps: ReturnMaps,
    groups: Int[np.ndarray, " g"],
    sets: list[tuple[int, Float[np.ndarray, "k 2n"]]],
    known: list[list[Cycle]],
    within: int,
    report,
    radius: float = tube.RADIUS,
    end_radius: float = tube.RADIUS,
) -> tuple[dict[int, Torus], list[tuple[int, Cycle]]]:
    """Which of these sets, each with the place of its group, are tori: those, by the place; and the cycles of those that are
    locked. `known` are the cycles of each group; starts about a torus, in a tube of this relative
    `radius`, have to be back `within` so many crossings, in the inner half of one of `end_radius`.
    """
    sets = [(k, states) for k, states in sets if not _holds_one_of(maps, states, known[k], radius)]
    if not sets:
        return {}, []
    own = np.array([groups[k] for k, _ in sets])
    back, last = _back(maps, own, [states for _, states in sets], within, report, radius, end_radius)
    if not len(back):
        return {}, []
    chosen = (tube.STARTS * back[:, None] + np.arange(0, tube.STARTS, tube.STARTS // FURTHER)).ravel()
    group, at = own[chosen // tube.STARTS], last.rows(chosen)
    peak, at = _highest(maps, group, at)
    growth, period, later, path = _parting(maps, group, at)
    growth, period = (np.mean(part.reshape(-1, FURTHER), axis=1) for part in (growth, period))
    lasting = np.array([_on_one_torus(part) for part in path.reshape(-1, FURTHER, *path.shape[1:])])
    closing_in = np.flatnonzero(growth < LOCKED)
    cycles: list[tuple[int, Cycle]] = []
    locked: list[int] = []
    of_group = {int(groups[k]): known[k] for k, _ in sets}
    # One motion of each after the other, because most lead to the same cycle.
    for nominee in range(0, FURTHER, FURTHER // NOMINATED):
        asks = FURTHER * closing_in[~np.isin(closing_in, locked)] + nominee
        if not len(asks):
            break
        for _, rows, cycle in stable_cycles(maps, group[asks], later.rows(asks), of_group, MORE_CROSSINGS):
            of_torus = asks[rows] // FURTHER
            cycles.append((sets[back[of_torus[0]]][0], cycle))
            locked += list(of_torus)
    with np.errstate(invalid="ignore"):
        kept = np.flatnonzero((growth < PARTING) & lasting & ~np.isin(np.arange(len(back)), locked))
    if not len(kept):
        return {}, cycles
    rows = (FURTHER * kept[:, None] + np.arange(FURTHER)).ravel()
    peak = _settled_peak(maps, group[rows], later.rows(rows), peak[kept], within)
    tori = {}
    for k, mean, highest in zip(kept, period[kept], peak, strict=True):
        place, states = sets[back[k]]
        if np.isfinite(mean) and np.isfinite(highest):
            tori[place] = Torus(states, float(highest), float(mean))
    return tori, cycles


def _holds_one_of(maps: ReturnMaps, states: Float[np.ndarray, "k 2n"], cycles: list[Cycle], radius: float) -> bool:
    """Whether a stable cycle lies in the inner half of the tube about a set: motions there may come to that instead."""
    return any(tube.home(states, maps.weights * cycle.points[:, None], radius).item() for cycle in cycles)


def _back(
    maps: ReturnMaps,
    group: Int[np.ndarray, " s"],
    sets: list[Float[np.ndarray, "k 2n"]],
    within: int,
    report,
    radius,
    end_radius,
) -> tuple[Int[np.ndarray, " t"], Section]:
    """About which of the sets all starts come back within so many crossings; and where the starts are then, set by set."""
    weights, count = maps.weights, tube.STARTS
    starts = [about(maps, states[:: len(states) // count] / weights, radius) for states in sets]
    own = np.repeat(group, count)
    last = section_at(np.concatenate(starts) / weights, maps.normal, maps.sliding[own])
    running, back, ok = np.arange(len(own)), np.zeros(len(own), bool), np.ones(len(sets), bool)
    smallest = np.array([np.min(np.linalg.norm(states, axis=1)) for states in sets])
    for _ in range(0, within, KEPT):
        report(0)
        image = maps.returns(own[running], last.rows(running), KEPT)
        last.put(running, image.at)
        ends = weights * np.moveaxis(image.path, 1, 0)
        # One that fades, or fails, does not come back.
        with np.errstate(invalid="ignore"):
            lost = ~(np.linalg.norm(ends[-1], axis=1) > 0.5 * smallest[running // count])
        ok[running[lost] // count] = False
        for k in np.unique(running // count):
            mine = running // count == k
            back[running[mine]] = tube.home(sets[k], ends[-tube.HOME :, mine], end_radius)
        running = running[ok[running // count] & ~back[running]]
        if not len(running):
            break
    return np.flatnonzero(np.all(back.reshape(-1, count), axis=1) & ok), last


def _on_one_torus(paths: Float[np.ndarray, "m k 2n"]) -> bool:
    """Whether motions, by their weighted states on the section in order, go about the same set again and again."""
    if not np.all(np.isfinite(paths)):
        return False
    whole = paths.reshape(-1, paths.shape[-1])
    means = np.stack([smooth_mean(path) for path in paths])
    apart = np.linalg.norm(means - np.mean(means, axis=0), axis=1)
    third = paths.shape[1] // 3
    early = paths[:, :third].reshape(-1, paths.shape[-1])
    late = paths[:, -third:]
    steps = [np.median(nearest(part, part, others=True)) for part in late]
    missed = [np.median(nearest(part, early)) for part in late]
    rounding = ROUNDING * tube.mean_size(whole)
    return bool(
        np.max(apart) <= SAME_MEAN * extent(whole) and np.all(missed <= NEAR_OTHERS * np.array(steps) + rounding)
    )


def _parting(maps: ReturnMaps, group, at: Section):
    """How fast neighbours part from motions that start here: the logarithm of the growth of their distance per return; the mean
    time of a return (s); where the motions are in the end; and their weighted states on the section.
    """
    beside, growth, time, paths = _beside(at), np.full(len(group), np.nan), np.zeros(len(group)), []
    for _ in range(2):
        growth, taken, at, beside, path = _parted(maps, group, at, beside)
        time = time + taken
        paths.append(path)
    return growth, time / (2 * PARTING_OVER), at, np.concatenate(paths, axis=1)


def _beside(at: Section) -> Float[np.ndarray, "m 2n"]:
    """Neighbours, away from the equilibrium: that keeps what the section and the contact hold at zero."""
    return at.y * (1 + APART)


def _parted(maps: ReturnMaps, group, at: Section, beside):
    """After `PARTING_OVER` returns: the logarithm of the growth of the distance to neighbours per return, the time taken (s),
    where the motions are, neighbours in the direction in which those from before are by then, and the motions' weighted states
    on the section.
    """
    weights = maps.weights
    size = np.linalg.norm(weights * at.y, axis=1, keepdims=True)
    apart = np.linalg.norm(weights * (beside - at.y), axis=1)
    pair = Section(*(np.concatenate(parts) for parts in zip(at, at._replace(y=beside), strict=True)))
    path, time = [], np.zeros(len(group))
    for _ in range(0, PARTING_OVER, KEPT):
        image = maps.returns(np.tile(group, 2), pair, KEPT)
        pair, time = image.at, time + image.time[: len(group)]
        path.append(weights * image.path[: len(group)])
    at, other = pair.rows(slice(None, len(group))), pair.rows(slice(len(group), None))
    away = weights * (other.y - at.y)
    distance = np.linalg.norm(away, axis=1, keepdims=True)
    with np.errstate(divide="ignore", invalid="ignore"):
        growth = np.log(distance[:, 0] / apart) / PARTING_OVER
        beside = at.y + APART * size * away / distance / weights
    return growth, time, at, beside, np.concatenate(path, axis=1)


def _highest(maps: ReturnMaps, group, at: Section) -> tuple[Float[np.ndarray, " t"], Section]:
    """The largest tangential speed (m/s) in the next `PEAK_OVER` returns of motions on tori, `FURTHER` on each; and where the
    motions are then.
    """
    highest, end = maps.peaks_and_ends(group, at, PEAK_OVER)
    return np.max(highest.reshape(-1, FURTHER), axis=1), end


def _settled_peak(
    maps: ReturnMaps, group, at: Section, before: Float[np.ndarray, " t"], within: int
) -> Float[np.ndarray, " t"]:
    """The same once it has settled, from what it was `before`; not a number where it does not settle."""
    peak, last = np.full(len(before), np.nan), before.copy()
    running, over = np.arange(len(peak)), 2 * PARTING_OVER
    if within > over:
        at, over = maps.returns(group, at, within - over).at, within
    for _ in range(SETTLE_TIMES):
        rows = (FURTHER * running[:, None] + np.arange(FURTHER)).ravel()
        now, end = _highest(maps, group[rows], at.rows(rows))
        done = np.abs(now / last[running] - 1) <= SETTLED
        peak[running[done]], last[running] = now[done], now
        open_ = ~done & np.isfinite(now)
        running, left = running[open_], np.repeat(open_, FURTHER)
        if not len(running):
            break
        over *= 2
        at.put(rows[left], maps.returns(group[rows[left]], end.rows(left), over).at)
    return peak


class Followed(NamedTuple):
    """What motions do in the long run."""

    chaotic: Bool[np.ndarray, " m"]  # neighbours part exponentially, or did for long
    closing_in: Bool[np.ndarray, " m"]  # neighbours close in exponentially, as they do on a cycle
    at: Section  # where the motions are then


def followed_on(maps: ReturnMaps, group: Int[np.ndarray, " m"], at: Section) -> Followed:
    """Whether neighbours part or close in exponentially where motions that start here lead to: asked over thousands of returns,
    because events may be rare. On a torus they do neither.
    """
    at = maps.returns(group, at, 1).at
    _, _, at, beside, _ = _parted(maps, group, at, _beside(at))
    running, last = np.arange(len(group)), Section(*(part.copy() for part in at))
    parted, least, most, furthest = np.zeros((4, len(group)))
    for _ in range(PARTING_TIMES):
        growth, _, at, beside, _ = _parted(maps, group[running], at, beside)
        parted[running] += PARTING_OVER * growth
        least, most = np.fmin(least, parted), np.fmax(most, parted)
        last.put(running, at)
        # Not a number is neither.
        with np.errstate(invalid="ignore"):
            furthest = np.fmax(furthest, parted - least)
            left = ((parted - least < PARTED) & (most - parted < CLOSED_IN))[running]
        running, at, beside = running[left], at.rows(left), beside[left]
        if not len(running):
            break
    with np.errstate(invalid="ignore"):
        closing_in = most - parted >= CLOSED_IN
        chaotic = furthest >= np.where(closing_in, AS_ON_A_TORUS, PARTED)
    return Followed(chaotic, closing_in & ~chaotic, last)


def about(maps: ReturnMaps, states, radius: float = tube.RADIUS) -> Float[np.ndarray, "m 2n"]:
    """Weighted starts on the edge of the tube of this relative `radius` about states of the section, or about one."""
    structure = maps.structure
    if len(structure.contacts) > 1:
        section = maps.section / maps.weights[structure.size :]
        return starts_of_several(maps.weights * np.atleast_2d(states), section, np.asarray(maps.normal), radius)
    velocity, rate = structure.size + structure.tangential, structure.size + structure.normal
    return tube.starts(maps.weights * np.atleast_2d(states), velocity, structure.normal, rate, radius)


def section_at(
    y: Float[np.ndarray, "m 2n"], normal: int | np.ndarray, direction: Float[np.ndarray, "m *contacts"]
) -> Section:
    """States of the section with the contact mode that they tell, and the direction of friction if they slide."""
    status = np.where(y[:, normal] > 0, int(Status.DETACH), int(Status.SLIDE)).astype(np.int32)
    return Section(y, status, np.where(status == Status.SLIDE, direction, 1.0))
