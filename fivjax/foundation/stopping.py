"""Ctrl-C and SIGTERM in a long run: noted when they arrive, obeyed at a point where no work is left half done.

Python raises `KeyboardInterrupt` between any two instructions: perhaps while a file is being written, or inside a destructor,
where it is swallowed and the run goes on.

A thread inside compiled code cannot be stopped. So it is waited for only for a while, and then left behind.
"""

import contextlib
import contextvars
import signal
import threading
from collections.abc import Callable, Generator
from concurrent.futures import Future, ThreadPoolExecutor, wait
from typing import TypeVar

from .precision import own_settings
from .signals import handled, handled_as_before

R = TypeVar("R")

# How long threads are waited for once a run is to stop, s.
PATIENCE = 2.0


@contextlib.contextmanager
def stop_requests() -> Generator[list[int]]:
    """Inside this context the first signal is only added to the list that it gives; a second one stops the run at once.

    At the end the former handlers are back, and a signal that was noted is sent again; but not a Ctrl-C that nobody else
    handles, which has done what it is for.
    """
    caught: list[int] = []
    # Only a program's main thread may set signal handlers.
    if threading.current_thread() is not threading.main_thread():
        yield caught
        return

    def note(number, _):
        if caught:
            raise KeyboardInterrupt
        caught.append(number)

    before = handled(note)
    try:
        yield caught
    finally:
        handled_as_before(before)
        if caught and before[caught[0]] is not signal.default_int_handler:
            signal.raise_signal(caught[0])


def interruptible(call: Callable[[], R]) -> R:
    """The result of a call that is inside compiled code for long. It runs in a thread, which a signal leaves behind at once: it
    goes on for nobody until it ends, or the process does. Of JAX's settings by context it has `own_settings` only.
    """
    if threading.current_thread() is not threading.main_thread():
        return call()
    context, outcome = contextvars.copy_context(), Future()

    def run() -> None:
        try:
            with own_settings():
                outcome.set_result(context.run(call))
        except BaseException as error:
            outcome.set_exception(error)

    threading.Thread(target=run, daemon=True).start()
    # A signal that comes just before waiting begins is handled when it ends, so it ends soon.
    while not outcome.done():
        wait([outcome], timeout=0.2)
    return outcome.result()


@contextlib.contextmanager
def waited_for(pool: ThreadPoolExecutor, *used: ThreadPoolExecutor) -> Generator[tuple[ThreadPoolExecutor, ...]]:
    """A pool of threads, and others that these use, which are waited for when the context ends; where it ends by an exception,
    for `PATIENCE` at most.
    """
    try:
        yield pool, *used
    except BaseException:
        pool.shutdown(wait=False, cancel_futures=True)
        # A pool waits for ever, so a thread waits for it.
        waiting = threading.Thread(target=pool.shutdown, daemon=True)
        waiting.start()
        waiting.join(PATIENCE)
        for one in used:
            one.shutdown(wait=False, cancel_futures=True)
        raise
    for one in (pool, *used):
        one.shutdown()
