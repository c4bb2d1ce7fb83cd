"""Progress of long work: one bar, with the stage in words, for whatever takes more than a second.

    with following("limit cycle", shown=progress):
        stage("searching")

`stage` and `tick` report to the work that runs now, so functions far below need no argument for it. Work inside other work has
no bar of its own: it becomes a stage of the outer one.

A bar is drawn by tqdm, in terminals and notebooks. While compiled code runs nothing can be reported, so a thread keeps the
time of the bar going. Where there is no terminal the command line asks for lines instead (`in_lines`).
"""

import contextlib
import contextvars
import functools
import os
import sys
import threading
import time
from collections.abc import Callable, Generator
from typing import ParamSpec, TypeVar

from tqdm.auto import tqdm

P = ParamSpec("P")
R = TypeVar("R")

# Work that ends sooner shows nothing; and how often the time of a bar is brought up to date, in s.
AFTER, EVERY = 1.0, 0.5
# A line that says how far work is is repeated after so long, in s.
AGAIN = 30.0


class Work:
    """What runs now, and how far it is. Several threads may report to it."""

    def __init__(self, label: str, total: int | None, already: int, unit: str, shown_as: str):
        self.label, self.unit, self.shown_as = label, unit, shown_as  # "bar", "lines" or "nothing"
        self.words, self.begun = "", time.perf_counter()
        self.total, self.count, self.already = total, already, already
        self.lock = threading.RLock()
        self.bar: tqdm | None = None
        self.said, self.said_at = "", self.begun

    @property
    def title(self) -> str:
        return f"{self.label}, {self.words}" if self.words else self.label

    def enter(self, words: str) -> None:
        """Begin a stage."""
        with self.lock:
            if words != self.words:
                self.words = words
                if self.bar is not None:
                    self.bar.set_description(self.title)

    def advance(self, count: int) -> None:
        """Count so many more parts as done."""
        with self.lock:
            self.count += count
            if self.bar is not None:
                self.bar.update(count)

    @contextlib.contextmanager
    def inside(self, label: str, total: int | None, already: int, unit: str) -> Generator["Work"]:
        """Work inside this work: a stage of it, with parts of its own to count."""
        with self.lock:
            before = self.total, self.count, self.already, self.unit, self.words
            self._close()
            self.total, self.count, self.already, self.unit, self.words = total, already, already, unit, label
        try:
            yield self
        finally:
            with self.lock:
                self._close()
                self.total, self.count, self.already, self.unit, self.words = before

    def show(self) -> None:
        """Bring what is shown up to date."""
        with self.lock:
            now = time.perf_counter()
            if self.shown_as == "bar":
                if self.bar is None:
                    self._open()
                else:
                    self.bar.refresh()
            elif self.title != self.said or now - self.said_at > AGAIN:
                done = f", {self.count} of {self.total}{self.unit}" if self.total is not None else ""
                print(f"{self.title}{done}: {now - self.begun:.0f} s", file=sys.stderr, flush=True)
                self.said, self.said_at = self.title, now

    def close(self) -> None:
        with self.lock:
            self._close()
            self.shown_as = "nothing"

    def _open(self) -> None:
        counted = self.total is not None
        self.bar = tqdm(
            desc=f"{self.title}: ",
            total=self.total,
            initial=self.already,
            unit=self.unit,
            # The mean rate: that of the last moments stays at an absurd figure after results that were kept.
            smoothing=0,
            bar_format=None if counted else "{desc}{elapsed}",
            leave=counted,
        )
        if not counted:
            self.bar.start_t -= time.perf_counter() - self.begun
        self.bar.update(self.count - self.already)

    def _close(self) -> None:
        if self.bar is not None:
            self.bar.close()
            self.bar = None


_current: contextvars.ContextVar[Work | None] = contextvars.ContextVar("work", default=None)
_lines = contextvars.ContextVar("lines", default=False)


@contextlib.contextmanager
def following(
    label: str, *, shown: bool | None, total: int | None = None, already: int = 0, unit: str = " steps"
) -> Generator[Work]:
    """Inside this context `stage` and `tick` report on this work, of `total` parts of which some are done `already`.

    It is shown if asked for; unless said, in terminals and notebooks. Inside other work it is a stage of that.
    """
    outer = _current.get()
    if outer is not None and (outer.shown_as != "nothing" or not shown):
        with outer.inside(label, total, already, unit):
            yield outer
        return
    work = Work(label, total, already, unit, _shown_as(shown))
    token = _current.set(work)
    try:
        with _time_kept(work, shown):
            yield work
    finally:
        _current.reset(token)


def reported(label: str) -> Callable[[Callable[P, R]], Callable[P, R]]:
    """A function with an argument `progress`, whose calls are followed under this label."""

    def of(function: Callable[P, R]) -> Callable[P, R]:
        @functools.wraps(function)
        def wrapped(*args: P.args, **kwargs: P.kwargs) -> R:
            with following(label, shown=kwargs.get("progress")):
                return function(*args, **kwargs)

        return wrapped

    return of


def stage(words: str) -> None:
    """Say what is done now, in a word or two: "compiling", "searching", "closing"."""
    work = _current.get()
    if work is not None:
        work.enter(words)


def tick(count: int = 1) -> None:
    """Count parts of the work that are done."""
    work = _current.get()
    if work is not None:
        work.advance(count)


@contextlib.contextmanager
def in_lines() -> Generator[None]:
    """Inside this context, without a terminal, a line for each stage is printed in place of a bar."""
    token = _lines.set(True)
    try:
        yield
    finally:
        _lines.reset(token)


def _shown_as(shown: bool | None) -> str:
    if shown is not None and not shown:
        return "nothing"
    if shown or _has_room():
        return "bar"
    return "lines" if _lines.get() else "nothing"


def _has_room() -> bool:
    """Whether there is a notebook, or a terminal in which a bar has room: those of some job systems have no columns."""
    if type(sys.stderr).__module__.startswith("ipykernel."):
        return True
    try:
        return sys.stderr.isatty() and os.get_terminal_size(sys.stderr.fileno()).columns > 0
    except (AttributeError, OSError, ValueError):
        return False


@contextlib.contextmanager
def _time_kept(work: Work, shown: bool | None) -> Generator[None]:
    """Inside this context a thread brings up to date what is shown of some work."""
    if work.shown_as == "nothing":
        yield
        return
    if shown:
        work.show()
    done = threading.Event()

    def keep_time() -> None:
        wait = 0.0 if shown else AFTER
        while not done.wait(max(wait, EVERY)):
            work.show()
            wait = 0.0

    # In this context, because a notebook shows what is drawn in the cell that the context belongs to.
    ticker = threading.Thread(target=contextvars.copy_context().run, args=(keep_time,), daemon=True)
    ticker.start()
    try:
        yield
    finally:
        done.set()
        ticker.join()
        work.close()
