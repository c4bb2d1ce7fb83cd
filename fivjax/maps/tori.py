"""Tori of many groups: the sets that long motions trace on the section, whether these attract, whether neighbours part on them,
how high they go.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from ..contact import Status
from ..cycles.torus import drifts, extent, smooth_mean
from ..verdicts import tube
from ..verdicts.tube import nearest
from ..verdicts.tube_of_several import starts_of_several
from .captures import CROSSINGS, KNOWN_TO, MORE_CROSSINGS, NOMINATED, Cycle, stable_cycles
from .parting import PARTING_OVER, parting_rates
from .section import ReturnMaps, Section
from .windowed_returns import KEPT

# Radii of the tube about a set that is tried as a torus, each with the number of its states: the narrower, the more are needed.
TUBES = ((tube.RADIUS, 512), (tube.RADIUS / 4, 2048), (tube.RADIUS / 16, 4096))
# States on the section in a row that make the set: so many, and twice as many of a motion that beats slowly; and how many at a
# time: after each, motions that have come to a torus that is known are left out, and those whose extent changes by this factor,
# as on the way to a cycle.
TRACED, LONGER, AT_A_TIME, CHANGES = 2048, 4096, 512, 1.5
# The mean of the states may change with time by so much of their extent, and their extent by this share. A fade that takes
# thousands of periods is such a set, too, and starts further in are home while they pass it.
DRIFT, SHRINKS = 5e-3, 0.05
# A motion that comes back this close, relative to the extent of its states, within `CROSSINGS`, is on a cycle. One that is
# locked weakly to a cycle of more crossings is better taken as on a torus: motions from about it trace the rest of that, once
# they have come to it, after so many returns. Its states are in clusters: distances between neighbours are mostly smaller than
# this share of those on a curve.
REPEATS, COME_AFTER, CLUSTERED = 1e-5, 48, 0.05
# Crossings in which starts in the tube have to be back, so much closer than elsewhere: next to a slow fade there is a direction
# in which they come back hardly at all. The first few starts tell most sets that do not attract.
BACK_WITHIN, CLOSER, FIRST = 1536, 0.5, 4
# Starts about a torus that are followed further. In chaos neighbours part by so much per return, and more.
FURTHER, PARTING = 8, 0.05
# Neighbours that close in on each other by so much per return are on a torus that is locked: on a cycle of many crossings.
LOCKED = -0.01
# On the way, motions that are on one torus have the same mean, but for so much of its extent, and come to where others were, to
# within so many distances between neighbours. A slow fade is a line of states: each motion is at a place of its own.
SAME_MEAN, NEAR_OTHERS, ROUNDING = 0.2, 8.0, 1e-7
# The largest speed in so many returns is the torus' amplitude if it has changed by no more than this share in so many returns,
# or in as many as starts about the torus took to come back, if these are more. Else the motions settle, each time for twice as
# long, so often at most: a set whose amplitude still drifts is not accepted. (What shrinks slowly beats more than it shrinks in
# a short time, and may seem to stand still; and the highest beats may be rare.)
PEAK_OVER, SETTLE_OVER, SETTLED, SETTLE_TIMES = 128, 384, 7.5e-4, 6


class Torus(NamedTuple):
    """A set of crossing states about which everything was seen to come back."""

    states: Float[np.ndarray, "k 2n"]  # weighted deviations
    radius: float  # of the tube from which all comes back, relative to the states' mean size; half of it captures
    amplitude: float  # m/s
    period: float  # mean time between crossings, s


def tori_from(
    maps: ReturnMaps,
    group: Int[np.ndarray, " m"],
    at: Section,
    cycles: list[list[Cycle]],
    tori: list[list[Torus]],
    report,
    tubes=TUBES,
) -> tuple[dict[int, Torus], list[tuple[int, Cycle]]]:
    """The tori that motions from these states are on, by row; and the cycles of locked ones, with their rows. `cycles` and
    `tori` are those known of each row's group. Of the `tubes` the first that attracts counts.
    """
    traced = _traced(maps, group, at, tori, max(TRACED, tubes[-1][1]))
    around = _traced_around(maps, group, traced)
    found: dict[int, Torus] = {}
    locked: list[tuple[int, Cycle]] = []
    # A tube that is wider says more, where everything in it comes back.
    for radius, count in tubes:
        # Where narrow tubes are tried, a locked motion has come so near to its cycle that its own states may do, too.
        own = [{row: traced[row] for row in around}] if len(tubes) > 1 else []
        for paths in (traced | around, *own):
            open_ = {row: path for row, path in paths.items() if row in traced}
            sets = [(row, path[:: max(len(path) // count, 1)]) for row, path in open_.items()]
            sets = [(row, states) for row, states in sets if not _holds_one_of(maps, states, cycles[row], radius)]
            if not sets:
                continue
            new, of_locked = _attracting(maps, group, sets, cycles, radius, report)
            found |= new
            locked += of_locked
            for row in {*new, *(row for row, _ in of_locked)}:
                del traced[row]
                around.pop(row, None)
    return found, locked


def reached(
    maps: ReturnMaps,
    group: Int[np.ndarray, " m"],
    at: Section,
    latest: Float[np.ndarray, "m 2n"],
    known: list[tuple[Int[np.ndarray, " r"], Torus]],
) -> dict[int, Torus]:
    """The tori that motions have come to, by row. `known` are tori, each with the rows that may have come to it; as for
    `captures.captured`, `latest` tells which to ask, and their next crossings decide.
    """
    near = []
    for rows, torus in known:
        width = (0.5 * torus.radius + KNOWN_TO) * tube.mean_size(torus.states)
        with np.errstate(invalid="ignore"):
            near.append(rows[nearest(maps.weights * latest[rows], torus.states) <= width])
    asked = np.unique(np.concatenate([np.zeros(0, int), *near]))
    if not len(asked):
        return {}
    _, paths = maps.path(group[asked], at.rows(asked), tube.HOME)
    found: dict[int, Torus] = {}
    for (_, torus), rows in zip(known, near, strict=True):
        open_ = np.array([row for row in rows if row not in found], int)
        if len(open_):
            ends = maps.weights * np.moveaxis(paths[np.searchsorted(asked, open_)], 1, 0)
            found |= dict.fromkeys(open_[_holds(torus, ends)].tolist(), torus)
    return found


def _holds(torus: Torus, ends: Float[np.ndarray, "h m 2n"]):
    """Which motions a torus has captured, by their weighted crossing states."""
    return tube.home(torus.states, ends, torus.radius)


def _traced(
    maps: ReturnMaps, group: Int[np.ndarray, " m"], at: Section, tori: list[list[Torus]], count: int
) -> dict[int, Float[np.ndarray, "_ 2n"]]:
    """At least so many weighted states of those motions, by row, that may be on a torus that is none of the known ones."""
    running, paths = np.arange(len(group)), np.zeros((len(group), 0, at.y.shape[1]))
    traced: dict[int, Float[np.ndarray, "_ 2n"]] = {}
    for length in range(AT_A_TIME, LONGER + 1, AT_A_TIME):
        if not len(running):
            break
        at, more = maps.path(group[running], at, AT_A_TIME)
        more *= maps.weights
        paths, left = np.concatenate([paths, more], axis=1), np.zeros(len(running), bool)
        for k, (row, path, now) in enumerate(zip(running, paths, more, strict=True)):
            if not _may_come_to_torus(now, tori[row]):
                continue
            if length >= count and _may_be_torus(path):
                traced[int(row)] = path
            else:
                left[k] = True
        running, at, paths = running[left], at.rows(left), paths[left]
    return traced


def _may_come_to_torus(path: Float[np.ndarray, "k 2n"], known: list[Torus]) -> bool:
    """Whether a motion may be on the way to a torus that is none of the `known` ones, as far as its latest states tell."""
    if not _goes_on(path):
        return False
    new = not any(_holds(torus, path[-tube.HOME :, None]).item() for torus in known)
    return new and abs(_growth(path)) <= np.log(CHANGES)


def _growth(path: Float[np.ndarray, "k 2n"]) -> float:
    """The logarithm of the growth of the extent of states from the first third of them to the last."""
    third = len(path) // 3
    with np.errstate(divide="ignore", invalid="ignore"):
        return float(np.log(extent(path[-third:]) / extent(path[:third])))


def _may_be_torus(path: Float[np.ndarray, "k 2n"]) -> bool:
    """Whether a motion neither drifts nor shrinks nor repeats, as far as its weighted states on the section tell."""
    return _goes_on(path) and not is_drifting(path)


def is_drifting(path: Float[np.ndarray, "k 2n"]) -> bool:
    """Whether the mean or the extent of weighted states on the section changes with time."""
    return drifts(path, DRIFT) or not abs(_growth(path)) <= SHRINKS


def _goes_on(path: Float[np.ndarray, "k 2n"]) -> bool:
    """Whether a motion goes on, and the last of its states is none of those up to `CROSSINGS` before."""
    if not np.all(np.isfinite(path)) or extent(path) <= ROUNDING * tube.mean_size(path):
        return False
    apart = np.linalg.norm(path[-1 - CROSSINGS : -1] - path[-1], axis=1)
    return bool(np.min(apart) > REPEATS * extent(path))


def _in_clusters(path: Float[np.ndarray, "k 2n"]) -> bool:
    """Whether states are in a few places of their curve, as those of a motion that repeats, or soon will."""
    states = path[:: len(path) // TUBES[0][1]]
    return bool(np.median(nearest(states, states, others=True)) <= CLUSTERED * 2 * np.pi * extent(states) / len(states))


def _traced_around(
    maps: ReturnMaps, group: Int[np.ndarray, " m"], traced: dict[int, Float[np.ndarray, "_ 2n"]]
) -> dict[int, Float[np.ndarray, "_ 2n"]]:
    """The states of motions about those that are in clusters."""
    rows = [row for row, path in traced.items() if _in_clusters(path)]
    if not rows:
        return {}
    own, at = _starts(maps, group[rows], [traced[row] for row in rows], tube.RADIUS)
    _, paths = maps.path(own, maps.returns(own, at, COME_AFTER).at, TRACED // tube.STARTS)
    states = (maps.weights * paths).reshape(len(rows), TRACED, -1)
    return {row: whole for row, whole in zip(rows, states, strict=True) if np.all(np.isfinite(whole))}


def _attracting(
    maps: ReturnMaps,
    groups: Int[np.ndarray, " g"],
    sets: list[tuple[int, Float[np.ndarray, "k 2n"]]],
    known: list[list[Cycle]],
    radius: float,
    report,
) -> tuple[dict[int, Torus], list[tuple[int, Cycle]]]:
    """Which of these sets, each with its row, are tori; and the cycles of those that are locked."""
    own = np.array([groups[row] for row, _ in sets])
    back, last, taken = _back(maps, own, [states for _, states in sets], radius, report)
    if not len(back):
        return {}, []
    chosen = (tube.STARTS * back[:, None] + np.arange(0, tube.STARTS, tube.STARTS // FURTHER)).ravel()
    group, at = own[chosen // tube.STARTS], last.rows(chosen)
    peak, at = _highest(maps, group, at)
    growth, period, later, path = parting_rates(maps, group, at)
    growth, period = (np.mean(part.reshape(-1, FURTHER), axis=1) for part in (growth, period))
    lasting = np.array([_on_one_torus(part) for part in path.reshape(-1, FURTHER, *path.shape[1:])])
    closing_in = np.flatnonzero(growth < LOCKED)
    cycles: list[tuple[int, Cycle]] = []
    locked: list[int] = []
    of_group = {int(groups[row]): known[row] for row, _ in sets}
    # One motion of each after the other, because most lead to the same cycle. What is no torus for sure has no better
    # attractor than a cycle with a narrow neighbourhood.
    for nominee, settled in (*((k, False) for k in range(0, FURTHER, FURTHER // NOMINATED)), (0, True)):
        left = closing_in[~np.isin(closing_in, locked)]
        asks = FURTHER * (left[~lasting[left]] if settled else left) + nominee
        if not len(asks):
            continue
        for _, rows, cycle in stable_cycles(maps, group[asks], later.rows(asks), of_group, MORE_CROSSINGS, settled):
            of_torus = asks[rows] // FURTHER
            cycles.append((sets[back[of_torus[0]]][0], cycle))
            locked += list(of_torus)
    with np.errstate(invalid="ignore"):
        kept = np.flatnonzero((growth < PARTING) & lasting & ~np.isin(np.arange(len(back)), locked))
    if not len(kept):
        return {}, cycles
    rows = _of_each(kept)
    peak = _settled_peak(maps, group[rows], later.rows(rows), peak[kept], taken[back[kept]])
    tori = {}
    for k, mean, highest in zip(kept, period[kept], peak, strict=True):
        row, states = sets[back[k]]
        if np.isfinite(mean) and np.isfinite(highest):
            tori[row] = Torus(states.copy(), radius, float(highest), float(mean))
    return tori, cycles


def _of_each(tori: Int[np.ndarray, " t"]) -> Int[np.ndarray, " s"]:
    """The places of the motions on each of these tori."""
    return (FURTHER * tori[:, None] + np.arange(FURTHER)).ravel()


def _holds_one_of(maps: ReturnMaps, states: Float[np.ndarray, "k 2n"], cycles: list[Cycle], radius: float) -> bool:
    """Whether a stable cycle lies in the inner half of the tube about a set: motions there may come to that instead."""
    return any(tube.home(states, maps.weights * cycle.points[:, None], radius).item() for cycle in cycles)


def _back(
    maps: ReturnMaps, group: Int[np.ndarray, " s"], sets: list[Float[np.ndarray, "k 2n"]], radius: float, report
) -> tuple[Int[np.ndarray, " t"], Section, Int[np.ndarray, " s"]]:
    """About which of the sets all starts come back; where the starts are then, set by set; and in how many crossings."""
    weights, count = maps.weights, tube.STARTS
    own, last = _starts(maps, group, sets, radius)
    back, ok, taken = np.zeros(len(own), bool), np.ones(len(sets), bool), np.zeros(len(sets), int)
    smallest = np.array([np.min(np.linalg.norm(states, axis=1)) for states in sets])
    place, of_set = np.arange(len(own)) % count, np.arange(len(own)) // count
    for among in (place < FIRST, place >= FIRST):
        running = np.flatnonzero(among & ok[of_set])
        for crossed in range(KEPT, BACK_WITHIN + 1, KEPT):
            if not len(running):
                break
            report(0)
            image = maps.returns(own[running], last.rows(running), KEPT)
            last.put(running, image.at)
            ends = weights * np.moveaxis(image.path, 1, 0)
            # One that fades, or fails, does not come back.
            with np.errstate(invalid="ignore"):
                lost = ~(np.linalg.norm(ends[-1], axis=1) > 0.5 * smallest[of_set[running]])
            ok[of_set[running[lost]]] = False
            for k in np.unique(of_set[running]):
                mine = of_set[running] == k
                back[running[mine]] = tube.home(sets[k], ends[-tube.HOME :, mine], CLOSER * radius)
            taken[of_set[running]] = np.maximum(taken[of_set[running]], crossed)
            running = running[ok[of_set[running]] & ~back[running]]
        ok[of_set[among & ~back]] = False
    return np.flatnonzero(ok), last, taken


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


def _highest(maps: ReturnMaps, group, at: Section) -> tuple[Float[np.ndarray, " t"], Section]:
    """The largest tangential speed (m/s) in the next `PEAK_OVER` returns of motions on tori, `FURTHER` on each; and where the
    motions are then.
    """
    highest, end = maps.peaks_and_ends(group, at, PEAK_OVER)
    return np.max(highest.reshape(-1, FURTHER), axis=1), end


def _settled_peak(
    maps: ReturnMaps, group, at: Section, before: Float[np.ndarray, " t"], over: Int[np.ndarray, " t"]
) -> Float[np.ndarray, " t"]:
    """The same once it has settled, from what it was `before`; not a number where it does not settle, each time `over` twice as
    many returns.
    """
    peak, last = np.full(len(before), np.nan), before.copy()
    over = np.maximum(over, SETTLE_OVER)
    running, further = np.arange(len(peak)), over - 2 * PARTING_OVER
    for _ in range(SETTLE_TIMES):
        going = running[further[running] > 0]
        rows = _of_each(going)
        if len(rows):
            at.put(rows, maps.returns(group[rows], at.rows(rows), np.repeat(further[going], FURTHER)).at)
        rows = _of_each(running)
        now, end = _highest(maps, group[rows], at.rows(rows))
        at.put(rows, end)
        done = np.abs(now / last[running] - 1) <= SETTLED
        peak[running[done]], last[running] = now[done], now
        running = running[~done & np.isfinite(now)]
        if not len(running):
            break
        over *= 2
        further = over
    return peak


def _starts(
    maps: ReturnMaps, group: Int[np.ndarray, " s"], sets: list[Float[np.ndarray, "_ 2n"]], radius: float
) -> tuple[Int[np.ndarray, " m"], Section]:
    """The starts about each of these sets, with their groups."""
    own = np.repeat(group, tube.STARTS)
    starts = [about(maps, states[:: len(states) // tube.STARTS] / maps.weights, radius) for states in sets]
    return own, section_at(np.concatenate(starts) / maps.weights, maps.normal, maps.sliding[own])


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
