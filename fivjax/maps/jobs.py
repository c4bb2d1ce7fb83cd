"""A map as independent jobs: each a pure function from what it holds to its results, for any process on any machine.

A job runs some trajectories of a map. What they come to follows from the job alone: not from who runs it, nor from what runs
beside it. A job is run as a whole or not at all, so an interrupted map is gone on with by its missing jobs.
"""

from collections.abc import Callable
from concurrent.futures import Executor, ThreadPoolExecutor
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from ..foundation.precision import in_double_precision
from ..model.scene import Scene
from ..steppers.base import AbstractStepper
from ..steppers.windowed import Windowed
from . import rounds
from .attractors import Attractors
from .results import Verdicts, not_run
from .sharing import Batch


class Task(NamedTuple):
    """What all jobs of a run have in common."""

    scene: Scene  # with NumPy's arrays: JAX's lose their precision where they are unpickled
    method: AbstractStepper | Windowed
    names: tuple[str, ...]  # parameters that make groups
    history: tuple[str, ...]  # those of the load's history
    states: dict[str, int]  # displacements and velocities at the beginning, with their places in the state
    t_max: float | None
    max_steps: int
    energy: bool
    width: int  # trajectories of a group side by side
    many: bool  # so many in all jobs that code which runs faster repays what it takes to compile


class Job(NamedTuple):
    """Some trajectories of a run, and the attractors of their groups as far as they are known."""

    task: Task
    values: dict[str, np.ndarray]
    known: dict[bytes, Attractors]


class Done(NamedTuple):
    """What a job comes to: its trajectories' ends, and attractors that were not known to it."""

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

    Where it runs, it may use `threads`; `report` is told how many trajectories have ended, and may end it by an exception:
    `interrupted` is then handed what is decided by then.
    """
    if threads is None:
        with ThreadPoolExecutor(max_workers=1) as one:
            return run_job(job, one, report, interrupted)
    task = job.task
    total = len(next(iter(job.values.values())))
    verdicts, known = not_run(total, task.energy), dict(job.known)
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
            tuple(task.states),
            known,
            task.t_max,
            task.max_steps,
            verdicts,
            np.arange(total),
            report or (lambda count: None),
        )
    except KeyboardInterrupt:
        if interrupted is not None:
            interrupted(verdicts)
        raise
    return Done(verdicts, {key: one for key, one in known.items() if key not in job.known})
