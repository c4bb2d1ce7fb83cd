"""Files that are whole or absent: written under a hidden name in the same folder, then renamed.

Who writes holds a lock on what has the hidden name. So those who come later can tell what is being written from what a killed
process has left, and remove that.
"""

import contextlib
import os
import secrets
import shutil
import stat
import time
from collections.abc import Generator
from pathlib import Path

try:
    import fcntl
except ImportError:  # Windows, where a file that is open cannot be removed
    fcntl = None

PREFIX, SUFFIX = ".fivjax.", ".part"


def write_whole(path: Path, content: bytes, like: os.stat_result | None = None, private: bool = False) -> None:
    """Write a file with this content in place of whatever is there.

    A new file has the permissions of any other; one that replaces another has those of that one, of which `like` is the
    status. A `private` file is for its owner only, and may be lost when power fails.

    **Raises:** `OSError`; what was there is unchanged then, and nothing is left beside it.
    """
    remove_left_over(path.parent)
    handle, part = _new_locked_file(path.parent, 0o600 if private or like else 0o666)
    try:
        with os.fdopen(handle, "wb") as file:
            file.write(content)
            file.flush()
            if like is not None:
                _permitted_as(handle, like)
            if not private:
                # On the disk before it gets its name: after a power failure there is the old file or the new one.
                os.fsync(handle)
            if fcntl is not None:  # while it is locked
                os.replace(part, path)
        if fcntl is None:
            os.replace(part, path)
    except BaseException:
        part.unlink(missing_ok=True)
        raise


def try_to_write(folder: Path) -> None:
    """Make a file in a folder and remove it.

    **Raises:** `OSError` where that is not possible.
    """
    handle, part = _new_locked_file(folder, 0o600)
    os.close(handle)
    part.unlink(missing_ok=True)


@contextlib.contextmanager
def own_folder(parent: Path) -> Generator[Path]:
    """A new folder for this process alone while the context lasts, then removed with all that is in it; unless it was renamed.

    **Raises:** `OSError` where it cannot be made.
    """
    remove_left_over(parent)
    folder, handle = _new_locked_folder(parent)
    try:
        yield folder
    finally:
        shutil.rmtree(folder, ignore_errors=True)
        if handle is not None:
            os.close(handle)


def remove_left_over(folder: Path) -> None:
    """Remove what killed processes of this user have left in a folder."""
    with contextlib.suppress(OSError):
        for name in os.listdir(folder):
            if name.startswith(PREFIX) and name.endswith(SUFFIX):
                with contextlib.suppress(OSError):
                    _remove_if_left(folder / name)


def _hidden(folder: Path) -> Path:
    return folder / f"{PREFIX}{secrets.token_hex(8)}{SUFFIX}"


def _new_locked_file(folder: Path, mode: int) -> tuple[int, Path]:
    """A new file under a hidden name, open and locked."""
    while True:
        part = _hidden(folder)
        handle = os.open(part, os.O_RDWR | os.O_CREAT | os.O_EXCL | getattr(os, "O_BINARY", 0), mode)
        if _still_there(handle, part):
            return handle, part
        os.close(handle)


def _new_locked_folder(parent: Path) -> tuple[Path, int | None]:
    """A new folder under a hidden name, and what holds its lock."""
    while True:
        folder = _hidden(parent)
        folder.mkdir(0o700)
        if fcntl is None:
            return folder, None
        with contextlib.suppress(FileNotFoundError):
            handle = os.open(folder, os.O_RDONLY)
            if _still_there(handle, folder):
                return folder, handle
            os.close(handle)


def _still_there(handle: int, path: Path) -> bool:
    """Lock what is open. Another process may have removed it before: it could not know that it was not left."""
    if fcntl is not None:
        with contextlib.suppress(OSError):  # a file system without locks
            fcntl.flock(handle, fcntl.LOCK_EX)
    return path.exists()


def _remove_if_left(path: Path) -> None:
    # Where a file system has no locks, what has not changed for so long was left (s).
    long_ago = 86400.0
    if fcntl is None:
        path.unlink()
        return
    there = os.lstat(path)
    if there.st_uid != os.geteuid():
        return
    of_folder = stat.S_ISDIR(there.st_mode)
    # A lock over a network needs a file that is open for writing.
    handle = os.open(path, (os.O_RDONLY if of_folder else os.O_RDWR) | os.O_NOFOLLOW | os.O_NONBLOCK)
    try:
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            return
        except OSError:
            if time.time() - there.st_mtime < long_ago:
                return
        if of_folder:
            shutil.rmtree(path)
        else:
            path.unlink()
    finally:
        os.close(handle)


def _permitted_as(handle: int, like: os.stat_result) -> None:
    """Give a file the owner and the permissions of another; none of its group where the group cannot be the same."""
    mode = stat.S_IMODE(like.st_mode)
    if not hasattr(os, "fchown"):
        return
    now = os.fstat(handle)
    if (now.st_uid, now.st_gid) != (like.st_uid, like.st_gid):
        try:
            os.fchown(handle, like.st_uid, like.st_gid)
        except OSError:
            with contextlib.suppress(OSError):
                os.fchown(handle, -1, like.st_gid)
        now = os.fstat(handle)
    if now.st_gid != like.st_gid:
        mode &= ~0o070
    os.fchmod(handle, mode & 0o777)
