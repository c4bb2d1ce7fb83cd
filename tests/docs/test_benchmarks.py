"""Benchmarks: the command that lists and runs them, and that pages name those which exist."""

import re
import sys
from pathlib import Path

import pytest

from benchmarks import __main__ as command
from benchmarks import page as measurements

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


PAGE = """# Measured

By hand.

<!-- printed by `maps speed` -->

| what | figure |
|---|---|
| a map | 2 s |

<!-- end of what `maps speed` printed -->

By hand, too.
"""


def test_what_a_benchmark_prints_takes_its_own_place_on_the_page(tmp_path, capsys):
    """A table in place of the table, any other output as it stands and at the end where it has no place yet; no other line changes."""
    page = tmp_path / "page.md"
    page.write_text(PAGE, encoding="utf-8")
    commands = {
        "maps speed": [
            sys.executable,
            "-c",
            "print('about μ'); print('| what | figure |\\n|---|---|\\n| a map | 1 s |')",
        ],
        "start": [sys.executable, "-c", "print('imports: 1 s')"],
        "energy": [sys.executable, "-c", "import sys; print('| half | a table |'); sys.exit(1)"],
    }
    assert command.run(commands, tmp_path / "kept.txt", command.written_into(page)) == 1
    text = page.read_text(encoding="utf-8")
    assert "| a map | 1 s |\n\n`maps speed`, 20" in text
    assert "2 s" not in text and "about μ" not in text
    assert "### `start`" in text and "```text\nimports: 1 s\n```" in text
    assert "half" not in text
    assert [line for line in PAGE.splitlines() if line not in text.splitlines()] == ["| a map | 2 s |"]
    # Again: each part is replaced, none is added.
    again = {"start": [sys.executable, "-c", "print('imports: 3 s')"]}
    assert command.run(again, tmp_path / "kept.txt", command.written_into(page)) == 0
    assert page.read_text(encoding="utf-8").count("printed by `start`") == 1
    assert list(measurements.parts(page.read_text(encoding="utf-8"))) == ["maps speed", "start"]
    capsys.readouterr()


def test_parts_of_the_page_are_of_commands_that_exist():
    """And without names every study is run, of every benchmark."""
    text = measurements.PAGE.read_text(encoding="utf-8")
    docs = command.benchmarks()
    for words in measurements.parts(text):
        assert command.command(words)
        assert all(re.search(rf"\b{word}\b", docs[words.split()[0]]) for word in words.split()[1:]), words
    asked = command.all_commands(text)
    assert {"responses", "engine first", "energy balance", "verdicts tori", "scenes one", "extremes table"} <= set(
        asked
    )
    assert not {"engine", "energy", "damaged_files format", "verdicts ghost"} & set(asked)
    assert {words.split()[0] for words in asked} == set(docs)
    assert len(set(asked)) == len(asked)


def test_a_part_without_an_end_is_refused():
    broken = PAGE.replace("<!-- end of what `maps speed` printed -->", "")
    with pytest.raises(ValueError, match="must have one part for `maps speed`"):
        measurements.with_part(broken, "maps speed", "new")
