"""The pictures that pages of the site show, out of the notebooks: each is run at full size, and a few of its pictures are kept.

    python notebooks/make_pictures.py                  # all of them, in some minutes
    python notebooks/make_pictures.py 01_quickstart    # only these

The explorer is not among them, because it needs a browser: `python tests/notebook/test_explorer_browser.py` takes its picture.
"""

import base64
import io
import re
import sys
from pathlib import Path

import nbformat
from nbclient import NotebookClient
from PIL import Image

FOLDER = Path(__file__).parent

# Which pictures of a notebook are kept, counted from the top, and under what name.
KEPT = {
    "01_quickstart": {1: "trajectory"},
    "02_paper": {5: "kicks", 8: "energy"},
    "05_calibration": {0: "calibration"},
}
WIDTH = 760


def pictures(name: str) -> list[bytes]:
    """Every picture that a notebook shows, as PNG: of its own, or inside the HTML of a result."""
    notebook = nbformat.read(FOLDER / f"{name}.ipynb", as_version=4)
    NotebookClient(notebook, timeout=3600, resources={"metadata": {"path": FOLDER}}).execute()
    found = []
    for cell in notebook.cells:
        for output in cell.get("outputs", []):
            data = output.get("data", {})
            encoded = re.findall("data:image/png;base64,([^'\"]+)", data.get("text/html", "")) or [
                data.get("image/png")
            ]
            found += [base64.b64decode(text) for text in encoded if text]
    return found


def main(names: list[str]) -> None:
    """Run the notebooks and write what is kept of them, small, so that pages stay light."""
    for name in names or KEPT:
        shown = pictures(name)
        for place, kept in KEPT[name].items():
            picture = Image.open(io.BytesIO(shown[place])).convert("RGB")
            picture.thumbnail((WIDTH, 4 * WIDTH), Image.Resampling.LANCZOS)
            path = FOLDER / "pictures" / f"{kept}.png"
            path.parent.mkdir(exist_ok=True)
            picture.quantize(256, Image.Quantize.MAXCOVERAGE, dither=Image.Dither.NONE).save(path, optimize=True)
            print(f"wrote {path}, {path.stat().st_size / 1e3:.0f} kB")


if __name__ == "__main__":
    main(sys.argv[1:])
