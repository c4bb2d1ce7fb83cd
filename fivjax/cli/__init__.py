"""The command line, `fivjax …`: the public API with sensible defaults; each command writes data and a picture.

Read first: `command_line`, which command is which; `options` and `structure_options`, what they share; `map_command` as one
of them. Heavy packages are imported only when a command runs, so that `--help`, `--version` and errors in options come at
once; and nothing at all before signals are handled (`program`).
"""

from .ending import program as program


def main(arguments: list[str] | None = None) -> int:
    """Run one command, see `command_line.main`."""
    from .command_line import main

    return main(arguments)
