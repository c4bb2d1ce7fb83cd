"""What long work says of itself: a bar in terminals, lines on the command line without one, and nothing elsewhere."""

import io
import os
import sys
import time

import pytest

import fivjax as fj
from fivjax.foundation import progress
from fivjax.foundation.progress import following, in_lines, reported, stage, tick


@pytest.fixture(autouse=True)
def at_once(monkeypatch):
    """Work of a second is shown; here, all."""
    monkeypatch.setattr(progress, "AFTER", 0.0)
    monkeypatch.setattr(progress, "EVERY", 0.02)


@pytest.fixture
def terminal(monkeypatch):
    monkeypatch.setattr(progress, "_has_room", lambda: True)


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True

    def fileno(self) -> int:
        return 2


def wait():
    time.sleep(0.2)


@reported("search")
def searched(*, progress: bool | None = None) -> int:
    stage("closing")
    wait()
    return 7


def test_without_a_terminal_nothing_is_said(capsys):
    """A log file must not fill with carriage returns."""
    assert searched() == 7
    assert capsys.readouterr().err == ""


def test_a_terminal_shows_the_stage_and_the_time(terminal, capsys):
    """A long compilation must not look like a hang."""
    searched()
    assert "search, closing: 00:00" in capsys.readouterr().err


def test_progress_false_is_silent_on_a_terminal_too(terminal, capsys):
    searched(progress=False)
    assert capsys.readouterr().err == ""


def test_progress_true_shows_a_bar_without_a_terminal(capsys):
    searched(progress=True)
    assert "search" in capsys.readouterr().err


@pytest.mark.parametrize("columns", [0, 80])
def test_a_terminal_without_columns_has_no_room_for_a_bar(columns, monkeypatch):
    """Some job systems give such terminals; a bar in them is empty lines."""
    monkeypatch.setattr(sys, "stderr", Terminal())
    monkeypatch.setattr(os, "get_terminal_size", lambda _: os.terminal_size((columns, 0)))
    assert progress._has_room() == (columns > 0)


def test_the_command_line_says_a_line_for_each_stage_where_no_bar_has_room(capsys):
    with in_lines(), following("map", shown=None, total=10, unit=" cells"):
        stage("compiling")
        wait()
        stage("following")
        tick(4)
        wait()
    lines = capsys.readouterr().err.splitlines()
    assert lines == ["map, compiling, 0 of 10 cells: 0 s", "map, following, 4 of 10 cells: 0 s"]


def test_a_line_is_said_again_after_a_while(monkeypatch, capsys):
    monkeypatch.setattr(progress, "AGAIN", 0.05)
    with in_lines(), following("map", shown=None):
        wait()
    assert len(capsys.readouterr().err.splitlines()) > 1


def test_work_inside_work_is_a_stage_of_it(terminal, capsys):
    """One bar at a time; what the inner work counted is not added to the outer's parts."""
    with following("outer", shown=None, total=3, unit=" parts") as work:
        tick()
        with following("inner", shown=None, total=100):
            assert work.title == "outer, inner"
            tick(50)
            wait()
        assert (work.count, work.total, work.title) == (1, 3, "outer")
    assert "outer, inner" in capsys.readouterr().err


def test_the_rate_is_not_that_of_what_was_kept(terminal, capsys):
    """A resumed map's bar begins at what is there, and its rate counts what was computed since."""
    with following("map", shown=True, total=1000, already=900, unit=" cells") as work:
        wait()
        tick(20)
        assert work.bar is not None
        rate = work.bar.format_dict
        assert rate["n"] - rate["initial"] == 20 and work.bar.smoothing == 0


def test_a_run_of_known_values_counts_its_rows(terminal, capsys):
    fj.simulate(fj.Scene(fj.belt_oscillator(), fj.Coulomb(0.2)), 0.02, 1e-3, progress=True)
    assert "20/20" in capsys.readouterr().err
