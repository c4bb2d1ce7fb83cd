"""`python -m fivjax` is `fivjax`."""

from .cli.ending import program

program()
