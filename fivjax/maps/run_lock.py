"""A lock on what a run keeps: a second process that would write the same is refused."""

import contextlib
import os
import platform
import time
from pathlib import Path

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None

LOCK = ".lock"


class RunLock:
    """A lock on a folder, which the operating system releases at the latest when the process ends; `what` is kept there, in
    words. File systems without locks have none.

    **Raises:** `ValueError` where another process has it, saying which.
    """

    def __init__(self, folder: Path, what: str):
        self._path, self._file = folder / LOCK, None
        while fcntl is not None and (self._file is None or not self._is_there()):
            self.release()
            self._file = open(self._path, "a+")  # noqa: SIM115
            try:
                fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                self._file.seek(0)
                holder = self._file.read().strip()
                self.release()
                raise ValueError(
                    f"{what} is being written by another process{f', {holder}' if holder else ''}; wait for it, or end it."
                ) from None
            except OSError:  # a file system without locks
                break
        if self._file is not None:
            with contextlib.suppress(OSError):  # a full disk
                self._file.truncate(0)
                self._file.write(
                    f"number {os.getpid()} on {platform.node()}, since {time.strftime('%Y-%m-%d %H:%M:%S')}\n"
                )
                self._file.flush()

    def _is_there(self) -> bool:
        """Whether the locked file has not been removed meanwhile, by a process whose run was over."""
        assert self._file is not None
        with contextlib.suppress(OSError):
            return os.path.samestat(os.fstat(self._file.fileno()), os.stat(self._path))
        return False

    def release(self) -> None:
        """Let others write."""
        if self._file is not None:
            self._file.close()

    def remove(self) -> None:
        """Let others write, and leave no file."""
        # Where it has been removed with its folder, another process may have made one of its own by now.
        if self._file is not None and self._is_there():
            self._path.unlink(missing_ok=True)
        self.release()
