"""Benchmarks: the command that lists and runs them, and that pages name those which exist."""

import re
import sys
from pathlib import Path

import pytest

from benchmarks import __main__ as command

ROOT = Path(__file__).parents[2]
# How pages name a benchmark: by its command, or by its words in brackets where the page says what they stand for.
WRITTEN_OUT = re.compile(r"python -m benchmarks\.(\w+)((?: [a-z_0-9]+)*)")
IN_BRACKETS = re.compile(r"\(`(?:FIVJAX_TIMES=\d+ )?(\w+)((?: [a-z_0-9]+)+)`")


def test_each_says_how_it_is_run_and_all_are_listed(capsys):
    assert command.main([]) == 0
    listed = capsys.readouterr().out
    for name, doc in command.benchmarks().items():
        assert f"python -m benchmarks.{name}" in doc, name
        # What it measures, how it is run, how its table is read.
        assert len(doc.split("\n\n")) >= 3, name
        assert f"\n{name} " in f"\n{listed}"


@pytest.mark.parametrize("page", ["docs/measurements.md", "docs/validation.md", "docs/structures.md", "docs/safe.md"])
def test_pages_name_benchmarks_that_exist(page):
    text = " ".join((ROOT / page).read_text(encoding="utf-8").split())
    named = WRITTEN_OUT.findall(text)
    if page in ("docs/measurements.md", "docs/validation.md"):
        named += IN_BRACKETS.findall(text)
    assert named
    docs = command.benchmarks()
    for name, words in (one for one in named if one[0] not in ("fivjax", "pytest")):
        # The finite-element brake's folder and numbers are arguments, all other words are studies.
        assert all(re.search(rf"\b{word}\b", docs[name]) for word in words.split() if not word.isdigit()), (name, words)


def test_output_is_kept_in_one_file_whatever_fails(tmp_path, capsys):
    commands = {
        "good": [sys.executable, "-c", "print('a figure')"],
        "bad": [sys.executable, "-c", "import sys; sys.exit('no figure')"],
    }
    assert command.run(commands, tmp_path / "kept.txt") == 1
    kept = (tmp_path / "kept.txt").read_text()
    assert kept == capsys.readouterr().out
    assert kept.startswith("=== good\na figure\n=== good: exit code 0, ")
    assert "no figure\n=== bad: exit code 1, " in kept


def test_a_benchmark_that_is_not_there_is_refused():
    assert command.command('maps "speed"')[-2:] == ["benchmarks.maps", "speed"]
    with pytest.raises(SystemExit, match="There is no benchmark `mapps`"):
        command.main(["run", "mapps"])
