"""Attractors: those of a call against those of a map, tori against long runs, and verdicts near Hopf points.

    python -m benchmarks.attractors                     # all three
    python -m benchmarks.attractors agree [N [SEED]]    # N random scenes, 200 unless given
    python -m benchmarks.attractors tori [N [SEED]]     # N scenes with tori, 20 unless given
    python -m benchmarks.attractors hopf [N [SEED]]     # N structures of 35 trajectories each, 12 unless given

`agree` draws random structures, oscillators about the paper's under constant and falling friction, and two or three of them coupled
by springs. Each attractor of a map over seven kicks must be among `limit_cycles`, of the same kind, with amplitude and period to 1e-3
(1e-6 for a cycle); where the map has none, nothing is compared. `tori` compares amplitudes with the largest speed of a run of 400 s by
the reference, which shares no code, in its last 320 s. `hopf` draws oscillators under falling friction whose sliding has a
Hopf point at some belt speed, and maps seven belt speeds from 1 % below it to 3 % above it by five kicks.

`agree` prints a line a scene: a word for what came of it, the map's verdicts (s slides, C limit cycle, ? undecided), seconds of map and
call, and the attractors where one is missed; then how often each word came. `tori` prints a line a torus, its amplitude beside the
run's, then the largest and the median difference. `hopf` prints for each oscillator the verdicts of each belt speed, one letter a kick.
"""

import sys
import time
from collections import Counter

import numpy as np
from scipy.linalg import block_diag
from scipy.optimize import brentq

import fivjax as fj
from benchmarks.verdicts import draw
from tests.helpers import reference

USUAL = fj.belt_oscillator().parameters
KICKS = np.array([0.0, 1.2, 1.6, 2.2, 3.0, 4.5, 6.0])
SPEEDS = np.array([-1e-2, -1e-3, -1e-4, 1e-4, 1e-3, 1e-2, 3e-2])
MARKS = {0: "s", 1: "C", -1: "?"}


def about_the_paper(rng):
    """The paper's oscillator with other masses, dampers and springs."""
    return fj.belt_oscillator(
        **{name: float(USUAL[name]) * float(np.exp(rng.uniform(-0.2, 0.2))) for name in USUAL if name != "theta"}
    )


def falling(rng, mu=(0.05, 0.25)):
    """A law of friction that falls with slip speed."""
    low, fall, decay = (float(rng.uniform(*ends)) for ends in (mu, (0.01, 0.1), (0.2, 3.0)))
    return fj.ExponentialDecay(low + fall, low, decay)


def coupled(rng):
    """Two or three oscillators with a contact each, and springs between them."""
    count = int(rng.integers(2, 4))
    each = [about_the_paper(rng) for _ in range(count)]
    mass, damping, stiffness = (
        block_diag(*(np.asarray(getattr(one, name)) for one in each)) for name in ("mass", "damping", "stiffness")
    )
    for block in range(count - 1):
        for place in (0, 1):
            pair = 3 * block + place, 3 * block + 3 + place
            stiffness[np.ix_(pair, pair)] += np.exp(rng.uniform(np.log(1e3), np.log(5e4))) * np.array(
                [[1, -1], [-1, 1]]
            )
    contacts = [
        fj.ContactPoint(tangential=3 * k + each[0].tangential, normal=3 * k + each[0].normal) for k in range(count)
    ]
    load = np.tile(np.asarray(each[0].load_direction), count)
    return fj.Structure(mass, damping, stiffness, load, contacts=contacts)


def scene_of(rng, number):
    """A random scene of one of four kinds."""
    if number % 4 == 0:
        return draw(rng, number % 8 == 0)[0]
    if number % 4 == 1:
        law, structure = fj.Coulomb(float(rng.uniform(0.03, 0.3))), about_the_paper(rng)
    elif number % 4 == 2:
        law, structure = falling(rng), about_the_paper(rng)
    else:
        structure = coupled(rng)
        law = fj.Coulomb(float(rng.uniform(0.05, 0.3))) if rng.random() < 0.6 else falling(rng)
    return fj.Scene(structure, law, float(rng.uniform(0.3, 5.0)), load=fj.Pulse(100.0, 1.2, 0.1))


def agree(count=200, seed=0):
    """How many attractors of maps are those of a call."""
    rng, tally = np.random.default_rng(seed), Counter()
    for number in range(count):
        scene = scene_of(rng, number)
        began = time.perf_counter()
        found = fj.bistability_map(scene, p=KICKS, progress=False)
        of_map = list(
            zip(
                *(found[f"attractor_{name}"].values for name in ("kind", "amplitude", "period")),
                strict=True,
            )
        )
        between = time.perf_counter()
        of_call = [(one.kind, one.amplitude, one.period) for one in fj.limit_cycles(scene)]
        took = between - began, time.perf_counter() - between
        bound = {"periodic": 1e-6, "torus": 1e-3}

        def held(one, of_call=of_call, bound=bound):
            return any(
                one[0] == other[0]
                and all(abs(a / b - 1) < bound[one[0]] for a, b in zip(one[1:], other[1:], strict=True))
                for other in of_call
            )

        missed = [one for one in of_map if not held(one)]
        tally += Counter(scenes=1, of_maps=len(of_map), tori=sum(one[0] == "torus" for one in of_map))
        tally += Counter(missed=len(missed), undecided=int(np.sum(found["verdict"] == fj.Verdict.UNDECIDED)))
        marks = "".join(MARKS.get(int(code), "!") for code in found["verdict"].values)
        word = "MISSED" if missed else "ok"
        print(f"[{number}] {word} {marks} {took[0]:.1f} s, {took[1]:.1f} s: ", of_map if missed else "", end=" ")
        print(of_call if missed else len(of_map), flush=True)
    print(dict(tally))


def tori(count=20, seed=0):
    """Amplitudes of tori against long runs of the reference."""
    rng, off = np.random.default_rng(seed), []
    while len(off) < count:
        scene = fj.Scene(
            about_the_paper(rng),
            fj.Coulomb(float(rng.uniform(0.05, 0.25))),
            float(rng.uniform(2.0, 6.0)),
            load=fj.Pulse(),
        )
        for torus in (one for one in fj.limit_cycles(scene) if one.kind == "torus"):
            y = np.asarray(torus.points[0])
            start = {**reference.of_scene(scene), "p": 1.0, "deviation": (y[:3], y[3:])}
            run = reference.fate([start], t_max=400.0, more=1)
            largest = float(np.max(run.amplitudes[0, 2:]))
            off.append(float(torus.amplitude / largest - 1))
            print(f"  {torus.amplitude:.6f} m/s, in 400 s {largest:.6f}: {off[-1]:+.1e}", flush=True)
    print(f"{len(off)} tori: {np.max(np.abs(off)):.1e} at most, {np.median(np.abs(off)):.1e} in the middle")


def hopf(count=12, seed=1):
    """Undecided trajectories near Hopf points, and the time that they take."""
    rng, tally, took, drawn = np.random.default_rng(seed), Counter(), 0.0, 0
    while drawn < count:
        structure, law = about_the_paper(rng), falling(rng, (0.02, 0.15))

        def at(speed, structure=structure, law=law):
            return fj.Scene(structure, law, float(speed), load=fj.Pulse(100.0, 1.2))

        def growth(speed, at=at):
            return float(np.max(np.real(fj.cea.eigenvalues(at(speed)))))

        speeds = np.geomspace(0.05, 20.0, 60)
        rates = list(map(growth, speeds))
        changes = [k for k in range(59) if rates[k] * rates[k + 1] < 0]
        if not changes:
            continue
        drawn += 1
        point = brentq(growth, *speeds[changes[-1] : changes[-1] + 2], xtol=1e-13)
        began = time.perf_counter()
        found = fj.bistability_map(
            at(point), belt_speed=point * (1 + SPEEDS), p=[0.9, 1.01, 1.2, 1.6, 2.5], progress=False
        )
        took += time.perf_counter() - began
        rows = found["verdict"].transpose("belt_speed", "p").values
        tally += Counter(MARKS.get(int(code), "!") for code in rows.ravel())
        print(
            f"[{drawn - 1}] v = {point:.5g} m/s:",
            *("".join(MARKS.get(int(code), "!") for code in row) for row in rows),
            f"{time.perf_counter() - began:.1f} s, decided after {np.nanmax(found['decided_at']):.0f} s at most",
            flush=True,
        )
    print(f"{dict(tally)}; {took:.0f} s")


STUDIES = {"agree": agree, "tori": tori, "hopf": hopf}

if __name__ == "__main__":
    for study in sys.argv[1:2] or STUDIES:
        STUDIES[study](*map(int, sys.argv[2:]))
