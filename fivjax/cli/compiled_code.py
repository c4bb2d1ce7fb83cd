"""The folder in which the command line keeps compiled code for later runs."""

import contextlib
import os
import sys
import warnings
from pathlib import Path

from ..foundation.kept_folder import NotKept, cannot_keep, folder_of_caches, folder_to_keep_in, tell

# The largest size of the compiled code that is kept, in bytes.
LARGEST = 2**30
# What JAX says, in words of its own and for each program, where it cannot read or write one.
NOT_READ, NOT_WRITTEN = (f"Error {what} persistent compilation cache entry" for what in ("reading", "writing"))
_show_otherwise = warnings.showwarning


def keep_compiled_code() -> None:
    """Keep compiled code, and traced programs (`foundation.kept_programs`), in the user's cache folder, unless JAX has a
    compilation cache already. What was used longest ago is removed first. A folder that is not the user's own, or cannot be
    written, is done without, and one sentence says so.
    """
    import jax

    warnings.showwarning = _show  # pyrefly: ignore[bad-assignment]
    if jax.config.jax_compilation_cache_dir is not None:
        return
    home = folder_of_caches()
    folder = None if home is None else folder_to_keep_in(home / "fivjax")
    if folder is not None:
        _remove_partial(folder)
        jax.config.update("jax_compilation_cache_dir", str(folder))
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.2)
        jax.config.update("jax_compilation_cache_max_size", LARGEST)


def _remove_partial(folder: Path) -> None:
    """Remove programs that JAX could only begin to write, as on a full disk: those without the file that it writes next. With
    such a one in the folder it would keep nothing any more.
    """
    import filelock

    with contextlib.suppress(OSError, filelock.Timeout), filelock.FileLock(folder / ".lockfile", timeout=1):
        names = set(os.listdir(folder))
        for name in names:
            if name.endswith("-cache") and name.removesuffix("-cache") + "-atime" not in names:
                (folder / name).unlink()


def _show(message, category, *where) -> None:
    """Show what the user is to know of compiled code as sentences, each once."""
    import jax

    text, folder = str(message), jax.config.jax_compilation_cache_dir
    if issubclass(category, NotKept):
        print(f"fivjax: {text}", file=sys.stderr)
    elif text.startswith(NOT_WRITTEN):
        cannot_keep(folder, text.partition("': ")[2])
        if jax.config.jax_compilation_cache_max_size == LARGEST:
            _remove_partial(Path(folder))
    elif text.startswith(NOT_READ):
        tell(
            f"A compiled program in folder `{folder}` is damaged, so that each start takes longer. Remove the folder; it is "
            "made anew.",
            about=NOT_READ,
        )
    else:
        _show_otherwise(message, category, *where)
