"""`python -m fivjax.cli` is `fivjax`."""

from .program import program

program()
