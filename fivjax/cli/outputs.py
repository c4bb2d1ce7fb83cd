"""Output files: checked before any work, never overwritten without being asked for, and named at the end."""

from pathlib import Path
from typing import Annotated

import tyro

import fivjax as fj

from ..io.files import check_writable

# An option of every command that writes files. It is not called --force, because that is the load.
Overwrite = Annotated[bool, tyro.conf.arg(help="replace files that are there already", help_behavior_hint="")]


class Interrupted(Exception):
    """A run was stopped from outside: a sentence about what is kept of it."""


class Failure(Exception):
    """A run ended without a result."""


def output_paths(stem: Path, overwrite: bool, *endings: str) -> tuple[Path, ...]:
    """The files of a result, by endings such as `.nc`; checked before any work is done.

    **Raises:** `ValueError` if the option names no file or a folder, if a folder does not exist or cannot be written, and for
    existing files unless they may be overwritten.
    """
    if not stem.name:
        raise ValueError(f"Option `--out` must name the files to write, such as `--out result`, but is `{stem}`.")
    if stem.is_dir():
        raise ValueError(
            f"Option `--out` must name the files to write, but `{stem}` is a folder. Name files in it, such as "
            f"`--out {stem / 'result'}`."
        )
    stem = stem.with_suffix("") if stem.suffix in (".nc", ".png") else stem
    paths = tuple(check_writable(stem.with_name(stem.name + ending)) for ending in endings)
    if not overwrite:
        refuse_existing(*paths)
    return paths


def refuse_existing(*paths: Path) -> None:
    """Refuse existing files."""
    there = [path for path in paths if path.exists()]
    if there:
        raise ValueError(
            f"File `{there[0]}` is there already. Add `--overwrite` to replace it, or name another by `--out`."
        )


def import_writers() -> None:
    """Import what writes data, so that what an interrupt leaves is written: in an import a signal ends a command at once."""
    import h5netcdf.legacyapi  # noqa: F401
    import xarray.backends.h5netcdf_  # noqa: F401


def write_data(result, path: Path) -> None:
    """Save a result, and print where at once: it is there if what follows is interrupted."""
    fj.save(result, path)
    say(path)


def write_picture(figure, path: Path) -> None:
    """The same of a picture."""
    fj.save_figure(figure, path)
    say(path)


def say(path: Path) -> None:
    """Print that a file was written."""
    print(f"wrote {path}")
