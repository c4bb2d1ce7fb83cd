"""Folders in which compiled code is kept for later processes, and the files in them.

Who can write to such a folder decides what all later processes run. So a folder is used only if it is its user's own and nobody
else may write there. What cannot be kept is made anew by each process: that costs time, never a result. One sentence says so.
"""

import contextlib
import os
import stat
import threading
import warnings
from pathlib import Path
from typing import NamedTuple

from .seals import Damaged, sealed, unsealed
from .whole_files import write_whole

# What others than the owner must not be permitted: writing; and looking inside, which what is below needs to be reached.
WRITING, ENTERING = 0o022, 0o011
CONSEQUENCE = "Results are the same, but each start takes longer."
NO_HOME = "Compiled code is not kept, because this user has no home folder; set XDG_CACHE_HOME to a folder of your own."

_told: set[str] = set()
_telling = threading.Lock()


class NotKept(UserWarning):
    """Compiled code is not kept for later processes."""


class Checked(NamedTuple):
    """A folder that may be used, or why it may not."""

    path: Path | None
    reason: str = ""


def checked(folder: str | Path) -> Checked:
    """The folder, if only its owner may write to it and that is the caller. It is made if it is not there, with those above.

    Symbolic links are followed first, and it is the place where they lead that has to be as it should.
    """
    path = Path(os.path.realpath(folder))
    try:
        _make(path)
        reason = _reason_against(path)
    except OSError as error:
        reason = f"cannot be made: {error.strerror or error}"
    return Checked(None, reason) if reason else Checked(path)


def folder_to_keep_in(folder: str | Path) -> Path | None:
    """`checked`, without the reason, which is told."""
    path, reason = checked(folder)
    if path is None:
        tell(f"Compiled code is not kept, because folder `{folder}` {reason}. {CONSEQUENCE}")
    return path


def folder_of_caches() -> Path | None:
    """The user's, by the rules of freedesktop.org: a relative path does not count."""
    named = Path(os.environ.get("XDG_CACHE_HOME", ""))
    if named.is_absolute():
        return named
    try:
        return Path.home() / ".cache"
    except RuntimeError:
        tell(NO_HOME)
        return None


def tell(sentence: str, about: str = "what is not kept") -> None:
    """Warn, once in a process about each subject: what hinders one file hinders the next."""
    with _telling:
        if about in _told:
            return
        _told.add(about)
    warnings.warn(sentence, NotKept, stacklevel=3)


def read_own(path: Path) -> bytes:
    """The content of a file.

    **Raises:** `OSError` where it is not there, or not the caller's own.
    """
    with open(path, "rb") as file:
        status = os.fstat(file.fileno())
        if hasattr(os, "geteuid") and (status.st_uid != os.geteuid() or status.st_mode & WRITING):
            raise PermissionError(f"{path} may have been written by others.")
        return file.read()


def read_kept(path: Path) -> bytes | None:
    """The content of a file written by `keep`; none where there is none. A damaged one, or one of somebody else, is removed."""
    try:
        content = unsealed(read_own(path))
        os.utime(path)
        return content
    except FileNotFoundError:
        return None
    except (OSError, Damaged):
        pass
    with contextlib.suppress(OSError):
        path.unlink()
    return None


def keep(path: Path, content: bytes) -> None:
    """Write a file whole, with a digest; where that is not possible, say so once and leave nothing."""
    try:
        write_whole(path, sealed(content), private=True)
    except OSError as error:
        cannot_keep(path.parent, error.strerror or str(error))


def cannot_keep(folder: str | Path, reason: str) -> None:
    """Say that something could not be written."""
    tell(f"Compiled code cannot be kept in folder `{folder}`: {reason}. {CONSEQUENCE}")


def make_room(folder: Path, largest: int) -> None:
    """Remove what was used longest ago, until the rest is small enough (bytes)."""
    found = []
    with contextlib.suppress(OSError), os.scandir(folder) as entries:
        for entry in entries:
            with contextlib.suppress(OSError):  # removed by another process just now
                if entry.is_file(follow_symlinks=False):
                    found.append((entry.stat(), entry.path))
    total = 0
    for status, path in sorted(found, key=lambda file: -file[0].st_mtime):
        total += status.st_size
        if total > largest:
            with contextlib.suppress(OSError):
                os.unlink(path)


def _make(path: Path) -> None:
    """Make a folder and those above it, private whatever the caller's mask."""
    for folder in (*reversed(path.parents), path):
        if not folder.exists():
            with contextlib.suppress(FileExistsError):  # made by another process just now
                folder.mkdir(0o700)


def _reason_against(path: Path) -> str:
    status = path.stat()
    if not stat.S_ISDIR(status.st_mode):
        return "is a file"
    if not os.access(path, os.W_OK | os.X_OK):
        return "cannot be written"
    if not hasattr(os, "geteuid"):  # Windows, where the folders of a user are that user's own
        return ""
    if status.st_uid != os.geteuid():
        return "belongs to another user"
    if status.st_mode & WRITING:
        return (
            f"may be written to by others (its mode is {stat.S_IMODE(status.st_mode):o}); remove it, or, if nobody else has "
            "written there, `chmod 700` it"
        )
    for above in reversed(path.parents):
        mode = above.stat().st_mode
        if not mode & ENTERING:  # nobody else comes further
            break
        # In a folder with the sticky bit, such as that for temporary files, only owners may rename.
        if mode & stat.S_IWOTH and not mode & stat.S_ISVTX:
            return f"lies in `{above}`, to which everybody may write"
    return ""
