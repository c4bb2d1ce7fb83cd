"""Output files: checked before any work, then whole or absent (`foundation.whole_files`)."""

import os
import stat
from io import BytesIO
from pathlib import Path

from ..foundation.whole_files import try_to_write, write_whole


class MissingFile(FileNotFoundError, ValueError):
    """A file that is to be read and is not there."""


def check_there(path: Path, of: str = "") -> None:
    """Refuse the path of a file that is not there, or cannot be read; `of` what it is."""
    if not path.is_file():
        raise MissingFile(
            f"File `{path}`{of} {'is a folder; give the name of a file in it' if path.is_dir() else 'does not exist'}."
        )
    if not os.access(path, os.R_OK):
        raise ValueError(f"File `{path}`{of} is protected against reading; permit reading it, or give another.")


def check_writable(path: str | Path) -> Path:
    """Refuse a path that could not be written, before any work is done.

    **Raises:** `ValueError` with the reason.
    """
    # Not above: a command line that only asks for its version or help starts without JAX, which this imports.
    from ..foundation import arguments

    path = arguments.path("path", path)
    try:
        _check(path, _place(path))
    except OSError as error:
        raise ValueError(f"Output path `{path}` cannot be written: {error.strerror}.") from error
    return path


def _check(path: Path, place: Path) -> None:
    """`place` is where the path leads."""
    there = _status(place)
    if there is not None and stat.S_ISDIR(there.st_mode):
        raise ValueError(f"Output path `{path}` is a folder; give the name of a file in it.")
    # What a path may lead to that is no file, and is never replaced by one.
    no_files = {
        stat.S_IFIFO: "a FIFO",
        stat.S_IFSOCK: "a socket",
        stat.S_IFCHR: "a device",
        stat.S_IFBLK: "a device",
        stat.S_IFLNK: "a symbolic link that leads back to itself",
    }
    if there is not None and not stat.S_ISREG(there.st_mode):
        kind = no_files.get(stat.S_IFMT(there.st_mode), "something else")
        raise ValueError(f"Output path `{path}` is no file but {kind}; give another.")
    if place.parent.exists() and not place.parent.is_dir():
        raise ValueError(f"Output folder `{place.parent}` is not a folder but a file; give another.")
    if not place.parent.is_dir():
        raise ValueError(f"Output folder `{place.parent}` does not exist; create it first.")
    if there is not None and not os.access(place, os.W_OK):
        raise ValueError(f"Output file `{path}` is write-protected; permit writing, or give another.")
    try:
        try_to_write(place.parent)
    except OSError as error:
        raise ValueError(f"Output folder `{place.parent}` cannot be written: {error.strerror}.") from error


def _place(path: Path) -> Path:
    """Where a path leads: files are written through symbolic links."""
    return Path(os.path.realpath(path)) if path.is_symlink() else path


def _status(place: Path) -> os.stat_result | None:
    try:
        return os.lstat(place)
    except (FileNotFoundError, NotADirectoryError):
        return None


def save_figure(figure, path: str | Path, **options) -> Path:
    """Write a matplotlib figure; the file appears under its name only when it is whole.

    **Raises:** `TypeError` for what is no figure, `ValueError` for a path that cannot be written, `OSError` where the disk is
    full.

    **Example:**

        >>> path = fj.save_figure(fj.plot.response(run), "squeal.png")
    """
    if not hasattr(figure, "savefig"):
        raise TypeError(
            "Argument `figure` must be a matplotlib figure, such as `fj.plot.response(run)`, but is of type "
            f"{type(figure).__name__}."
        )
    path = check_writable(path)
    options = {"dpi": 150, "bbox_inches": "tight", "format": path.suffix.lstrip(".") or "png", **options}
    content = BytesIO()
    figure.savefig(content, **options)
    return replace_whole(path, content.getvalue())


def save_text(text: str, path: str | Path) -> Path:
    """Write a text in UTF-8; the file appears under its name only when it is whole.

    **Raises:** `ValueError` for a path that cannot be written.
    """
    return replace_whole(check_writable(path), text.encode())


def replace_whole(path: Path, content: bytes) -> Path:
    """Write a file with this content in place of what is there, atomically; returns its path. The place where a symbolic link
    leads is written, and a file that is replaced keeps its permissions.
    """
    place = _place(path)
    try:
        write_whole(place, content, like=_status(place))
    except OSError as error:
        # The file that could not be written, not the temporary one.
        raise OSError(error.errno, error.strerror, str(path)) from error
    return path
