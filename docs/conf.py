"""The site: `python -m sphinx -W -b html docs docs/_build`. Nothing is fetched and no notebook is run while it is built."""

import sys
import tomllib
from pathlib import Path

HERE = Path(__file__).parent
sys.path.insert(0, str(HERE / "_ext"))
PROJECT = tomllib.loads((HERE.parent / "pyproject.toml").read_text(encoding="utf-8"))["project"]

project = "fivjax"
author = "The fivjax authors"
copyright = "2026, the fivjax authors"
version = release = PROJECT["version"]

extensions = ["myst_nb", "reference", "code_links", "formulas"]
exclude_patterns = ["_build", "_ext"]

# Notebooks are stored with what they show (`notebooks/make_pages.py`).
nb_execution_mode = "off"
myst_enable_extensions = ["dollarmath", "colon_fence", "deflist"]
myst_heading_anchors = 3
# Comments in outputs, such as progress bars, have no lexer.
suppress_warnings = ["mystnb.unknown_mime_type"]

html_theme = "furo"
html_title = f"fivjax {version}"
html_static_path = ["_static"]
html_css_files = ["site.css"]
html_theme_options = {
    "source_repository": PROJECT["urls"]["Source"],
    "source_branch": "main",
    "source_directory": "docs/",
}
html_show_sourcelink = False
html_copy_source = False
pygments_style = "friendly"
