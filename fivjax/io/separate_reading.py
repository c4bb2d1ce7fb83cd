"""Files read in a process of their own (`reading_process`), because their libraries may crash, hang or fill the memory."""

import contextlib
import json
import math
import os
import subprocess
import sys
import threading
from collections.abc import Generator, Iterator
from io import BytesIO
from pathlib import Path
from typing import IO

import numpy as np

from . import reading_process
from .reading_limits import COPIES, PACKED, SMALL, check_declared, free_memory, unreadable

# Memory that the process may take beside the data, bytes; time of a processor, s, that it may take beside what it needs to read
# so many bytes in one; how long it may take by the clock, s, beside four times as long, because others use the machine. A small
# file is then done with within eight seconds of the start of the process, which a slow disk delays, but no file.
BESIDE, SECONDS, PATIENCE, START = 2**28, 3, 4, 60


def parts_of(path: Path, what: str, kind: str) -> Iterator[tuple[dict, np.ndarray | None]]:
    """What is in a file: for each part what it is, and its array if it has one.

    `what`: the function of `reading_process` that reads it; `kind`: the format, for sentences.

    **Raises:** `ValueError` where the file is damaged, refused, or larger than its length or the memory allow.
    """
    length = path.stat().st_size
    with _reading(path, what, length) as stream:
        declared = 0
        while True:
            line = stream.readline()
            try:
                about = json.loads(line)
            except ValueError:
                raise unreadable(path, kind, "its library fell over it, or did not come to an end") from None
            if "end" in about:
                if about["end"]:
                    raise unreadable(path, kind, about["end"])
                return
            if "declared" in about:
                declared += about["declared"]
                check_declared(path, kind, declared, length)
            elif "texts" in about:
                # NumPy makes each as long as the longest.
                check_declared(path, kind, 4 * len(about["texts"]) * max(map(len, about["texts"]), default=0), length)
                yield about, np.array(about["texts"], str).reshape(about["shape"])
            elif "bytes" in about:
                content = bytearray(about["bytes"])
                if stream.readinto(content) != len(content):  # type: ignore[attr-defined]
                    raise unreadable(path, kind, "its library fell over it, or did not come to an end")
                yield about, np.frombuffer(content, about["dtype"]).reshape(about["shape"])
            else:
                yield about, None


@contextlib.contextmanager
def _reading(path: Path, what: str, length: int) -> Generator[IO[bytes]]:
    """The stream of a process that reads a file; the process ends with the context, or when it takes too long."""
    if not sys.executable:  # Python inside another program: there is nothing to start
        sent = BytesIO()
        reading_process.run(what, str(path), sent)
        sent.seek(0)
        yield sent
        return
    free = free_memory()
    memory = COPIES * max(SMALL, PACKED * length)
    memory = BESIDE + (memory if free is None else min(memory, free))
    # Bytes that are read in a second at the slowest.
    needed = math.ceil(length / (500_000 if what == "output4" else 10_000_000))
    command = [
        sys.executable,
        "-P",
        reading_process.__file__,
        what,
        str(path.absolute()),
        str(memory),
        str(SECONDS + needed),
    ]
    # It finds what this process finds, and starts no threads.
    own = {"PYTHONPATH": os.pathsep.join(filter(None, sys.path)), "OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"}
    process = subprocess.Popen(
        command, env={**os.environ, **own}, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL
    )
    assert process.stdout is not None
    late = _killed_after(START, process)
    try:
        started = process.stdout.readline()
        late.cancel()
        if started != reading_process.STARTED:
            raise ValueError(
                f"File `{path}` was not read: the process that reads it, `{sys.executable}`, did not start. Free some memory, "
                f"and see whether Python imports {', '.join(reading_process.LIBRARIES[what])}."
            )
        late = _killed_after(PATIENCE + 4 * needed, process)
        yield process.stdout
    finally:
        late.cancel()
        process.kill()
        process.stdout.close()
        process.wait()


def _killed_after(seconds: float, process: subprocess.Popen) -> threading.Timer:
    late = threading.Timer(seconds, process.kill)
    late.daemon = True
    late.start()
    return late
