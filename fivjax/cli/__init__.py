"""The command line, `fivjax …`: the public API with sensible defaults; each command writes data and a picture.

Heavy packages are imported only when a command runs, so that `--help`, `--version` and errors in options come at once.
"""

from .command_line import main as main
from .command_line import program as program
