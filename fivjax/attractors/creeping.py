"""Motions that creep along a line of states, taken further by leaps.

Near a Hopf point, past a fold, or about a cycle that attracts or repels weakly, all but one deviation decays soon, and the one
that is left changes by a millionth in each return. What the motion does is then read off its drift: it is moved on along it by
a small share of its size, is left to settle on the line again, and its drift is measured there.

**Why no cycle is leapt over.** With the drift $g(x)$ as a function of the place on the line, a cycle is a zero of $g$. At a
distance $a$ from the nearest one $|g'/g|$ is about $1/a$, or $2/a$ from the pair that is born in a fold. A leap is no longer
than `TRUSTED` times $|g/g'|$, by the drifts at the two latest places, so it covers a part of that distance; and it counts only
if the drift at its end has the same direction, nearly the same speed, and the same contact events.
"""

from collections.abc import Callable

import numpy as np
from jaxtyping import Bool, Float, Int

from ..section.return_maps import ReturnMaps, Section

# Returns over which a drift is measured; and in which a motion settles after a leap, at first and at most: what is left of
# other deviations is magnified by a leap, so the next drift shows whether that was long enough.
OVER, SETTLES, LONGEST = 48, 128, 4096
# A leap is this share of the motion's size at most, and the first one that; and the most leaps of a motion.
SHARE, FIRST, MOST = 0.05, 0.004, 1024
# Leaps of fewer drifts than this are not worthwhile: the motion is followed for so many returns, and so often at most.
LEAST, PLAIN, MOST_PLAIN = 4.0, 512, 48
# A leap over which the drift changes e-fold, by its two latest places, is too long: this part of it is trusted.
TRUSTED = 0.25
# Two drifts are alike if the cosine between them is this at least, and neither is longer than so many times the other.
ALIGNED, ALIKE = 0.95, 1.5
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
    share, settles, plainly = np.full(len(group), np.nan), np.full(len(group), SETTLES), np.zeros(len(group), int)
    rows, begun = np.arange(len(group)), _measured(maps, group, at)
    for _ in range(MOST):
        here, drift, taken, met, steady = begun
        length, size = np.linalg.norm(drift, axis=1), np.linalg.norm(maps.weights * here.y, axis=1)
        going = steady & (length > ROUNDING * size) & (plainly[rows] < MOST_PLAIN)
        rows, here, drift, taken, met = rows[going], here.rows(going), drift[going], taken[going], met[going]
        length, size = length[going], size[going]
        if not len(rows):
            break
        # The first leap is a short one, but worthwhile.
        first = np.clip(1.5 * LEAST * length / size, FIRST, SHARE)
        share[rows] = np.where(np.isnan(share[rows]), first, share[rows])
        times = share[rows] * size / length
        plain = times < LEAST
        times[plain] = 0.0
        leapt = here._replace(y=here.y + times[:, None] * drift / maps.weights)
        settled = maps.returns(group[rows], leapt, np.where(plain, PLAIN, settles[rows]))
        there = _measured(maps, group[rows], settled.at)
        with np.errstate(divide="ignore", invalid="ignore"):
            faster = np.linalg.norm(there[1], axis=1) / length
            longer = np.fmin(np.minimum(2 * share[rows], SHARE), TRUSTED * share[rows] / np.abs(np.log(faster)))
            # As long as the mean of what both drifts say.
            skipped = 0.5 * times * (1 + 1 / faster)
        kept = plain | (there[4] & _alike(drift, there[1]) & (there[3] == met))
        share[rows] = np.where(plain, np.nan, np.where(kept, longer, 0.5 * share[rows]))
        settles[rows] = np.where(kept, settles[rows], np.minimum(2 * settles[rows], LONGEST))
        plainly[rows] += plain
        done = rows[kept]
        creeps[done] = True
        last.put(done, there[0].rows(kept))
        time[done] += (np.where(plain, 0.0, skipped * taken) + settled.time + there[2])[kept]
        events[done] += (times * met).astype(int)[kept] + settled.events[kept] + there[3][kept]
        # From where they have got to; the others try a shorter leap.
        begun = _joined(there, (here, drift, taken, met, np.ones(len(rows), bool)), kept)
        left = ~kept
        if len(done):
            left[kept] = ~arrived(done, last.rows(done))
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
