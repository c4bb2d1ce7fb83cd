"""What a long run has finished, kept on disk while it goes on.

A checkpoint is a file with one value per trajectory of each result, and a description of the run it belongs to. It is
written anew as a whole and appears under its name only then (`io.datasets.save`), so at any instant, also that of a power
cut, the file is some earlier state of the run. A trajectory's result does not depend on which others run beside it; so what a
resumed run adds is, bit for bit, what the interrupted one would have found.
"""

import json
import warnings
from pathlib import Path

import numpy as np
import xarray as xr

from ..io.datasets import check_writable, save

KIND = "fivjax checkpoint"


def recall(path: str | Path, run: dict) -> dict[str, np.ndarray] | None:
    """The results kept in a checkpoint, by name; None where there is no such file yet.

    `run` describes the run in plain Python values (what `json` can hold).

    **Raises:** `ValueError`, before any work is done, for a path that cannot be written, a file that is no checkpoint, and
    the checkpoint of another run, with the first difference.
    """
    path = check_writable(path)
    if not path.exists():
        return None
    try:
        with xr.open_dataset(path, engine="h5netcdf") as file:
            kept = file.load()
        theirs = json.loads(kept.attrs["run"]) if kept.attrs.get("kind") == KIND else None
    except (OSError, ValueError, KeyError):
        theirs = None
    if theirs is None:
        raise ValueError(f"File `{path}` is not a checkpoint of fivjax; give another path for the checkpoint.")
    ours = json.loads(json.dumps(run))
    for name in [*ours, *theirs]:
        if ours.get(name) != theirs.get(name):
            raise ValueError(
                f"Checkpoint `{path}` is of another run: {_difference(name, theirs.get(name), ours.get(name))}. "
                f"Resume it with the arguments it was begun with, or give another path."
            )
    return {str(name): kept[name].values for name in kept.data_vars}


def keep(path: str | Path, run: dict, results: dict[str, np.ndarray]) -> None:
    """Write the checkpoint; where the disk does not take it, say so and leave the earlier one."""
    dataset = xr.Dataset({name: ("trajectory", values) for name, values in results.items()})
    dataset.attrs.update(kind=KIND, run=json.dumps(run))
    try:
        save(dataset, path)
    except (OSError, ValueError) as error:
        warnings.warn(
            f"Checkpoint `{path}` could not be written ({error}); the run goes on and will try again.", stacklevel=3
        )


def _difference(name: str, theirs, ours) -> str:
    if isinstance(theirs, dict) and isinstance(ours, dict):
        for inner in [*ours, *theirs]:
            if theirs.get(inner) != ours.get(inner):
                return _difference(inner, theirs.get(inner), ours.get(inner))
    short = [text if len(text) <= 40 else f"{text[:37]}..." for text in map(json.dumps, (theirs, ours))]
    return f"its `{name}` is {short[0]} and not {short[1]}"
