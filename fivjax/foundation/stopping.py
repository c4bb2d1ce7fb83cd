"""Ctrl-C and SIGTERM in a long run: noted when they arrive, obeyed where nothing is left half done.

Python raises `KeyboardInterrupt` between any two instructions: in the middle of a record, or inside a destructor, where
it is swallowed and the run goes on.
"""

import contextlib
import signal
import threading
from collections.abc import Iterator


@contextlib.contextmanager
def stop_requests() -> Iterator[list[int]]:
    """Within, the first signal is only added to the list that this gives; who asks a second time is obeyed at once.

    At the end the signals mean what they meant before, and a SIGTERM that was noted is sent again.
    """
    caught: list[int] = []
    # Only a program's main thread may say what a signal does.
    if threading.current_thread() is not threading.main_thread():
        yield caught
        return

    def note(number, _):
        if caught:
            raise KeyboardInterrupt
        caught.append(number)

    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    # What the caller ignores (`nohup`), or handles outside Python, stays as it is.
    before = {number: handler for number, handler in before.items() if handler not in (signal.SIG_IGN, None)}
    for number in before:
        signal.signal(number, note)
    try:
        yield caught
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
        if signal.SIGTERM in caught:
            signal.raise_signal(signal.SIGTERM)
