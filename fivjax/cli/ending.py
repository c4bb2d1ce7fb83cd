"""The program: a command in a process of its own, which ends when it is told to.

Ctrl-C and SIGTERM (which a batch system sends before it kills a process) end a command in the same orderly way: what is
finished is kept, and a sentence says so. The exit code is 130 or 143, as of a program that the signal has killed.

Python can handle a signal only between two instructions of its main thread, which may be waiting for compiled code. So a second
thread is told of signals, too, and ends a process that has not ended by itself `PATIENCE` seconds later. While modules are
imported there is nothing to keep, and an exception may get lost: the process ends at once.
"""

import io
import os
import signal
import socket
import sys
import threading
import time
from types import FrameType
from typing import NoReturn

from ..foundation.signals import SIGNALS, exit_code, handled

# The process ends within five seconds of a signal.
PATIENCE = 4.0  # s


def program() -> NoReturn:
    """`main`, and the end of the process at once: Python would take half a second to take apart what JAX has made."""
    handled(_at_once)
    _end_when_late()
    for stream in (sys.stdout, sys.stderr):
        # What a terminal has no letters for is no reason to fail.
        if isinstance(stream, io.TextIOWrapper) and stream.errors == "strict":
            stream.reconfigure(errors="replace")
    from .command_line import main

    unread = 120  # Python's own code for what nobody reads any more
    try:
        code = main(interrupt=_interrupt)
    except BrokenPipeError:
        code = unread
    try:
        for stream in (sys.stdout, sys.stderr):
            if stream is not None:  # it was closed from the beginning
                stream.flush()
    except OSError:
        code = code or unread
    os._exit(code)


def _at_once(number: int, _: FrameType | None) -> NoReturn:
    _leave(number, "Interrupted; nothing was written.")


def _interrupt(number: int, frame: FrameType | None) -> None:
    """Leave at once while modules are imported, else by an exception."""
    if _is_importing(frame):
        _leave(number, "Interrupted.")
    # An exception that arrives in a destructor is lost; the process then ends when it is late. Nobody needs to read of it.
    sys.unraisablehook = threading.excepthook = lambda *_: None
    raise KeyboardInterrupt


def _is_importing(frame: FrameType | None) -> bool:
    while frame is not None:
        if frame.f_code.co_filename.startswith("<frozen importlib"):
            return True
        frame = frame.f_back
    return False


def _end_when_late() -> None:
    """Start the thread that ends the process if it has not ended `PATIENCE` seconds after a signal."""
    read, write = socket.socketpair()
    write.setblocking(False)
    # Python writes the numbers of signals here when they arrive, whatever its main thread is doing.
    signal.set_wakeup_fd(write.fileno(), warn_on_full_buffer=False)

    def wait() -> None:
        _kept_open = write
        number = 0
        while number not in SIGNALS:
            number = read.recv(1)[0]
        time.sleep(PATIENCE)
        _leave(number, "Interrupted; what was under way could not be ended in order. What was finished before is kept.")

    threading.Thread(target=wait, name="fivjax signals", daemon=True).start()


def _leave(number: int, sentence: str) -> NoReturn:
    # Not by `print`, which a signal may have interrupted. Whoever read it may be gone.
    try:
        os.write(2, f"fivjax: {sentence}\n".encode())
    finally:
        os._exit(exit_code(number))
