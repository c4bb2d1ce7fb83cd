"""Figures that pages state more than once are those of the page of measurements, or of the code."""

import re
from pathlib import Path

import pytest

from fivjax.attractors import divergence, long_run
from fivjax.maps import plan

ROOT = Path(__file__).parents[2]
DOCS = ROOT / "docs"


def text_of(path: Path) -> str:
    return " ".join(path.read_text(encoding="utf-8").split())


def rows(path: Path) -> list[list[str]]:
    """The rows of all tables of a page, as cells."""
    lines = path.read_text(encoding="utf-8").splitlines()
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in lines if line.startswith("|")]


MOST_WINDOWS = rows(DOCS / "measurements.md")


def measured(start: str) -> str:
    """The figure of the row that begins so."""
    (found,) = [row[1] for row in MOST_WINDOWS if row[0].startswith(start)]
    return found


@pytest.mark.parametrize("page", ["docs/methods.md", "docs/howto/gpu.md"])
def test_what_kernels_gain_is_as_measured(page):
    """ "A fortieth of the time" is the ratio of two measured times, rounded to tens."""
    with_kernels, without = map(
        float, re.findall(r"([\d.]+) s", measured("64 × 64, μ 0.05–0.228, p 1–4, 3 m/s; without kernels"))
    )
    assert round(without / with_kernels, -1) == 40
    assert "maps take a fortieth of the time" in text_of(ROOT / page)


def test_methods_are_compared_by_the_measured_errors():
    compared = {row[0]: row[1:4] for row in rows(DOCS / "methods.md") if row[0].startswith("`fj.")}
    assert compared == {row[0]: row[1:] for row in MOST_WINDOWS if row[0].startswith("`fj.") and len(row) == 4}
    assert len(compared) == 2


def test_sizes_of_jobs_are_those_of_the_plan():
    said = f"at most {plan.GROUPS_IN_A_JOB} structures and {plan.IN_A_JOB} trajectories ({plan.IN_A_LONG_JOB} "
    assert said in text_of(DOCS / "howto" / "long_maps.md")


def test_how_long_motions_are_followed_on_is_as_in_the_code():
    first, onward = divergence.WINDOW_RETURNS * divergence.MOST_WINDOWS, long_run.TIMES * long_run.ONWARD
    assert (round(first, -3), round(first + onward, -4)) == (6000, 40_000)
    assert "for six thousand crossings at most" in text_of(DOCS / "verdicts.md")
    assert "for up to forty thousand crossings" in text_of(ROOT / "fivjax" / "maps" / "bistability.py")
