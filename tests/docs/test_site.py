"""The site: every public name is in it, its code runs as it stands, its links lead somewhere, its notebooks are the ones in the tree."""

import doctest
import importlib.util
import inspect
import re
import shutil
import subprocess
import sys
from pathlib import Path

import matplotlib
import nbformat
import numpy as np
import pytest

import fivjax as fj

ROOT = Path(__file__).parents[2]
DOCS = ROOT / "docs"
SLOW = doctest.register_optionflag("SLOW")

_spec = importlib.util.spec_from_file_location("reference", DOCS / "_ext" / "reference.py")
assert _spec is not None
assert _spec.loader is not None
reference = importlib.util.module_from_spec(_spec)
_spec.loader.exec_module(reference)

PAGES = sorted(path for path in DOCS.rglob("*.md") if not {"_build", "reference"} & set(path.parts))
# Pages whose code takes seconds; of the others a map or a limit cycle is compiled.
QUICK = {"cite", "clusters"}


def code_of(path: Path) -> list[str]:
    return re.findall(r"^```python\n(.*?)^```", path.read_text(encoding="utf-8"), re.DOTALL | re.MULTILINE)


WITH_CODE = [path for path in [ROOT / "README.md", *PAGES] if code_of(path)]


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """An empty folder to run in, with the sample recording where pages and docstrings look for it."""
    (tmp_path / "notebooks").mkdir()
    for place in (tmp_path, tmp_path / "notebooks"):
        shutil.copy(ROOT / "notebooks" / "decay.csv", place)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", ["page"])
    with matplotlib.rc_context({"figure.max_open_warning": 0, "backend": "agg"}):
        yield tmp_path


@pytest.mark.parametrize(
    "path", [pytest.param(p, marks=[pytest.mark.slow] * (p.stem not in QUICK), id=p.stem) for p in WITH_CODE]
)
def test_the_code_of_a_page_runs_as_it_stands(path, folder, capsys):
    """From top to bottom, as a reader would type it; where the page shows what it prints, it prints that."""
    text = path.read_text(encoding="utf-8")
    exec(compile("\n".join(code_of(path)), path.name, "exec"), {"__name__": "page"})
    said = capsys.readouterr().out
    for shown in re.findall(
        r"^```python\n.*?^```\n+(?:They print[^\n]*\n+)?```text\n(.*?)^```", text, re.DOTALL | re.MULTILINE
    ):
        for line in shown.splitlines():
            # How well a cycle closes is rounding: its last digits differ from machine to machine.
            assert line in said or "closes to" in line


@pytest.fixture(scope="module")
def names():
    """What examples in docstrings find defined."""
    structure = fj.belt_oscillator()
    scene = fj.Scene(structure, fj.Coulomb(mu=0.227), belt_speed=3.0, load=fj.Pulse(force=100.0, p=1.2))
    run = fj.simulate(scene.replace(p=1.5), 0.4, 1e-3, energy=True)
    return {"fj": fj, "np": np, "structure": structure, "scene": scene, "run": run}


def examples(slow: bool):
    """Docstrings with an example, those that take long or the others."""
    finder = doctest.DocTestFinder(recurse=False)
    for name, thing in reference.documented():
        (found,) = finder.find(thing, name, module=False, globs={}) or [None]
        if found is not None and found.examples and any(SLOW in e.options for e in found.examples) == slow:
            yield found


def run_examples(slow: bool, names) -> None:
    runner = doctest.DocTestRunner(verbose=False, optionflags=doctest.NORMALIZE_WHITESPACE)
    said: list[str] = []
    for found in examples(slow):
        found.globs = dict(names)
        runner.run(found, out=said.append, clear_globs=True)
    assert runner.tries
    assert not said, "".join(said)


@pytest.mark.slow
def test_examples_in_docstrings_run(names, folder):
    """Rejects an example that has fallen behind the function it stands under."""
    run_examples(False, names)


@pytest.mark.slow
def test_examples_in_docstrings_that_take_long_run(names, folder):
    run_examples(True, names)


def test_every_public_function_and_class_has_an_example():
    """What the door offers can be tried from its own docstring."""
    without = {
        name
        for name in dir(fj)
        if callable(getattr(fj, name)) and ">>>" not in (reference._own_docstring(getattr(fj, name)) or "")
    }
    # Results, shown where they are made.
    assert without <= {"Calibration", "CycleDerivatives", "Derivatives", "Reduction"}


def documented_arguments(doc: str):
    """The names that begin the items of a docstring's list of arguments."""
    listed = re.search(r"\*\*Arguments:\*\*\n\n(.*?)(?:\n\n[ ]*\*\*|\Z)", inspect.cleandoc(doc), re.S)
    for item in re.findall(r"^- ((?:`[^`]+`(?:, | and )?)+)", listed.group(1) if listed else "", re.M):
        yield from (name.lstrip("*") for name in re.findall(r"`([^`]+)`", item))


def test_documented_arguments_are_those_of_the_function():
    """Rejects an argument that a rename, or a slip of one, has left in a docstring."""
    assert list(
        documented_arguments("A map.\n\n**Arguments:**\n\n- `a`, `b`: numbers.\n- `**axes`: `c`.\n\n**Returns:** `d`.")
    ) == ["a", "b", "axes"]
    asked = [fj, fj.cea, fj.design, fj.energy, fj.plot]
    functions = {getattr(of, name) for of in asked for name in dir(of) if inspect.isfunction(getattr(of, name))}
    told = {f: list(documented_arguments(f.__doc__ or "")) for f in functions}
    assert sum(map(len, told.values())) > 100
    wrong = {
        (f.__name__, name) for f, names in told.items() for name in names if name not in inspect.signature(f).parameters
    }
    assert not wrong


def test_every_public_name_has_a_place_in_the_reference():
    """Rejects a name that the site leaves out, and one on two pages."""
    pages = reference.names_by_page()
    placed = [name for names in pages.values() for name in names]
    assert sorted(placed) == sorted(dir(fj))
    for name in placed:
        text = reference.described(name)
        kind = "py:module} fivjax." if name in ("cea", "design", "energy", "plot") else "} "
        assert f"{kind}{name}" in text or "py:module" in text


@pytest.mark.parametrize("path", [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *PAGES], ids=lambda path: path.stem)
def test_links_inside_the_project_lead_somewhere(path):
    """Rejects a link to a page, a heading, a picture or a file of the tree that is not there."""
    for address in re.findall(r"\]\(([^)\s]+)\)", path.read_text(encoding="utf-8")):
        if "://" in address or address.startswith("reference/") or "/reference/" in address:
            continue
        target, _, anchor = address.partition("#")
        target = (path.parent / target) if target else path
        assert target.exists(), address
        if anchor:
            headings = re.findall(r"^#+ (.*)$", target.read_text(encoding="utf-8"), re.MULTILINE)
            assert anchor in {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}, (
                address
            )


NOTEBOOKS = sorted((ROOT / "notebooks").glob("*.ipynb"))


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_stored_pages_are_of_the_notebooks_in_the_tree(path):
    """A page that shows what an earlier notebook computed is rejected; `python notebooks/make_pages.py` makes it anew."""
    page = DOCS / "notebooks" / path.name
    assert page.exists(), f"python notebooks/make_pages.py {path.stem}"
    ours, theirs = (nbformat.read(file, as_version=4) for file in (path, page))
    assert [cell.source for cell in ours.cells] == [cell.source for cell in theirs.cells], path.stem
    assert any(cell.get("outputs") for cell in theirs.cells)
    assert page.stat().st_size < 1_500_000


@pytest.mark.slow
def test_the_site_builds_without_a_warning(tmp_path):
    """Offline, with warnings as errors; and its inventory, which other projects link by, has every public name."""
    inventory = pytest.importorskip("sphinx.util.inventory", reason="Sphinx is missing: pip install '.[docs]'")
    command = [sys.executable, "-m", "sphinx", "-W", "--keep-going", "-q", "-b", "html", "-d", tmp_path / "trees"]
    done = subprocess.run([*command, DOCS, tmp_path / "site"], capture_output=True, text=True, cwd=ROOT)
    assert done.returncode == 0, done.stderr[-3000:]
    with (tmp_path / "site" / "objects.inv").open("rb") as file:
        known = inventory.InventoryFile.load(file, "", lambda base, uri: uri)
    entries_of = getattr(known, "data", known)  # a dictionary until Sphinx 8
    found = {name for kind, entries in entries_of.items() if kind.startswith("py:") for name in entries}
    assert {f"fivjax.{name}" for name in dir(fj)} <= found
