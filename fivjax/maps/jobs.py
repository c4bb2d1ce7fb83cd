"""A map as independent jobs: each is a pure function from its data to its results, for any process on any machine.

A job runs some trajectories of a map. Its results follow from the job alone, not from the worker or from other jobs. A map
keeps the results of whole jobs, so an interrupted map continues with its missing jobs; one that was under way goes on from its
own file (`job_files`).
"""

from collections.abc import Callable
from concurrent.futures import Executor, ThreadPoolExecutor
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from ..attractors.known import Attractors
from ..foundation.parent import end_with_parent
from ..foundation.precision import in_double_precision
from ..model.scene import Scene
from ..steppers.base import AbstractStepper
from ..steppers.propagation import Propagation
from . import rounds
from .groups import Batch
from .job_files import JobFile
from .results import Verdicts, not_run


class Task(NamedTuple):
    """The data that all jobs of a run have in common."""

    scene: Scene  # with NumPy arrays, because JAX arrays lose double precision when they are unpickled
    method: AbstractStepper | Propagation
    names: tuple[str, ...]  # parameters that differ between groups
    history: tuple[str, ...]  # parameters of the kick
    states: dict[str, int]  # initial displacements and velocities, with their indices in the state
    t_max: float | None
    max_steps: int
    energy: bool
    width: int  # trajectories of a group in a row of a block
    many: bool  # whether there are so many trajectories that fully optimised code repays its compilation


class Job(NamedTuple):
    """Some trajectories of a run, and the known attractors of their groups and of those that seed these."""

    task: Task
    values: dict[str, np.ndarray]
    seeding: Float[np.ndarray, "r k"]  # see `Grid.seeding`
    known: dict[bytes, Attractors]
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
    """
    if threads is None:
        # Also in a pool that a user has made: its workers would wait for jobs of a killed process for ever.
        end_with_parent()
        with ThreadPoolExecutor(max_workers=1) as one:
            return run_job(job, one, report, interrupted)
    task = job.task
    total = len(next(iter(job.values.values())))
    verdicts, known, log = not_run(total, task.energy), dict(job.known), JobFile(job.file, job.key)
    scene = jax.tree.map(lambda leaf: jnp.asarray(leaf) if isinstance(leaf, np.ndarray) else leaf, task.scene)
    batch = Batch(
        scene=scene,
        method=task.method,
        names=task.names,
        history=task.history,
        states=tuple(task.states.values()),
        energy=task.energy,
        width=task.width,
        many=task.many,
        pool=threads,
    )
    try:
        rounds.follow_all(
            batch,
            job.values,
            job.seeding,
            tuple(task.states),
            known,
            task.t_max,
            task.max_steps,
            verdicts,
            np.arange(total),
            report or (lambda count: None),
            log,
        )
    except KeyboardInterrupt:
        log.flush()
        if interrupted is not None:
            interrupted(verdicts)
        raise
    return Done(verdicts, {key: one for key, one in known.items() if key not in job.known})
