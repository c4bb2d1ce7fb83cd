"""Many trajectories, each followed until its verdict is known: jobs, executors, progress, and results kept on disk.

A trajectory (`one_trajectory`) belongs to a group that shares its mechanics (`groups`); several groups make a job (`plan`),
whose trajectories are followed in blocks of one size, round by round (`jobs`).
"""

import contextvars
import functools
import threading
import warnings
from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple

import jax
import numpy as np

from ..attractors.catalogue import Attractors
from ..foundation.blocks import workers as cores
from ..foundation.progress import Work, following
from ..foundation.stopping import stop_requests, waited_for
from ..model.scene import Scene
from ..steppers.base import AbstractStepper
from ..verdicts.verdict import Verdict
from .checkpoint import Checkpoint
from .executors import Workers, hand_out
from .groups import Limits, groups_of
from .jobs import Done, Job, run_job
from .plan import Grid, Indices, Plan, TrajectoryList, plan_of
from .results import Verdicts, not_run
from .store import Store


class RunOptions(NamedTuple):
    """How a run is carried out: its results do not depend on this."""

    label: str  # of its progress bar
    memory: float = 2e9  # that the jobs may take which run at a time in this process, bytes
    progress: bool | None = None  # whether there is a bar; unless given, in terminals and notebooks
    executor: Workers | None = None  # runs the jobs; unless given, threads of this process do
    # Gets the results of each job, and has those of an earlier run. A job with any missing result is run as a whole.
    keeper: Checkpoint | Store | None = None
    # Whether what is known by an interrupt is of no use: what a search has not run would count as what it has not found.
    all_or_none: bool = False


def run_to_verdict(
    scene: Scene,
    trajectories: Grid | TrajectoryList,
    method: AbstractStepper,
    limits: Limits,
    options: RunOptions,
    places: Indices | None = None,
    attractors: dict[bytes, Attractors] | None = None,
) -> Verdicts:
    """Follow trajectories (all, unless their indices `places` are given, in rising order) until their verdicts are known.
    Returns their results in their order.

    `attractors` are those found in an earlier run over the same parameters; new ones are added.

    Interrupted by the user, it returns the verdicts known by then (of jobs in other processes, those of finished jobs); all
    other trajectories have `Verdict.NOT_RUN`.

    **Raises:** `KeyboardInterrupt` if it was interrupted and `all_or_none` are wanted.
    """
    plan, keeper = plan_of(scene, trajectories, method, limits, places), options.keeper
    total = trajectories.total if places is None else len(places)
    verdicts = not_run(total, limits.energy) if keeper is None else keeper.recall(places)
    already, unit = total - int(verdicts.pending().sum()), " trajectories"
    with (
        stop_requests() as requested,
        following(options.label, shown=options.progress, total=total, already=already, unit=unit) as work,
    ):
        run = _Run(
            plan, options, verdicts, places, {} if attractors is None else attractors, _EndedCount(work), requested
        )
        try:
            for part in plan.parts:
                run.follow(part)
            if requested and options.all_or_none:
                # After the last report: whoever asks has more to do.
                raise KeyboardInterrupt
        except KeyboardInterrupt:
            if options.all_or_none:
                raise
            interrupted(verdicts)
        finally:
            if keeper is not None:
                keeper.flush()
    return verdicts


def interrupted(verdicts: Verdicts) -> Verdicts:
    """What is known by now of trajectories, after a warning that says of how many nothing is."""
    total, left = len(verdicts.verdict), int(verdicts.pending().sum())
    if not left:
        return verdicts
    of = f"{total:,} {'trajectory' if total == 1 else 'trajectories'}"
    warnings.warn(
        f"Interrupted: of {of}, {left} without a verdict, labelled {Verdict.NOT_RUN.value}.",
        stacklevel=3,
    )
    return verdicts


class _Run(NamedTuple):
    """A run under way: its plan and options, and the results by now."""

    plan: Plan
    options: RunOptions
    verdicts: Verdicts
    places: Indices | None
    attractors: dict[bytes, Attractors]
    ended: "_EndedCount"
    requested: list[int]  # signals that ask to stop

    def rows(self, number: int) -> Indices:
        """The rows of a job's trajectories among the results."""
        own = self.plan.jobs[number]
        return own if self.places is None else np.searchsorted(self.places, own)

    def job(self, number: int) -> Job:
        own, task = self.plan.jobs[number], self.plan.task
        values, seeding = self.plan.trajectories.columns(own), self.plan.trajectories.seeding(own)
        within = (*task.of_kick, *task.states)
        groups = groups_of(values, within)[0] if self.attractors else np.zeros((0, seeding.shape[1]))
        keys = {row.tobytes() for row in (*groups, *np.unique(seeding, axis=0))}
        known = {key: self.attractors[key] for key in keys & self.attractors.keys()}
        file = (None, "") if self.options.keeper is None else self.options.keeper.job_file(own)
        return Job(task, values, seeding, known, task.by_kernel, *file)

    def write(self, number: int, results: Verdicts) -> None:
        for whole, own in zip(jax.tree.leaves(self.verdicts), jax.tree.leaves(results), strict=True):
            whole[self.rows(number)] = own

    def given_up(self, number: int) -> None:
        # Not kept on disk: with more memory, or on another machine, the job may succeed.
        self.verdicts.verdict[self.rows(number)] = Verdict.WORKER_LOST
        self.ended(len(self.plan.jobs[number]))

    def follow(self, part: list[int]) -> None:
        """Run the jobs of one part of the plan whose results are missing, and add the attractors that they find."""
        plan, keeper, workers = self.plan, self.options.keeper, self.options.executor
        # Attractors may be needed by another run over the same parameters, or by jobs that share a group.
        needed_later = self.places is not None or bool(plan.parts[-1])

        def is_missing(number: int) -> bool:
            lost = needed_later and keeper is not None and int(plan.jobs[number][0]) not in keeper.found
            return lost or bool(np.any(self.verdicts.pending(self.rows(number))))

        missing = [number for number in part if is_missing(number)]
        found: dict[int, dict[bytes, Attractors]] = {}
        if keeper is not None and keeper.found:
            found = {number: keeper.found.get(int(plan.jobs[number][0]), {}) for number in set(part) - set(missing)}

        def done(number: int, result: Done) -> None:
            self.write(number, result.verdicts)
            found[number] = result.found
            if keeper is not None:
                keeper.keep(plan.jobs[number], result.verdicts, result.found if needed_later else None)
            if workers is not None:
                self.ended(len(plan.jobs[number]))

        if missing and workers is None:
            self._follow_here(missing, done)
        elif missing and workers is not None:
            self._hand_out(missing, lambda number: workers.submit(run_job, self.job(number)), workers, done)
        for number in part:
            for key, one in found.get(number, {}).items():
                self.attractors.setdefault(key, one)

    def _hand_out(self, missing: list[int], submit, workers: Workers, done) -> None:
        hand_out(missing, submit, workers, done, self.given_up, lambda: bool(self.requested))

    def _follow_here(self, missing: list[int], done) -> None:
        """Run jobs in threads of this process, as many at a time as memory allows. Those that are left behind (`waited_for`)
        end at their next report, and change nothing any more.
        """
        failed, over = [], []
        most = int(self.options.memory // self.plan.memory) if self.plan.memory else 1

        def report(count: int) -> None:
            if not over:
                self.ended(count)
            if self.requested or failed:
                raise KeyboardInterrupt

        def stopped(number: int, results: Verdicts) -> None:
            # Results of an interrupted job are returned but not kept with the others, which are of whole jobs.
            if not over:
                self.write(number, results)

        try:
            pools = ThreadPoolExecutor(max(1, min(cores(), most))), ThreadPoolExecutor(cores())
            with waited_for(*pools) as (threads, blocks):
                mine = Workers(threads)

                def here(number: int):
                    then = functools.partial(stopped, number)
                    return mine.submit(contextvars.copy_context().run, run_job, self.job(number), blocks, report, then)

                try:
                    self._hand_out(missing, here, mine, done)
                except BaseException:
                    failed.append(True)
                    raise
        finally:
            over.append(True)


class _EndedCount:
    """Counts trajectories that have ended; several threads may report to it."""

    def __init__(self, work: Work):
        self.work, self.reports, self.lock = work, 0, threading.Lock()
        # Nothing moves until the first round is compiled, which may take longer than the map.
        work.enter("compiling …")

    def __call__(self, count: int) -> None:
        """Count so many more trajectories as ended."""
        with self.lock:
            self.reports += 1
            if self.reports == 2 or (self.reports == 1 and count):  # the first report comes before any step
                self.work.enter("")
            self.work.advance(count)
