"""Linear theory beside independent routes: critical friction, sensitivities, charts, corners, designs; and seconds.

    python -m benchmarks.cea

The routes are Eq. 3 typed out, NumPy's eigenvalues and SciPy's `brentq` (`tests/helpers/linear_reference.py`). Each block has a line for
each route: its value and how far it is from the first one's or the reference's. Searches by steps are off by their tolerance, all
others by rounding.
"""

import time

import jax
import numpy as np

import fivjax as fj
from fivjax.linear import cea, design
from tests.helpers import linear_reference as reference


def heading(text):
    print(f"\n{text}\n{'-' * len(text)}")


def timed(function, repeats=1):
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        result = function()
        times.append(time.perf_counter() - start)
    return result, min(times)


def critical_friction():
    heading("Critical friction of Table 1")
    structure = fj.belt_oscillator()
    expected = reference.critical_friction()
    limit, first = timed(lambda: cea.stability_limit(structure))
    _, warm = timed(lambda: cea.critical_friction(structure), 20)
    rows = {
        "all crossings at once (cea.critical_friction)": limit.mu,
        "gradient search, eigenvalues": design.search_critical_friction(structure).mu,
        "gradient search, Routh-Hurwitz": design.search_critical_friction(structure, route="routh-hurwitz").mu,
        "NumPy eigenvalues and SciPy brentq": expected,
        "mpmath, 40 digits": 0.22822534771804482,
    }
    for name, value in rows.items():
        print(f"{name:<48}{value:.16f}   {value - expected:+.1e}")
    print(
        f"frequency there {limit.frequency:.6f} Hz, {limit.mechanism.value}; first call {first:.1f} s, warm {warm:.1e} s"
    )
    undamped, damped = cea.coalescence(structure), cea.coalescence(structure, damped=True)
    print(f"coalescence, undamped: mu {undamped.mu:.10f}, {undamped.frequency:.5f} Hz")
    print(
        f"coalescence, damped:   mu {damped.mu:.10f}, {damped.frequency:.5f} Hz, growth {damped.growth_rate:.4f} 1/s, "
        f"imperfection {damped.imperfection:.2e}"
    )
    print("printed in the paper: mu_crit 0.23, coupling 0.22, 68 Hz")


def sensitivities():
    heading("Sensitivities against central differences of the SciPy route")
    result = cea.sensitivity(fj.belt_oscillator())
    worst = 0.0
    for name, value in reference.TABLE_1.items():
        step = value * (2e-3 if name in ("c1", "c2") else 2e-5)
        expected = reference.difference(
            lambda x, name=name: reference.critical_friction(low=0.2268, high=0.2297, **{name: x}), value, step
        )
        error = abs(result[name] / expected - 1)
        worst = max(worst, error)
        print(f"{name:<6}{result[name]:>16.9g}{expected:>16.9g}   relative error {error:.1e}", end="")
        print(f"{result.normalised[name]:>12.4f} % per %")
    print(f"worst relative error {worst:.1e}")


def searches():
    heading("Search by gradient from 20 random starts in (0, 1), and from the worst")
    structure = fj.belt_oscillator()
    expected = reference.critical_friction()
    starts = np.random.default_rng(2025).uniform(0, 1, 20)
    special = [cea.coalescence(structure).mu, cea.coalescence(structure, damped=True).mu, expected, 1e-12, 99.0]
    for route in ("eigenvalues", "routh-hurwitz"):
        for name, some in (("random", starts), ("worst", special)):
            found = [design.search_critical_friction(structure, start, route=route) for start in some]
            errors = [abs(search.mu - expected) for search in found]
            steps = [search.steps for search in found]
            print(
                f"{route:<15}{name:<8}{sum(e < 1e-10 for e in errors)} of {len(found)} within 1e-10; "
                f"worst {max(errors):.1e}; evaluations {min(steps)} to {max(steps)}"
            )
    never = fj.belt_oscillator(theta=0.0)
    print("theta = 0:", [str(design.search_critical_friction(never, 0.3, route=r).outcome) for r in ROUTES])


ROUTES = ("eigenvalues", "routh-hurwitz")


def charts():
    heading("Stability chart, a million points")
    structure = fj.belt_oscillator()
    mu, k1 = np.linspace(0, 0.5, 1000), np.linspace(80e3, 120e3, 1000)
    _, first = timed(lambda: cea.chart(structure, mu=mu, k1=k1))
    chart, warm = timed(lambda: cea.chart(structure, mu=mu, k1=k1), 5)
    rng = np.random.default_rng(0)
    errors = []
    for i, j in rng.integers(0, 1000, (2000, 2)):
        errors.append(abs(chart["growth_rate"].values[i, j] - reference.growth(mu[i], k1=k1[j])))
    disagreements = int(np.sum((chart["margin"].values > 0) != (chart["growth_rate"].values < 0)))
    print(
        f"structure (mu, k1): first {first:.2f} s, warm {warm:.2f} s; missing {int(chart.growth_rate.isnull().sum())}"
    )
    print(f"growth rate against NumPy at 2000 points: worst {max(errors):.1e} 1/s, median {np.median(errors):.1e} 1/s")
    print(f"Routh-Hurwitz and the sign of the growth rate disagree at {disagreements} of 1000000 points")
    scene = fj.Scene(structure, fj.ExponentialDecay(0.2, 0.1, 0.5), belt_speed=0.5)
    axes = {"belt_speed": np.linspace(0.1, 3, 1000), "decay": np.linspace(0, 2, 1000)}
    _, warm = timed(lambda: cea.chart(scene, **axes), 4)
    print(f"scene (belt_speed, decay): warm {warm:.2f} s")
    springs = np.linspace(80e3, 120e3, 10_000)
    with jax.enable_x64(True):
        batch = jax.jit(jax.vmap(lambda k: cea.critical_friction(fj.belt_oscillator(k1=k))))
        _, warm = timed(lambda: batch(springs).block_until_ready(), 4)
    print(f"10000 critical frictions in one batch: warm {warm:.2f} s")


def slopes():
    heading("Section 3.2: negative slope")
    scene = fj.Scene(fj.belt_oscillator(), fj.ExponentialDecay(0.2, 0.1, 0.5), belt_speed=0.5)
    values = cea.eigenvalues(scene)
    fastest = values[np.argmax(values.real)]
    print(f"slope of friction {cea.friction_slope(scene):.6f} s/m, critical {cea.critical_slope(scene):.6f} s/m")
    print(f"growth rate {fastest.real:.6f} 1/s, frequency {abs(fastest.imag) / (2 * np.pi):.6f} Hz")


def corners():
    heading("Corners")
    cases = {
        "undamped": {"c1": 0.0, "c2": 0.0},
        "damping ratio 2e-9": {"c1": 1e-6, "c2": 1e-6},
        "only c2": {"c1": 0.0},
        "only c1": {"c2": 0.0},
        "overdamped": {"c1": 1e3, "c2": 1e3},
        "theta = 0": {"theta": 0.0},
        "theta = -0.3": {"theta": -0.3},
        "theta = 1.2": {"theta": 1.2},
        "k2 = 1e9": {"k2": 1e9},
        "k1 = 0.1": {"k1": 0.1},
    }
    for name, parameters in cases.items():
        limit = cea.stability_limit(fj.belt_oscillator(**parameters))
        print(f"{name:<20}{limit.mu:<22.15g}{limit.outcome.value:<18}{limit.mechanism.value}")
    worst = {}
    for n in (2, 3, 6, 12):
        for seed in range(5):
            rng = np.random.default_rng(100 * n + seed)
            x, y, z = rng.normal(size=(3, n, n))
            matrices = {
                "mass": np.diag(rng.uniform(0.1, 2, n)) + 0.02 * x @ x.T,
                "damping": 0.05 * y @ y.T,
                "stiffness": 1e4 * z @ z.T + np.diag(rng.uniform(0, 1e4, n)),
            }
            limit = cea.stability_limit(fj.Structure(*matrices.values(), np.ones(n), 0, n - 1))
            top = min(1.05 * limit.mu, 20.0)
            expected = reference.general_critical_friction(top, 501, **matrices, tangential=0, normal=n - 1)
            error = 0.0 if np.isinf(expected) and limit.mu > top else abs(limit.mu / expected - 1)
            worst[n] = max(worst.get(n, 0.0), error)
    for n, error in worst.items():
        print(f"five random structures of {n} degrees of freedom: worst relative error of mu_crit {error:.1e}")


def designs():
    heading("Design")
    structure = fj.belt_oscillator()
    springs = {"bounds": {"k1": (90e3, 110e3)}, "tied": {"k2": lambda p: 201e3 - p["k1"]}}
    dampers = {"bounds": {"c1": (0.1, 1.9)}, "tied": {"c2": lambda p: 2.0 - p["c1"]}}
    for name, choice in (("stiffness split", springs), ("damping split", dampers)):
        result = design.raise_critical_friction(structure, **choice, target=0.4)
        print(f"{name}: {result}")


if __name__ == "__main__":
    critical_friction()
    sensitivities()
    searches()
    charts()
    slopes()
    corners()
    designs()
