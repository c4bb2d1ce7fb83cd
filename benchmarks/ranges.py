"""Trajectories drawn over the ranges that fivjax claims to handle, and what an independent solver says of one of them."""

import math

import numpy as np

import fivjax as fj
from tests.helpers import oracle

# From, to, and how values lie between: spread over decades, or evenly. Ratios are to mass 1 and spring 1 of the paper.
RANGES = {
    "belt_speed": (1e-6, 1e4, "decades"),
    "theta": (-1.2, 1.2, "even"),
    "mu": (0.0, 3.0, "even"),
    "mu_static": (1.0, 5.0, "even"),  # relative to mu; half of all trajectories have one coefficient only
    "p": (0.0, 1000.0, "kick"),
    "damping": (0.0, 1e2, "damping"),  # of each spring with its mass, relative to critical
    "mass_ratio": (1e-6, 1e6, "decades"),
    "stiffness_ratio": (1e-6, 1e6, "decades"),
    "force": (1e-6, 1e9, "decades"),
    "duration": (1e-9, 1e9, "decades"),
    "restitution": (0.0, 1.0, "even"),
}
# A share of all trajectories has one of these instead.
CORNERS = {
    "theta": (0.0, -1.2, 1.2),
    "mu": (0.0, 3.0, 0.227),
    "p": (0.0, 1.0, 1000.0),
    "damping": (0.0, 100.0),
    "restitution": (0.0, 1.0),
    "mass_ratio": (1e-6, 1e6, 0.085),
    "stiffness_ratio": (1e-6, 1e6, 1.01),
    "belt_speed": (1e-6, 1e4, 3.0),
    "force": (1e-6, 1e9, 100.0),
}
M1, K1 = 0.53, 1e5


def draw(count: int, seed: int, corners: float = 0.2) -> dict[str, np.ndarray]:
    """Parameters of a belt oscillator with friction that does not fall, by the names of a scene; one trajectory per element."""
    rng = np.random.default_rng(seed)
    found = {}
    for name, (low, high, kind) in RANGES.items():
        share = rng.random(count)
        if kind == "decades":
            values = low * (high / low) ** share
        elif kind == "even":
            values = low + (high - low) * share
        elif kind == "kick":
            values = np.where(rng.random(count) < 0.5, 1.0 + 2.0 * share, high * share)
        else:
            values = high * 10.0 ** (-8.0 * share)
        at_corner = rng.random(count) < corners
        if name in CORNERS:
            values = np.where(at_corner, rng.choice(CORNERS[name], count), values)
        found[name] = values
    found["mu_static"] = np.where(
        rng.random(count) < 0.5, found["mu"], np.minimum(found["mu"] * found["mu_static"], RANGES["mu"][1])
    )
    m2, k2 = M1 * found.pop("mass_ratio"), K1 * found.pop("stiffness_ratio")
    damping = found.pop("damping")
    found |= {"m1": np.full(count, M1), "m2": m2, "k1": np.full(count, K1), "k2": k2}
    found |= {"c1": 2 * damping * math.sqrt(M1 * K1), "c2": 2 * damping * np.sqrt(m2 * k2)}
    return found


def draw_falling(count: int, seed: int) -> dict[str, np.ndarray]:
    """The same with friction that falls with slip speed: not at all, at once, and in between."""
    found = draw(count, seed)
    rng = np.random.default_rng(seed + 1)
    decay = 10.0 ** rng.uniform(-6.0, 6.0, count)
    corner = rng.random(count) < 0.2
    return {
        **{name: values for name, values in found.items() if name != "mu"},
        "mu_dynamic": found["mu"],
        "decay": np.where(corner, rng.choice([0.0, 1e6], count), decay),
    }


def row(trajectories: dict[str, np.ndarray], index: int) -> dict[str, float]:
    return {name: float(values[index]) for name, values in trajectories.items()}


def scene(trajectory: dict[str, float]) -> fj.Scene:
    if "decay" in trajectory:
        return FALLING.replace(**trajectory)
    return CONSTANT.replace(**{"mu_static": trajectory["mu"], **trajectory})


CONSTANT = fj.Scene(fj.belt_oscillator(), fj.Coulomb(0.2, 0.2), 3.0, fj.Pulse(100.0, 1.2))
FALLING = fj.Scene(fj.belt_oscillator(), fj.ExponentialDecay(0.2, 0.2, 0.5), 3.0, fj.Pulse(100.0, 1.2))


def slow_period(trajectory: dict[str, float]) -> float:
    """The longest of the periods that its masses and springs could make, s."""
    return 2 * math.pi * math.sqrt((trajectory["m1"] + trajectory["m2"]) / min(trajectory["k1"], trajectory["k2"]))


def fastest_rate(trajectory: dict[str, float]) -> float:
    """Of the free structure, overdamped motion included, rad/s."""
    matrices = model(trajectory)
    inverse, n = np.linalg.inv(matrices.mass), len(matrices.mass)
    generator = np.block([[np.zeros((n, n)), np.eye(n)], [-inverse @ matrices.stiffness, -inverse @ matrices.damping]])
    return float(np.max(np.abs(np.linalg.eigvals(generator))))


def model(trajectory: dict[str, float]) -> oracle.Model:
    return oracle.paper_model(**trajectory)
