"""Attractors that jobs have found, written to bytes (NumPy's npz, without pickles) and read again, bit for bit."""

import io
import json

import numpy as np

from ..attractors.cycles import Cycle
from ..attractors.known import Attractors, Torus
from ..attractors.neighbourhood import Neighbourhood
from ..attractors.tube import Tube


def to_bytes(found: dict[bytes, Attractors]) -> bytes:
    """The attractors of groups, by the groups' parameters, as bytes."""
    arrays, index = {}, []
    for number, (key, one) in enumerate(found.items()):
        index.append([key.hex(), len(one.cycles), len(one.tori)])
        for k, cycle in enumerate(one.cycles):
            fields = {**cycle._asdict(), **{f"n_{name}": part for name, part in cycle.neighbourhood._asdict().items()}}
            del fields["neighbourhood"]
            arrays |= {f"{number}.{k}.{name}": np.asarray(value) for name, value in fields.items()}
        for k, torus in enumerate(one.tori):
            fields = {**torus._asdict(), "states": torus.tube.states, "radius": torus.tube.radius}
            del fields["tube"]
            arrays |= {f"{number}.torus{k}.{name}": np.asarray(value) for name, value in fields.items()}
    content = io.BytesIO()
    np.savez_compressed(content, index=np.frombuffer(json.dumps(index).encode(), np.uint8), **arrays)
    return content.getvalue()


def from_bytes(content: bytes) -> dict[bytes, Attractors]:
    """The attractors that `to_bytes` has written."""
    with np.load(io.BytesIO(content), allow_pickle=False) as file:
        arrays = {name: file[name] for name in file.files}
    found = {}
    for number, (key, cycles, tori) in enumerate(json.loads(arrays["index"].tobytes())):

        def of(kind, prefix, own=number, **others):
            names = [name for name in kind._fields if name not in others]
            return kind(**others, **{name: _plain(arrays[f"{own}.{prefix}{name}"]) for name in names})

        def tube(k, own=number):
            return Tube(*(_plain(arrays[f"{own}.torus{k}.{name}"]) for name in ("states", "radius")))

        found[bytes.fromhex(key)] = Attractors(
            [of(Cycle, f"{k}.", neighbourhood=of(Neighbourhood, f"{k}.n_")) for k in range(cycles)],
            [of(Torus, f"torus{k}.", tube=tube(k)) for k in range(tori)],
        )
    return found


def _plain(value: np.ndarray):
    return value if value.ndim else value.item()
