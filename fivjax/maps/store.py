"""The finished jobs of a long run, kept in a folder of chunks (Zarr) while the run goes on: for maps of many million
trajectories.

The folder is a Zarr group that `xarray.open_zarr` reads at any time: one array per result over the map's axes, in which
trajectories that have not been run have the verdict `NOT_RUN`. A chunk is the part of the grid that one job computes, and ends
in a checksum (Zarr's codec `crc32c`). Only the process that hands out the jobs writes chunks, so a chunk has one writer; a file
lock keeps other processes out. The verdicts of a job are written last, after all its other results are on the disk: a chunk
with verdicts is complete, even if the process is killed. A chunk that cannot be read counts as not run.

Zarr's metadata carry no checksums. So those of all files that make an empty store are kept in a file of their own, `checksums`.
A damaged one of these files is made anew, because it follows from the run.
"""

import contextlib
import errno
import json
import math
import os
import warnings
import zlib
from collections.abc import Generator, Iterator
from pathlib import Path

import numpy as np

from ..attractors.catalogue import Attractors
from ..foundation.seals import Damaged, sealed, unsealed
from ..foundation.whole_files import own_folder
from ..io.files import check_writable, replace_whole
from .checkpoint import refuse_other_run
from .job_files import attractors_from_bytes, attractors_to_bytes, file_of
from .plan import Grid, Indices, Tiles
from .results import Verdicts, by_name, not_run
from .run_lock import RunLock

KIND = "fivjax store"
CHECKSUMS = "checksums"
# Errors in reading a file that say nothing of what is in it.
NOT_OF_THE_FILE = (
    errno.EACCES,
    errno.EPERM,
    errno.EMFILE,
    errno.ENFILE,
    errno.ENOMEM,
    errno.EAGAIN,
    errno.EINTR,
    errno.ETIMEDOUT,
    errno.ESTALE,
    errno.EIO,
)
HOW_ON = "Delete it to begin the run anew, or give another path."


# The subfolders for attractors that later jobs need, and for jobs that are under way.
FOUND, JOBS = "attractors", "jobs"


def is_store(path: str | Path) -> bool:
    """Whether results are to be kept in a folder of chunks."""
    return Path(path).suffix == ".zarr"


class Store:
    """The folder of a run: reads the results of an earlier run, and writes new ones.

    **Raises:** `ValueError`, before any work is done, for a path that cannot be written, a folder that is no store, the store
    of another run (naming the first difference), one whose metadata are damaged, and one that another process is writing;
    `ImportError` without Zarr; `OSError` for a disk that is full or read-only, naming the store.
    """

    def __init__(self, path: str | Path, run: dict, grid: Grid, tile: tuple[int, ...], energy: bool):
        self.path, self.tiles = Path(path), Tiles(grid.shape, tile)
        self.found: dict[int, dict[bytes, Attractors]] = {}
        self.energy, self.run = energy, {**run, "chunk": list(tile)}
        fields = by_name(not_run(1, energy))
        if not self.path.exists():
            with _naming(self.path):
                create(self.path, self.run, grid, tile, fields)
        check_begun(self.path, self.run, grid, tile, fields)
        with _naming(self.path):
            self._lock = RunLock(self.path, f"Store `{self.path}`")
        try:
            # A chunk without a file is one that was not written, or is lost.
            with zarr().config.set({"array.write_empty_chunks": True}):
                group = zarr().open_group(self.path, mode="r+", use_consolidated=False)
                self.arrays = {name: group[name] for name in fields}
            # Chunks that this run begins have nothing to recall.
            self._earlier = set(self._chunks_begun())
            for file in sorted((self.path / FOUND).glob("*.npz")):
                # Without it, the job that found it is run again.
                with contextlib.suppress(OSError, Damaged, ValueError):
                    self.found[int(file.stem)] = attractors_from_bytes(unsealed(file.read_bytes()))
        except BaseException:
            self._lock.release()
            raise

    def _chunks_begun(self) -> Iterator[int]:
        return (number for number in range(len(self.tiles)) if self._chunk("verdict", number).exists())

    def recall(self, places: Indices | None) -> Verdicts:
        """The results kept by earlier runs of these trajectories (all, unless given)."""
        verdicts = not_run(self.tiles.total if places is None else len(places), self.energy)
        for number, inside, rows in self.tiles.among(places):
            if number not in self._earlier:
                continue
            parts = self._read(number)
            if not parts:
                self._earlier.remove(number)
                continue
            for name, values in by_name(verdicts).items():
                values[rows] = parts[name][inside]
        return verdicts

    def _read(self, number: int) -> dict[str, np.ndarray]:
        """All results in a chunk, by name; none where any of them is damaged, of which then none counts."""
        parts, at = {}, self.tiles.slices(number)
        for name, array in self.arrays.items():
            try:
                if not self._chunk(name, number).exists():
                    raise FileNotFoundError(errno.ENOENT, "missing")
                parts[name] = np.array(array[at]).ravel()
            except Exception as error:  # a damaged chunk may raise any error in its decoder
                if isinstance(error, MemoryError) or getattr(error, "errno", None) in NOT_OF_THE_FILE:
                    raise
                file = self._chunk(name, number).relative_to(self.path)
                # Without verdicts, none of its trajectories counts as run.
                self._chunk("verdict", number).unlink(missing_ok=True)
                warnings.warn(
                    f"Store `{self.path}` is damaged: file `{file}` is not what was written. The trajectories of this chunk "
                    f"are computed anew.",
                    stacklevel=6,
                )
                return {}
        return parts

    def job_file(self, places: Indices) -> tuple[str, str]:
        """The path and the key of the file for the job with these trajectories."""
        return file_of(self.path / JOBS, self.run, places)

    def keep(self, places: Indices, verdicts: Verdicts, found: dict[bytes, Attractors] | None) -> None:
        """Keep the results of the job with these trajectories."""
        with _naming(self.path):
            self._keep(places, verdicts, found)

    def _keep(self, places: Indices, verdicts: Verdicts, found: dict[bytes, Attractors] | None) -> None:
        if found is not None:
            folder = self.path / FOUND
            folder.mkdir(exist_ok=True)
            replace_whole(folder / f"{int(places[0])}.npz", sealed(attractors_to_bytes(found)))
        fields = by_name(verdicts)
        parts = []
        for number, inside, rows in self.tiles.among(places):
            shape = [part.stop - part.start for part in self.tiles.slices(number)]
            # Of a part that has several jobs, what the others have written stays.
            earlier = {}
            if len(rows) < math.prod(shape) and self._chunk("verdict", number).exists():
                earlier = self._read(number)
            parts.append((number, inside, rows, shape, earlier))
        for name in sorted(fields, key=lambda name: name == "verdict"):  # verdicts last
            for number, inside, rows, shape, earlier in parts:
                nothing = np.full(math.prod(shape), self.arrays[name].fill_value, fields[name].dtype)
                values = earlier.get(name, nothing)
                values[inside] = fields[name][rows]
                # pyrefly: ignore[unsupported-operation]
                self.arrays[name][self.tiles.slices(number)] = values.reshape(shape)
                _sync(self._chunk(name, number))
        Path(self.job_file(places)[0]).unlink(missing_ok=True)

    def _chunk(self, name: str, number: int) -> Path:
        return self.path.joinpath(name, "c", *map(str, np.unravel_index(number, self.tiles.parts)))

    def flush(self) -> None:
        """Nothing to do: every job is written at once."""

    def close(self) -> None:
        """Release the lock, so that other processes may write."""
        with contextlib.suppress(OSError):  # jobs are under way, or there never were any
            (self.path / JOBS).rmdir()
        self._lock.release()


@contextlib.contextmanager
def _naming(path: Path) -> Generator[None]:
    """Errors of the operating system name the store, and say what to do."""
    try:
        yield
    except OSError as error:
        raise OSError(
            error.errno,
            f"Store `{path}` cannot be written: {error.strerror}. What it holds is whole. Make room, or the disk writable, and "
            f"call again; or give another path",
        ) from error


def _sync(path: Path) -> None:
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def zarr():
    """The module `zarr`.

    **Raises:** `ImportError` where it is not installed.
    """
    try:
        import zarr
    except ImportError:
        raise ImportError("Maps are kept in a Zarr store by the package zarr: `pip install fivjax[zarr]`.") from None
    return zarr


def create(path: Path, run: dict, grid: Grid, tile: tuple[int, ...], fields: dict[str, np.ndarray]) -> None:
    """Create an empty store; it appears under its name only when it is whole. One that another process has begun meanwhile is
    left alone.
    """
    with own_folder(check_writable(path).parent) as part:
        _fill(part, run, grid, tile, fields)
        mask = os.umask(0)
        os.umask(mask)
        part.chmod(0o777 & ~mask)
        try:
            part.rename(path)
        except OSError as error:
            if error.errno not in (errno.ENOTEMPTY, errno.EEXIST):
                raise


def _fill(part: Path, run: dict, grid: Grid, tile: tuple[int, ...], fields: dict[str, np.ndarray]) -> None:
    """Make an empty store of a folder."""
    zarr()  # says what is to be done where it is not installed
    from zarr.codecs import Crc32cCodec, ZstdCodec

    codecs = {"compressors": [ZstdCodec(), Crc32cCodec()]}
    group = zarr().create_group(part, zarr_format=3, attributes={"kind": KIND, "run": json.dumps(run)})
    for name, values in grid.axes.items():
        group.create_array(name, data=values, chunks=(len(values),), dimension_names=(name,), **codecs)
    for name, one in fields.items():
        group.create_array(
            name,
            shape=grid.shape,
            chunks=tile,
            dtype=one.dtype,
            fill_value=one[0],
            dimension_names=tuple(grid.axes),
            **codecs,
        )
    with warnings.catch_warnings():
        # Zarr warns that consolidated metadata is not supported everywhere; without it, xarray warns that opening is slow.
        warnings.simplefilter("ignore", UserWarning)
        zarr().consolidate_metadata(part)
    files = {str(file.relative_to(part)): _checksum(file) for file in sorted(part.rglob("*")) if file.is_file()}
    (part / CHECKSUMS).write_bytes(sealed(json.dumps(files).encode()))


def check_begun(path: Path, run: dict, grid: Grid, tile: tuple[int, ...], fields: dict[str, np.ndarray]) -> None:
    """Check that a folder is the store of this run, and replace damaged files in it that do not depend on its results.

    **Raises:** `ValueError` for what is no store, for one of another run, naming the first difference, and for one that is
    damaged so that this cannot be told.
    """
    root = path / "zarr.json"
    try:
        files = json.loads(unsealed((path / CHECKSUMS).read_bytes()))
    except (OSError, Damaged) as error:
        _refuse_unchecked(path, isinstance(error, Damaged))
        raise
    damaged = [name for name, sum_ in files.items() if _checksum(path / name) != sum_]
    if root.name not in damaged:
        refuse_other_run(f"Store `{path}`", json.loads(json.loads(root.read_text())["attributes"]["run"]), run)
    if not damaged:
        return
    with own_folder(path.parent) as part:
        _fill(part, run, grid, tile, fields)
        for name in damaged:
            # What is not made again as it was belongs to another run, or was made by another version of Zarr.
            if _checksum(part / name) != files[name]:
                raise ValueError(
                    f"Store `{path}` is damaged: file `{name}` is not what was written, and cannot be made again. {HOW_ON}"
                )
            warnings.warn(f"Store `{path}` was damaged: file `{name}` is made anew.", stacklevel=6)
            (path / name).parent.mkdir(parents=True, exist_ok=True)
            replace_whole(path / name, (part / name).read_bytes())


def _refuse_unchecked(path: Path, damaged: bool) -> None:
    if damaged:
        raise ValueError(f"Store `{path}` is damaged: file `{CHECKSUMS}` is not what was written. {HOW_ON}") from None
    try:
        ours = KIND in (path / "zarr.json").read_text(errors="replace")
    except OSError:
        ours = False
    if not ours:
        raise ValueError(f"`{path}` is not a store of fivjax; give another path for the store.") from None
    raise ValueError(
        f"Store `{path}` has no checksums: it is damaged, or a version of fivjax began it that kept none. {HOW_ON}"
    ) from None


def _checksum(file: Path) -> int | None:
    try:
        return zlib.crc32(file.read_bytes())
    except OSError:
        return None
