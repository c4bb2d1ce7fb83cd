"""A map as independent jobs: each is a pure function from its data to its results, for any process on any machine.

A job follows some trajectories of a map, round by round, until the verdict on each is known. After each round of steps the
decided ones leave and the undecided ones are compacted: work is spent only where the verdict is open. Results follow from the
job alone, not from the worker or from other jobs. A map keeps the results of whole jobs, so an interrupted map continues with
its missing jobs; one that was under way goes on from its own file (`job_files`).
"""

import platform
from collections.abc import Callable
from concurrent.futures import Executor, ThreadPoolExecutor
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Bool, Float, Int

from ..attractors.catalogue import Attractors, CapturingSet
from ..attractors.cycles import CROSSINGS, MORE_CROSSINGS
from ..foundation.flattened import Flattened
from ..foundation.parent import end_with_parent
from ..foundation.precision import in_double_precision
from ..verdicts.verdict import Verdict
from .capture import Capture, attractor_columns
from .following import Batch, advance_all, begin_all
from .groups import Task, groups_of
from .job_files import JobFile, JobState
from .one_trajectory import Progress
from .results import Verdicts, not_run, record

# How long trajectories are followed after the last jump of their load, unless told: so many periods of the slowest mode, or so
# many seconds if none oscillates.
PERIODS, WITHOUT_PERIOD = 2000.0, 20.0


class Job(NamedTuple):
    """Some trajectories of a run, and the known attractors of their groups and of those that seed these."""

    task: Task
    values: dict[str, np.ndarray]
    seeding: Float[np.ndarray, "r k"]  # see `Grid.seeding`
    known: dict[bytes, Attractors]
    by_kernel: bool  # whether kernels follow the trajectories where the map was begun
    file: str | None = None  # where it keeps how far it has come,
    key: str = ""  # and what the file calls this job of this run


class Done(NamedTuple):
    """The results of a job: verdicts of its trajectories, and attractors that it has found."""

    verdicts: Verdicts
    found: dict[bytes, Attractors]


@in_double_precision
def run_job(
    job: Job,
    threads: Executor | None = None,
    report: Callable[[int], None] | None = None,
    interrupted: Callable[[Verdicts], None] | None = None,
) -> Done:
    """The results of a job.

    It may use `threads` of the process it runs in. `report` gets the number of trajectories that have ended and may stop the
    job by an exception; `interrupted` then gets the verdicts known by then, and the job's file what it takes to go on.

    **Raises:** `RuntimeError` in a worker that steps by other means than the process where the map was begun: results would
    depend on who computed them, by rounding.
    """
    if job.by_kernel != job.task.by_kernel:
        raise RuntimeError(
            f"Trajectories of this map are followed {'by kernels' if job.by_kernel else 'without kernels'} where it was begun, "
            f"but this worker, on {platform.node()}, {'has none' if job.by_kernel else 'has them'}. Install the same versions "
            f"of jax and warp-lang for both."
        )
    if threads is None:
        # Also in a pool that a user has made: its workers would wait for jobs of a killed process for ever.
        end_with_parent()
        with ThreadPoolExecutor(max_workers=1) as one:
            return run_job(job, one, report, interrupted)
    done = Done(not_run(len(job.seeding), job.task.limits.energy), dict(job.known))
    file = JobFile(job.file, job.key)
    try:
        follow_all(job, threads, done, file, report or (lambda count: None))
    except KeyboardInterrupt:
        file.flush()
        if interrupted is not None:
            interrupted(done.verdicts)
        raise
    return done._replace(found={key: one for key, one in done.found.items() if key not in job.known})


def follow_all(job: Job, pool: Executor, results: Done, file: JobFile, report: Callable[[int], None]) -> None:
    """Follow the trajectories of a job, which fit in memory together, and write their `results`.

    Those found already are the known attractors of groups, by the group's parameters. `report` is told how many trajectories
    have ended. The file keeps the state between rounds, and has the one from which an interrupted run goes on.
    """
    following = _Following(job, pool, results, report)
    if (earlier := file.last()) is not None:
        following.go_on(earlier)
        report(len(job.seeding) - len(following.pending))
    while True:
        ended = following.conclude()
        # A run that begins here comes to the same: it finds nothing more to conclude.
        file.note(following.state(), at_once=following.asks_for_attractors)
        report(ended)
        if not len(following.pending):
            return
        following.search(lambda: file.note(following.state()))
        file.moving()
        following.advance()


class _Following:
    """The trajectories of a job that have no verdict yet, and how far they have come. In each round those that have one leave
    (`conclude`), attractors are looked for at times (`search`), and the others go on (`advance`).
    """

    # After so many rounds the attractors of the groups of those that are undecided are computed; those that are undecided later
    # ask for one of their own, each time after twice the steps.
    GROUPS_AFTER, OWN_AFTER = 4, 16
    # Rounds from which on cycles of many crossings are tried, too: locked tori, whose neighbours are followed for long anyway.
    MORE_AFTER = 64

    def __init__(self, job: Job, pool: Executor, results: Done, report: Callable[[int], None]):
        self.task, (self.verdicts, self.known) = job.task, results
        task = self.task
        of_groups, self.group = groups_of(job.values, (*task.of_kick, *task.states))
        of_groups, seeds = with_seeding(of_groups, job.seeding[np.unique(self.group, return_index=True)[1]])
        self.batch = Batch(task, of_groups, pool)
        self.pending = np.arange(len(self.group))
        own = [job.values[name] for name in (*task.of_kick, *task.states)]
        columns = np.stack([np.zeros(len(self.group)), *own], axis=-1)[:, 1:]
        self.trajectories = begin_all(self.batch, self.group, columns)
        self.capture = Capture(self.batch, of_groups, self.group, seeds, report)
        limit = task.limits.t_max
        if limit is None:
            period = np.asarray(self.batch.constants.modes.slowest_period)
            limit = np.where(period > 0, PERIODS * period, WITHOUT_PERIOD)
        self.limit = np.broadcast_to(limit, len(of_groups))
        self.done, self.own_from = 0, self.OWN_AFTER * task.method.round

    @property
    def groups_from(self) -> int:
        """Steps of each trajectory after which the attractors of groups are computed."""
        return self.GROUPS_AFTER * self.task.method.round

    @property
    def asks_for_attractors(self) -> bool:
        """Whether `search` looks for attractors now."""
        return self.done == self.groups_from or self.done >= self.own_from

    def state(self) -> JobState:
        """From which another run goes on."""
        verdicts, numbers = self.verdicts, self.trajectories.numbers
        return JobState(
            self.done, self.own_from, verdicts, self.pending, numbers, dict(self.known), *self.capture.state()
        )

    def go_on(self, earlier: JobState) -> None:
        """From where another run has come to."""
        self.done, self.own_from, self.pending = earlier.done, earlier.own_from, earlier.pending
        self.trajectories = Flattened(earlier.numbers, self.trajectories.form)
        self.capture.go_on(earlier)
        self.known.update(earlier.searched)
        for whole, part in zip(jax.tree.leaves(self.verdicts), jax.tree.leaves(earlier.verdicts), strict=True):
            whole[:] = part

    def conclude(self) -> int:
        """Write the verdicts of those that have one, or whose time is over, and leave them out. How many these are."""
        task, pending, now = self.task, self.pending, self.trajectories.tree[1]
        verdict, in_time = np.array(now.verdict), self._in_time(now)
        entered: dict[int, CapturingSet] = {}
        if self.done > self.groups_from:
            entered = self.capture.entered(pending, now, (verdict == Verdict.UNDECIDED) & in_time)
            verdict[list(entered)] = Verdict.LIMIT_CYCLE
        if self.done >= task.limits.max_steps:
            # Only now: their last steps may have led them to an attractor.
            verdict = np.where((verdict == Verdict.UNDECIDED) & in_time, Verdict.STEP_FAILURE, verdict)
        finished = (verdict != Verdict.UNDECIDED) | ~in_time
        # Who says how long to follow says which motions count.
        late = self.capture.at_last(
            pending, now, finished & (verdict == Verdict.UNDECIDED), proving=task.limits.t_max is None
        )
        verdict[list(late.attractor)], verdict[late.sliding] = Verdict.LIMIT_CYCLE, Verdict.SLIDING
        ended = verdict, attractor_columns(len(pending), entered | late.attractor, late.chaotic)
        rows = np.flatnonzero(finished)
        record(self.verdicts, pending[finished], *(_rows(part, rows) for part in (late.now, *ended)))
        self.pending, self.trajectories = pending[~finished], self.trajectories.compacted(np.flatnonzero(~finished))
        return len(rows)

    def _in_time(self, now: Progress) -> Bool[np.ndarray, " m"]:
        """Which trajectories are followed on, if they have no verdict."""
        group = self.group[self.pending]
        if self.task.limits.t_max is not None:
            return np.asarray(now.t) < self.limit[group]
        long = np.maximum(self.limit, self.capture.settled_by)[group]
        # On a slow belt events are rare, and their steps are few: first the attractors are computed.
        return np.asarray(now.t - now.skipped - now.last_jump < long) | (self.done <= self.groups_from)

    def search(self, keep: Callable[[], None]) -> None:
        """Look for attractors where it is time to; `keep` is called now and then meanwhile."""
        task = self.task
        if self.done == self.groups_from:
            self.capture.search(np.unique(self.group[self.pending]), self.known, keep)
        elif self.done >= self.own_from:
            crossings = CROSSINGS if self.done < self.MORE_AFTER * task.method.round else MORE_CROSSINGS
            self.capture.search_alone(self.pending, self.trajectories.tree[1], crossings)
            self.own_from = 2 * self.done

    def advance(self) -> None:
        """A round of steps. Trajectories that have taken long may take longer: rounds grow longer, in proportion."""
        task = self.task
        steps = min(max(task.method.round, self.done // 8), max(task.limits.max_steps - self.done, 1))
        advance_all(self.batch, self.group[self.pending], self.trajectories, steps)
        self.done += steps


def with_seeding(
    of_groups: Float[np.ndarray, "g k"], seeding: Float[np.ndarray, "g k"]
) -> tuple[Float[np.ndarray, "more k"], Int[np.ndarray, " g"]]:
    """The parameters of groups, followed by those of other groups that seed some of them; and which one seeds each."""
    place = {row.tobytes(): g for g, row in enumerate(of_groups)}
    more: list[np.ndarray] = []
    for row in seeding:
        if row.tobytes() not in place:
            place[row.tobytes()] = len(place)
            more.append(row)
    seeds = np.array([place[row.tobytes()] for row in seeding], int)
    return np.concatenate([of_groups, np.array(more).reshape(len(more), of_groups.shape[1])]), seeds


def _rows(tree, chosen: np.ndarray):
    return jax.tree.map(lambda leaf: np.asarray(leaf)[chosen], tree)
