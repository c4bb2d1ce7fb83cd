"""The explorer in a real browser: JupyterLab on a loopback port, Chromium without a screen, driven by Playwright.

    python tests/notebook/test_explorer_browser.py picture.png

does the same outside pytest, prints how long pictures take to change, and takes a screenshot: `picture.png`, and
`picture_narrow.png` of a window 900 pixels wide.
"""

import contextlib
import os
import secrets
import shutil
import socket
import subprocess
import sys
import time
import urllib.request
from importlib.util import find_spec
from pathlib import Path

import nbformat
import pytest

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
MISSING = [name for name in ("jupyterlab", "playwright") if find_spec(name) is None]
ROOT = Path(__file__).parents[2]

CELL = """
import numpy as np
import fivjax as fj

scene = fj.Scene(fj.belt_oscillator(), fj.Coulomb(mu=0.227), belt_speed=3.0, load=fj.Pulse(force=100.0, p=1.3))
m = fj.bistability_map(scene, mu=np.linspace(0.1, 0.22, 7), p=np.linspace(1, 2.5, 7), t_max=6.0, progress=False)
e = fj.explorer(scene, m)
e
"""

# From the key that moves a slider to the new picture, loaded.
WATCH = """() => {
  const image = document.querySelector("img.fivjax-response");
  window.took = new Promise((resolve) => {
    document.addEventListener("keydown", () => {
      const begin = performance.now();
      image.addEventListener("load", () => resolve(performance.now() - begin), { once: true });
    }, { once: true, capture: true });
  });
}"""


@contextlib.contextmanager
def jupyterlab(folder: Path):
    """A JupyterLab that serves a folder; its address, token included."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    token = secrets.token_hex(16)
    command = [
        sys.executable,
        "-m",
        "jupyterlab",
        "--no-browser",
        "--ServerApp.ip=127.0.0.1",
        f"--ServerApp.port={port}",
    ]
    command += [
        "--allow-root",
        f"--ServerApp.root_dir={folder}",
        "--LabApp.check_for_updates_class=jupyterlab.NeverCheckForUpdate",
    ]
    # Or it asks whether news may be fetched, over the picture.
    settings = folder / "JUPYTERLAB_SETTINGS_DIR" / "@jupyterlab" / "apputils-extension"
    settings.mkdir(parents=True)
    (settings / "notification.jupyterlab-settings").write_text('{"fetchNews": "false"}')
    paths = os.pathsep.join(filter(None, [str(ROOT), os.environ.get("PYTHONPATH")]))
    own = {
        name: str(folder / name) for name in ("JUPYTER_CONFIG_DIR", "JUPYTER_RUNTIME_DIR", "JUPYTERLAB_SETTINGS_DIR")
    }
    with (folder / "log").open("w") as log:
        environment = {**os.environ, **own, "PYTHONPATH": paths, "JUPYTER_TOKEN": token}
        server = subprocess.Popen(command, env=environment, stdout=log, stderr=log)
    try:
        for _ in range(120):
            with contextlib.suppress(OSError):
                urllib.request.urlopen(f"http://127.0.0.1:{port}/api", timeout=2).close()
                break
            time.sleep(0.5)
        yield f"http://127.0.0.1:{port}/lab/tree/explorer.ipynb?token={token}&reset"
    finally:
        server.terminate()
        server.wait(timeout=30)


def explore(folder: Path, screenshot: Path | None = None) -> dict:
    """Open the explorer, move sliders by key, click on the map; what was seen."""
    from playwright.sync_api import sync_playwright

    notebook = nbformat.v4.new_notebook(cells=[nbformat.v4.new_code_cell(CELL)])
    notebook.metadata["kernelspec"] = {"name": "python3", "display_name": "Python 3", "language": "python"}
    nbformat.write(notebook, folder / "explorer.ipynb")
    with jupyterlab(folder) as address, sync_playwright() as playwright:
        browser = playwright.chromium.launch(
            executable_path=CHROMIUM, args=["--no-sandbox", "--disable-gpu", "--disable-background-networking"]
        )
        page = browser.new_page(viewport={"width": 1500, "height": 1250})
        page.goto(address)
        page.locator(".jp-Notebook .jp-CodeCell").first.wait_for(timeout=60_000)
        # Whoever runs a cell before the kernel is there is asked which one is wanted.
        page.get_by_text("Python 3 (ipykernel) | Idle").wait_for(timeout=60_000)
        page.get_by_role("menuitem", name="Run", exact=True).click()
        page.get_by_text("Run All Cells", exact=True).click()
        page.locator("img.fivjax-response").wait_for(timeout=240_000)
        page.locator("img.fivjax-map").wait_for(timeout=60_000)
        picture = "document.querySelector('img.fivjax-response').src"
        readout = page.locator(".widget-readout").first
        handles = page.locator(".widget-slider .noUi-handle")
        took, before = [], readout.inner_text()
        for k in (0, 0, 0, 1, 1, 2, 2, 5):
            source = page.evaluate(picture)
            handles.nth(k).focus()
            page.evaluate(WATCH)
            page.keyboard.press("ArrowRight")
            took.append(page.evaluate("window.took") / 1e3)
            assert page.evaluate(picture) != source
            time.sleep(0.5)
        moved = readout.inner_text()
        # A place on the map: the sliders follow to its nearest trajectory.
        source = page.evaluate(picture)
        page.locator("img.fivjax-map").scroll_into_view_if_needed()
        box = page.locator("img.fivjax-map").bounding_box()
        assert box is not None
        page.mouse.click(box["x"] + 0.3 * box["width"], box["y"] + 0.3 * box["height"])
        page.wait_for_function(f"(source) => {picture} !== source", arg=source, timeout=10_000)
        page.wait_for_timeout(500)
        # In a narrow window the picture moves below the sliders, which keep their width.
        page.set_viewport_size({"width": 900, "height": 1250})
        page.wait_for_timeout(500)
        boxes = [page.locator(".slider-container").nth(k).bounding_box() for k in range(3)]
        tracks = [box["width"] for box in boxes if box]
        if screenshot is not None:
            page.locator(".jp-OutputArea-output").first.screenshot(
                path=screenshot.with_stem(f"{screenshot.stem}_narrow")
            )
        page.set_viewport_size({"width": 1500, "height": 1250})
        page.wait_for_timeout(500)
        springs = [page.locator(".widget-readout").nth(k).inner_text() for k in (7, 8)]
        opened = [page.locator(".widget-readout").nth(k).inner_text() for k in range(2)]
        if screenshot is not None:
            page.locator(".jp-OutputArea-output").first.screenshot(path=screenshot)
        browser.close()
    return {"took": took, "before": before, "moved": moved, "opened": opened, "springs": springs, "tracks": tracks}


@pytest.mark.skipif(CHROMIUM is None, reason="no Chromium is installed")
@pytest.mark.skipif(bool(MISSING), reason=f"not installed: {', '.join(MISSING)}")
def test_sliders_and_the_map_in_a_browser(tmp_path):
    seen = explore(tmp_path)
    assert seen["before"] == "0.227"
    assert float(seen["moved"]) > 0.227
    # A trajectory of the map has the map's springs, to the digit, whatever steps a slider has.
    assert seen["springs"] == ["100000", "101000"]
    # Trajectories of the map's grid: 0.10, 0.12 … and 1.00, 1.25 …
    mu, p = map(float, seen["opened"])
    assert round((mu - 0.1) / 0.02, 6) == round((mu - 0.1) / 0.02)
    assert round((p - 1) / 0.25, 6) == round((p - 1) / 0.25)
    assert seen["tracks"] and min(seen["tracks"]) > 100
    # 0.3 s is the aim, measured by the command above; a test must pass on a machine that does other things too.
    assert sorted(seen["took"][1:])[len(seen["took"]) // 2] < 1.5


if __name__ == "__main__":
    import tempfile

    with tempfile.TemporaryDirectory() as name:
        found = explore(Path(name), Path(sys.argv[1]) if len(sys.argv) > 1 else None)
    print(", ".join(f"{1e3 * t:.0f}" for t in found["took"]), "ms from key to picture;", found)
