"""Where jobs run: any executor in the manner of `concurrent.futures`, and how to have another when its workers die.

What is taken for an executor:

- anything with `submit(function, *arguments)` that gives futures with `add_done_callback` and `result`: thread and process
  pools, loky, `mpi4py.futures`, and what `client.get_executor()` of Dask gives;
- a Dask `Client`, recognised by its `get_executor`;
- a class or a function that makes one without arguments. fivjax then shuts it down, and calls the function anew when the
  workers of the earlier one have died and taken it with them (`BrokenProcessPool`).

A `concurrent.futures.ProcessPoolExecutor` that broke is made anew from what it was made with.
"""

import contextlib
import functools
from collections.abc import Callable
from concurrent.futures import Executor, ProcessPoolExecutor
from typing import Any, ParamSpec, TypeVar

from ..foundation import arguments

P = ParamSpec("P")
R = TypeVar("R")

# Jobs that are handed out before the first is back, where the number of workers is not known.
HANDED_OUT = 512
MOST_BREAKS = 32


def with_workers(function: Callable[P, R]) -> Callable[P, R]:
    """`function`, with `Workers` in place of what a user gives it as `executor`, until it ends."""

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
    """Refuse what no job can be handed to, and pools whose workers are copies of this process.

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
    """An executor of one of the kinds above, as something that jobs are submitted to and that can be had anew."""

    def __init__(self, executor):
        self._made_here = _makes_one(executor)
        self._make: Callable[[], Any] | None = executor if self._made_here else None
        self._executor = _adopted(executor() if self._made_here else executor)
        self._breaks, self._left_running = 0, False

    @property
    def side_by_side(self) -> int | None:
        """How many jobs run at a time, in the order in which they were submitted; None where that is not known."""
        return getattr(self._executor, "_max_workers", None)

    def submit(self, function, *given):
        """A future of `function(*given)`."""
        return self._executor.submit(function, *given)

    def renew(self) -> None:
        """Another executor in place of one whose workers have died.

        **Raises:** `RuntimeError` where there is no way to have one, and where all workers die before any job is done.
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
        """A job is done: the workers can do them."""
        self._breaks = 0

    def take_back(self, futures) -> None:
        """Nobody waits for these any more."""
        for future in futures:
            future.cancel()
            self._left_running |= not future.done()

    def close(self) -> None:
        """Ends an executor that was made here, and what it still runs."""
        if not self._made_here:
            return
        # Else the program would wait at its end for work that nobody wants.
        processes = dict(getattr(self._executor, "_processes", None) or {}) if self._left_running else {}
        with contextlib.suppress(TypeError):
            self._executor.shutdown(wait=False, cancel_futures=True)
        for process in processes.values():
            process.terminate()


def _makes_one(executor) -> bool:
    # Of a class the methods are there, and need an object of it.
    return isinstance(executor, type) or not (hasattr(executor, "submit") or hasattr(executor, "get_executor"))


def _adopted(executor):
    """What jobs are submitted to.

    **Raises:** `TypeError`, `ValueError` for what a function has made that is no executor.
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
    """A Dask `Client`, used directly: a future of its `get_executor` never ends when its result is lost and its job is not
    tried again.
    """

    def __init__(self, client):
        self._client = client

    def submit(self, function, *given):
        # Not pure: a job that was lost and comes again is not the same task to Dask.
        return self._client.submit(function, *given, pure=False)


def _like(broken: ProcessPoolExecutor) -> Executor:
    # What it was made with is in no public attribute.
    names = {"max_workers": "_max_workers", "mp_context": "_mp_context", "initializer": "_initializer"}
    names |= {"initargs": "_initargs", "max_tasks_per_child": "_max_tasks_per_child"}
    return ProcessPoolExecutor(**{name: getattr(broken, own) for name, own in names.items() if hasattr(broken, own)})


def is_loss(error: BaseException) -> bool:
    """Whether a job that ended so was lost with its worker, as opposed to having failed."""
    return isinstance(error, ConnectionError) or bool(
        {"BrokenExecutor", "CancelledError", "KilledWorker", "CommClosedError"} & _kinds(error)
    )


def is_broken(error: BaseException) -> bool:
    """Whether the executor was lost as well."""
    return "BrokenExecutor" in _kinds(error)


def is_proof(error: BaseException) -> bool:
    """Whether the executor itself has tried the job on several workers, which died (Dask)."""
    return "KilledWorker" in _kinds(error)


def _kinds(error: BaseException) -> set[str]:
    return {kind.__name__ for kind in type(error).__mro__}
