"""The folder of a store: begun, recognised with its metadata checked, and locked.

Zarr's metadata carry no checksums. So those of all files that make an empty store are kept in a file of their own, `checksums`.
A damaged one of these files is made anew, because it follows from the run.
"""

import contextlib
import errno
import json
import os
import platform
import time
import warnings
import zlib
from pathlib import Path

import numpy as np

from ..foundation.seals import Damaged, sealed, unsealed
from ..foundation.whole_files import own_folder
from ..io.files import check_writable, replace_whole
from .checkpoint import refuse_other_run
from .trajectories import Grid

KIND = "fivjax store"
CHECKSUMS, LOCK = "checksums", ".lock"
HOW_ON = "Delete it to begin the run anew, or give another path."


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


def locked(path: Path):
    """A lock on the store, which the operating system releases at the latest when the process ends.

    **Raises:** `ValueError` where another process has it, saying which.
    """
    file = open(path / LOCK, "a+")  # noqa: SIM115
    try:
        import fcntl
    except ImportError:  # Windows
        return file
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        file.seek(0)
        holder = file.read().strip()
        file.close()
        raise ValueError(
            f"Store `{path}` is being written by another process{f', {holder}' if holder else ''}; wait for it, or end it."
        ) from None
    except OSError:  # a file system without locks
        pass
    with contextlib.suppress(OSError):  # a full disk
        file.truncate(0)
        file.write(f"number {os.getpid()} on {platform.node()}, since {time.strftime('%Y-%m-%d %H:%M:%S')}\n")
        file.flush()
    return file
