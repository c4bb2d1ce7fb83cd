"""`python -m fivjax.cli` is `fivjax`."""

from .ending import program

program()
