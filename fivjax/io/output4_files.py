"""Matrices of Nastran OUTPUT4 files, read by pyyeti in a process of its own."""

import importlib.util
from pathlib import Path

from . import sparse_parts
from .separate_reading import parts_of


def output4_matrices(path: Path) -> dict:
    """The matrices of a file by name, sparse, of whatever shape.

    **Raises:** `ImportError` without pyyeti, `ValueError` for a file that is damaged.
    """
    if importlib.util.find_spec("pyyeti") is None:
        raise ImportError(
            f'File `{path}` needs pyyeti to be read. Install it with `pip install "fivjax[fe]"`, or give the '
            f"matrices as DMIG in a `.pch` file."
        )
    shapes, parts = {}, {}
    kind = "OUTPUT4"
    for about, values in parts_of(path, "output4", kind):
        if values is None:
            shapes[about["name"]] = tuple(about["shape"])
        else:
            parts[about["name"]] = values
    return {
        name: sparse_parts.listed(path, kind, parts[f"{name}/data"], parts[f"{name}/row"], parts[f"{name}/col"], shape)
        for name, shape in shapes.items()
    }
