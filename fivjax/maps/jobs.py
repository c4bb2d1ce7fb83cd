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
from jaxtyping import Float, Int

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
    task, (verdicts, known) = job.task, results
    of_groups, group = groups_of(job.values, (*task.of_kick, *task.states))
    of_groups, seeds = with_seeding(of_groups, job.seeding[np.unique(group, return_index=True)[1]])
    batch = Batch(task, of_groups, pool)
    own = [job.values[name] for name in (*task.of_kick, *task.states)]
    columns = np.stack([np.zeros(len(group)), *own], axis=-1)[:, 1:]
    pending = np.arange(len(group))
    trajectories = begin_all(batch, group, columns)
    capture = Capture(batch, of_groups, group, seeds, report)
    # After so many rounds the attractors of the groups of those that are undecided are computed; those that are undecided later
    # ask for a cycle of their own, each time after twice the steps.
    known_from, own_from = 4 * task.method.round, 16 * task.method.round
    limit = task.limits.t_max
    if limit is None:
        period = np.asarray(batch.constants.modes.slowest_period)
        limit = np.where(period > 0, PERIODS * period, WITHOUT_PERIOD)
    limit = np.broadcast_to(limit, len(of_groups))
    done = 0
    if (earlier := file.last()) is not None:
        done, own_from, pending = earlier.done, earlier.own_from, earlier.pending
        trajectories = Flattened(earlier.numbers, trajectories.form)
        capture.go_on(earlier)
        known.update(earlier.searched)
        for whole, part in zip(jax.tree.leaves(verdicts), jax.tree.leaves(earlier.verdicts), strict=True):
            whole[:] = part
        report(len(group) - len(pending))

    def state() -> JobState:
        return JobState(done, own_from, verdicts, pending, trajectories.numbers, dict(known), *capture.state())

    # Rounds from which on cycles of many crossings are tried, too: locked tori, whose neighbours are followed for long
    # anyway.
    more_from = 64
    while True:
        _, now = trajectories.tree
        verdict = np.array(now.verdict)
        if task.limits.t_max is None:
            in_time = now.t - now.skipped - now.last_jump < np.maximum(limit, capture.settled_by)[group[pending]]
            # On a slow belt events are rare, and their steps are few: first the attractors are computed.
            in_time |= done <= known_from
        else:
            in_time = now.t < limit[group[pending]]
        entered: dict[int, CapturingSet] = {}
        if done > known_from:
            entered = capture.entered(pending, now, (verdict == Verdict.UNDECIDED) & in_time)
            verdict[list(entered)] = Verdict.LIMIT_CYCLE
        if done >= task.limits.max_steps:
            # Only now: their last steps may have led them to an attractor.
            verdict = np.where((verdict == Verdict.UNDECIDED) & in_time, Verdict.STEP_FAILURE, verdict)
        finished = (verdict != Verdict.UNDECIDED) | ~in_time
        # Who says how long to follow says which motions count.
        late = capture.at_last(
            pending, now, finished & (verdict == Verdict.UNDECIDED), proving=task.limits.t_max is None
        )
        verdict[list(late.attractor)], verdict[late.sliding] = Verdict.LIMIT_CYCLE, Verdict.SLIDING
        ended = verdict, attractor_columns(len(pending), entered | late.attractor, late.chaotic)
        rows = np.flatnonzero(finished)
        record(verdicts, pending[finished], *(_rows(part, rows) for part in (late.now, *ended)))
        pending, trajectories = pending[~finished], trajectories.compacted(np.flatnonzero(~finished))
        # A run that begins here comes to the same: it finds nothing more to conclude.
        file.note(state(), at_once=done == known_from or done >= own_from)
        report(int(finished.sum()))
        if not len(pending):
            return
        if done == known_from:
            capture.search(np.unique(group[pending]), known, lambda: file.note(state()))
        elif done >= own_from:
            crossings = CROSSINGS if done < more_from * task.method.round else MORE_CROSSINGS
            capture.search_alone(pending, trajectories.tree[1], crossings)
            own_from = 2 * done
        # Trajectories that have taken long may take longer: looks at their verdicts grow rarer, in proportion.
        steps = min(max(task.method.round, done // 8), max(task.limits.max_steps - done, 1))
        file.moving()
        advance_all(batch, group[pending], trajectories, steps)
        done += steps


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
