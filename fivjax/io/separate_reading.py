"""Files read in a process of their own (`reading_process`), because their libraries may crash, hang or fill the memory."""

import contextlib
import json
import math
import os
import subprocess
import sys
import threading
from collections.abc import Iterator
from io import BytesIO
from pathlib import Path
from typing import IO

import numpy as np

from . import reading_process
from .reading_limits import COPIES, PACKED, SMALL, check_declared, free_memory, unreadable

# Memory that the process may take beside the data, bytes; time of a processor that it may take, s, and how many bytes it must
# read in one; how much longer it may take by the clock, s, where others use the machine.
BESIDE, SECONDS, PATIENCE = 2**28, 3, 20
RATES = {"netcdf": 10_000_000, "matlab": 10_000_000, "output4": 500_000}


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
def _reading(path: Path, what: str, length: int) -> Iterator[IO[bytes]]:
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
    seconds = SECONDS + math.ceil(length / RATES[what])
    command = [sys.executable, "-P", reading_process.__file__, what, str(path.absolute()), str(memory), str(seconds)]
    # It finds what this process finds, and starts no threads.
    own = {"PYTHONPATH": os.pathsep.join(filter(None, sys.path)), "OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"}
    process = subprocess.Popen(
        command, env={**os.environ, **own}, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL
    )
    late = threading.Timer(PATIENCE + 4 * seconds, process.kill)
    late.daemon = True
    late.start()
    assert process.stdout is not None
    try:
        yield process.stdout
    finally:
        late.cancel()
        process.kill()
        process.stdout.close()
        process.wait()
