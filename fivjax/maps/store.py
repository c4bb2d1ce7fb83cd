"""The finished jobs of a long run, kept in a folder of chunks (Zarr) while the run goes on: for maps of many million
trajectories.

The folder is a Zarr group that `xarray.open_zarr` reads at any time: one array per result over the map's axes, in which
trajectories that have not been run have the verdict `NOT_RUN`. A chunk is the part of the grid that one job computes. Only the
process that hands out the jobs writes, so a chunk has one writer; a file lock keeps other processes out. The verdicts of a job
are written last, after all its other results are on the disk: a chunk with verdicts is complete, even if the process is killed.
A chunk that cannot be read counts as not run.
"""

import contextlib
import json
import math
import os
import shutil
import tempfile
import warnings
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from ..batches.attractors import Attractors
from ..batches.results import Verdicts, by_name, not_run
from ..io.files import check_writable
from .attractor_files import from_bytes, to_bytes
from .checkpoint import refuse_other_run
from .trajectories import Grid, Places, Tiles

KIND = "fivjax store"
# The subfolder for attractors that later jobs need.
FOUND = "attractors"


def is_store(path: str | Path) -> bool:
    """Whether results are to be kept in a folder of chunks."""
    return Path(path).suffix == ".zarr"


class Store:
    """The folder of a run: reads the results of an earlier run, and writes new ones.

    **Raises:** `ValueError`, before any work is done, for a path that cannot be written, a folder that is no store, the store
    of another run (naming the first difference), and one that another process is writing; `ImportError` without Zarr.
    """

    def __init__(self, path: str | Path, run: dict, grid: Grid, tile: tuple[int, ...], energy: bool):
        zarr = _zarr()
        self.path, self.tiles = Path(path), Tiles(grid.shape, tile)
        self.found: dict[int, dict[bytes, Attractors]] = {}
        self.energy = energy
        run = {**run, "chunk": list(tile)}
        fields = by_name(not_run(1, energy))
        with contextlib.suppress(FileExistsError):
            if not self.path.exists():
                _create(self.path, run, grid, tile, fields)
        _refuse_other(self.path, run)
        self._lock = _locked(self.path)
        try:
            group = zarr.open_group(self.path, mode="r+", use_consolidated=False)
            self.arrays = {name: group[name] for name in fields}
            # Chunks that this run begins have nothing to recall.
            self._earlier = set(self._begun())
            for file in sorted((self.path / FOUND).glob("*.npz")):
                with contextlib.suppress(Exception):  # an incomplete file, after a power failure
                    self.found[int(file.stem)] = from_bytes(file.read_bytes())
        except BaseException:
            self._lock.close()
            raise

    def _begun(self) -> Iterator[int]:
        return (number for number in range(len(self.tiles)) if self._chunk("verdict", number).exists())

    def recalled(self, places: Places | None) -> Verdicts:
        """The results kept by earlier runs of these trajectories (all, unless given)."""
        verdicts = not_run(self.tiles.total if places is None else len(places), self.energy)
        for number, inside, rows in self.tiles.among(places):
            if number not in self._earlier:
                continue
            try:
                parts = {name: self._values(name, number) for name in self.arrays}
            except Exception:  # a damaged chunk may raise any error in its decoder
                # Without verdicts, none of its trajectories counts as run.
                self._chunk("verdict", number).unlink()
                self._earlier.remove(number)
                continue
            for name, values in by_name(verdicts).items():
                values[rows] = parts[name][inside]
        return verdicts

    def _values(self, name: str, number: int) -> np.ndarray:
        return np.array(self.arrays[name][self.tiles.slices(number)]).ravel()

    def keep(self, places: Places, verdicts: Verdicts, found: dict[bytes, Attractors]) -> None:
        """Keep the results of the job with these trajectories."""
        if found:
            folder = self.path / FOUND
            folder.mkdir(exist_ok=True)
            _write(folder / f"{int(places[0])}.npz", to_bytes(found))
        fields = by_name(verdicts)
        parts = list(self.tiles.among(places))
        for name in sorted(fields, key=lambda name: name == "verdict"):  # verdicts last
            for number, inside, rows in parts:
                at = self.tiles.slices(number)
                shape = [part.stop - part.start for part in at]
                values = np.full(math.prod(shape), self.arrays[name].fill_value, fields[name].dtype)
                if len(rows) < len(values) and self._chunk(name, number).exists():
                    # One that is damaged has no verdicts either, so nothing in it counts.
                    with contextlib.suppress(Exception):
                        values = self._values(name, number)
                values[inside] = fields[name][rows]
                self.arrays[name][at] = values.reshape(shape)
                # A chunk that contains only the fill value has no file.
                if (chunk := self._chunk(name, number)).exists():
                    _sync(chunk)

    def _chunk(self, name: str, number: int) -> Path:
        return self.path.joinpath(name, "c", *map(str, np.unravel_index(number, self.tiles.parts)))

    def flush(self) -> None:
        """Nothing to do: every job is written at once."""

    def close(self) -> None:
        """Release the lock, so that other processes may write."""
        self._lock.close()


def _zarr():
    try:
        import zarr
    except ImportError:
        raise ImportError("Maps are kept in a Zarr store by the package zarr: `pip install fivjax[zarr]`.") from None
    return zarr


def _create(path: Path, run: dict, grid: Grid, tile: tuple[int, ...], fields: dict[str, np.ndarray]) -> None:
    """Create an empty store; it appears under its name only when it is whole."""
    zarr = _zarr()
    part = Path(tempfile.mkdtemp(dir=check_writable(path).parent, prefix=".fivjax."))
    try:
        group = zarr.create_group(part, zarr_format=3, attributes={"kind": KIND, "run": json.dumps(run)})
        for name, values in grid.axes.items():
            group.create_array(name, data=values, chunks=(len(values),), dimension_names=(name,))
        for name, one in fields.items():
            group.create_array(
                name,
                shape=grid.shape,
                chunks=tile,
                dtype=one.dtype,
                fill_value=one[0],
                dimension_names=tuple(grid.axes),
            )
        with warnings.catch_warnings():
            # Zarr warns that consolidated metadata is not supported everywhere; without it, xarray warns that opening is slow.
            warnings.simplefilter("ignore", UserWarning)
            zarr.consolidate_metadata(part)
        mask = os.umask(0)
        os.umask(mask)
        part.chmod(0o777 & ~mask)
        part.rename(path)
    except BaseException:
        shutil.rmtree(part, ignore_errors=True)
        raise


def _refuse_other(path: Path, run: dict) -> None:
    try:
        attributes = json.loads((path / "zarr.json").read_text())["attributes"]
        theirs = json.loads(attributes["run"]) if attributes["kind"] == KIND else None
    except (OSError, ValueError, KeyError):
        theirs = None
    if theirs is None:
        raise ValueError(f"`{path}` is not a store of fivjax; give another path for the store.")
    refuse_other_run(f"Store `{path}`", theirs, run)


def _locked(path: Path):
    """A lock on the store, which the operating system releases at the latest when the process ends."""
    file = open(path / ".lock", "a")  # noqa: SIM115
    try:
        import fcntl
    except ImportError:  # Windows
        return file
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        file.close()
        raise ValueError(f"Store `{path}` is being written by another process; wait for it, or end it.") from None
    except OSError:  # a file system without locks
        pass
    return file


def _write(path: Path, content: bytes) -> None:
    part = path.with_suffix(".part")
    part.write_bytes(content)
    _sync(part)
    part.replace(path)


def _sync(path: Path) -> None:
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)
