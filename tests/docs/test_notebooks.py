"""The notebooks run from top to bottom at a small size, and are stored without what they show."""

import os
import sys
from pathlib import Path

import nbformat
import pytest
from nbclient import NotebookClient

FOLDER = Path(__file__).parents[2] / "notebooks"
NOTEBOOKS = sorted(FOLDER.glob("*.ipynb"))


def shown(notebook) -> str:
    """Everything that the cells of an executed notebook print or show, as one text."""
    said = []
    for cell in notebook.cells:
        for output in cell.get("outputs", []):
            said += [output.get("text", ""), *map(str, output.get("data", {}).values())]
    return "\n".join(said)


# What each must show: a number of the paper's, a picture, a parameter that is found again.
MUST_SHOW = {
    "01_quickstart": [
        "belt inclination",
        "tangential speed up to",
        "data:image/png;base64",
        "image/png",
        "application/vnd.jupyter.widget-view+json",
    ],
    "02_paper": ["μ_coupling: 0.22; here 0.22636"],
    "03_linear_theory": ["0.2282253477", "image/png"],
    "04_speed_and_accuracy": ["good to  1e-09: event-exact", "image/png"],
    "05_calibration": ["converged", "standard deviations away"],
    "06_limit_cycles": ["1.11209 m/s", "unstable in 1 direction", "0.5859 m/s", "image/png"],
    "07_the_boundary": ["manifold: p_crit = 1.107205808352", "Target reached", "image/png"],
    "08_your_own_structure": ["0.1779 at 76.5 Hz: flutter", "0 rigid-body modes", "found at 0.0807", "image/png"],
}


# Compiled for minutes, however small: figures of the paper, five methods with all their parts, a fit.
SLOW = (
    "02_paper",
    "03_linear_theory",
    "04_speed_and_accuracy",
    "05_calibration",
    "06_limit_cycles",
    "07_the_boundary",
    "08_your_own_structure",
)


@pytest.mark.parametrize(
    "path", [pytest.param(path, marks=[pytest.mark.slow] * (path.stem in SLOW), id=path.stem) for path in NOTEBOOKS]
)
def test_notebook_runs(path, monkeypatch):
    """In a process of its own, which finds what other tests have compiled (see `conftest`)."""
    monkeypatch.setenv("FIVJAX_SMALL", "1")
    # The package under test, wherever it lies.
    root = str(FOLDER.parent)
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(filter(None, [root, os.environ.get("PYTHONPATH")])))
    notebook = nbformat.read(path, as_version=4)
    client = NotebookClient(notebook, timeout=300, kernel_name="python3", resources={"metadata": {"path": FOLDER}})
    client.create_kernel_manager()
    assert client.km is not None
    # This interpreter, not the one that a kernel of that name was installed for.
    client.km.kernel_spec.argv[0] = sys.executable
    client.execute()
    text = shown(notebook)
    mimes = {key for cell in notebook.cells for out in cell.get("outputs", []) for key in out.get("data", {})}
    for wanted in MUST_SHOW[path.stem]:
        assert wanted in text or wanted in mimes
    assert any("image/png" in str(out) for cell in notebook.cells for out in cell.get("outputs", []))
    # What goes to standard error is a progress bar or a warning; there is no terminal for bars, so nothing may.
    warned = [
        out["text"]
        for cell in notebook.cells
        for out in cell.get("outputs", [])
        if out.get("name") == "stderr" and "Warning" in out["text"]
    ]
    assert warned == []


def test_all_five_are_here():
    assert [path.stem for path in NOTEBOOKS] == list(MUST_SHOW)


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_stored_without_outputs(path):
    notebook = nbformat.read(path, as_version=4)
    nbformat.validate(notebook)
    for cell in notebook.cells:
        assert not cell.get("outputs")
        assert cell.get("execution_count") is None
    assert path.stat().st_size < 30_000
