"""The cost of several contacts: processor time per trajectory and cycle, on the limit cycle, relative to one contact.

    python -m benchmarks.several_contacts [counts ...]

One structure contains copies of the paper's oscillator, uncoupled (each has events of its own) or with neighbours coupled in the mass
matrix (`coupled`). Processor time is the least of three runs after compilation.

A line a structure: milliseconds of processor time per cycle, and how many times that is of one contact.
"""

import sys
import time

import numpy as np

import fivjax as fj
from fivjax.kernels import tiered
from tests.helpers.several_contacts import copies, scene_of

CYCLES = 68.0  # a second


def scene(count, mass_coupling):
    if count == 1:
        return fj.Scene(fj.belt_oscillator(), fj.Coulomb(0.2), 3.0, fj.Pulse(100.0, 2.0))
    structure = copies(count, shares=1 + 0.1 * np.arange(count))
    mass, damping, stiffness, load = (np.array(matrix) for matrix in structure.matrices)
    for i in range(count - 1):
        mass[3 * i + 2, 3 * i + 5] = mass[3 * i + 5, 3 * i + 2] = mass_coupling
    structure = fj.Structure(mass, damping, stiffness, load, contacts=structure.contacts)
    return scene_of(structure, p=2.0)


def cost(count, t1=0.5, mass_coupling=0.0):
    """Seconds of processor time per cycle, and events per cycle."""
    case, times = scene(count, mass_coupling), []
    for k in range(4):
        begin = time.process_time()
        run = fj.simulate(case, t1, t1 / 50)
        if k:
            times.append(time.process_time() - begin)
    assert run.meaning == "reached its end", run.meaning
    return min(times) / (CYCLES * t1)


if __name__ == "__main__":
    counts = [int(word) for word in sys.argv[1:]] or [1, 2, 4, 8]
    # What is compiled quickly first runs several times as long, and how soon it is compiled thoroughly depends on its length.
    tiered.WORTH = tiered.WORTH_OF_LONG = 0.0
    one = cost(1)
    print(f"1 contact: {1e3 * one:.3f} ms per cycle")
    for count in counts:
        if count > 1:
            for name, coupling in (("uncoupled", 0.0), ("coupled", 0.004)):
                found = cost(count, mass_coupling=coupling)
                print(
                    f"{count} contacts, {name}: {1e3 * found:.3f} ms per cycle, {found / one:.1f} times one", flush=True
                )
