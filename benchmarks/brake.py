"""The finite-element brake: unstable modes by `complex_modes` against a reference by another route, and contacts of the reduced brake.

    python -m benchmarks.brake [modes] [contacts] [FOLDER]

FOLDER holds the matrices; unless given, it is `brake` in the folder that FIVJAX_DATA names, or else in `../shared/data`.

`modes`: one line a quantity: seconds for the modes up to 3 kHz, the modes, the two unstable eigenvalues (1/s) of the reference in
`tests/helpers/brake.py` and how well they solve their equation, then relative errors: of fivjax's eigenvalues, of those of the model
reduced to 60 coordinates, of the reduced growth rates, and of the derivatives by the disc's speed against differences. All errors
should be small against 1.

`contacts`: limit cycles, and 8 × 8 maps over friction and kick about critical friction, of the reduced structures in
`reduced_1.npz` and `reduced_2.npz` (18 and 21 coordinates, one and two contacts). Each runs in a process of its own with nothing
compiled, and there once more: wall seconds with imports, and of the second call.
"""

import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from tests.helpers.brake import FOLDER, measure

CALLS = "limit_cycle", "bistability_map"
CRITICAL = {1: 1.2379, 2: 1.2526}


def modes(folder: Path) -> None:
    for name, value in measure(folder).items():
        print(f"{name}: {value}")


def contacts(folder: Path) -> None:
    print("| call, contacts | first in a process with nothing compiled | again |")
    print("|---|---|---|")
    for count in CRITICAL:
        for call in CALLS:
            begin = time.perf_counter()
            with tempfile.TemporaryDirectory() as cache:
                again = subprocess.run(
                    [sys.executable, "-m", "benchmarks.brake", "twice", call, str(count), str(folder)],
                    env={**os.environ, "XDG_CACHE_HOME": cache},
                    check=True,
                    stdout=subprocess.PIPE,
                    text=True,
                ).stdout
            print(
                f"| `{call}`, {count} | {time.perf_counter() - begin - float(again):.0f} s | {float(again):.1f} s |",
                flush=True,
            )


def twice(call: str, count: int, folder: Path) -> None:
    """Seconds of the second of two calls."""
    import numpy as np

    import fivjax as fj

    given, critical = np.load(folder / f"reduced_{count}.npz"), CRITICAL[count]
    places = zip(given["tangential"].tolist(), given["normal"].tolist(), strict=True)
    matrices = (given[name] for name in ("mass", "damping", "stiffness", "load"))
    structure = fj.Structure(*matrices, contacts=[fj.ContactPoint(*place) for place in places])
    scene = fj.Scene(structure, fj.Coulomb(1.02 * critical), 3.0, fj.Pulse(100.0, 2.0))
    axes = (
        {"mu": np.linspace(0.9, 1.02, 8) * critical, "p": np.linspace(1.2, 6.0, 8)} if call == "bistability_map" else {}
    )
    for _ in range(2):
        begin = time.perf_counter()
        getattr(fj, call)(scene, **axes)
    print(time.perf_counter() - begin)


if __name__ == "__main__":
    words = sys.argv[1:]
    if words[:1] == ["twice"]:
        sys.exit(twice(words[1], int(words[2]), Path(words[3])))
    studies = [study for study in (modes, contacts) if study.__name__ in words] or [modes, contacts]
    named = [word for word in words if word not in (modes.__name__, contacts.__name__)]
    folder = Path(named[0]) if named else FOLDER
    if not folder.is_dir():
        sys.exit(f"The brake's matrices are not in `{folder}`. Name their folder as an argument, or by FIVJAX_DATA.")
    for study in studies:
        study(folder)
