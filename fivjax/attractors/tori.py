"""Tori of many groups: the sets that long motions trace on the section, whether these attract, whether neighbours part on them,
and how high they go.

A set counts as a torus by these checks, each with its tolerance beside it: the motion goes on and repeats nothing
(`goes_on`), drifts no more (`is_drifting`), and its amplitude has settled (`_settled_amplitude`); whatever starts on the
edge of a tube about the set comes back (`returning`); and motions that start there go about the same set without
parting (`_attracting_tubes`, `_on_one_torus`), also along the whole of what was traced (`_chaotic`).
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from ..section.return_maps import ReturnMaps
from . import tube
from .cycles import (
    AT_FIRST,
    CROSSINGS,
    MORE_CROSSINGS,
    MOST_CROSSINGS,
    Recurrence,
    StableCycle,
    close_recurring,
    points_on,
    stable_cycles,
)
from .divergence import diverges_along, growth_rates
from .locked_tori import cycles_closed_in_on, cycles_repeated
from .motions import NOMINATED, Motions, extent, position_of, smooth_mean
from .returning import BACK_TO, starts_on_edges, tubes_returned_to
from .tube import Tube, thin, tree_of

# Radii of the tube about a set that is tried as a torus, each with the number of its states: the narrower, the more are needed.
TUBES = ((tube.RADIUS, 512), (tube.RADIUS / 4, 2048), (tube.RADIUS / 16, 4096))
# States on the section in a row that make the set: so many, and twice as many of a motion that beats slowly. Near a resonance
# beats are so slow that it takes more states to tell them from a drift.
TRACED, LONGER, LONGEST = 2048, 4096, 12288
# So many states at a time: after each, motions that have come to a torus that is known are left out.
AT_A_TIME = 512
# An attractor this near to a tube, in its radii, may draw motions out of it.
NEAR = 1.5
# In chaos neighbours part by so much per return, and more.
CHAOTIC_FROM = 0.05
# Motions whose extent, or whose distance from others, is below this share of their size differ by rounding only.
ROUNDING = 1e-7


class Traced(NamedTuple):
    """What a motion that may be on a torus traces on the section."""

    states: Float[np.ndarray, "k 2n"]  # weighted deviations, in order
    amplitude: float  # m/s
    period: float  # mean time between crossings, s


class Torus(NamedTuple):
    """A set of crossing states about which everything was seen to come back."""

    tube: Tube  # about weighted deviations; all comes back from its edge, and half of it captures
    amplitude: float  # m/s
    period: float  # mean time between crossings, s

    @property
    def reach(self) -> float:
        """How far what it captures may be, relative to its size."""
        return self.tube.radius / 2

    @property
    def contraction(self) -> float:
        """The share of the tube to which everything came back that started on its edge."""
        return BACK_TO

    @property
    def position(self) -> float:
        """See `position_of`."""
        return position_of(self.tube.states)


def tori_from(
    maps: ReturnMaps,
    motions: Motions,
    cycles: list[list[StableCycle]],
    tori: list[list[Torus]],
    report,
    tubes=TUBES,
) -> tuple[dict[int, Torus], list[tuple[int, StableCycle, Tube | None]]]:
    """The tori that these motions are on, by row; and the cycles of locked ones, with their rows, and with the torus' tube
    where that captures. `cycles` and `tori` are those known of each row's group. Of the `tubes` the first that attracts counts.
    """
    group = motions.group
    traced = _trace(maps, motions, tori, max(TRACED, tubes[-1][1]))
    found: dict[int, Torus] = {}
    locked: list[tuple[int, StableCycle, Tube | None]] = []
    for row, cycle in cycles_repeated(maps, group, _states_of(traced), cycles):
        locked.append((row, cycle, None))
        del traced[row]
    around = _trace_around(maps, group, traced)
    # A tube that is wider says more, where everything in it comes back.
    for radius, count in tubes:
        # Where narrow tubes are tried, a locked motion has come so near to its cycle that its own states may do, too.
        own = [{row: traced[row] for row in around}] if len(tubes) > 1 else []
        for paths in (traced | around, *own):
            tried = [(row, Tube(thin(paths[row].states, count).copy(), radius)) for row in paths if row in traced]
            tried = [(row, one) for row, one in tried if not contains_cycle(maps, one, cycles[row])]
            if not tried:
                continue
            new, of_locked = _attracting_tubes(maps, group, tried, cycles, report)
            for row in around_stable_cycles(maps, group, {row: traced[row].states for row in new}, new):
                del new[row]
            for row in _chaotic(maps, group, traced, new):
                del new[row], traced[row]
                around.pop(row, None)
            found |= {row: Torus(one, traced[row].amplitude, traced[row].period) for row, one in new.items()}
            locked += [(row, cycle, None) for row, cycle in of_locked]
            for row, cycle in cycles_closed_in_on(maps, group, _states_of({row: traced[row] for row in new}), cycles):
                del found[row]
                locked.append((row, cycle, new[row]))
            for row in {*new, *(row for row, _ in of_locked)}:
                del traced[row]
                around.pop(row, None)
    return found, locked


def _states_of(traced: dict[int, Traced]) -> dict[int, Float[np.ndarray, "k 2n"]]:
    return {row: one.states for row, one in traced.items()}


def _trace(maps: ReturnMaps, motions: Motions, tori: list[list[Torus]], count: int) -> dict[int, Traced]:
    """At least so many states of those motions, by row, that may be on a torus that is none of the known ones."""
    group, at = motions
    running, paths = np.arange(len(group)), np.zeros((len(group), 0, at.y.shape[1]))
    peaks, times = np.zeros((2, len(group), 0))
    traced: dict[int, Traced] = {}
    # A set whose amplitude still drifts in the end is not accepted.
    for length in range(AT_A_TIME, 24576 + 1, AT_A_TIME):
        if not len(running):
            break
        if length == AT_A_TIME:
            # Most are left out after this, and peaks take as long as the motion.
            at, more = maps.path(group[running], at, AT_A_TIME)
        else:
            at, _, _, taken, more, highest = maps.returns(group[running], at, AT_A_TIME, AT_A_TIME, peaks=True)
            peaks, times = (
                np.concatenate([earlier, latest[:, None]], axis=1)[:, -kept // AT_A_TIME :]
                for earlier, latest, kept in ((peaks, highest, LONGER), (times, taken, LONGEST))
            )
        more *= maps.weights
        paths = np.concatenate([paths, more], axis=1)[:, -LONGEST:]
        ends = np.moveaxis(more, 1, 0)
        # An extent that changes so much is that of a motion on the way to a cycle.
        left = goes_on(ends) & (np.abs(_growth(ends)) <= np.log(1.5)) & maps.moves(group[running], at.y)
        for k in np.flatnonzero(left):
            left[k] = not any(
                one.tube.holds_all(ends[-tube.RETURNS_INSIDE :, k : k + 1]).item() for one in tori[running[k]]
            )
        if length >= count:
            whole = np.moveaxis(paths[:, -LONGER:], 1, 0)
            drifting = is_drifting(whole) & is_drifting(np.moveaxis(paths, 1, 0))
            left &= goes_on(whole)
            for k in np.flatnonzero(left):
                amplitude = _settled_amplitude(peaks[k])
                settled = amplitude is not None and (length >= LONGEST or _is_settled(times[k]))
                if settled and not drifting[k]:
                    traced[int(running[k])] = Traced(
                        paths[k, -LONGER:].copy(), amplitude, float(np.mean(times[k])) / AT_A_TIME
                    )
                    left[k] = False
                left[k] &= length < LONGER or (not drifting[k] if amplitude is None else length < LONGEST)
        if length == LONGER and np.any(left):
            # What never settles is chaos, mostly.
            growth, *_ = growth_rates(maps, Motions(group[running[left]], at.rows(left)))
            left[left] = growth < CHAOTIC_FROM
        running, at, paths, peaks, times = running[left], at.rows(left), paths[left], peaks[left], times[left]
    return traced


def _settled_amplitude(peaks: Float[np.ndarray, " k"]) -> float | None:
    """The largest of the later half of successive peaks (m/s): the amplitude, if that of the earlier half differs little. What
    shrinks slowly beats more than it shrinks in a short time, and may seem to stand still; and the highest beats may be rare.
    """
    earlier, later = np.max(peaks[: len(peaks) // 2]), np.max(peaks[len(peaks) // 2 :])
    return float(later) if abs(later / earlier - 1) <= 7.5e-4 else None


def _is_settled(times: Float[np.ndarray, " k"]) -> bool:
    """Whether successive times of equally many returns have settled to their mean: slow beats may be of different lengths."""
    earlier, later = np.mean(times[: len(times) // 2]), np.mean(times[len(times) // 2 :])
    return bool(abs(later / earlier - 1) <= 5e-4)


def _growth(paths: Float[np.ndarray, "k *m 2n"]) -> Float[np.ndarray, "*m"]:
    """The logarithm of the growth of the extent of states from the first third of them to the last."""
    third = len(paths) // 3
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.log(extent(paths[-third:]) / extent(paths[:third]))


def is_drifting(paths: Float[np.ndarray, "k *m 2n"]) -> Bool[np.ndarray, "*m"]:
    """Whether the mean or the extent of weighted states on the section changes with time: by more than these shares of the
    extent. A fade that takes thousands of periods traces a set, too, and starts further in are home while they pass it.
    """
    third = len(paths) // 3
    with np.errstate(invalid="ignore"):
        early, late = (smooth_mean(part) for part in (paths[:third], paths[-third:]))
        moved = np.linalg.norm(late - early, axis=-1) > 5e-3 * extent(paths)
        return moved | ~(np.abs(_growth(paths)) <= 0.05)


def goes_on(paths: Float[np.ndarray, "k *m 2n"]) -> Bool[np.ndarray, "*m"]:
    """Whether a motion goes on without repeating itself, by its weighted states on the section: the last is none of the
    `CROSSINGS` before it, or the motion is on a cycle. One that is locked weakly to a cycle of more is better taken as on a
    torus.
    """
    with np.errstate(invalid="ignore"):
        width = extent(paths)
        moving = width > ROUNDING * np.mean(np.linalg.norm(paths, axis=-1), axis=0)
        apart = np.linalg.norm(paths[-1 - CROSSINGS : -1] - paths[-1], axis=-1)
        return moving & (np.min(apart, axis=0) > 1e-5 * width)


def _in_clusters(path: Float[np.ndarray, "k 2n"]) -> bool:
    """Whether states are in a few places of their curve, as those of a motion that repeats, or soon will: distances between
    neighbours are mostly smaller than this share of those of states that are spread over a curve.
    """
    states = thin(path, TUBES[0][1])
    return bool(np.median(_spacing(states)) <= 0.05 * 2 * np.pi * extent(states) / len(states))


def _spacing(states: Float[np.ndarray, "k 2n"]) -> Float[np.ndarray, " k"]:
    """The distance of each state to the nearest of the others."""
    return tree_of(states).query(states, k=2)[0][:, 1]


def _trace_around(maps: ReturnMaps, group: Int[np.ndarray, " m"], traced: dict[int, Traced]) -> dict[int, Traced]:
    """The motions that are in clusters, with the states that others about them trace once they have come to the torus; their
    amplitudes are their own.
    """
    rows = [row for row, one in traced.items() if _in_clusters(one.states)]
    if not rows:
        return {}
    own, about = np.repeat(group[rows], tube.STARTS), [Tube(traced[row].states, tube.RADIUS) for row in rows]
    at = starts_on_edges(maps, group[rows], about)
    _, paths = maps.path(own, maps.returns(own, at, 48).at, TRACED // tube.STARTS)
    states = (maps.weights * paths).reshape(len(rows), TRACED, -1)
    return {
        row: traced[row]._replace(states=whole)
        for row, whole in zip(rows, states, strict=True)
        if np.all(np.isfinite(whole))
    }


def _attracting_tubes(
    maps: ReturnMaps,
    groups: Int[np.ndarray, " g"],
    tubes: list[tuple[int, Tube]],
    known: list[list[StableCycle]],
    report,
) -> tuple[dict[int, Tube], list[tuple[int, StableCycle]]]:
    """Which of these tubes, each with its row, are about tori; and the cycles of tori that are locked."""
    own, each = np.array([groups[row] for row, _ in tubes]), [one for _, one in tubes]
    back, last = tubes_returned_to(maps, own, each, starts_on_edges(maps, own, each), report)
    if not len(back):
        return {}, []
    # So many of the starts are followed further: first from the edge of the tube to the torus.
    further = 4
    chosen = (tube.STARTS * back[:, None] + np.arange(0, tube.STARTS, tube.STARTS // further)).ravel()
    group = own[chosen // tube.STARTS]
    at = maps.returns(group, last.rows(chosen), 128).at
    growth, later, path = growth_rates(maps, Motions(group, at))
    growth = np.mean(growth.reshape(-1, further), axis=1)
    lasting = np.array([_on_one_torus(part) for part in path.reshape(-1, further, *path.shape[1:])])
    # Neighbours that close in by so much per return are on a torus that is locked: on a cycle of many crossings.
    closing_in = np.flatnonzero(growth < -0.01)
    cycles: list[tuple[int, StableCycle]] = []
    locked: list[int] = []
    of_group = {int(groups[row]): known[row] for row, _ in tubes}
    # One motion of each after the other, because most lead to the same cycle. Only then a cycle of many crossings, or with a
    # narrow neighbourhood.
    nominees = ((k, Recurrence(MORE_CROSSINGS)) for k in range(0, further, further // NOMINATED))
    for nominee, recurrence in (*nominees, (0, Recurrence(MOST_CROSSINGS, settled=True))):
        left = closing_in[~np.isin(closing_in, locked)]
        asks = further * left + nominee
        if not len(asks):
            continue
        at = later.rows(asks)
        if recurrence.settled:
            at = maps.returns(group[asks], at, 2048).at
        for _, rows, cycle in stable_cycles(maps, Motions(group[asks], at), of_group, recurrence):
            of_torus = asks[rows] // further
            cycles.append((tubes[back[of_torus[0]]][0], cycle))
            locked += list(of_torus)
    with np.errstate(invalid="ignore"):
        kept = np.flatnonzero((growth < CHAOTIC_FROM) & lasting & ~np.isin(np.arange(len(back)), locked))
    return dict(tubes[back[k]] for k in kept), cycles


def around_stable_cycles(
    maps: ReturnMaps,
    group: Int[np.ndarray, " m"],
    traced: dict[int, Float[np.ndarray, "k 2n"]],
    tubes: dict[int, Tube],
) -> list[int]:
    """The rows of tubes that have a stable cycle amid the closed curves which their motions trace, by these states in order:
    that from which a torus has come, where it is stable again, or still. No start on a tube's edge need come to it.
    """
    rows = list(tubes)
    if not rows:
        return []
    middles = [(row, one) for row in rows for one in _middles(traced[row])]
    rows, own = [row for row, _ in middles], np.array([group[row] for row, _ in middles])
    states = np.array([one for _, one in middles]) / maps.weights
    at = maps.with_modes(own, states)
    found = set()
    # By Newton's method, which may lead astray from there; and from where motions lead.
    for returns, recurrence in ((0, AT_FIRST), (128, Recurrence(nearly=0.01))):
        at = maps.returns(own, at, returns).at if returns else at
        near, closed = close_recurring(maps, Motions(own, at), recurrence)
        stable = np.max(np.abs(np.linalg.eigvals(closed.jacobian)), axis=1) < 1
        for k, attracts, y in zip(near, stable, points_on(maps, own[near], closed), strict=True):
            if attracts and np.all(tubes[rows[k]].holds(maps.weights * y, NEAR)):
                found.add(rows[k])
    return sorted(found)


def _chaotic(
    maps: ReturnMaps, group: Int[np.ndarray, " m"], traced: dict[int, Traced], tubes: dict[int, Tube]
) -> list[int]:
    """The rows of tubes that are about a motion from which neighbours part exponentially."""
    rows = list(tubes)
    if not rows:
        return []
    # As many of each, so that no answer depends on which others are asked.
    paths = np.array([traced[row].states[-TRACED:] for row in rows])
    return [row for row, parts in zip(rows, diverges_along(maps, group[rows], paths), strict=True) if parts]


def _middles(states: Float[np.ndarray, "k 2n"]) -> list[Float[np.ndarray, " 2n"]]:
    """Middles of the closed curves about which states in order go by turns: of one curve for each number of them at which they
    are smaller than at all lower numbers. Near a resonance a curve is made of several, smaller ones.
    """
    found, smallest = [], np.inf
    for count in range(1, CROSSINGS + 1):
        turns = states[: len(states) // count * count].reshape(-1, count, states.shape[-1])
        spread = np.sqrt(np.mean(extent(turns) ** 2))
        if spread < 0.9 * smallest:
            found.append(smooth_mean(turns[:, 0]))
            smallest = spread
    return found


def contains_cycle(maps: ReturnMaps, one: Tube, cycles: list[StableCycle]) -> bool:
    """Whether a stable cycle lies in a tube, or next to it: motions in its inner half may come to that instead."""
    return any(np.all(one.holds(maps.weights * cycle.points, NEAR)) for cycle in cycles)


def _on_one_torus(paths: Float[np.ndarray, "m k 2n"]) -> bool:
    """Whether motions, by their weighted states on the section in order, go about the same set again and again: they have the
    same mean, but for so much of its extent, and come to where others were, to within so many distances between neighbours. A
    slow fade is a line of states: each motion is at a place of its own.
    """
    if not np.all(np.isfinite(paths)):
        return False
    whole = paths.reshape(-1, paths.shape[-1])
    means = smooth_mean(np.moveaxis(paths, 1, 0))
    apart = np.linalg.norm(means - np.mean(means, axis=0), axis=1)
    third = paths.shape[1] // 3
    early = paths[:, :third].reshape(-1, paths.shape[-1])
    late = paths[:, -third:]
    steps = [np.median(_spacing(part)) for part in late]
    missed = np.median(tree_of(early).query(late)[0], axis=1)
    rounding = ROUNDING * tube.mean_size(whole)
    return bool(np.max(apart) <= 0.2 * extent(whole) and np.all(missed <= 8.0 * np.array(steps) + rounding))
