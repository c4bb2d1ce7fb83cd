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
from typing import NamedTuple

import numpy as np

from ..attractors.approach import Approach
from ..attractors.catalogue import Attractors
from ..attractors.cycles import StableCycle
from ..attractors.neighbourhood import Neighbourhood
from ..attractors.tori import Torus
from ..attractors.tube import Tube
from ..foundation.seals import Damaged, sealed, unsealed
from ..io.files import replace_whole
from .plan import Indices
from .results import Verdicts, by_name


def attractors_to_bytes(found: dict[bytes, Attractors]) -> bytes:
    """The attractors of groups, by the groups' parameters, as bytes."""
    arrays, index = {}, []
    for number, (key, one) in enumerate(found.items()):
        place = {id(cycle): k for k, cycle in enumerate(one.cycles)}
        approached = [place[id(approach.cycle)] for approach in one.approaches]
        index.append([key.hex(), len(one.cycles), len(one.tori), approached])
        for k, cycle in enumerate(one.cycles):
            fields = {**cycle._asdict(), **{f"n_{name}": part for name, part in cycle.neighbourhood._asdict().items()}}
            del fields["neighbourhood"]
            arrays |= {f"{number}.{k}.{name}": np.asarray(value) for name, value in fields.items()}
        for k, torus in enumerate(one.tori):
            fields = {**torus._asdict(), **_of_tube(torus.tube)}
            del fields["tube"]
            arrays |= {f"{number}.torus{k}.{name}": np.asarray(value) for name, value in fields.items()}
        for k, approach in enumerate(one.approaches):
            arrays |= {f"{number}.approach{k}.{name}": value for name, value in _of_tube(approach.tube).items()}
    content = io.BytesIO()
    np.savez_compressed(content, index=np.frombuffer(json.dumps(index).encode(), np.uint8), **arrays)
    return content.getvalue()


def attractors_from_bytes(content: bytes) -> dict[bytes, Attractors]:
    """The attractors that `attractors_to_bytes` has written."""
    with np.load(io.BytesIO(content), allow_pickle=False) as file:
        arrays = {name: file[name] for name in file.files}
    found = {}
    for number, (key, cycles, tori, approached) in enumerate(json.loads(arrays["index"].tobytes())):

        def of(kind, prefix, own=number, **others):
            names = [name for name in kind._fields if name not in others]
            return kind(**others, **{name: _plain(arrays[f"{own}.{prefix}{name}"]) for name in names})

        def tube(prefix, own=number):
            return Tube(*(_plain(arrays[f"{own}.{prefix}{name}"]) for name in ("states", "radius")))

        own = [of(StableCycle, f"{k}.", neighbourhood=of(Neighbourhood, f"{k}.n_")) for k in range(cycles)]
        found[bytes.fromhex(key)] = Attractors(
            own,
            [of(Torus, f"torus{k}.", tube=tube(f"torus{k}.")) for k in range(tori)],
            [Approach(own[place], tube(f"approach{k}.")) for k, place in enumerate(approached)],
        )
    return found


def _of_tube(tube: Tube) -> dict[str, np.ndarray]:
    return {"states": tube.states, "radius": np.asarray(tube.radius)}


def _plain(value: np.ndarray):
    return value if value.ndim else value.item()


class JobState(NamedTuple):
    """The state of a job after some rounds. What trajectories share follows from the job's values and is worked out again."""

    done: int  # steps of each trajectory
    own_from: int  # steps after which trajectories search for attractors of their own
    verdicts: Verdicts  # of all trajectories of the job
    pending: np.ndarray  # trajectories without a verdict, as indices
    numbers: np.ndarray  # their states, see `Flattened`
    searched: dict[bytes, Attractors]  # what searches have found, by the group's parameters
    settled_by: np.ndarray  # time that the known cycles of each group take to attract, s
    # The same with what trajectories have found on their way, by the group's number; and when their time was over.
    known: dict[int, Attractors]
    at_last: dict[int, Attractors]


# Time between writes, s.
KEEP_EVERY = 4.0
# And in times of what the latest took, where that is longer.
SHARE_OF_TIME = 20.0


class JobFile:
    """The file of one job; `key` names the run and the job. Without a path nothing is kept.

    Where the file cannot be written (a worker on a machine without this folder, a full disk), the job runs on all the same.
    """

    def __init__(self, path: str | None, key: str):
        self.path, self.key = None if path is None else Path(path), key
        self._written, self._took = time.monotonic(), 0.0
        self._noted: JobState | None = None

    def last(self) -> JobState | None:
        """The state in which an interrupted run of the job was kept, if there is one."""
        if self.path is None or not self.path.is_file():
            return None
        try:
            return state_from_bytes(unsealed(self.path.read_bytes()), self.key)
        except (OSError, Damaged):
            warnings.warn(f"File `{self.path}` of an unfinished job is damaged; the job begins anew.", stacklevel=2)
        return None

    def note(self, now: JobState, at_once: bool = False) -> None:
        """Keep this state if it is time, or almost so if `at_once`: before a part of the work that may take long. Until
        `moving`, its arrays do not change.
        """
        self._noted = now
        if time.monotonic() - self._written >= max((0.25 if at_once else 1.0) * KEEP_EVERY, SHARE_OF_TIME * self._took):
            self.flush()

    def moving(self) -> None:
        """The arrays of the state noted last are about to change."""
        self._noted = None

    def flush(self) -> None:
        """Write the state noted last, if it is still whole and not written."""
        noted, self._noted = self._noted, None
        if noted is None or self.path is None:
            return
        begun = time.monotonic()
        with contextlib.suppress(OSError):
            self.path.parent.mkdir(exist_ok=True)
            replace_whole(self.path, sealed(state_to_bytes(noted, self.key)))
        self._written = time.monotonic()
        self._took = self._written - begun


def state_to_bytes(now: JobState, key: str) -> bytes:
    """The state as bytes (NumPy's npz, without pickles)."""
    head = {"key": key, "done": now.done, "own_from": now.own_from}
    attractors = {
        "known": attractors_to_bytes(now.searched),
        "of_groups": attractors_to_bytes({str(g).encode(): one for g, one in now.known.items()}),
        "at_last": attractors_to_bytes({str(g).encode(): one for g, one in now.at_last.items()}),
    }
    arrays = {f"result.{name}": values for name, values in by_name(now.verdicts).items()}
    arrays |= {name: np.frombuffer(content, np.uint8) for name, content in attractors.items()}
    arrays |= {"pending": now.pending, "numbers": now.numbers, "settled_by": now.settled_by}
    content = io.BytesIO()
    np.savez(content, head=np.frombuffer(json.dumps(head).encode(), np.uint8), **arrays)
    return content.getvalue()


def state_from_bytes(content: bytes, key: str) -> JobState | None:
    """The state again; none where it is not of this run and job."""
    with np.load(io.BytesIO(content), allow_pickle=False) as file:
        head = json.loads(file["head"].tobytes())
        if head["key"] != key:
            return None
        arrays = {name: file[name] for name in file.files}
    results = {name.removeprefix("result."): arrays[name] for name in arrays if name.startswith("result.")}
    parts = {name: results.pop(name) for name in Verdicts._fields if name != "energy"}
    searched, known, at_last = (
        attractors_from_bytes(arrays[name].tobytes()) for name in ("known", "of_groups", "at_last")
    )
    return JobState(
        done=head["done"],
        own_from=head["own_from"],
        verdicts=Verdicts(**parts, energy=results),
        pending=arrays["pending"],
        numbers=arrays["numbers"],
        settled_by=arrays["settled_by"],
        searched=searched,
        known={int(g): one for g, one in known.items()},
        at_last={int(g): one for g, one in at_last.items()},
    )


def file_of(folder: Path, run: dict, places: Indices) -> tuple[str, str]:
    """The path and the key of the file, in this folder, for the job of this run with these trajectories."""
    job = hashlib.sha256(np.asarray(places, np.int64).tobytes()).hexdigest()
    # Workers may have another working directory.
    return str(folder.absolute() / f"{int(places[0])}.job"), json.dumps({"run": run, "job": job})


def runs_of(folder: Path) -> list[dict]:
    """The runs that the files of jobs in a folder belong to; damaged ones say nothing."""
    found = []
    for path in sorted(folder.glob("*.job")):
        with contextlib.suppress(OSError, Damaged, ValueError, KeyError):
            file = np.load(io.BytesIO(unsealed(path.read_bytes())), allow_pickle=False)
            found.append(json.loads(json.loads(file["head"].tobytes())["key"])["run"])
    return found
