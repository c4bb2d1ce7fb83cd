"""How the cost of a map grows: with its grid, with the attractors in it, with coordinates, and with contacts.

    python -m benchmarks.growth [grid] [attractors] [coordinates] [contacts]

Each word picks one study; without any, all run. Seconds are of processor time, of a warm map (the second of its kind in the process), so
that a busy machine changes little.

- `grid`: the paper's map, μ 0.05–0.228 and p 1–4 at 3 m/s, of 64² to 1024² trajectories;
- `attractors`: 1,024 trajectories over p, spread over 1 to 16 values of μ, each with attractors of its own to find and to prove;
- `coordinates`: the paper's oscillator with small masses on springs beside it, 3 to 24 coordinates, 8 × 16 trajectories over μ and p;
- `contacts`: 1 to 4 copies of it, coupled by springs, at 1 m/s: 4 × 8 trajectories over μ and p.

A line for each size: seconds, milliseconds a trajectory, and what the map found; then the exponent e of seconds ∝ size^e between the
smallest and the largest.
"""

import json
import math
import sys
import time
from collections.abc import Callable, Iterable

import numpy as np

import fivjax as fj
from tests.helpers.several_contacts import coupled

P = (1.0, 4.0)


def oscillator(structure=None, belt_speed=3.0) -> fj.Scene:
    structure = fj.belt_oscillator() if structure is None else structure
    return fj.Scene(structure, fj.Coulomb(0.227), belt_speed, fj.Pulse(100.0, 1.2))


def with_appendages(size: int) -> fj.Structure:
    """The paper's oscillator with small masses on m1, each by a spring and a damper, of frequencies from 100 to 300 Hz."""
    mass, damping, stiffness, load = (np.array(matrix) for matrix in fj.belt_oscillator().matrices)
    at, more = 1, size - len(load)
    mass, damping, stiffness = (np.pad(matrix, (0, more)) for matrix in (mass, damping, stiffness))
    for own, frequency in enumerate(np.linspace(100.0, 300.0, more), len(load)):
        rate = 2 * np.pi * frequency
        mass[own, own] = 1e-3
        for matrix, value in ((stiffness, rate**2), (damping, 0.04 * rate)):
            matrix[np.ix_([at, own], [at, own])] += 1e-3 * value * np.array([[1.0, -1.0], [-1.0, 1.0]])
    return fj.Structure(mass, damping, stiffness, np.pad(load, (0, more)), tangential=0, normal=2)


def cost(scene: fj.Scene, mu, p) -> tuple[float, int, str]:
    """Seconds of a warm map, its number of trajectories, and what was found."""
    seconds = math.inf
    for k in range(2):
        begin = time.process_time()
        m = fj.bistability_map(scene, mu=mu, p=p, progress=False)
        seconds = time.process_time() - begin if k else math.inf
    counts = json.loads(m.attrs["counts"])
    kinds = ", ".join(f"{count} {kind.replace('_', ' ')}" for kind, count in counts.items() if count)
    return seconds, m["verdict"].size, f"{len(m.attractors)} attractors; {kinds}"


def grid():
    for points in (64, 128, 256, 512, 1024):
        yield points**2, oscillator(), np.linspace(0.05, 0.228, points), np.linspace(*P, points)


def attractors():
    for groups in (1, 2, 4, 8, 16):
        yield groups, oscillator(), np.linspace(0.2, 0.227, groups), np.linspace(*P, 1024 // groups)


def coordinates():
    for size in (3, 6, 12, 24):
        yield size, oscillator(with_appendages(size)), np.linspace(0.1, 0.22, 8), np.linspace(*P, 16)


def contacts():
    for count in (1, 2, 3, 4):
        speed = 1.0 if count == 1 else np.full(count, 1.0)
        yield count, oscillator(coupled(count), speed), np.linspace(0.15, 0.22, 4), np.linspace(*P, 8)


def study(name: str, cases: Callable[[], Iterable]) -> None:
    found = []
    for size, scene, mu, p in cases():
        seconds, trajectories, what = cost(scene, mu, p)
        found.append((size, seconds))
        print(f"{name} {size}: {seconds:.2f} s, {1e3 * seconds / trajectories:.3f} ms a trajectory; {what}", flush=True)
    (small, first), (large, last) = found[0], found[-1]
    print(f"{name}: seconds ∝ {name}^{math.log(last / first) / math.log(large / small):.2f}", flush=True)


if __name__ == "__main__":
    studies = {"grid": grid, "attractors": attractors, "coordinates": coordinates, "contacts": contacts}
    for word in sys.argv[1:] or studies:
        study(word, studies[word])
