"""The finite-element brake: unstable modes by `complex_modes` against a reference by another route, whole and reduced.

    python -m benchmarks.brake [FOLDER]

FOLDER holds the matrices; unless given, it is `brake` in the folder that FIVJAX_DATA names, or else in `../shared/data`. The reference
is that of `tests/helpers/brake.py`.

One line a quantity: seconds for the modes up to 3 kHz, the modes, the reference's two unstable eigenvalues (1/s) and how well they solve
their equation, then relative errors: of fivjax's eigenvalues, of those of the model reduced to 60 coordinates, of the reduced growth
rates, and of the derivatives by the disc's speed against differences. All errors should be small against 1.
"""

import sys
from pathlib import Path

from tests.helpers.brake import FOLDER, measure

if __name__ == "__main__":
    folder = Path(sys.argv[1]) if len(sys.argv) > 1 else FOLDER
    if not folder.is_dir():
        sys.exit(f"The brake's matrices are not in `{folder}`. Name their folder as an argument, or by FIVJAX_DATA.")
    for name, value in measure(folder).items():
        print(f"{name}: {value}")
