"""Branches of limit cycles against an ODE solver and the independent solver in `reference`.

    python -m benchmarks.branches [benchmark_a] [births] [cost]

`benchmark_a`: both ends of the unstable branch of benchmark A. `births`: the friction at which the paper's limit cycle appears
at belt speeds 1 and 3, and the independent solver's motions 1e-4 above and below it. `cost`: seconds for a branch, once its
programs are compiled.

Special points are listed as the value of the parameter and what happens there. Just above a birth the reference's motions should be
sustained, just below it slide.
"""

import argparse
import time

import numpy as np

import fivjax as fj
from tests.helpers import reference
from tests.helpers.reference import cycles


def paper(belt_speed: float, mu: float, p: float = 1.2) -> fj.Scene:
    return fj.Scene(fj.belt_oscillator(), fj.Coulomb(mu), belt_speed=belt_speed, load=fj.Pulse(100.0, p=p))


def show(branch) -> None:
    print(" ", branch.begins)
    for i in np.flatnonzero(branch.special.values != ""):
        print(f"  {float(branch.parameter[i]):.12f}  {branch.special.values[i]}")
    print(" ", branch.ends)


def of_benchmark_a() -> None:
    structure = fj.Structure(np.eye(2), np.diag([0.1, 0.0]), np.eye(2), np.array([0.0, -1.0]), tangential=0, normal=1)
    scene = fj.Scene(structure, fj.ExponentialDecay(1.0, 0.5, 2.0), 1.5, fj.ConstantLoad(1.0))
    start = ([cycles.sliding_cycle(1.5)["lowest"], 0, 0, 0], 1)
    branch = fj.continue_cycle(scene, "belt_speed", (1.0, 2.0), start)
    show(branch)
    hopf, grazing = branch.parameter.values[branch.special.values != ""][:2]
    print(f"  Hopf point: off the closed form by {hopf - 0.5 * np.log(10.0):.1e}")
    print(f"  grazing: off the ODE solver's root by {grazing - cycles.grazing_speed():.1e}")


def started(belt_speed: float) -> tuple[fj.Scene, fj.LimitCycle]:
    """The paper's scene with its limit cycle; at 3 m/s a large kick at low friction leads to it."""
    if belt_speed == 1.0:
        scene = paper(1.0, 0.2)
        return scene, fj.limit_cycle(scene)
    scene = paper(3.0, 0.03, p=12.0)
    return scene, fj.limit_cycle(scene, start=fj.simulate(scene, t1=4.0, dt_save=1e-3))


def births() -> None:
    for belt_speed in (1.0, 3.0):
        scene, cycle = started(belt_speed)
        branch = fj.continue_cycle(scene, "mu", (0.0, 0.3), start=cycle)
        print(f"belt speed {belt_speed}")
        show(branch)
        lowest = int(np.argmin(branch.parameter.values))
        at = float(branch.parameter[lowest])
        deviation = fj.cycle_at(branch, lowest).deviation
        scenes = [
            reference.paper_scene(
                mu=at + by, belt_speed=belt_speed, deviation=(share * deviation[:3], share * deviation[3:])
            )
            for by in (1e-4, -1e-4)
            for share in (1.0, 1.01, 1.02, 1.05, 1.1)
        ]
        fates = reference.fate(scenes).fate
        print(f"  born at μ = {at:.12f}; the reference 1e-4 above: {list(fates[:5])}, 1e-4 below: {list(fates[5:])}")


def cost() -> None:
    scene, cycle = started(1.0)
    for _ in range(2):
        began = time.perf_counter()
        branch = fj.continue_cycle(scene, "mu", (0.0, 0.3), start=cycle)
        took = time.perf_counter() - began
        print(f"  {len(branch.point)} points in {took:.1f} s: {100 * took / len(branch.point):.1f} s for 100")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", nargs="*", default=["benchmark_a", "births", "cost"])
    for what in parser.parse_args().what:
        print(what)
        {"benchmark_a": of_benchmark_a, "births": births, "cost": cost}[what]()
