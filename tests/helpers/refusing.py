"""What a refusal looks like, for the tests that ask for one; each is noted, so that kinds of bad input can be counted."""

import contextlib
import re

import pytest

from fivjax import cli

# What compiles: the functions that the public ones call once their arguments are checked.
ENGINES = (
    "fivjax.maps.bistability.run_to_verdict",
    "fivjax.kicks.narrowing.run_to_verdict",
    "fivjax.simulation.trajectory.rows_in_parts",
    "fivjax.simulation.trajectory.rows_by_kernel",
    "fivjax.calibration.fit.misfit_of_waveform",
    "fivjax.kicks.tradeoff_study._end_state",
    "fivjax.simulation.differentiation._differentiated",
)


class EngineReached(BaseException):
    """Bad input got as far as compiled code. Not an `Exception`, so that no handler takes it for a refusal."""


def without_engines(monkeypatch) -> None:
    """Have every function that compiles raise `EngineReached`: a check that is made after compiling comes minutes too late."""

    def reached(*_, **__):
        raise EngineReached

    for name in ENGINES:
        monkeypatch.setattr(name, reached)
    # It configures JAX for the whole process.
    monkeypatch.setattr("fivjax.cli.command_line.keep_compiled_code", lambda: None)


SEEN: set[str] = set()  # kinds of refusals met in this process: sentences without their values


def sentence(message: str) -> bool:
    return (message[0].isupper() or message[0] == "`") and message[-1] in ".?" and "\n" not in message


def note(message: str) -> None:
    """Numbers, quoted values and paths are not what makes a kind; an argument's name is."""
    kind = re.sub(r"`[^`]*/[^`]*`", "`PATH`", message)
    kind = re.sub(r"'[^']*'|\([^)]*\)|it has: .*|has: .*", "…", kind)
    SEEN.add(re.sub(r"[-+]?\d+(\.\d+)?(e[-+]?\d+)?|\bnan\b|\binf\b", "#", kind))


@contextlib.contextmanager
def refused(error, *fragments):
    """A refusal in whole sentences that hold all of these fragments: the argument's name and the value among them."""
    with pytest.raises(error) as refusal:
        yield
    message = str(refusal.value)
    assert sentence(message), message
    for fragment in fragments:
        assert fragment in message, message
    note(message)


@contextlib.contextmanager
def untouched(folder):
    """The folder holds the same files with the same contents afterwards: no result, no temporary."""

    def contents():
        return {path.name: path.is_file() and path.read_bytes() for path in folder.iterdir()}

    before = contents()
    yield
    assert contents() == before


def refused_on_the_command_line(capsys, arguments) -> str:
    """The sentence that a command answers with; it must come on standard error, with exit code 2 and nothing else."""
    code = cli.main([str(argument) for argument in arguments])
    captured = capsys.readouterr()
    assert code == 2, captured
    assert captured.out == ""
    lines = captured.err.splitlines()
    assert len(lines) == 1, lines
    assert lines[0].startswith("fivjax: ")
    message = lines[0].removeprefix("fivjax: ")
    assert sentence(message), message
    note(message)
    return message
