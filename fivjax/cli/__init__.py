"""The command line, `fivjax …`: the public API with sensible defaults, data and a picture of each result.

Nothing heavy is imported before a command runs, so that `--help`, `--version` and refusals come at once.
"""

from .command_line import main as main
