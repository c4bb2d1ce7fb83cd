"""The signals that end a program, and their handlers."""

import signal
from collections.abc import Callable

SIGNALS = (signal.SIGINT, signal.SIGTERM)


def handled(handler: Callable) -> dict:
    """Have the signals handled so, but for those that the caller ignores (`nohup`) or handles outside Python; returns their
    former handlers.
    """
    before = {number: signal.getsignal(number) for number in SIGNALS}
    before = {number: former for number, former in before.items() if former not in (signal.SIG_IGN, None)}
    for number in before:
        signal.signal(number, handler)
    return before


def handled_as_before(before: dict) -> None:
    """Undo `handled`."""
    for number, handler in before.items():
        signal.signal(number, handler)


def exit_code(number: int) -> int:
    """The exit code of a process that a signal has ended."""
    return 128 + number
