"""The notebooks with what they show, for the site: each is run at full size and written to `docs/notebooks`.

    python notebooks/make_pages.py                  # all of them, in some minutes
    python notebooks/make_pages.py 01_quickstart    # only these

Pictures are made small, progress bars are left out, and what needs a running kernel is replaced by a picture of it.
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
PAGES = FOLDER.parent / "docs" / "notebooks"
WIDTH = 1100
EXPLORER = (
    "![The explorer: sliders, response, status, energy, phase plane and map](../../notebooks/pictures/explorer.png)"
)


def smaller(encoded: str) -> str:
    """A PNG of at most `WIDTH` pixels and 256 colours."""
    picture = Image.open(io.BytesIO(base64.b64decode(encoded))).convert("RGB")
    picture.thumbnail((WIDTH, 4 * WIDTH), Image.Resampling.LANCZOS)
    file = io.BytesIO()
    picture.quantize(256, Image.Quantize.MAXCOVERAGE, dither=Image.Dither.NONE).save(file, "PNG", optimize=True)
    return base64.b64encode(file.getvalue()).decode()


def kept(output, source: str):
    """An output of a cell as the page has it; None where it is left out."""
    if output.get("name") == "stderr":
        return None
    data = output.get("data", {})
    if any("widget" in kind for kind in data):
        # What is no explorer is a progress bar.
        if "fj.explorer" not in source:
            return None
        return nbformat.v4.new_output("display_data", {"text/markdown": EXPLORER})
    if "image/png" in data:
        return nbformat.v4.new_output("display_data", {"image/png": smaller(data["image/png"])})
    if "text/html" in data:
        shrunk = re.sub(
            r"(data:image/png;base64,)([^'\"]+)", lambda m: m.group(1) + smaller(m.group(2)), data["text/html"]
        )
        return nbformat.v4.new_output("display_data", {"text/html": shrunk})
    return output


def page(name: str):
    """The notebook as a page: run, with what is worth keeping."""
    notebook = nbformat.read(FOLDER / f"{name}.ipynb", as_version=4)
    NotebookClient(notebook, timeout=3600, resources={"metadata": {"path": FOLDER}}).execute()
    for number, cell in enumerate(notebook.cells):
        cell["id"] = f"cell-{number}"
        cell.metadata.clear()
        if cell.cell_type == "code":
            cell.outputs = [found for output in cell.outputs if (found := kept(output, cell.source)) is not None]
            for output in cell.outputs:
                if "execution_count" in output:
                    output["execution_count"] = cell.execution_count
    notebook.metadata = {"kernelspec": {"display_name": "Python 3", "language": "python", "name": "python3"}}
    return notebook


def main(names: list[str]) -> None:
    """Write the pages."""
    for name in names or sorted(path.stem for path in FOLDER.glob("*.ipynb")):
        path = PAGES / f"{name}.ipynb"
        path.parent.mkdir(exist_ok=True)
        nbformat.write(page(name), path)
        print(f"wrote {path}, {path.stat().st_size / 1e3:.0f} kB", flush=True)


if __name__ == "__main__":
    main(sys.argv[1:])
