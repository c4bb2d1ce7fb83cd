"""What a file may ask for before it is believed: sizes that it declares, against its length and the memory that is free.

A file of a few bytes can declare 10¹² rows, or unpack to more than any memory holds. Readers ask here before they make room.
"""

import os
from pathlib import Path

# A file may unpack to this many bytes whatever its length; above, to so many times its length. Measured signals and matrices
# pack to a tenth at best.
SMALL, PACKED = 2**28, 200
# While a file is read, its data are there up to three times: packed, unpacked, and in the form that is wanted.
COPIES = 3


def unreadable(path: Path, kind: str, why) -> ValueError:
    """The sentence for a file that is no `kind`, or a damaged one; `why` is a reason in words, or a library's error."""
    # Of a library's message, the first line; many have none.
    said = next((line.strip() for line in str(why).splitlines() if line.strip()), type(why).__name__).rstrip(".:;, ")
    readable = "".join(character if character.isprintable() else "?" for character in said)
    return ValueError(f"File `{path}` cannot be read as {kind}: {readable[:200]}. Write it again.")


def check_declared(path: Path, kind: str, declared: int, length: int | None = None) -> None:
    """Refuse a file whose data, unpacked, would be larger than its length explains, or than the free memory holds.

    `declared`: bytes that the file says its data take; `length`: the file's bytes that hold them, all unless given.

    **Raises:** `ValueError`.
    """
    length = path.stat().st_size if length is None else length
    if declared > max(SMALL, PACKED * length):
        raise unreadable(path, kind, f"it declares {_amount(declared)} of data, but holds only {_amount(length)}")
    free = free_memory()
    if free is not None and declared > SMALL // 8 and COPIES * declared > free:
        raise ValueError(
            f"File `{path}` holds {_amount(declared)} of data, and reading it takes up to {COPIES} times as much memory; "
            f"{_amount(free)} are free. Read it on a larger machine, or write fewer data."
        )


def check_length(path: Path) -> None:
    """Refuse a file that is longer than the free memory holds.

    **Raises:** `ValueError`.
    """
    check_declared(path, "data", path.stat().st_size)


def check_rows(path: Path, kind: str, rows: int, entries: int) -> None:
    """Refuse a sparse matrix with far more rows or columns than entries.

    **Raises:** `ValueError`.
    """
    # Rows of a sparse matrix that may be empty: each costs memory, but no byte in the file.
    empty_rows = 1_000_000
    if rows > max(entries, empty_rows):
        raise unreadable(path, kind, f"it declares {rows} rows or columns, but has {entries} entries")


def free_memory() -> int | None:
    """Bytes that this process can still take: what the machine, its container and the limits of the process leave it.

    None where the system does not say.
    """
    found = [_available(), _in_container(), _within_limits()]
    known = [amount for amount in found if amount is not None]
    return max(0, min(known)) if known else None


def _available() -> int | None:
    try:
        with open("/proc/meminfo") as file:
            table = dict(line.split(":", 1) for line in file)
        return int(table["MemAvailable"].split()[0]) * 1024
    except (OSError, ValueError, KeyError):
        return machine_memory()


def machine_memory() -> int | None:
    """The memory of this machine, in bytes; None where the system does not say."""
    try:
        return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    except (AttributeError, ValueError, OSError):  # Windows
        return None


def _in_container() -> int | None:
    """Of the control group of the process, as it is seen inside a container."""
    for most, used in (
        ("/sys/fs/cgroup/memory.max", "/sys/fs/cgroup/memory.current"),
        ("/sys/fs/cgroup/memory/memory.limit_in_bytes", "/sys/fs/cgroup/memory/memory.usage_in_bytes"),
    ):
        try:
            return int(Path(most).read_text()) - int(Path(used).read_text())
        except (OSError, ValueError):  # no such group, or no limit: "max"
            continue
    return None


def _within_limits() -> int | None:
    try:
        import resource

        most, _ = resource.getrlimit(resource.RLIMIT_AS)
        if most == resource.RLIM_INFINITY:
            return None
        with open("/proc/self/statm") as file:
            return most - int(file.read().split()[0]) * resource.getpagesize()
    except (ImportError, AttributeError, OSError, ValueError):
        return None


def _amount(count: int) -> str:
    for unit, size in (("TB", 1e12), ("GB", 1e9), ("MB", 1e6), ("kB", 1e3)):
        if count >= size:
            return f"{count / size:.3g} {unit}"
    return f"{count} bytes"
