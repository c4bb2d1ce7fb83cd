"""How far a job has come, kept in a file of its own while it runs, by whichever process runs it.

An interrupted job goes on from there, with the same bits as without the interruption. The file names the run and the job that
it belongs to and carries a checksum; one that is damaged, or of another job, is not used. It is removed when the job is done.
"""

import contextlib
import hashlib
import io
import json
import time
import warnings
from pathlib import Path

import numpy as np

from ..foundation.seals import Damaged, sealed, unsealed
from ..io.files import replace_whole
from .attractor_files import from_bytes, to_bytes
from .halfway import Halfway
from .results import Verdicts, by_name
from .trajectories import Places

# Time between writes, s, and before a part of the work that may take as long as that.
KEEP_EVERY, KEEP_BEFORE_LONG = 4.0, 1.0


class JobFile:
    """The file of one job; `key` names the run and the job. Without a path nothing is kept.

    Where the file cannot be written (a worker on a machine without this folder, a full disk), the job runs on all the same.
    """

    def __init__(self, path: str | None, key: str):
        self.path, self.key = None if path is None else Path(path), key
        self._written, self._noted = time.monotonic(), None

    def last(self) -> Halfway | None:
        """The state in which an interrupted run of the job was kept, if there is one."""
        if self.path is None or not self.path.is_file():
            return None
        try:
            return from_content(unsealed(self.path.read_bytes()), self.key)
        except (OSError, Damaged):
            warnings.warn(f"File `{self.path}` of an unfinished job is damaged; the job begins anew.", stacklevel=2)
        return None

    def note(self, now: Halfway, at_once: bool = False) -> None:
        """Keep this state if it is time, or almost so if `at_once`. Until `moving`, its arrays do not change."""
        self._noted = now
        if time.monotonic() - self._written >= (KEEP_BEFORE_LONG if at_once else KEEP_EVERY):
            self.flush()

    def moving(self) -> None:
        """The arrays of the state noted last are about to change."""
        self._noted = None

    def flush(self) -> None:
        """Write the state noted last, if it is still whole and not written."""
        noted, self._noted = self._noted, None
        if noted is None or self.path is None:
            return
        with contextlib.suppress(OSError):
            self.path.parent.mkdir(exist_ok=True)
            replace_whole(self.path, sealed(to_content(noted, self.key)))
        self._written = time.monotonic()


def to_content(now: Halfway, key: str) -> bytes:
    """The state as bytes (NumPy's npz, without pickles)."""
    head = {"key": key, "done": now.done, "own_from": now.own_from}
    attractors = {
        "known": to_bytes(now.known),
        "of_groups": to_bytes({str(g).encode(): one for g, one in now.of_groups.items()}),
        "at_last": to_bytes({str(g).encode(): one for g, one in now.at_last.items()}),
    }
    arrays = {f"result.{name}": values for name, values in by_name(now.verdicts).items()}
    arrays |= {name: np.frombuffer(content, np.uint8) for name, content in attractors.items()}
    arrays |= {"pending": now.pending, "numbers": now.numbers, "settled_by": now.settled_by}
    content = io.BytesIO()
    np.savez(content, head=np.frombuffer(json.dumps(head).encode(), np.uint8), **arrays)
    return content.getvalue()


def from_content(content: bytes, key: str) -> Halfway | None:
    """The state again; none where it is not of this run and job."""
    with np.load(io.BytesIO(content), allow_pickle=False) as file:
        head = json.loads(file["head"].tobytes())
        if head["key"] != key:
            return None
        arrays = {name: file[name] for name in file.files}
    results = {name.removeprefix("result."): arrays[name] for name in arrays if name.startswith("result.")}
    parts = {name: results.pop(name) for name in Verdicts._fields if name != "energy"}
    known, of_groups, at_last = (from_bytes(arrays[name].tobytes()) for name in ("known", "of_groups", "at_last"))
    return Halfway(
        done=head["done"],
        own_from=head["own_from"],
        verdicts=Verdicts(**parts, energy=results),
        pending=arrays["pending"],
        numbers=arrays["numbers"],
        settled_by=arrays["settled_by"],
        known=known,
        of_groups={int(g): one for g, one in of_groups.items()},
        at_last={int(g): one for g, one in at_last.items()},
    )


def file_of(folder: Path, run: dict, places: Places) -> tuple[str, str]:
    """The path and the key of the file, in this folder, for the job of this run with these trajectories."""
    key = hashlib.sha256(json.dumps(run).encode() + np.asarray(places, np.int64).tobytes()).hexdigest()
    # Workers may have another working directory.
    return str(folder.absolute() / f"{int(places[0])}.job"), key
