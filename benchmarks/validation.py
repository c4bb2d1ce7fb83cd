"""The gallery of `docs/validation.md`: numbers that are published or follow from a formula, and those of fivjax.

    python -m benchmarks.validation [closed] [benchmark] [linear] [cycles] [bifurcation]

Each word picks one study; without any, all run (some minutes on two cores). Studies with a script of their own are not repeated here:
Table 2 (`benchmarks.maps table2`), energies (`benchmarks.energy`), derivatives (`benchmarks.gradients`), the paper's figures
(`fivjax reproduce`).

A line a quantity: the published or closed number, that of fivjax, and how far apart they are.
"""

import sys

import numpy as np
from scipy.optimize import brentq

import fivjax as fj
from tests.helpers.reference.cycles import stored

REFERENCE = stored()


def row(what: str, theirs: float, ours: float) -> None:
    print(f"{what:58s} {theirs:20.13g} {ours:20.13g}   {abs(ours - theirs):.1e}", flush=True)


def block(stiffness: float = 1.0, damping: float = 0.0) -> fj.Structure:
    """A unit mass along the belt, and a normal coordinate of its own."""
    normal = 1.0 if stiffness else 0.0
    return fj.Structure(
        np.eye(2), np.diag([damping, 0.0]), np.diag([stiffness, normal]), [0.0, -1.0], tangential=0, normal=1
    )


def paper(belt_speed: float) -> fj.Scene:
    return fj.Scene(fj.belt_oscillator(), fj.Coulomb(0.227), belt_speed, fj.ConstantLoad(100.0))


def benchmark_a(belt_speed: float) -> fj.Scene:
    return fj.Scene(block(damping=0.1), fj.ExponentialDecay(1.0, 0.5, 2.0), belt_speed, fj.ConstantLoad(1.0))


def closed() -> None:
    """Closed forms: a block on a belt, an oscillator that friction brings to rest, a bouncing mass."""
    scene = fj.Scene(block(), fj.Coulomb(0.5, mu_static=1.0), 0.2, fj.ConstantLoad(1.0))
    row("block on a belt: period (s)", 5.0 + 2 * (np.pi - np.arctan(2.5)), fj.limit_cycle(scene).period)
    still = fj.Scene(block(), fj.Coulomb(1.0), 0.0, fj.ConstantLoad(1.0))
    run = fj.simulate(still, 30.0, 0.01, y0=([12.0, 0.0], [6.0, 0.0]), energy=True)
    row("oscillator with Coulomb friction: at rest at (m)", 15 - np.hypot(13, 6), run.displacement[-1, 0])
    ends = fj.energy_per_event(run)["event_time"].values
    row("and after (s)", np.arctan2(6, 13) + 7 * np.pi, ends[-1])
    falling = fj.Scene(block(0.0), fj.Coulomb(0.0), 1.0, fj.ConstantLoad(9.81), restitution=0.5)
    run = fj.simulate(falling, 2.0, 0.001, y0=([0.0, 1.0], [0.0, 0.0]), energy=True)
    bounces = fj.energy_per_event(run)["event_time"].values
    fall = np.sqrt(2 / 9.81)
    row("bouncing mass, e = 0.5: fifth bounce (s)", fall * (1 + 2 * sum(0.5**k for k in range(1, 5))), bounces[4])
    row("and at rest after (s)", fall * 1.5 / 0.5, bounces[-1])


def linear() -> None:
    """Linear theory against closed forms and the printed page."""
    for theta, printed in ((0.01, 108.49), (0.5, 2.03), (0.8, 1.14)):
        scene = fj.Scene(fj.belt_oscillator(theta=theta), fj.Coulomb(0.1), 1.0, fj.ConstantLoad(100.0))
        row(f"Painlevé's limit at θ = {theta}", printed, float(fj.painleve_friction(scene.structure)))
    row("μ_crit, as printed", 0.23, float(fj.cea.critical_friction(fj.belt_oscillator())))
    row("its frequency, as printed (Hz)", 68.0, float(fj.cea.stability_limit(fj.belt_oscillator()).frequency))

    def growth(speed):
        return float(fj.cea.growth_rate(benchmark_a(speed)))

    row("Benchmark A: Hopf at a belt speed of", 0.5 * np.log(10.0), brentq(growth, 1.0, 1.3, xtol=1e-14))


def benchmark() -> None:
    """Benchmark A's two cycles against DOP853 with its variational equation."""
    for speed in (1.2, 1.4, 1.6, 1.8):
        sliding = REFERENCE["benchmark_a"]["sliding"][str(speed)]
        stick_slip = REFERENCE["benchmark_a"]["stick_slip"][str(speed)]
        cycle = fj.limit_cycle(benchmark_a(speed))
        saddle = fj.saddle_cycle(benchmark_a(speed), cycle)
        row(f"Benchmark A at {speed}: period of the stick-slip cycle", stick_slip["period"], cycle.period)
        row(f"Benchmark A at {speed}: period of the unstable cycle", sliding["period"], saddle.period)
        row(f"Benchmark A at {speed}: its multiplier", sliding["multiplier"], saddle.multipliers[0].real)


def cycles() -> None:
    """The paper's limit cycle against the independent solver, and the saddle on its boundary."""
    for expected in REFERENCE["paper"]["periodic"]:
        if expected["mu"] != 0.227:
            continue
        speed = expected["belt_speed"]
        cycle = fj.limit_cycle(paper(speed))
        row(f"paper's cycle at {speed} m/s: period (s)", expected["period"], cycle.period)
        row(f"paper's cycle at {speed} m/s: peak speed (m/s)", expected["peak_speed"], cycle.amplitude)
        first = np.hypot(*expected["multipliers"][0])
        row(f"paper's cycle at {speed} m/s: largest multiplier", first, abs(cycle.multipliers[1]))
        print(f"  closes to {cycle.residual:.1e}")
    saddle = fj.saddle_cycle(paper(1.0))
    print(f"saddle at 1 m/s: multiplier {saddle.multipliers[0].real:.8f}, closes to {saddle.residual:.1e}")


def bifurcation() -> None:
    """Where the paper's cycle becomes a torus: the pair of multipliers is on the unit circle."""
    before = fj.limit_cycle(paper(1.8))
    at = fj.limit_cycle(paper(1.8378941586942), start=before)
    pair = at.multipliers[np.abs(at.multipliers.imag) > 0.1]
    row("Neimark-Sacker at 1.8378941586942 m/s: size of the pair", 1.0, abs(pair[0]))
    torus = fj.limit_cycle(paper(3.0))
    peak = next(case["peak_speed"] for case in REFERENCE["paper"]["peaks"] if case["belt_speed"] == 3.0)
    row("torus at 3 m/s: peak speed (m/s)", peak, torus.amplitude)


STUDIES = {study.__name__: study for study in (closed, linear, benchmark, cycles, bifurcation)}

if __name__ == "__main__":
    for name in sys.argv[1:] or STUDIES:
        print(f"--- {name}: {STUDIES[name].__doc__}")
        STUDIES[name]()
