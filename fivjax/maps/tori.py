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
from .captures import CROSSINGS, MORE_CROSSINGS, NOMINATED, Cycle, stable_cycles
from .parting import parting_rates
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
# The largest speed in the later half of the states is the torus' amplitude if that in the earlier half differs by no more than
# this share. Else the motion is followed further, for so many returns at most: a set whose amplitude still drifts is not
# accepted. (What shrinks slowly beats more than it shrinks in a short time, and may seem to stand still; and the highest beats
# may be rare.)
SETTLED, SETTLED_WITHIN = 7.5e-4, 24576
# Returns that starts about a torus take from the edge of the tube to the torus, once they are back.
COME_NEARER = 128


class Traced(NamedTuple):
    """What a motion that may be on a torus traces on the section."""

    states: Float[np.ndarray, "k 2n"]  # weighted deviations, in order
    amplitude: float  # m/s

    def thinned(self, count: int) -> "Traced":
        """With some `count` of the states."""
        return self._replace(states=self.states[:: max(len(self.states) // count, 1)])


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
            open_ = [(row, one.thinned(count)) for row, one in paths.items() if row in traced]
            sets = [(row, one) for row, one in open_ if not _holds_one_of(maps, one.states, cycles[row], radius)]
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
        width = (0.5 * torus.radius + maps.known_to) * tube.mean_size(torus.states)
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
) -> dict[int, Traced]:
    """At least so many states of those motions, by row, that may be on a torus that is none of the known ones."""
    running, paths, peaks = np.arange(len(group)), np.zeros((len(group), 0, at.y.shape[1])), np.zeros((len(group), 0))
    traced: dict[int, Traced] = {}
    for length in range(AT_A_TIME, SETTLED_WITHIN + 1, AT_A_TIME):
        if not len(running):
            break
        if length == AT_A_TIME:
            # Most are left out after this, and peaks take as long as the motion.
            at, more = maps.path(group[running], at, AT_A_TIME)
        else:
            at, more, highest = maps.path_and_peaks(group[running], at, AT_A_TIME)
            peaks = np.concatenate([peaks, highest[:, None]], axis=1)[:, -LONGER // AT_A_TIME :]
        more *= maps.weights
        paths = np.concatenate([paths, more], axis=1)[:, -LONGER:]
        left = np.zeros(len(running), bool)
        for k, (row, path, now) in enumerate(zip(running, paths, more, strict=True)):
            if not _may_come_to_torus(now, tori[row]):
                continue
            may_be = length >= count and _may_be_torus(path)
            if may_be and (amplitude := _settled(peaks[k])):
                traced[int(row)] = Traced(path, amplitude)
            else:
                left[k] = may_be or length < LONGER
        if length == LONGER and np.any(left):
            # What never settles is chaos, mostly.
            growth, *_ = parting_rates(maps, group[running[left]], at.rows(left))
            left[left] = growth < PARTING
        running, at, paths, peaks = running[left], at.rows(left), paths[left], peaks[left]
    return traced


def _settled(peaks: Float[np.ndarray, " k"]) -> float | None:
    """The largest of successive peaks (m/s), unless it differs much from half of them to the other."""
    earlier, later = np.max(peaks[: len(peaks) // 2]), np.max(peaks[len(peaks) // 2 :])
    return float(later) if abs(later / earlier - 1) <= SETTLED else None


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


def _traced_around(maps: ReturnMaps, group: Int[np.ndarray, " m"], traced: dict[int, Traced]) -> dict[int, Traced]:
    """The motions that are in clusters, with the states that others about them trace; their amplitudes are their own."""
    rows = [row for row, one in traced.items() if _in_clusters(one.states)]
    if not rows:
        return {}
    own, at = _starts(maps, group[rows], [traced[row].states for row in rows], tube.RADIUS)
    _, paths = maps.path(own, maps.returns(own, at, COME_AFTER).at, TRACED // tube.STARTS)
    states = (maps.weights * paths).reshape(len(rows), TRACED, -1)
    return {
        row: traced[row]._replace(states=whole)
        for row, whole in zip(rows, states, strict=True)
        if np.all(np.isfinite(whole))
    }


def _attracting(
    maps: ReturnMaps,
    groups: Int[np.ndarray, " g"],
    sets: list[tuple[int, Traced]],
    known: list[list[Cycle]],
    radius: float,
    report,
) -> tuple[dict[int, Torus], list[tuple[int, Cycle]]]:
    """Which of these sets, each with its row, are tori; and the cycles of those that are locked."""
    own = np.array([groups[row] for row, _ in sets])
    back, last = _back(maps, own, [one.states for _, one in sets], radius, report)
    if not len(back):
        return {}, []
    chosen = (tube.STARTS * back[:, None] + np.arange(0, tube.STARTS, tube.STARTS // FURTHER)).ravel()
    group = own[chosen // tube.STARTS]
    at = maps.returns(group, last.rows(chosen), COME_NEARER).at
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
    tori = {}
    for k in kept[np.isfinite(period[kept])]:
        row, one = sets[back[k]]
        tori[row] = Torus(one.states.copy(), radius, one.amplitude, float(period[k]))
    return tori, cycles


def _holds_one_of(maps: ReturnMaps, states: Float[np.ndarray, "k 2n"], cycles: list[Cycle], radius: float) -> bool:
    """Whether a stable cycle lies in the inner half of the tube about a set: motions there may come to that instead."""
    return any(tube.home(states, maps.weights * cycle.points[:, None], radius).item() for cycle in cycles)


def _back(
    maps: ReturnMaps, group: Int[np.ndarray, " s"], sets: list[Float[np.ndarray, "k 2n"]], radius: float, report
) -> tuple[Int[np.ndarray, " t"], Section]:
    """About which of the sets all starts come back; and where the starts are then, set by set."""
    weights, count = maps.weights, tube.STARTS
    own, last = _starts(maps, group, sets, radius)
    back, ok = np.zeros(len(own), bool), np.ones(len(sets), bool)
    smallest = np.array([np.min(np.linalg.norm(states, axis=1)) for states in sets])
    place, of_set = np.arange(len(own)) % count, np.arange(len(own)) // count
    for among in (place < FIRST, place >= FIRST):
        running = np.flatnonzero(among & ok[of_set])
        crossed = 0
        while crossed < BACK_WITHIN and len(running):
            report(0)
            # Most are back soon; the others are looked at in growing steps.
            further = min(max(KEPT, crossed // 2), BACK_WITHIN - crossed)
            crossed += further
            image = maps.returns(own[running], last.rows(running), further)
            last.put(running, image.at)
            ends = weights * np.moveaxis(image.path, 1, 0)
            # One that fades, or fails, does not come back.
            with np.errstate(invalid="ignore"):
                lost = ~(np.linalg.norm(ends[-1], axis=1) > 0.5 * smallest[of_set[running]])
            ok[of_set[running[lost]]] = False
            for k in np.unique(of_set[running]):
                mine = of_set[running] == k
                back[running[mine]] = tube.home(sets[k], ends[-tube.HOME :, mine], CLOSER * radius)
            running = running[ok[of_set[running]] & ~back[running]]
        ok[of_set[among & ~back]] = False
    return np.flatnonzero(ok), last


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
