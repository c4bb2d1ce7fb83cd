"""The finished jobs of a long run, kept in one file while the run goes on.

A checkpoint is a file with one value per trajectory of each result, and a description of the run it belongs to. It is always
written as a whole under another name and then renamed (`io.datasets.save`), so at any instant, even after a power failure, the
file is some earlier state of the run. It contains a job as a whole or not at all, so a resumed run gives, bit for bit, the
results of one that was not interrupted.
"""

import json
import time
import warnings
from pathlib import Path

import jax
import numpy as np
import xarray as xr

from ..batches.attractors import Attractors
from ..batches.results import Verdicts, by_name, not_run
from ..io.datasets import check_writable, save
from .attractor_files import from_bytes, to_bytes
from .trajectories import Places

KIND = "fivjax checkpoint"
# Time between writes, s: long enough to cost nothing, short enough to lose little.
KEEP_EVERY = 2.0


class Checkpoint:
    """The file of a run: reads the results of an earlier run, and writes new ones.

    `run` describes the run of `total` trajectories in plain Python values (that `json` can hold).

    **Raises:** as `recall`.
    """

    def __init__(self, path: str | Path, run: dict, total: int, energy: bool):
        self.path, self.run = path, run
        self.found: dict[int, dict[bytes, Attractors]] = {}
        self.verdicts = not_run(total, energy)
        kept = recall(path, run)
        if kept is not None:
            for place, content in json.loads(kept.pop("found", np.zeros(0, np.uint8)).tobytes() or "{}").items():
                self.found[int(place)] = from_bytes(bytes.fromhex(content))
            parts = {name: kept.pop(name) for name in Verdicts._fields if name != "energy"}
            self.verdicts = Verdicts(**parts, energy=kept)
        self._written, self._new = time.monotonic(), False

    def recalled(self, places: Places | None) -> Verdicts:
        """The results kept of these trajectories (all, unless given)."""
        chosen = slice(None) if places is None else places
        return jax.tree.map(lambda leaf: leaf[chosen].copy(), self.verdicts)

    def keep(self, places: Places, verdicts: Verdicts, found: dict[bytes, Attractors]) -> None:
        """Keep the results of a job; they are written if it is time."""
        if found:
            self.found[int(places[0])] = found
        for whole, own in zip(jax.tree.leaves(self.verdicts), jax.tree.leaves(verdicts), strict=True):
            whole[places] = own
        self._new = True
        if time.monotonic() - self._written >= KEEP_EVERY:
            self.flush()

    def close(self) -> None:
        """Nothing to release."""

    def flush(self) -> None:
        """Write results that are not written yet."""
        if not self._new:
            return
        found = json.dumps({place: to_bytes(part).hex() for place, part in self.found.items()}).encode()
        results = {**by_name(self.verdicts), "found": np.frombuffer(found, np.uint8)}
        keep(self.path, self.run, results)
        self._written, self._new = time.monotonic(), False


def recall(path: str | Path, run: dict) -> dict[str, np.ndarray] | None:
    """The results kept in a checkpoint, by name; None if there is no such file yet.

    `run` describes the run in plain Python values (that `json` can hold).

    **Raises:** `ValueError`, before any work is done, for a path that cannot be written, a file that is no checkpoint, and
    the checkpoint of another run, naming the first difference.
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
    refuse_other_run(f"Checkpoint `{path}`", theirs, run)
    return {str(name): kept[name].values for name in kept.data_vars}


def refuse_other_run(what: str, theirs: dict, run: dict) -> None:
    """Refuse the results of another run.

    **Raises:** `ValueError`, naming the first difference.
    """
    ours = json.loads(json.dumps(run))
    for name in [*ours, *theirs]:
        if ours.get(name) != theirs.get(name):
            raise ValueError(
                f"{what} is of another run: {_difference(name, theirs.get(name), ours.get(name))}. "
                f"Resume it with the arguments it was begun with, or give another path."
            )


def keep(path: str | Path, run: dict, results: dict[str, np.ndarray]) -> None:
    """Write the checkpoint; if the disk does not take it, warn and leave the earlier one."""
    # All results are over trajectories, except for the attractors, which are bytes.
    over = {name: "byte" if name == "found" else "trajectory" for name in results}
    dataset = xr.Dataset({name: (over[name], values) for name, values in results.items()})
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
