"""The smallest perturbations, against differential evolution on verdicts of the independent solver in `reference`.

    python -m benchmarks.smallest [kick] [state] [history]

Each prints what `fj.smallest_kick` finds and certifies, and the smallest that SciPy's `differential_evolution` finds in 2,000
trajectories of the paper's case at 1 m/s, in the same bounds.

The certified bound must be below both; the found one should be no larger than that of the 2,000 trajectories.
"""

import argparse
import time

import numpy as np
from scipy.optimize import differential_evolution

import fivjax as fj
from tests.helpers import reference

SCENE = fj.Scene(fj.belt_oscillator(), fj.Coulomb(0.227), belt_speed=1.0, load=fj.Pulse(force=100.0, p=1.2))
TRAJECTORIES = 2000
# The size of a perturbation that slides is multiplied by this, so that the search goes on to those that squeal.
SLIDES = 10.0


def evolved(size, scene_of, bounds) -> tuple[float, int]:
    """The smallest size that squeals, and how many trajectories were followed."""
    count, best = 0, np.inf

    def objective(points):
        nonlocal count, best
        points = np.atleast_2d(points.T)
        left = max(TRAJECTORIES - count, 0)
        points_run = points[:left]
        sizes = np.array([size(x) for x in points])
        squeals = np.zeros(len(points), bool)
        if len(points_run):
            fates = reference.fate([scene_of(x) for x in points_run], periods=2000, threads=2).fate
            squeals[: len(points_run)] = fates == "sustained"
            count += len(points_run)
        if squeals.any():
            best = min(best, float(sizes[squeals].min()))
        return np.where(squeals, sizes, SLIDES + 1.0 / np.maximum(sizes, 1e-9))

    population = 40
    generations = TRAJECTORIES // population
    differential_evolution(
        objective,
        bounds,
        popsize=max(population // len(bounds), 5),
        maxiter=generations,
        vectorized=True,
        updating="deferred",
        polish=False,
        tol=0,
        rng=np.random.default_rng(0),
        callback=lambda *_, **__: count >= TRAJECTORIES,
    )
    return best, count


def kick() -> None:
    began = time.perf_counter()
    found = fj.smallest_kick(SCENE, bounds={"p": (1.0, 1.3), "duration": (0.0, 0.2)})
    print(found)
    print(f"  {time.perf_counter() - began:.0f} s")
    p, count = evolved(
        lambda x: x[0],
        lambda x: {**reference.paper_scene(belt_speed=1.0), "p": x[0], "duration": x[1]},
        [(1.0, 1.3), (0.0, 0.2)],
    )
    print(
        f"  differential evolution: p = {p:.9g} in {count} trajectories; found here / there, as excess: {(found.p - 1) / (p - 1):.6f}"
    )


def state() -> None:
    began = time.perf_counter()
    found = fj.smallest_kick(SCENE, over="state")
    print(found)
    print(f"  {found.trajectories} trajectories, {time.perf_counter() - began:.0f} s")
    stiffness, mass = np.asarray(SCENE.structure.stiffness), np.asarray(SCENE.structure.mass)
    free = [0, 1]
    roots = [np.linalg.inv(np.linalg.cholesky(0.5 * m[np.ix_(free, free)])).T for m in (stiffness, mass)]

    def scene_of(x):
        q, v = np.zeros(3), np.zeros(3)
        q[free], v[free] = roots[0] @ x[:2], roots[1] @ x[2:]
        return {**reference.paper_scene(belt_speed=1.0), "deviation": (q, v)}

    size, count = evolved(np.linalg.norm, scene_of, [(-0.1, 0.1)] * 4)
    print(
        f"  differential evolution: {size**2:.9g} J in {count} trajectories; found here / there, as norm: {found.size / size:.6f}"
    )


def history() -> None:
    began = time.perf_counter()
    found = fj.smallest_kick(SCENE, over="history")
    print(found)
    print(f"  {found.trajectories} trajectories, {time.perf_counter() - began:.0f} s")
    pieces = len(found.values)
    duration = float(SCENE.load.duration) / pieces

    def scene_of(x):
        # The reference takes a single pulse, so the history is followed piece by piece; all of it slides.
        base = reference.paper_scene(belt_speed=1.0)
        rest = reference.linear({**base, "p": 1.0}).q_eq
        q, v = rest, np.zeros(3)
        for factor in 1.0 + x:
            part = reference.trajectory({**base, "force": 100.0 * factor, "y0": (q, v)}, duration, times=[duration])
            q, v = part.q[0], part.v[0]
        return {**base, "deviation": (q - rest, v)}

    size, count = evolved(lambda x: np.max(np.abs(x)), scene_of, [(-0.03, 0.03)] * pieces)
    print(
        f"  differential evolution: {100 * size:.6g} % in {count} trajectories; found here / there: {found.size / size:.6f}"
    )


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", nargs="*", default=["kick", "state", "history"])
    for what in parser.parse_args().what:
        print(what, flush=True)
        {"kick": kick, "state": state, "history": history}[what]()
