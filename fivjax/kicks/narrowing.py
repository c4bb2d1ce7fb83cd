"""Brackets of critical kicks: the scan of a range of kicks, and brackets that are narrowed, by verdicts of trajectories."""

import math
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from ..foundation import arguments
from ..maps.crossing import FirstCrossing, first_crossings, with_ends
from ..maps.engine import RunOptions, run_to_verdict
from ..maps.groups import Limits
from ..maps.plan import TrajectoryList
from ..maps.results import Verdicts
from ..model.scene import Scene
from ..steppers.base import AbstractStepper
from ..verdicts.verdict import Verdict

AT_ENDS = (Verdict.SLIDING, Verdict.LIMIT_CYCLE)
# The steps of a scan, unless given.
P_STEP = 0.01


def checked_range(p_range, p_step: float | None) -> tuple[float, float, float, int]:
    """The ends of the range of p, the steps of its scan, and how many kicks there are in it."""
    low, high = arguments.pair("p_range", p_range, "(1.0, 5.0)", minimum=0)
    if p_step is None:
        p_step = min(P_STEP, high - low)
    arguments.real_number("p_step", p_step, above=0, maximum=high - low)
    # The last step is no longer than the others; by rounding alone there is none more.
    return low, high, p_step, math.ceil(min((high - low) / p_step, 1e15) * (1 - 1e-6)) + 1


class Kicked(NamedTuple):
    """Scenes of which each is kicked with several p, and how their trajectories are followed."""

    scene: Scene
    columns: dict[str, Float[np.ndarray, " r"]]  # values of the parameters in which the scenes differ, by name
    method: AbstractStepper
    limits: Limits
    options: RunOptions
    known: dict  # attractors of the scenes, which are the same in the scan and in all later runs

    def only(self, rows: Int[np.ndarray, " s"] | Bool[np.ndarray, " r"]) -> "Kicked":
        """These of the scenes."""
        return self._replace(columns={name: column[rows] for name, column in self.columns.items()})

    def run(self, p: Float[np.ndarray, "r kicks"], label: str) -> Verdicts:
        """What becomes of each scene at its own values of p, one kick after the other."""
        values = {name: np.repeat(column, p.shape[1]) for name, column in self.columns.items()}
        trajectories, options = TrajectoryList({**values, "p": p.ravel()}), self.options._replace(label=label)
        return run_to_verdict(self.scene, trajectories, self.method, self.limits, options, attractors=self.known)

    def verdicts(self, p: Float[np.ndarray, "r kicks"], label: str) -> Int[np.ndarray, "r kicks"]:
        """The verdicts on each scene at its own values of p."""
        return self.run(p, label).verdict.reshape(p.shape)

    def narrowed(
        self,
        brackets: Float[np.ndarray, "r 2"],
        at_ends: Int[np.ndarray, "r 2"],
        tolerance: float,
        rounds: int | None = None,
    ) -> tuple[FirstCrossing, Bool[np.ndarray, " r"]]:
        """The crossings inside brackets, narrowed to the tolerance, or to where undecided trajectories stop the narrowing; in
        so many `rounds` at most.

        The first ends of each bracket are run again, so that both ends of the returned crossing are verdicts of trajectories
        from the narrowing. Second result: which rows have a verdict that contradicts `at_ends`. Of two different verdicts on
        the same kick one is false, so no crossing is stated there.
        """
        # Points inside a bracket that are tried at once: with more points there are fewer rounds, and rounds take the time.
        points_per_round = 15
        nothing = np.full(len(brackets), np.nan)
        found = FirstCrossing(nothing, nothing.copy(), nothing.copy(), np.zeros(len(brackets), int))
        contradicted = np.zeros(len(brackets), bool)
        brackets = brackets.copy()
        open_ = np.flatnonzero(np.isfinite(brackets).all(axis=1))
        round_ = 0
        while len(open_) and round_ != rounds:
            round_ += 1
            shares = np.linspace(0, 1, points_per_round + 2)
            p = brackets[open_, :1] + shares * np.diff(brackets[open_])
            chosen, label = self.only(open_), f"narrowing {round_}"
            if round_ == 1:
                verdicts = chosen.verdicts(p, label)
                before, again = at_ends[open_], verdicts[:, [0, -1]]
                contradicted[open_] = np.any((before >= 0) & (again >= 0) & (before != again), axis=1)
            else:
                verdicts = with_ends(chosen.verdicts(p[:, 1:-1], label))
            now = first_crossings(p, verdicts)
            still = []
            for row, place in enumerate(open_):
                width = now.high[row] - now.low[row]
                narrower = round_ == 1 or width < 0.9 * (brackets[place, 1] - brackets[place, 0])
                for whole, part in zip(found, now, strict=True):
                    whole[place] = part[row]
                if np.isfinite(width):
                    brackets[place] = now.low[row], now.high[row]
                if narrower and width > tolerance and not contradicted[place]:
                    still.append(place)
            open_ = np.array(still, int)
        # Two kicks that are neighbours in rounding cannot come closer.
        close = found.high - found.low <= np.maximum(tolerance, np.spacing(found.high))
        middle = np.where(close, 0.5 * (found.low + found.high), found.middle)
        middle = np.where(~close & np.isfinite(found.low), np.nan, middle)
        middle, high = (np.where(contradicted, np.nan, values) for values in (middle, found.high))
        return found._replace(middle=middle, high=high), contradicted


class Scan(NamedTuple):
    """The verdicts on several scenes over a range of kicks, and where they first change."""

    p: Float[np.ndarray, " kicks"]
    verdicts: Int[np.ndarray, "r kicks"]
    seen: FirstCrossing

    @classmethod
    def of(cls, kicked: Kicked, p: Float[np.ndarray, " kicks"]) -> "Scan":
        """That of these scenes."""
        rows = len(next(iter(kicked.columns.values())))
        verdicts = kicked.verdicts(np.tile(p, (rows, 1)), "scan")
        return cls(p, verdicts, first_crossings(p, verdicts))

    @property
    def brackets(self) -> tuple[Float[np.ndarray, "r 2"], Int[np.ndarray, "r 2"]]:
        """The brackets to be narrowed, and the verdicts at their ends. If already the first kick leads to a limit cycle, the
        bracket is the first step.
        """
        from_the_start = (np.isnan(self.seen.low) & np.isfinite(self.seen.middle))[:, None]
        brackets = np.where(from_the_start, self.p[:2], self.seen.brackets)
        return brackets, np.where(from_the_start, self.verdicts[:, :2], AT_ENDS)

    @property
    def has_one_change(self) -> Bool[np.ndarray, " r"]:
        """Where there is at most one change, and no undecided kick outside its bracket that might hide another."""
        inside, no_kick = (self.p > self.seen.low[:, None]) & (self.p < self.seen.high[:, None]), self.p == 1.0
        return (self.seen.changes <= 1) & ~np.any((self.verdicts < 0) & ~inside & ~no_kick, axis=1)


def least_crossings(kicked: Kicked, p: Float[np.ndarray, " kicks"], tolerance: float, wanted: int) -> FirstCrossing:
    """The first crossings of the scenes, the smallest of them, as many as are `wanted` or more, narrowed to the tolerance; NaN
    for the others. Kicks far above the smallest that lead to a limit cycle need no verdict.
    """
    rows = len(next(iter(kicked.columns.values())))
    low, high, middle = np.full((3, rows), np.nan)
    found = FirstCrossing(low, high, middle, np.zeros(rows, int))
    left, begin = np.arange(rows), 0
    for share in (1 / 8, 1 / 4, 1 / 2, 1):
        end = max(begin + 2, math.ceil(share * len(p)))
        own = kicked.only(left)
        scan = Scan.of(own, p[begin:end])
        fine, _ = own.narrowed(*scan.brackets, tolerance)
        for whole, part in zip(found, fine, strict=True):
            whole[left] = part
        go_on = np.isnan(scan.seen.high)
        # From the last kick that is known to slide: on an undecided one no bracket rests.
        slides = np.flatnonzero(np.all(scan.verdicts[go_on] == Verdict.SLIDING, axis=0))
        left, begin = left[go_on], begin + int(slides[-1]) if len(slides) else begin
        if not len(left) or end >= len(p) or np.sum(np.isfinite(found.middle)) >= wanted:
            break
    return found
