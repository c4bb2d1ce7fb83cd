"""`python -m fivjax` is `fivjax`."""

from .cli.ending import program

if __name__ == "__main__":
    program()
