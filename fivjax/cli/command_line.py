"""The program: its commands and exit codes."""

import contextlib
import os
import signal
import sys
import threading
from typing import NoReturn

import tyro

import fivjax as fj

from ..foundation.progress import in_lines
from .analysis_commands import Calibrate, Cea
from .branch_command import Branch
from .compiled_code import keep_compiled_code
from .cycle_command import Cycle
from .map_command import Map
from .outputs import Failure, Interrupted
from .parsing import numbers
from .simulate_command import Simulate
from .study_commands import Reproduce, Tradeoff

COMMANDS = {
    "map": Map,
    "simulate": Simulate,
    "cea": Cea,
    "cycle": Cycle,
    "branch": Branch,
    "calibrate": Calibrate,
    "tradeoff": Tradeoff,
    "reproduce": Reproduce,
}


def main(arguments: list[str] | None = None) -> int:
    """Run one command. Returns the exit code; errors are sentences on standard error.

    0: success; 1: no result, or the disk did not take it; 2: refused before any work; 130: interrupted.
    """
    arguments = sys.argv[1:] if arguments is None else arguments
    if arguments == ["--version"]:
        print(f"fivjax {fj.__version__}")
        return 0
    with numbers():
        command = tyro.extras.subcommand_cli_from_dict(
            COMMANDS,
            prog="fivjax",
            description="Friction-induced vibration: what a scene does after a kick. `fivjax --version` says which it is.",
            args=arguments,
        )
    keep_compiled_code()
    try:
        with _terminated_like_interrupted(), in_lines():
            command.run()
    except (ValueError, TypeError) as error:
        print(f"fivjax: {error}", file=sys.stderr)
        return 2
    except OSError as error:
        print(f"fivjax: A result could not be written: {error}.", file=sys.stderr)
        return 1
    except Failure as failure:
        print(f"fivjax: {failure}", file=sys.stderr)
        return 1
    except Interrupted as interruption:
        print(f"fivjax: {interruption}", file=sys.stderr)
        return 130
    except KeyboardInterrupt:
        print("fivjax: Interrupted; nothing was written.", file=sys.stderr)
        return 130
    return 0


def program() -> NoReturn:
    """`main`, and the end of the process at once: Python would take half a second to take apart what JAX has made."""
    code = main()
    try:
        sys.stdout.flush()
        sys.stderr.flush()
    except OSError:  # nobody reads it any more; the code is Python's own for this
        code = code or 120
    os._exit(code)


@contextlib.contextmanager
def _terminated_like_interrupted():
    """SIGTERM, which a batch system sends before it kills a process, ends a run in the same orderly way as Ctrl-C."""

    def interrupt(*_):
        raise KeyboardInterrupt

    # Only a program's main thread may set signal handlers.
    mine = threading.current_thread() is threading.main_thread()
    before = signal.signal(signal.SIGTERM, interrupt) if mine else None
    try:
        yield
    finally:
        if mine:
            signal.signal(signal.SIGTERM, before)
