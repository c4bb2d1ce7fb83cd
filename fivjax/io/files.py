"""Files that are whole or absent: written under another name in the same folder, then renamed."""

import os
import tempfile
from io import BytesIO
from pathlib import Path


def check_writable(path: str | Path) -> Path:
    """Refuse a path that could not be written, before any work is done.

    **Raises:** `ValueError` with the reason.
    """
    path = Path(path)
    if path.is_dir():
        raise ValueError(f"Output path `{path}` is a folder; give the name of a file in it.")
    if path.parent.exists() and not path.parent.is_dir():
        raise ValueError(f"Output folder `{path.parent}` is not a folder but a file; give another.")
    if not path.parent.is_dir():
        raise ValueError(f"Output folder `{path.parent}` does not exist; create it first.")
    try:
        with tempfile.NamedTemporaryFile(dir=path.parent, prefix=".fivjax."):
            pass
    except OSError as error:
        raise ValueError(f"Output folder `{path.parent}` cannot be written: {error.strerror}.") from error
    return path


def save_figure(figure, path: str | Path, **options) -> Path:
    """Write a matplotlib figure; the file appears under its name only when it is whole.

    **Raises:** `ValueError` for a path that cannot be written, `OSError` where the disk is full.

    **Example:**

        >>> path = fj.save_figure(fj.plot.response(run), "squeal.png")
    """
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
    """Write a file with this content in place of whatever is there, atomically; returns its path."""
    # In the same folder, so that the final rename stays within one file system and is atomic.
    handle, part = tempfile.mkstemp(dir=path.parent, prefix=".fivjax.", suffix=".part")
    try:
        with os.fdopen(handle, "wb") as file:
            file.write(content)
            file.flush()
            # On the disk before it gets its name: after a power failure there is the old file or the new one.
            os.fsync(file.fileno())
        # `mkstemp` makes private files; a result has the permissions of any other new file.
        mask = os.umask(0)
        os.umask(mask)
        os.chmod(part, 0o666 & ~mask)
        os.replace(part, path)
    except BaseException:
        Path(part).unlink(missing_ok=True)
        raise
    return path
