"""Executors of jobs: any in the manner of `concurrent.futures`, and how a new one is made when its workers die.

An executor is

- any object with `submit(function, *arguments)` that returns futures with `add_done_callback` and `result`: thread and process
  pools, loky, `mpi4py.futures`, and the result of Dask's `client.get_executor()`;
- a Dask `Client`, recognised by its `get_executor`;
- a class or a function that makes one without arguments. fivjax then shuts it down at the end, and calls the function again if
  the workers have died and broken the executor (`BrokenProcessPool`).

A broken `concurrent.futures.ProcessPoolExecutor` is made anew with the same arguments.
"""

import contextlib
import functools
from collections.abc import Callable
from concurrent.futures import Executor, ProcessPoolExecutor
from typing import Any, ParamSpec, TypeVar

from ..foundation import arguments

P = ParamSpec("P")
R = TypeVar("R")

# The most jobs handed out at a time, if the number of workers is not known.
HANDED_OUT = 512
MOST_BREAKS = 32


def with_workers(function: Callable[P, R]) -> Callable[P, R]:
    """`function`, which gets `Workers` in place of the user's `executor`; they are closed when it ends."""

    @functools.wraps(function)
    def wrapped(*args: P.args, **kwargs: P.kwargs) -> R:
        executor = kwargs.get("executor")
        if executor is None or isinstance(executor, Workers):
            return function(*args, **kwargs)
        check_executor(executor)
        with contextlib.closing(Workers(executor)) as workers:
            return function(*args, **{**kwargs, "executor": workers})

    return wrapped


def check_executor(executor) -> None:
    """Refuse objects that take no jobs, and pools whose workers are forked from this process.

    **Raises:** `TypeError`, `ValueError`.
    """
    if executor is None or hasattr(executor, "get_executor"):
        return
    if _makes_one(executor) and not callable(executor):
        raise TypeError(
            "Argument `executor` must be an executor such as `ProcessPoolExecutor`, a Dask `Client`, or a function that makes "
            f"one, but is {arguments.describe(executor)}."
        )
    context = getattr(executor, "_mp_context", None)
    if context is not None and context.get_start_method() == "fork":
        raise ValueError(
            "Argument `executor` copies this process by fork, which JAX does not survive; make its workers afresh: "
            '`ProcessPoolExecutor(mp_context=multiprocessing.get_context("spawn"))`.'
        )


class Workers:
    """An executor of one of the kinds above, which can be replaced when it breaks."""

    def __init__(self, executor):
        self._made_here = _makes_one(executor)
        self._make: Callable[[], Any] | None = executor if self._made_here else None
        self._executor = _adopted(executor() if self._made_here else executor)
        self._breaks, self._left_running = 0, False

    @property
    def side_by_side(self) -> int | None:
        """The number of jobs that run at a time, in the order in which they were submitted; None if that is not known."""
        return getattr(self._executor, "_max_workers", None)

    def submit(self, function, *given):
        """A future of `function(*given)`."""
        return self._executor.submit(function, *given)

    def renew(self) -> None:
        """Replace an executor whose workers have died.

        **Raises:** `RuntimeError` if a new one cannot be made, or if executors keep breaking before any job is done.
        """
        self._breaks += 1
        if self._breaks > MOST_BREAKS:
            raise RuntimeError(
                f"The workers of `executor` died {self._breaks} times without one finished job. If they are started from "
                'a script, its own work must stand below `if __name__ == "__main__":`; else look at their memory.'
            )
        broken = self._executor
        with contextlib.suppress(Exception):
            broken.shutdown(wait=False)
        if self._make is not None:
            self._executor = _adopted(self._make())
        elif isinstance(broken, ProcessPoolExecutor) and type(broken).__module__.startswith("concurrent."):
            self._executor, self._made_here = _like(broken), True
        else:
            raise RuntimeError(
                "The workers of `executor` died, and with them the executor. Give a function that makes one, such as "
                "`executor=lambda: ...`, and it is made anew where that happens."
            )

    def progressed(self) -> None:
        """Note that a job is done, so the workers are able to do jobs."""
        self._breaks = 0

    def take_back(self, futures) -> None:
        """Cancel futures that are no longer needed."""
        for future in futures:
            future.cancel()
            self._left_running |= not future.done()

    def close(self) -> None:
        """Shut down an executor that was made here, with the jobs that it still runs."""
        if not self._made_here:
            return
        # Otherwise the program would wait at its end for results that are not needed.
        processes = dict(getattr(self._executor, "_processes", None) or {}) if self._left_running else {}
        with contextlib.suppress(TypeError):
            self._executor.shutdown(wait=False, cancel_futures=True)
        for process in processes.values():
            process.terminate()


def _makes_one(executor) -> bool:
    # A class has the methods, too, but they need an instance.
    return isinstance(executor, type) or not (hasattr(executor, "submit") or hasattr(executor, "get_executor"))


def _adopted(executor):
    """The object to which jobs are submitted.

    **Raises:** `TypeError` or `ValueError` if a function has made an object that is no executor.
    """
    if hasattr(executor, "get_executor"):
        return _OfDask(executor)
    if not hasattr(executor, "submit"):
        raise TypeError(
            "The function given as `executor` must make an executor, such as `ProcessPoolExecutor`, but what it made is "
            f"{arguments.describe(executor)}."
        )
    check_executor(executor)
    return executor


class _OfDask:
    """A Dask `Client`, used directly, because a future of its `get_executor` never ends if its result was lost with a worker
    and the job is not tried again.
    """

    def __init__(self, client):
        self._client = client

    def submit(self, function, *given):
        # Not pure, so that a job which was lost and is submitted again is a new task for Dask.
        return self._client.submit(function, *given, pure=False)


def _like(broken: ProcessPoolExecutor) -> Executor:
    # The arguments it was made with are in no public attributes.
    names = {"max_workers": "_max_workers", "mp_context": "_mp_context", "initializer": "_initializer"}
    names |= {"initargs": "_initargs", "max_tasks_per_child": "_max_tasks_per_child"}
    return ProcessPoolExecutor(**{name: getattr(broken, own) for name, own in names.items() if hasattr(broken, own)})


def is_loss(error: BaseException) -> bool:
    """Whether the error means that the job was lost with its worker, as opposed to having failed."""
    return isinstance(error, ConnectionError) or bool(
        {"BrokenExecutor", "CancelledError", "KilledWorker", "CommClosedError"} & _kinds(error)
    )


def is_broken(error: BaseException) -> bool:
    """Whether the error means that the executor is broken as well."""
    return "BrokenExecutor" in _kinds(error)


def is_proof(error: BaseException) -> bool:
    """Whether the error means that the executor has tried the job on several workers, all of which died (Dask)."""
    return "KilledWorker" in _kinds(error)


def _kinds(error: BaseException) -> set[str]:
    return {kind.__name__ for kind in type(error).__mro__}
