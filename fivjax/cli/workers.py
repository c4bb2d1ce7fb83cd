"""Workers of a command: processes of this machine, or the workers of a Dask scheduler."""

import contextlib
import multiprocessing
import signal
import sys
import warnings
from collections.abc import Generator
from concurrent.futures import ProcessPoolExecutor

from ..foundation.kept_folder import NotKept
from ..foundation.parent import end_with_parent
from .compiled_code import keep_compiled_code


@contextlib.contextmanager
def workers_of(count: int, dask: str | None) -> Generator:
    """An executor for `fivjax.bistability_map` (None: threads of this process) while the command runs.

    **Raises:** `ValueError` for counts below zero, both kinds at once, and a scheduler that does not answer.
    """
    if count < 0:
        raise ValueError(f"Option `--workers` must not be negative, but is {count}.")
    if count and dask is not None:
        raise ValueError("Options `--workers` and `--dask` are two places to compute in; give one of them.")
    if dask is not None:
        with contextlib.closing(_client(dask)) as client:
            yield client
    elif count:
        # An interrupted program leaves the pool's semaphores to Python's resource tracker, which would complain of it.
        sys.warnoptions.append("ignore:resource_tracker:UserWarning")
        context = multiprocessing.get_context("spawn")
        # A function, so that the map makes the pool, replaces it when workers die, and ends it when it is interrupted.
        yield lambda: ProcessPoolExecutor(count, mp_context=context, initializer=_begin)
    else:
        yield None


def _begin() -> None:
    """In each worker process: ignore Ctrl-C, which the process that hands out the jobs handles, and end with that process. That
    one also says what cannot be kept.
    """
    end_with_parent()
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    warnings.simplefilter("ignore", NotKept)
    keep_compiled_code()


def _client(address: str):
    try:
        from distributed import Client
    except ImportError:
        raise ValueError("Option `--dask` needs the package distributed: `pip install fivjax[dask]`.") from None
    try:
        return Client(address, timeout=10)
    except (OSError, ValueError) as error:
        raise ValueError(f"Option `--dask`: no scheduler answers at {address} ({error}).") from None
