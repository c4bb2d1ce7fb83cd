"""Critical kicks by Newton's method and their derivatives, against an independent event-exact solver.

    python -m benchmarks.critical [table2] [random] [derivatives] [cost]

`table2`: the kicks of Table 2, by Newton's method and by bisection with the independent solver. `random`: the same for ten
random structures. `derivatives`: all of them at two points of each kind against differences of the independent solver's kicks.
`cost`: the time of the derivatives, in units of a trajectory.

Each kick is printed beside the bracket of the reference, in which it should lie to rounding (2e-13); each derivative beside that of the
reference, which is good to some 1e-8.
"""

import argparse
import time

import numpy as np

import fivjax as fj
from fivjax.kicks.critical_derivatives import differentiable
from fivjax.kicks.stable_manifold import critical_kick
from tests.helpers import reference

SPEEDS = (0.5, 1.0, 1.5, 3.0, 5.0, 10.0, 100.0)


def paper(belt_speed: float, **others) -> fj.Scene:
    return fj.Scene(fj.belt_oscillator(**others), fj.Coulomb(0.227), belt_speed=belt_speed, load=fj.Pulse(p=1.2))


def static(belt_speed: float, mu: float) -> fj.Scene:
    """Static friction above kinetic friction: a motion that just touches sticking squeals."""
    return fj.Scene(fj.belt_oscillator(), fj.Coulomb(mu, mu_static=0.5), belt_speed=belt_speed, load=fj.Pulse(p=1.2))


def bisected(scene: fj.Scene, low: float, high: float, width: float = 2e-13) -> tuple[float, float]:
    """The change from sliding to anything else between two kicks, by the independent solver; outside them where it is not inside."""
    while True:
        ends = reference.fate([{**reference.of_scene(scene), "p": p} for p in (low, high)], threads=2).fate == "slides"
        if (ends[0] and not ends[1]) or high - low > 1e-2:
            break
        low, high = low - 4 * (high - low), high + 4 * (high - low)
    while high - low > width * high:
        tried = np.linspace(low, high, 18)[1:-1]
        fates = reference.fate([{**reference.of_scene(scene), "p": p} for p in tried], threads=2).fate
        first = int(np.argmax(fates != "slides")) if np.any(fates != "slides") else len(tried)
        new = (low if first == 0 else tried[first - 1]), (high if first == len(tried) else tried[first])
        if new == (low, high):
            break
        low, high = new
    return low, high


def compared(name: str, scene: fj.Scene, found) -> None:
    p = float(found.p_crit)
    if not np.isfinite(p):
        print(f"  {name}: no number; {found.why_none.values}")
        return
    low, high = bisected(scene, p - 1e-6, p + 1e-6)
    apart = 0.0 if low <= p <= high else min(abs(p - low), abs(p - high))
    kind, took = str(found.kind.values), int(found.newton_trajectories)
    print(
        f"  {name}: p_crit {p:.12f} ({kind}, {took} trajectories), off the reference's bracket by {apart:.1e} {found.why_none.values}"
    )


def table2() -> None:
    found = fj.critical_perturbation(
        paper(1.0), belt_speed=SPEEDS, p_range=(1.0, 1.3), derivatives=True, progress=False
    )
    for row, speed in enumerate(SPEEDS):
        compared(f"v = {speed:g}", paper(speed), found.isel(belt_speed=row))
        print(f"      dp/dv = {float(found.d_p_crit.sel(parameter='belt_speed')[row]):.12f}")


def random() -> None:
    draw, done = np.random.default_rng(3), 0
    while done < 10:
        share = draw.uniform(0.7, 1.4, 6)
        parameters = dict(zip(("m1", "m2", "c1", "c2", "k1", "k2"), (0.53, 0.045, 1, 1, 100e3, 101e3), strict=True))
        structure = fj.belt_oscillator(**{k: x * s for (k, x), s in zip(parameters.items(), share, strict=True)})
        limit = float(fj.cea.critical_friction(structure))
        if not 0.02 < limit < 0.8:
            continue
        scene = fj.Scene(
            structure, fj.Coulomb(draw.uniform(0.7, 0.98) * limit), draw.uniform(0.5, 5.0), fj.Pulse(p=1.2)
        )
        found = fj.critical_perturbation(scene, p_range=(1.0, 9.0), p_step=0.05, derivatives=True, progress=False).isel(
            belt_speed=0
        )
        if np.isfinite(found.p_crit_low):
            done += 1
            compared(f"structure {done}", scene, found)


def derivatives() -> None:
    for scene in (paper(1.0), paper(5.0), static(1.0, 0.227), static(0.3, 0.22)):
        found = fj.critical_perturbation(scene, p_range=(1.0, 1.3), derivatives=True, progress=False).isel(belt_speed=0)
        p, speed = float(found.p_crit), float(scene.belt_speed)
        low, high = bisected(scene, p - 1e-6, p + 1e-6)
        print(f"  {found.kind.values} at v = {speed:g}: {p:.12f}, the reference's bracket {low:.12f} to {high:.12f}")
        for name in differentiable(scene):
            value, slope = float(scene.parameters[name]), float(found.d_p_crit.sel(parameter=name))
            # So small that p_crit is smooth (farther away another oscillation touches first), and far above its rounding.
            by = min(1e-3 * (abs(value) or 1.0), 2e-6 / max(abs(slope), 1e-12))
            difference = extrapolated(scene, name, p, slope, by)
            apart = abs(slope - difference)
            relative = f"{apart / abs(difference):.0e} of it" if difference else ""
            print(
                f"  {name:12s} {slope: .12e}  differences {difference: .12e}  apart {apart:.0e} {relative}", flush=True
            )


def extrapolated(scene: fj.Scene, name: str, p: float, slope: float, by: float) -> float:
    """The derivative of the independent solver's critical kick: differences over a step and its half, extrapolated to none.

    Of one side alone where the other would be negative, as of a coefficient of restitution of zero.
    """
    value = float(scene.parameters[name])

    def kick(side: float) -> float:
        guess = p + slope * side
        return float(np.mean(bisected(scene.replace(**{name: value + side}), guess - 2e-9, guess + 2e-9)))

    if value < by:
        coarse, fine = ((kick(h) - p) / h for h in (by, by / 2))
        return 2 * fine - coarse
    coarse, fine = ((kick(h) - kick(-h)) / (2 * h) for h in (by, by / 2))
    return (4 * fine - coarse) / 3


def cost() -> None:
    for speed in (1.0, 5.0):
        scene = paper(speed)
        bracket = (1.107205, 1.107207) if speed == 1.0 else (1.190282, 1.190284)
        names = differentiable(scene)
        critical_kick(scene, bracket, names)
        began = time.perf_counter()
        found = critical_kick(scene, bracket, names)
        took = time.perf_counter() - began
        began = time.perf_counter()
        for _ in range(5):
            fj.simulate(scene.replace(p=found.p), t1=10.0, dt_save=10.0)
        one = (time.perf_counter() - began) / 5
        print(
            f"  v = {speed:g}: {took:.2f} s for p_crit and {len(names)} derivatives; a trajectory of 10 s takes {one:.3f} s"
        )


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", nargs="*", default=["table2", "random", "derivatives", "cost"])
    for what in parser.parse_args().what:
        print(what, flush=True)
        {"table2": table2, "random": random, "derivatives": derivatives, "cost": cost}[what]()
