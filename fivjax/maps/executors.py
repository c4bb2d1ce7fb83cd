"""Executors of jobs: any in the manner of `concurrent.futures`; how jobs are handed out to one, and how a new one is made when
its workers die.

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
import pickle
import queue
from collections import Counter, deque
from collections.abc import Callable, Sequence
from concurrent.futures import Executor, ProcessPoolExecutor
from typing import Any, ParamSpec, TypeVar

from ..foundation import arguments

P = ParamSpec("P")
R = TypeVar("R")

# A job that is lost so often while others run is run alone, and one that is lost so often then is given up.
MOST_LOSSES = 3


def with_workers(function: Callable[P, R]) -> Callable[P, R]:
    """`function`, which gets `Workers` in place of the user's `executor`; they are closed when it ends."""

    @functools.wraps(function)
    def wrapped(*args: P.args, **kwargs: P.kwargs) -> R:
        executor = kwargs.get("executor")
        if executor is None or isinstance(executor, Workers):
            return function(*args, **kwargs)
        check_executor(executor)
        with contextlib.closing(Workers(executor)) as workers:
            return function(*args, **{**kwargs, "executor": workers})  # pyrefly: ignore[invalid-param-spec]

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
        self._executor = _with_submit(executor() if self._made_here else executor)
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
        if self._breaks > 32:
            raise RuntimeError(
                f"The workers of `executor` died {self._breaks} times without one finished job. If they are started from "
                'a script, its own work must stand below `if __name__ == "__main__":`; else look at their memory.'
            )
        broken = self._executor
        with contextlib.suppress(Exception):
            broken.shutdown(wait=False)
        if self._make is not None:
            self._executor = _with_submit(self._make())
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


def _with_submit(executor):
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


def was_tried_on_several(error: BaseException) -> bool:
    """Whether the error means that the executor has tried the job on several workers, all of which died (Dask)."""
    return "KilledWorker" in _kinds(error)


def _kinds(error: BaseException) -> set[str]:
    return {kind.__name__ for kind in type(error).__mro__}


def hand_out(
    jobs: Sequence[int],
    submit: Callable[[int], Any],
    workers: Workers,
    done: Callable[[int, Any], None],
    given_up: Callable[[int], None],
    stop: Callable[[], bool],
) -> None:
    """Run all jobs (numbers): `submit` hands one out and returns its future, `done` gets its result, in any order.

    Workers may die. If several jobs run at a time, a broken pool does not tell which of them killed a worker, so a lost job is
    first run again after all others. A job that is lost three times waits until all others are done, and then runs alone; if
    its worker dies three times again, the job is the cause, and `given_up` is called for it.

    **Raises:** `KeyboardInterrupt` once `stop()` is true, or if a worker was interrupted; `RuntimeError` if there are no
    workers any more; `ValueError` where jobs cannot be sent to them; and anything that a job raises.
    """
    waiting = _Waiting(jobs, given_up)
    under_way: dict[Any, int] = {}  # futures, in the order in which they were handed out
    back: queue.SimpleQueue[Any] = queue.SimpleQueue()
    try:
        while waiting.any_left or under_way:
            _submit_some(waiting, submit, workers, under_way, back)
            try:
                # While no result arrives, requests to stop are looked for.
                future = back.get(timeout=0.2)
            except queue.Empty:
                future = None
            if stop():
                for finished, number in under_way.items():
                    if _has_result(finished):
                        done(number, finished.result())
                raise KeyboardInterrupt
            if future is None or future not in under_way:
                continue
            running = list(under_way)[: workers.side_by_side]
            number = under_way.pop(future)
            result, loss = _result_or_loss(future)
            if loss is None:
                done(number, result)
                workers.progressed()
                continue
            gone = [(future, number)]
            if is_broken(loss):
                # Jobs that were finished before the workers died still report their results.
                gone += [one for one in under_way.items() if not _has_result(one[0])]
                for one, _ in gone[1:]:
                    del under_way[one]
                workers.renew()
            for one, number in gone:
                # Jobs begin in order, so only the first ones were running.
                waiting.put_back(number, MOST_LOSSES if was_tried_on_several(loss) else int(one in running))
    finally:
        workers.take_back(under_way)


class _Waiting:
    """The jobs that are still to be run, and how often each was lost."""

    def __init__(self, jobs: Sequence[int], given_up: Callable[[int], None]):
        self._together, self._one_by_one = deque(jobs), deque()
        self._lost, self._lost_alone = Counter(), Counter()
        self._alone: int | None = None  # the job that runs alone
        self._given_up = given_up

    @property
    def any_left(self) -> bool:
        return bool(self._together or self._one_by_one)

    def now(self, running: int, room: int) -> int | None:
        """The job to be run next beside so many, if there is `room` for it."""
        if self._together or running:
            return self._together[0] if self._together and running < room else None
        return self._one_by_one[0] if self._one_by_one else None

    def begin(self, number: int) -> None:
        """This job, the next one, is run."""
        beside_others = bool(self._together)
        (self._together if beside_others else self._one_by_one).popleft()
        self._alone = None if beside_others else number

    def put_back(self, number: int, blamed: int) -> None:
        """This job was lost, and is so often `blamed` for it: it is run again, or given up."""
        (self._lost_alone if number == self._alone else self._lost)[number] += blamed
        if self._lost_alone[number] >= MOST_LOSSES:
            self._given_up(number)
        elif self._lost[number] >= MOST_LOSSES:
            self._one_by_one.append(number)
        else:
            self._together.append(number)


def _submit_some(
    waiting: _Waiting,
    submit: Callable[[int], Any],
    workers: Workers,
    under_way: dict[Any, int],
    back: "queue.SimpleQueue[Any]",
) -> None:
    """Hand out as many jobs as there is room for; their futures come `back` when they are done."""
    # Where the number of workers is not known, so many jobs.
    room = 512 if workers.side_by_side is None else workers.side_by_side + 1
    while (number := waiting.now(len(under_way), room)) is not None:
        try:
            future = submit(number)
        except Exception as error:
            if not is_broken(error):
                raise
            if under_way:
                return  # the futures under way will report the same error
            workers.renew()
            continue
        waiting.begin(number)
        under_way[future] = number
        future.add_done_callback(back.put)


def _result_or_loss(future) -> tuple[Any, BaseException | None]:
    """What a job has come to, or the error that says that it was lost."""
    try:
        return future.result(), None
    except BaseException as error:
        if isinstance(error, pickle.PicklingError) or (
            isinstance(error, AttributeError | TypeError) and "pickle" in str(error)
        ):
            raise ValueError(
                f"The scene cannot be sent to the workers of `executor` ({error}). Define its classes and functions "
                f"in a module that they can import, or take an executor that sends them by value, such as loky's."
            ) from error
        if not is_loss(error):
            raise
        return None, error


def _has_result(future) -> bool:
    return future.done() and not future.cancelled() and future.exception() is None
