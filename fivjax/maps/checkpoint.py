"""The finished jobs of a long run, kept in one file while the run goes on.

A checkpoint is a file with the results of finished jobs, the indices of their trajectories, and a description of the run. It is
always written as a whole under another name and then renamed, so at any instant, even after a power failure, the file is some
earlier state of the run. It contains a job as a whole or not at all, so a resumed run gives, bit for bit, the results of one
that was not interrupted. Jobs that are under way are kept beside it (`job_files`), in a folder that exists only while there are
any, or while a process writes the checkpoint: a lock in it keeps others out.
"""

import contextlib
import json
import shutil
import time
import warnings
import zlib
from collections.abc import Mapping
from io import BytesIO
from pathlib import Path
from typing import NamedTuple

import jax
import numpy as np

from ..attractors.catalogue import Attractors
from ..foundation.seals import Damaged, sealed, unsealed
from ..io.datasets import netcdf_of
from ..io.files import check_writable, replace_whole
from ..verdicts.verdict import Verdict
from .job_files import SHARE_OF_TIME, attractors_from_bytes, attractors_to_bytes, file_of, runs_of
from .plan import Indices
from .results import Verdicts, by_name, not_run
from .run_lock import RunLock

KIND = "fivjax checkpoint"
# Time between writes, s: long enough to cost nothing, short enough to lose little.
KEEP_EVERY = 2.0
# The name of the trajectories' indices.
PLACE = "place"
# The last bytes of the file, after the length of the list.
MARK, LENGTH = b"fivjax.3", 8
# The number of values that share a checksum.
BLOCK = 1024


class Contents(NamedTuple):
    """What a checkpoint contains, as far as it is not damaged."""

    run: dict
    results: dict[str, np.ndarray]
    damaged: dict[str, list[slice]]  # parts of the results
    elsewhere: bool  # whether anything else is damaged
    found: dict[int, bytes]  # attractors, by the first trajectory of the job


class Checkpoint:
    """The file of a run: reads the results of an earlier run, and writes new ones.

    `run` describes the run of `total` trajectories in plain Python values (that `json` can hold).

    **Raises:** as `read_checkpoint`.
    """

    def __init__(self, path: Path, run: dict, total: int, energy: bool):
        self.path, self.run, self.total, self.energy = path, run, total, energy
        self.verdicts, self.found = not_run(0, energy), {}
        # The indices of the results, in rising order; and those of jobs since then, with theirs.
        self._places, self._more = np.zeros(0, np.int64), []
        self._new, self._done, self._took = False, [], 0.0
        self._lock = self._locked()
        try:
            self._read()
        except BaseException:
            self._release()
            raise
        self._written = time.monotonic()

    def _locked(self) -> RunLock | None:
        """The lock on the run; none where no folder can be made for it (a full disk)."""
        if self._jobs.exists() and not self._jobs.is_dir():
            raise ValueError(
                f"File `{self._jobs}` is where the jobs of checkpoint `{self.path}` are kept, in a folder. Move it, or give "
                f"another path for the checkpoint."
            )
        for _ in range(100):
            try:
                self._jobs.mkdir(exist_ok=True)
                return RunLock(self._jobs, f"Checkpoint `{self.path}`")
            except FileNotFoundError:
                # Another run has ended in between, and removed it.
                continue
            except OSError:
                break
        return None

    def _read(self) -> None:
        kept = read_checkpoint(self.path, self.run)
        if kept is None:
            # Interrupted before its first job was done: nothing else is left of a run.
            for theirs in runs_of(self._jobs):
                refuse_other_run(f"What is kept in `{self._jobs}`", theirs, self.run)
        else:
            self._places = kept.results[PLACE]
            self.verdicts = not_run(len(self._places), self.energy)
            for name, values in by_name(self.verdicts).items():
                values[:] = kept.results[name]
            self._new = self._leave_out_damage(kept)
            self.found = {place: attractors_from_bytes(content) for place, content in kept.found.items()}

    def _leave_out_damage(self, kept: Contents) -> bool:
        """Damaged results count as not run; whether there are any, or other damage."""
        for name, parts in kept.damaged.items():
            for part in parts:
                warnings.warn(
                    f"Checkpoint `{self.path}` is damaged: the `{name}` in its rows {part.start} to {part.stop - 1} is not "
                    f"what was written. Their trajectories are computed anew.",
                    stacklevel=6,
                )
                self.verdicts.verdict[part] = Verdict.NOT_RUN
        whole = ~self.verdicts.pending()
        self._places, self.verdicts = self._places[whole], jax.tree.map(lambda part: part[whole], self.verdicts)
        if kept.elsewhere:
            warnings.warn(f"Checkpoint `{self.path}` is damaged beside its results; it is written anew.", stacklevel=6)
        return bool(kept.damaged) or kept.elsewhere

    def recall(self, places: Indices | None) -> Verdicts:
        """The results kept of these trajectories (all, unless given)."""
        self._merge()
        places = np.arange(self.total) if places is None else places
        found = not_run(len(places), self.energy)
        known = np.isin(places, self._places)
        rows = np.searchsorted(self._places, places[known])
        for whole, kept in zip(jax.tree.leaves(found), jax.tree.leaves(self.verdicts), strict=True):
            whole[known] = kept[rows]
        return found

    def _merge(self) -> None:
        """Put the results of the latest jobs among the others. A job that was run again has the same ones."""
        if not self._more:
            return
        places, verdicts = zip(*self._more, strict=True)
        self._places, first = np.unique(np.concatenate([self._places, *places]), return_index=True)
        self.verdicts = jax.tree.map(lambda *parts: np.concatenate(parts)[first], self.verdicts, *verdicts)
        self._more = []

    def job_file(self, places: Indices) -> tuple[str, str]:
        """The path and the key of the file for the job with these trajectories."""
        return file_of(self._jobs, self.run, places)

    def keep(self, places: Indices, verdicts: Verdicts, found: dict[bytes, Attractors] | None) -> None:
        """Keep the results of a job; they are written if it is time."""
        if found is not None:
            self.found[int(places[0])] = found
        self._more.append((places, verdicts))
        self._new = True
        self._done.append(places)
        if time.monotonic() - self._written >= max(KEEP_EVERY, SHARE_OF_TIME * self._took):
            self.flush()

    def close(self) -> None:
        """Release the lock, and remove the folder of jobs under way if there are none."""
        if len(self._places) == self.total and not self._new:
            shutil.rmtree(self._jobs, ignore_errors=True)
        self._release()

    def _release(self) -> None:
        if self._lock is not None:
            self._lock.remove()
        with contextlib.suppress(OSError):
            self._jobs.rmdir()

    def flush(self) -> None:
        """Write results that are not written yet."""
        if not self._new:
            return
        begun = time.monotonic()
        self._merge()
        found = {place: attractors_to_bytes(part) for place, part in self.found.items()}
        if write_checkpoint(self.path, self.run, by_name(self.verdicts) | {PLACE: self._places}, found):
            self._new = False
            for places in self._done:
                Path(self.job_file(places)[0]).unlink(missing_ok=True)
            self._done = []
        self._written = time.monotonic()
        self._took = self._written - begun

    @property
    def _jobs(self) -> Path:
        return jobs_beside(self.path)


def jobs_beside(path: Path) -> Path:
    """The folder of the jobs under way, beside a checkpoint."""
    return path.with_name(f"{path.name}.jobs")


def read_checkpoint(path: Path, run: dict) -> Contents | None:
    """What is kept in a checkpoint; None if there is no such file yet.

    `run` describes the run in plain Python values (that `json` can hold).

    **Raises:** `ValueError`, before any work is done, for a file that is no checkpoint, one whose list of contents is
    damaged, and the checkpoint of another run, naming the first difference.
    """
    if not path.exists():
        return None
    try:
        data = path.read_bytes()
    except OSError as error:
        raise ValueError(f"Checkpoint `{path}` cannot be read: {error.strerror}.") from None
    try:
        kept = contents_from_bytes(data)
    except Damaged:
        if KIND.encode() not in data:
            raise ValueError(
                f"File `{path}` is not a checkpoint of fivjax; give another path for the checkpoint."
            ) from None
        raise ValueError(
            f"Checkpoint `{path}` has no list of its contents with checksums that are right: it is damaged, or a version of "
            f"fivjax wrote it that kept none. Delete it to begin the run anew, or put an undamaged copy in its place."
        ) from None
    refuse_other_run(f"Checkpoint `{path}`", kept.run, run)
    return kept


def refuse_other_run(what: str, theirs: dict, run: dict) -> None:
    """Refuse the results of another run.

    **Raises:** `ValueError`, naming the first difference.
    """
    ours = json.loads(json.dumps(run))
    for name in [*ours, *theirs]:
        if _differ(ours.get(name), theirs.get(name)):
            raise ValueError(
                f"{what} is of another run: {_difference(name, theirs.get(name), ours.get(name))}. "
                f"Resume it with the arguments it was begun with, or give another path."
            )


def write_checkpoint(path: Path, run: dict, results: dict[str, np.ndarray], found: dict[int, bytes]) -> bool:
    """Write the checkpoint; if the disk does not take it, warn and leave the earlier one. Whether it was written."""
    try:
        replace_whole(check_writable(path), contents_to_bytes(run, results, found))
    except (OSError, ValueError) as error:
        warnings.warn(
            f"Checkpoint `{path}` could not be written ({error}); the run goes on and will try again.", stacklevel=3
        )
        return False
    return True


def _differ(ours, theirs) -> bool:
    """Whether values differ in any bit: in the order of names, in the sign of a zero."""
    return json.dumps(ours) != json.dumps(theirs)


def _difference(name: str, theirs, ours) -> str:
    if name == "code":
        part = next(part for part in [*ours, *theirs] if ours.get(part) != theirs.get(part))
        return (
            f"the code of its {part} is not that of this run's, or a constant or a field in it that is no parameter of the "
            f"scene is another"
        )
    if isinstance(theirs, dict) and isinstance(ours, dict):
        if list(theirs) != list(ours) and set(theirs) == set(ours):
            return f"its {name} are in the order {', '.join(theirs)} and not {', '.join(ours)}"
        for inner in [*ours, *theirs]:
            if _differ(ours.get(inner), theirs.get(inner)):
                return _difference(inner, theirs.get(inner), ours.get(inner))
    short = [text if len(text) <= 40 else f"{text[:37]}..." for text in map(json.dumps, (theirs, ours))]
    return f"its `{name}` is {short[0]} and not {short[1]}"


def contents_to_bytes(run: dict, results: dict[str, np.ndarray], found: Mapping[int, bytes]) -> bytes:
    """The bytes of a checkpoint: NetCDF for any reader, and behind it a list of its contents with checksums, for fivjax.

    A checksum stands for so many values of a result. Damage to one costs these; damage to the rest of the NetCDF costs nothing,
    because the list says where the results are. Only of the list itself must every bit be right.
    """
    import h5py
    import xarray as xr

    dataset = xr.Dataset({name: ("trajectory", values) for name, values in results.items()})
    dataset.attrs.update(kind=KIND, run=json.dumps(run))
    data = netcdf_of(dataset)
    with h5py.File(BytesIO(data)) as file:
        places = {name: file[name].id.get_offset() for name in results}
    arrays = {
        name: [places[name], values.dtype.str, len(values), [zlib.crc32(values[part]) for part in _blocks(len(values))]]
        for name, values in results.items()
    }
    blobs = {place: sealed(content) for place, content in found.items()}
    contents = {
        "run": run,
        "arrays": arrays,
        "netcdf": [len(data), _without(data, arrays)],
        "found": [[place, len(blob)] for place, blob in blobs.items()],
    }
    listed = sealed(json.dumps(contents).encode())
    return b"".join([data, *blobs.values(), listed, len(listed).to_bytes(LENGTH, "little"), MARK])


def contents_from_bytes(data: bytes) -> Contents:
    """The contents again.

    **Raises:** `Damaged` where the list of the contents is.
    """
    end = len(data) - len(MARK) - LENGTH
    if data[end + LENGTH :] != MARK:
        raise Damaged("The end of the file is missing.")
    begin = end - int.from_bytes(data[end : end + LENGTH], "little")
    contents = json.loads(unsealed(data[max(begin, 0) : end]))
    size, rest = contents["netcdf"]
    if size + sum(length for _, length in contents["found"]) != begin:
        raise Damaged("Parts of the file are missing.")
    results, damaged, found = {}, {}, {}
    for name, (place, kind, count, checksums) in contents["arrays"].items():
        values = np.frombuffer(data, kind, count, place).copy()
        bad = [part for part, sum_ in zip(_blocks(count), checksums, strict=True) if zlib.crc32(values[part]) != sum_]
        results[name] = values
        if bad:
            damaged[name] = bad
    elsewhere = _without(data[:size], contents["arrays"]) != rest
    for place, length in contents["found"]:
        try:
            found[place] = unsealed(data[size : size + length])
        except Damaged:
            elsewhere = True
        size += length
    return Contents(contents["run"], results, damaged, elsewhere, found)


def _blocks(count: int) -> list[slice]:
    return [slice(start, min(start + BLOCK, count)) for start in range(0, count, BLOCK)]


def _without(data: bytes, arrays: Mapping) -> int:
    """The checksum of all but the arrays."""
    at, total = 0, 0
    for place, kind, count, _ in sorted(arrays.values()):
        total = zlib.crc32(data[at:place], total)
        at = place + np.dtype(kind).itemsize * count
    return zlib.crc32(data[at:], total)
