"""`python -m fivjax.cli` is `fivjax`."""

from .command_line import program

program()
