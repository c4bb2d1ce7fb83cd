"""In place of `jobs.run_job`, for tests of who runs jobs: picklable, quick, and deadly where it is told to be."""

import os
import signal
from pathlib import Path

import numpy as np

from fivjax.maps.jobs import Done, Job
from fivjax.maps.results import not_run


def verdicts_of(values: dict[str, np.ndarray]):
    """Some numbers that depend on the values alone."""
    verdicts = not_run(len(values["p"]), energy=False)
    verdicts.verdict[:] = values["p"] > 2.0
    verdicts.amplitude[:] = np.sin(values["p"]) * values.get("mu", 1.0)
    return verdicts


def run(job: Job) -> Done:
    return Done(verdicts_of(job.values), {})


def killing_once(job: Job, folder: str = os.environ.get("FIVJAX_TEST_KILLED", "")) -> Done:
    """The first process that meets a kick of 3 dies of it; the others go on."""
    if np.any(job.values["p"] == 3.0):
        try:
            (Path(folder) / "killed").touch(exist_ok=False)
        except FileExistsError:
            return run(job)
        os.kill(os.getpid(), signal.SIGKILL)
    return run(job)
