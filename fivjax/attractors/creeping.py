r"""Motions that creep along a line of states, taken further by leaps.

Near a Hopf point, past a fold, or about a cycle that attracts or repels weakly, all but one deviation decays soon, and the one
that is left changes by a millionth in each return. What the motion does is then read off its drift: it is moved on along it by
a small share of its size, is left to settle on the line again, and its drift is measured there.

**Why no cycle is leapt over.** With the drift $g(x)$ as a function of the place on the line, a cycle is a zero of $g$. At a
distance $a$ from the nearest one $|g'/g|$ is about $1/a$, or $2/a$ from the pair that is born in a fold. No leap, the first
one included, is longer than `TRUSTED` times $|g/g'|$, by the drifts at the two latest places (of the first, at both ends of the
drift itself), so it covers a part of that distance; and it counts only if the drift at its end has the same direction, nearly
the same speed, and the same contact events.

**Growth and decay about the equilibrium.** A motion without events that does nothing but grow, or decay, leaps in proportion to
its size: from rounding to its first event there are thirty e-folds. What is said above then holds of $\ln x$ and of the rate
$g/x$. That depends on the size by its powers, $γ_0 + γ_2 x^2 + γ_4 x^4 + …$: it changes the faster, the larger $x$ is, which
`POWER` allows for.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from ..section.return_maps import ReturnMaps, Section
from .motions import Motions

# Returns over which a drift is measured.
DRIFT_RETURNS = 48
# The longest leaps of motions that grow about the equilibrium, or decay to it, in e-folds. Those that decay soon slide for
# ever, and are asked after each leap.
LONGEST_GROWTH, LONGEST_DECAY = np.log(4.0), 0.2
# A rate of growth changes with size no faster than this power of it.
POWER = 4.0
# A leap over which the drift changes e-fold, by its two latest places, is too long: this part of it is trusted.
TRUSTED = 0.25


class _Drift(NamedTuple):
    """How motions drift over `DRIFT_RETURNS` returns."""

    at: Section  # where they are at the end
    way: Float[np.ndarray, "m 2n"]  # weighted
    time: Float[np.ndarray, " m"]  # that it took, s
    events: Int[np.ndarray, " m"]  # contact events on it
    passed: Float[np.ndarray, " m"]  # the time of these and of as many returns before, s
    changes: Int[np.ndarray, " m"]  # and how often a contact's status changed on them
    steady: Bool[np.ndarray, " m"]  # whether the drift was the same before
    change: Float[np.ndarray, " m"]  # of its logarithm since then, or of that of the growth below
    growth: Float[np.ndarray, " m"]  # the logarithm of that of the motions' size
    grows: Bool[np.ndarray, " m"]  # which are without events and do nothing but grow, or decay

    def rows(self, chosen) -> "_Drift":
        return _Drift(self.at.rows(chosen), *(part[chosen] for part in self[1:]))

    def put(self, chosen, rows: "_Drift") -> None:
        """Write these rows at the chosen indices."""
        self.at.put(chosen, rows.at)
        for whole, part in zip(self[1:], rows[1:], strict=True):
            whole[chosen] = part


def creep(
    maps: ReturnMaps,
    motions: Motions,
    arrived: Callable[[Int[np.ndarray, " r"], Section], Bool[np.ndarray, " r"]],
) -> tuple[Bool[np.ndarray, " m"], Section, Float[np.ndarray, " m"], Int[np.ndarray, " m"]]:
    """Which motions creep; and where these are, how much later (s), and after how many more changes of a contact's status, when
    they have `arrived` (told by their rows and states), or creep no more.
    """
    # A leap is this share of the motion's size at most.
    longest_leap = 0.05
    # After a leap the other deviations are no larger beside the drift than before, so that the motion settles so many times
    # sooner.
    sooner = 8
    # Leaps of fewer drifts than this are not worthwhile: the motion is followed for some returns instead.
    least_drifts = 4.0
    group, at = motions
    last = Section(*(np.array(part) for part in at))
    creeps = np.zeros(len(group), bool)
    share, settles, plainly = np.full(len(group), np.nan), np.full(len(group), 128), np.zeros(len(group), int)
    rows, here = np.arange(len(group)), _measure_drift(maps, motions)
    time, changes = here.passed.copy(), here.changes.copy()
    for _ in range(1024):
        length, size = np.linalg.norm(here.way, axis=1), np.linalg.norm(maps.weights * here.at.y, axis=1)
        # What has faded is of interest only if it grows again.
        lasts = maps.moves(group[rows], here.at.y) | (here.grows & (here.growth > 0))
        # A shorter drift is rounding.
        going = here.steady & (length > 1e-11 * size) & (plainly[rows] < 48) & lasts
        rows, here, length, size = rows[going], here.rows(going), length[going], size[going]
        if not len(rows):
            break
        grows = here.grows
        longest = np.where(grows, np.where(here.growth > 0, LONGEST_GROWTH, LONGEST_DECAY), longest_leap)
        # The first leap is a short one, but worthwhile, and trusted by how the drift has changed on its own way.
        first = np.clip(1.5 * least_drifts * length / size, 0.004, longest_leap)
        first = np.minimum(first, _trusted(length / size, here.change, grows))
        share[rows] = np.where(np.isnan(share[rows]), first, np.minimum(share[rows], longest))
        times = share[rows] * size / length
        plain = times < least_drifts
        times[plain] = 0.0
        along = times[:, None] * here.way / maps.weights
        moved = np.where(grows[:, None], here.at.y * np.expm1(times * here.growth)[:, None], along)
        leapt = here.at._replace(y=here.at.y + moved)
        waits = np.where(grows, settles[rows] // sooner, settles[rows])
        settled = maps.returns(group[rows], leapt, np.where(plain, 512, waits))
        there = _measure_drift(maps, Motions(group[rows], settled.at))
        with np.errstate(divide="ignore", invalid="ignore"):
            faster = np.where(grows, there.growth / here.growth, np.linalg.norm(there.way, axis=1) / length)
            change = np.abs(np.log(faster))
            longer = np.fmin(np.minimum(2 * share[rows], longest), _trusted(share[rows], change, grows))
            # As long as the mean of what both drifts say.
            skipped = 0.5 * times * (1 + 1 / faster)
        alike = np.where(grows, there.grows & (change <= np.log(1.5)), _alike(here.way, there.way))
        # Nor has it come back to the line after something else.
        expected = here.events * (waits / DRIFT_RETURNS)
        alike &= np.abs(settled.events - expected) <= np.where(grows, 0.0, 2 + 0.05 * expected)
        kept = plain | (there.steady & alike & (there.events == here.events))
        share[rows] = np.where(plain, np.nan, np.where(kept, longer, 0.5 * share[rows]))
        # What is left of other deviations is magnified by a leap, so the next drift shows whether the motion has settled.
        settles[rows] = np.where(kept, settles[rows], np.minimum(2 * settles[rows], 4096))
        plainly[rows] += plain
        done = rows[kept]
        creeps[done] = True
        last.put(done, there.at.rows(kept))
        time[done] += (np.where(plain, 0.0, skipped * here.time) + settled.time + there.passed)[kept]
        # As many in each return of a leap as in those before it.
        leapt_over = (0.5 * times * here.changes).astype(int)
        changes[done] += (leapt_over + settled.changes + there.changes)[kept]
        # From where they have got to; the others try a shorter leap.
        there.put(~kept, here.rows(~kept))
        left = ~kept
        if len(done):
            left[kept] = ~arrived(done, last.rows(done))
        rows, here = rows[left], there.rows(left)
    return creeps, last, time, changes


def _measure_drift(maps: ReturnMaps, motions: Motions) -> _Drift:
    """How motions drift in the latter half of `2 * DRIFT_RETURNS` returns."""
    group, at = motions
    middle = maps.returns(group, at, DRIFT_RETURNS)
    end = maps.returns(group, middle.at, DRIFT_RETURNS)
    before, way = (maps.weights * (after.y - earlier.y) for earlier, after in ((at, middle.at), (middle.at, end.at)))
    steady = _alike(before, way) & (middle.events == end.events)
    passed, changes = middle.time + end.time, middle.changes + end.changes
    growth, straight = _growth(maps.weights * end.at.y, way)
    grows = straight & (end.events == 0)
    with np.errstate(invalid="ignore", divide="ignore"):
        earlier, _ = _growth(maps.weights * middle.at.y, before)
        faster = np.where(grows, growth / earlier, np.linalg.norm(way, axis=1) / np.linalg.norm(before, axis=1))
        # What is no number is not to be trusted at all.
        change = np.nan_to_num(np.abs(np.log(faster)), nan=np.inf)
    return _Drift(end.at, way, end.time, end.events, passed, changes, steady, change, growth, grows)


def _trusted(share: Float[np.ndarray, " m"], change: Float[np.ndarray, " m"], grows: Bool[np.ndarray, " m"]):
    """How long the next leaps may be, if the logarithm of the drift, or of the growth, changed so much over the latest ones."""
    with np.errstate(divide="ignore"):
        by_distance = TRUSTED * share / change
        by_power = np.log1p(-TRUSTED * np.expm1(-POWER * share) / change) / POWER
    return np.where(grows, np.minimum(by_distance, by_power), by_distance)


def _growth(
    end: Float[np.ndarray, "m 2n"], way: Float[np.ndarray, "m 2n"]
) -> tuple[Float[np.ndarray, " m"], Bool[np.ndarray, " m"]]:
    """The logarithm of the growth of states on these ways to their ends, and which of the ways go straight out, or in."""
    with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
        start, along = np.sum((end - way) ** 2, axis=1), np.sum(end * way, axis=1)
        straight = np.abs(along) >= 0.99 * np.linalg.norm(end, axis=1) * np.linalg.norm(way, axis=1)
        return 0.5 * np.log1p((2 * along - np.sum(way**2, axis=1)) / start), straight


def _alike(one: Float[np.ndarray, "m 2n"], other: Float[np.ndarray, "m 2n"]) -> Bool[np.ndarray, " m"]:
    """Which drifts have one direction (by the cosine between them), and nearly one speed."""
    a, b = np.linalg.norm(one, axis=1), np.linalg.norm(other, axis=1)
    with np.errstate(invalid="ignore", divide="ignore"):
        return (np.sum(one * other, axis=1) >= 0.95 * a * b) & (np.maximum(a / b, b / a) <= 1.5)
