"""What is published: versions, addresses and what to cite are said once, or alike wherever they are said again."""

import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

import fivjax as fj
from fivjax.io.references import PAPER_DOI

ROOT = Path(__file__).parents[2]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
CITATION = (ROOT / "CITATION.cff").read_text(encoding="utf-8")


def field(name: str) -> str:
    found = re.search(rf'^{name}: "?([^"\n]+)', CITATION, re.MULTILINE)
    assert found is not None
    return found.group(1)


def test_the_version_is_that_of_the_project_file():
    """Rejects a release whose citation, or whose own word, is of another version."""
    assert fj.__version__ == PROJECT["version"] == field("version")
    assert f"version = {{{fj.__version__}}}" in fj.citation()


def test_what_to_cite_is_the_same_everywhere():
    """Rejects another paper or another home in one of the places that name them."""
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    for text in (fj.citation(), CITATION, readme):
        assert PAPER_DOI in text
    for author in ("Cattai", "Tonazzi", "Ciprari", "Massi"):
        assert author in fj.citation()
        assert author in CITATION
        assert author in readme
    assert field("repository-code") == PROJECT["urls"]["Source"] == PROJECT["urls"]["Homepage"]
    assert f"{{{PROJECT['urls']['Homepage']}}}" in fj.citation()
    assert field("url") == PROJECT["urls"]["Documentation"]
    assert field("license") == PROJECT["license"]


def test_a_type_checker_is_told_to_look():
    """Without this file a user's checker takes everything here for `Any`."""
    assert (Path(fj.__file__).parent / "py.typed").is_file()


def test_a_user_s_file_is_clean_to_a_type_checker():
    """Rejects a public name whose type a checker cannot see, or sees wrongly."""
    command = [
        sys.executable,
        "-m",
        "pyrefly",
        "check",
        "--error=missing-attribute,bad-argument-type",
        "--python-interpreter-path",
        sys.executable,
        str(ROOT / "tests" / "helpers" / "typed_user.py"),
    ]
    done = subprocess.run(command, capture_output=True, text=True, cwd=ROOT / "tests")
    assert done.returncode == 0, done.stdout


def test_the_readme_can_be_read_in_a_checkout():
    """Its pictures and links to our own pages are files of the tree, so they show before anything is published. It is short
    enough to be read.
    """
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    assert len(readme.split()) <= 900
    for address in re.findall(r"\]\(([^)]+)\)", readme):
        assert address.startswith("https://doi.org/") or (ROOT / address).exists(), address


def test_where_the_project_is_published_is_said_once():
    """In the project file, from which all else reads it; `CITATION.cff`, whose form has no references, is held to it above."""
    home = PROJECT["urls"]["Homepage"].removeprefix("https://")
    site = PROJECT["urls"]["Documentation"].removeprefix("https://")
    for path in [*ROOT.glob("*.md"), *(ROOT / "fivjax").rglob("*.py"), *(ROOT / "docs").glob("**/*.md")]:
        text = path.read_text(encoding="utf-8")
        assert home not in text and site.rstrip("/") not in text, path


@pytest.mark.parametrize("name", ["CHANGELOG.md", "CITATION.cff", "LICENSE", "README.md"])
def test_the_source_archive_has(name):
    """A packager works from the archive alone."""
    included = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["tool"]["hatch"]["build"]["targets"]
    assert name in included["sdist"]["include"]
    assert (ROOT / name).is_file()
