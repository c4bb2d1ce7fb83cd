"""The commands, and the exit codes of what they raise."""

import contextlib
import signal
import sys
import threading
from collections.abc import Callable, Generator
from types import FrameType

import tyro

import fivjax as fj

from ..foundation.progress import in_lines
from ..foundation.signals import exit_code, handled, handled_as_before
from .analysis_commands import Calibrate, Cea
from .compiled_code import keep_compiled_code
from .cycle_commands import Branch, CycleCommand
from .map_command import Map
from .outputs import Failure, Interrupted
from .parsing import options, refuse_repeated
from .simulate_command import Simulate
from .study_commands import Reproduce, Tradeoff

COMMANDS = {
    "map": Map,
    "simulate": Simulate,
    "cea": Cea,
    "cycle": CycleCommand,
    "branch": Branch,
    "calibrate": Calibrate,
    "tradeoff": Tradeoff,
    "reproduce": Reproduce,
}


def main(arguments: list[str] | None = None, interrupt: Callable[[int, FrameType | None], None] | None = None) -> int:
    """Run one command. Returns the exit code; errors are sentences on standard error.

    0: success; 1: no result, or the disk did not take it; 2: refused; 130: interrupted; 143: terminated.

    `interrupt` is called when SIGINT or SIGTERM arrives, and raises `KeyboardInterrupt`; so does what stands in for it.
    """
    arguments = sys.argv[1:] if arguments is None else arguments
    if arguments == ["--version"]:
        print(f"fivjax {fj.__version__}")
        return 0
    with options():
        # pyrefly: ignore[no-matching-overload]
        command = tyro.extras.subcommand_cli_from_dict(
            COMMANDS,
            prog="fivjax",
            description="Friction-induced vibration: what a scene does after a kick. `fivjax --version` prints the version.",
            args=arguments,
        )
    keep_compiled_code()
    received: list[int] = []
    try:
        with _interruptible(received, interrupt or _interrupt), in_lines():
            refuse_repeated(arguments)
            command.run()
    except BaseException as error:
        if isinstance(error, Interrupted | KeyboardInterrupt) or received:
            said = error if isinstance(error, Interrupted) else "Interrupted; nothing more was written."
            print(f"fivjax: {said}", file=sys.stderr)
            return exit_code(received[0] if received else signal.SIGINT)
        if isinstance(error, MemoryError):
            print(f"fivjax: There is not enough memory for that ({error}); ask for less.", file=sys.stderr)
            return 1
        if isinstance(error, OSError) and not isinstance(error, BrokenPipeError):
            print(f"fivjax: What is needed on disk could not be written: {error}.", file=sys.stderr)
            return 1
        if isinstance(error, ImportError) and error.name is None:  # a sentence that says what to install
            print(f"fivjax: {error}", file=sys.stderr)
            return 2
        if isinstance(error, ValueError | TypeError | Failure):
            print(f"fivjax: {error}", file=sys.stderr)
            return 1 if isinstance(error, Failure) else 2
        raise
    return 0


def _interrupt(*_) -> None:
    raise KeyboardInterrupt


@contextlib.contextmanager
def _interruptible(received: list[int], interrupt: Callable[[int, FrameType | None], None]) -> Generator[None]:
    """Note SIGINT and SIGTERM in `received` before they interrupt."""

    def note(number: int, frame: FrameType | None) -> None:
        received.append(number)
        interrupt(number, frame)

    # Only a program's main thread may set signal handlers.
    before = handled(note) if threading.current_thread() is threading.main_thread() else {}
    try:
        yield
    finally:
        handled_as_before(before)
