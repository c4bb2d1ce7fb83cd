"""Many trajectories, each followed until its verdict is known: jobs, executors, progress, and results kept on disk.

A trajectory (`progress`, `conclusion`) belongs to a group that shares its mechanics (`sharing`); several groups make a job
(`plan`, `jobs`), whose trajectories are followed in blocks of one size, round by round (`rounds`).
"""

import contextvars
import functools
import threading
import warnings
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from typing import Protocol

import jax
import numpy as np

from ..attractors.known import Attractors
from ..foundation.blocks import workers as cores
from ..foundation.progress import Work, following
from ..foundation.stopping import stop_requests, waited_for
from ..model.scene import Scene
from ..steppers.base import AbstractStepper
from ..verdicts.verdict import Verdict
from .executors import Workers
from .groups import grouped
from .handing_out import hand_out
from .jobs import Done, Job, run_job
from .plan import Plan, planned
from .results import Verdicts, counted, not_run
from .trajectories import Places

# The most steps of a trajectory: enough for 10⁵ cycles with their events; a map of such trajectories takes hours.
MOST_STEPS = 2**21


class Keeper(Protocol):
    """An object that keeps results on disk while a run goes on."""

    found: dict[int, dict[bytes, Attractors]]  # attractors from earlier jobs, by the first trajectory of each job

    def recalled(self, places: Places | None) -> Verdicts:
        """The results of an earlier run of these trajectories (all, unless given), in their order."""
        ...

    def job_file(self, places: Places) -> tuple[str, str]:
        """The path and the key of the file in which the job with these trajectories keeps how far it has come."""
        ...

    def keep(self, places: Places, verdicts: Verdicts, found: dict[bytes, Attractors] | None) -> None:
        """Keep the results of the job with these trajectories; of its attractors, those that are needed later."""
        ...

    def flush(self) -> None:
        """Write results that are not written yet."""
        ...


def run_to_verdict(
    scene: Scene,
    values: Mapping[str, np.ndarray],
    method: AbstractStepper,
    *,
    t_max: float | None,
    memory: float,
    max_steps: int = MOST_STEPS,
    progress: bool | None,
    label: str,
    energy: bool = False,
    states: Mapping[str, int] | None = None,
    attractors: dict[bytes, Attractors] | None = None,
    executor: Workers | None = None,
    places: Places | None = None,
    keeper: Keeper | None = None,
) -> Verdicts:
    """Follow one trajectory for each row of `values` (a `Grid`, or equally long columns by name) until its verdict. Returns the
    results of these trajectories, in their order.

    - `energy`: whether to keep the energy ledger of each trajectory.
    - `states`: names in `values` that are initial displacements or velocities instead of parameters, with their indices in the
      state; all other coordinates begin at the sliding equilibrium.
    - `attractors`: those found in an earlier run over the same parameters; new ones are added.
    - `executor`: runs the jobs; unless given, threads of this process do, as many at a time as `memory` (bytes) allows.
    - `places`: indices of the trajectories to run, in rising order; all unless given.
    - `keeper`: gets the results of each job, and has those of an earlier run; missing ones are added. A job with any missing
      result is run as a whole.

    Interrupted by the user, it returns the verdicts known by then (of jobs in other processes, those of finished jobs); all
    other trajectories have `Verdict.NOT_RUN`.
    """
    plan = planned(scene, values, method, t_max=t_max, max_steps=max_steps, energy=energy, states=states, places=places)
    total = plan.trajectories.total if places is None else len(places)
    verdicts = not_run(total, energy) if keeper is None else keeper.recalled(places)

    def rows(number: int) -> Places:
        own = plan.jobs[number]
        return own if places is None else np.searchsorted(places, own)

    attractors = {} if attractors is None else attractors
    at_a_time = max(1, min(cores(), int(memory // plan.memory) if plan.memory else 1))
    already, unit = total - int(verdicts.pending().sum()), " trajectories"
    with (
        stop_requests() as requested,
        following(label, shown=progress, total=total, already=already, unit=unit) as work,
    ):
        ended = _Ended(work)
        try:
            # Attractors may be needed by another run over the same parameters, or by jobs that share a group.
            needed_later = places is not None or bool(plan.parts[-1])
            for part in plan.parts:
                _follow(
                    plan, part, rows, verdicts, attractors, executor, at_a_time, keeper, needed_later, ended, requested
                )
        except KeyboardInterrupt:
            left = int(verdicts.pending().sum())
            warnings.warn(
                f"Interrupted: of {counted(total, 'trajectory')}, {left} without a verdict, "
                f"labelled {Verdict.NOT_RUN.value}.",
                stacklevel=2,
            )
        finally:
            if keeper is not None:
                keeper.flush()
    return verdicts


def _follow(
    plan: Plan,
    part: list[int],
    rows: Callable[[int], Places],
    verdicts: Verdicts,
    attractors: dict[bytes, Attractors],
    workers: Workers | None,
    at_a_time: int,
    keeper: Keeper | None,
    needed_later: bool,
    ended: "_Ended",
    requested: list[int],
) -> None:
    """Run the jobs of one part of the plan whose results are missing in the `rows` of each, and add the attractors that they
    find.
    """

    def is_missing(number: int) -> bool:
        lost = needed_later and keeper is not None and int(plan.jobs[number][0]) not in keeper.found
        return lost or bool(np.any(verdicts.pending(rows(number))))

    missing = [number for number in part if is_missing(number)]
    found: dict[int, dict[bytes, Attractors]] = {}
    if keeper is not None and keeper.found:
        found = {number: keeper.found.get(int(plan.jobs[number][0]), {}) for number in set(part) - set(missing)}

    def job(number: int) -> Job:
        values = plan.trajectories.columns(plan.jobs[number])
        seeding = plan.trajectories.seeding(plan.jobs[number])
        own = grouped(values, tuple(plan.task.states))[0] if attractors else np.zeros((0, seeding.shape[1]))
        keys = {row.tobytes() for row in (*own, *np.unique(seeding, axis=0))}
        known = {key: attractors[key] for key in keys & attractors.keys()}
        file = (None, "") if keeper is None else keeper.job_file(plan.jobs[number])
        return Job(plan.task, values, seeding, known, *file)

    def write(number: int, results: Verdicts) -> None:
        for whole, own in zip(jax.tree.leaves(verdicts), jax.tree.leaves(results), strict=True):
            whole[rows(number)] = own

    def done(number: int, result: Done) -> None:
        write(number, result.verdicts)
        found[number] = result.found
        if keeper is not None:
            keeper.keep(plan.jobs[number], result.verdicts, result.found if needed_later else None)
        if workers is not None:
            ended(len(plan.jobs[number]))

    def given_up(number: int) -> None:
        # Not kept on disk: with more memory, or on another machine, the job may succeed.
        verdicts.verdict[rows(number)] = Verdict.WORKER_LOST
        ended(len(plan.jobs[number]))

    if not missing:
        pass
    elif workers is None:
        _run_here(missing, job, write, done, given_up, at_a_time, ended, requested)
    else:
        them = workers
        hand_out(
            missing, lambda number: them.submit(run_job, job(number)), them, done, given_up, lambda: bool(requested)
        )
    for number in part:
        for key, one in found.get(number, {}).items():
            attractors.setdefault(key, one)


def _run_here(
    missing: list[int],
    job: Callable[[int], Job],
    write: Callable[[int, Verdicts], None],
    done: Callable[[int, Done], None],
    given_up: Callable[[int], None],
    at_a_time: int,
    ended: "_Ended",
    requested: list[int],
) -> None:
    """Run jobs in threads of this process. Those that are left behind (`waited_for`) end at their next report, and change
    nothing any more.
    """
    failed, over = [], []

    def report(count: int) -> None:
        if not over:
            ended(count)
        if requested or failed:
            raise KeyboardInterrupt

    def interrupted(number: int, results: Verdicts) -> None:
        # Results of an interrupted job are returned but not kept with the others, which are of whole jobs.
        if not over:
            write(number, results)

    try:
        with waited_for(ThreadPoolExecutor(at_a_time), ThreadPoolExecutor(cores())) as (threads, blocks):
            mine = Workers(threads)

            def here(number: int):
                then = functools.partial(interrupted, number)
                return mine.submit(contextvars.copy_context().run, run_job, job(number), blocks, report, then)

            try:
                hand_out(missing, here, mine, done, given_up, lambda: bool(requested))
            except BaseException:
                failed.append(True)
                raise
    finally:
        over.append(True)


class _Ended:
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
