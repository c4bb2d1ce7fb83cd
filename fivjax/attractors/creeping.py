"""Motions that creep along a line of states, taken further by leaps.

Near a Hopf point, past a fold, or about a cycle that attracts or repels weakly, all but one deviation decays soon, and the one
that is left changes by a millionth in each return. What the motion does is then read off its drift: it is moved on along it by
a small share of its size, is left to settle on the line again, and its drift is measured there. Between two places whose drifts
have one direction and nearly one speed, with the same contact events, there is no place at which it could stop.
"""

from collections.abc import Callable

import numpy as np
from jaxtyping import Bool, Float, Int

from ..section.return_maps import ReturnMaps, Section

# Returns over which a drift is measured; and in which a motion settles after a leap, at first and at most: a leap magnifies what
# is left of other deviations in a drift, so the next drift shows whether that was long enough.
OVER, SETTLES, LONGEST = 48, 128, 4096
# A leap is this share of the motion's size at most, and at least so many times the drift; and the most leaps of a motion.
SHARE, LEAST, MOST = 0.05, 4.0, 768
# Two drifts are alike if the cosine between them is this at least, and neither is longer than so many times the other.
ALIGNED, ALIKE = 0.95, 1.6
# A drift below this share of the size, in `OVER` returns, is rounding.
ROUNDING = 1e-11


def crept(
    maps: ReturnMaps,
    group: Int[np.ndarray, " m"],
    at: Section,
    arrived: Callable[[Int[np.ndarray, " r"], Section], Bool[np.ndarray, " r"]],
) -> tuple[Bool[np.ndarray, " m"], Section, Float[np.ndarray, " m"], Int[np.ndarray, " m"]]:
    """Which motions creep; and where they are, how much later (s), and after how many more contact events, when they have
    `arrived` (told by their rows and states), or creep no more.
    """
    last = Section(*(np.array(part) for part in at))
    time, events, creeps = np.zeros(len(group)), np.zeros(len(group), int), np.zeros(len(group), bool)
    rows, begun = np.arange(len(group)), _measured(maps, group, at)
    share, settles = np.full(len(group), SHARE), np.full(len(group), SETTLES)
    for _ in range(MOST):
        here, drift, taken, met, slow = begun
        lengths, size = np.linalg.norm(drift, axis=1), np.linalg.norm(maps.weights * here.y, axis=1)
        with np.errstate(divide="ignore", invalid="ignore"):
            times = share[rows] * size / lengths
            going = slow & (lengths > ROUNDING * size) & (times >= LEAST)
        rows, here, drift, taken, met = rows[going], here.rows(going), drift[going], taken[going], met[going]
        if not len(rows):
            break
        times = times[going]
        leapt = here._replace(y=here.y + times[:, None] * drift / maps.weights)
        settled = maps.returns(group[rows], leapt, settles[rows])
        there = _measured(maps, group[rows], settled.at)
        alike = there[4] & _alike(drift, there[1]) & (there[3] == met)
        share[rows] = np.where(alike, np.minimum(1.5 * share[rows], SHARE), 0.5 * share[rows])
        settles[rows] = np.where(alike, settles[rows], np.minimum(2 * settles[rows], LONGEST))
        with np.errstate(divide="ignore", invalid="ignore"):
            # As long as the mean of what both drifts say.
            times = 0.5 * times * (1 + lengths[going] / np.linalg.norm(there[1], axis=1))
        done = rows[alike]
        creeps[done] = True
        last.put(done, there[0].rows(alike))
        time[done] += (times * taken + settled.time + there[2])[alike]
        events[done] += (times * met).astype(int)[alike] + settled.events[alike] + there[3][alike]
        # From where they have got to; the others try a shorter leap.
        begun = _joined(there, (here, drift, taken, met, np.ones(len(rows), bool)), alike)
        left = ~alike
        if len(done):
            left[alike] = ~arrived(done, last.rows(done))
        rows, begun = rows[left], (begun[0].rows(left), *(part[left] for part in begun[1:]))
    return creeps, last, time, events


def _measured(maps: ReturnMaps, group, at: Section):
    """Where motions are after `2 * OVER` returns, their weighted drift in the latter `OVER`, how long that took (s), its
    contact events, and whether the drift is steady.
    """
    middle = maps.returns(group, at, OVER)
    end = maps.returns(group, middle.at, OVER)
    before, drift = (maps.weights * (after.y - earlier.y) for earlier, after in ((at, middle.at), (middle.at, end.at)))
    steady = _alike(before, drift) & (middle.events == end.events)
    return end.at, drift, end.time, end.events, steady


def _alike(one: Float[np.ndarray, "m 2n"], other: Float[np.ndarray, "m 2n"]) -> Bool[np.ndarray, " m"]:
    """Which drifts have one direction, and nearly one speed."""
    a, b = np.linalg.norm(one, axis=1), np.linalg.norm(other, axis=1)
    with np.errstate(invalid="ignore", divide="ignore"):
        return (np.sum(one * other, axis=1) >= ALIGNED * a * b) & (np.maximum(a / b, b / a) <= ALIKE)


def _joined(one, other, chosen: Bool[np.ndarray, " m"]):
    """The chosen rows of one measurement, and the rest of the other."""
    at = Section(*(np.where(_over(chosen, a), a, b) for a, b in zip(one[0], other[0], strict=True)))
    return at, *(np.where(_over(chosen, a), a, b) for a, b in zip(one[1:], other[1:], strict=True))


def _over(chosen: Bool[np.ndarray, " m"], like: np.ndarray) -> np.ndarray:
    return chosen.reshape(-1, *[1] * (np.ndim(like) - 1))
