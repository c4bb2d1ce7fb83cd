"""Synthetic recordings: what an accelerometer would give of a run of the paper's scene.

python tests/helpers/recordings.py notebooks/decay.csv    # writes the recording that README and notebook fit
"""

import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

import fivjax as fj

FREE = {
    3: ["mu", "c1", "k1"],
    5: ["mu", "c1", "c2", "k1", "k2"],
    7: ["mu", "c1", "c2", "k1", "k2", "m1", "theta"],
}
# Scene, where the recording begins and ends (s), and its regime.
CASES = {
    "linear phase": (dict(mu=0.25, p=1.05), 0.12, 0.92, "sliding"),
    "linear phase after a known kick": (dict(mu=0.25, p=1.05), 0.0371, 0.9371, "kick"),
    "decaying response": (dict(mu=0.2, p=1.2), 0.0371, 1.0371, "kick"),
    "limit cycle": (dict(mu=0.3, belt_speed=1.0), 2.0, 3.0, "limit cycle"),
}
RATE = 25_000.0


def paper(**changes) -> fj.Scene:
    return fj.Scene(fj.belt_oscillator(), fj.Coulomb(0.227), 3.0, fj.Pulse(100.0, 1.2)).replace(**changes)


def clean(scene: fj.Scene, begin: float, end: float, y0=None, rate: float = RATE) -> np.ndarray:
    """Accelerations of the two sliding coordinates: each sample a change of velocity, as a sensor with a filter gives it."""
    run = fj.simulate(scene, end, 1 / rate, y0=y0)
    first = round(begin * rate)
    return np.diff(run.velocity[first:, :2], axis=0) * rate


def points(scene: fj.Scene, begin: float, count: int, rate: float, y0=None) -> np.ndarray:
    """Accelerations of the two sliding coordinates at instants, as a converter without a filter takes them."""
    run = fj.simulate(scene, begin + (count - 1) / rate, 1 / rate, y0=y0)
    return run.acceleration[-count:, :2]


def _of_two(c1, k1, coupling):
    """The paper's oscillator and a softer one, whose second masses are coupled by a spring."""
    first, second = (one.matrices for one in (fj.belt_oscillator(c1=c1, k1=k1), fj.belt_oscillator(k1=6e4, k2=6.1e4)))
    zero, apart = jnp.zeros((3, 3)), jnp.array([0.0, 1, 0, 0, -1, 0])
    mass, damping, stiffness = (
        jnp.block([[one, zero], [zero, other]]) for one, other in zip(first[:3], second[:3], strict=True)
    )
    load = jnp.concatenate([first.load_direction, second.load_direction])
    return mass, damping, stiffness + coupling * jnp.outer(apart, apart), load


def pair(coupling: float, second_friction: float = 0.15, **changes) -> fj.Scene:
    """Two contacts: the paper's scene, and a softer oscillator beside it; uncoupled without `coupling` (N/m)."""
    contacts = [fj.ContactPoint(0, 2), fj.ContactPoint(3, 5)]
    structure = fj.Structure.from_parameters(_of_two, dict(c1=1.0, k1=100e3, coupling=coupling), contacts=contacts)
    laws = [fj.Coulomb(0.2), fj.Coulomb(second_friction)]
    return fj.Scene(structure, laws, 3.0, fj.Pulse(100.0, 1.2)).replace(**changes)


def slid(scene: fj.Scene, begin: float, end: float, rate: float = RATE) -> np.ndarray:
    """Accelerations of the sliding coordinates after a kick, as `clean` gives them, while all contacts slide: by eigenvalues
    of matrices that are put together here."""
    with jax.enable_x64(True):
        mass, damping, stiffness, load = map(np.array, scene.structure.matrices)
    contacts = scene.structure.contacts
    for matrix in (mass, damping, stiffness, load):
        for contact, law in zip(contacts, scene.friction.laws, strict=True):
            matrix[contact.tangential] -= float(law.mu) * matrix[contact.normal]
    free = np.setdiff1d(np.arange(len(load)), np.array([contact.normal for contact in contacts], int))
    mass, damping, stiffness = (matrix[np.ix_(free, free)] for matrix in (mass, damping, stiffness))
    m = len(free)
    lower = -np.linalg.solve(mass, np.hstack([stiffness, damping]))
    values, modes = np.linalg.eig(np.vstack([np.eye(m, 2 * m, m), lower]))
    kick = scene.load
    t = np.arange(round(begin * rate), round(end * rate) + 1)[:, None] / rate
    raised = (
        np.concatenate([np.linalg.solve(stiffness, load[free]), np.zeros(m)]) * float(kick.force) * (float(kick.p) - 1)
    )
    shares = np.linalg.solve(modes, raised)
    since = [np.exp(np.maximum(t - instant, 0) * values) for instant in (0.0, float(kick.duration))]
    # The response to the raised load begins at its jump, and that to its fall is the same with the other sign.
    states = (shares * (since[1] - since[0])) @ modes.T
    return np.diff(states[:, m:].real, axis=0) * rate


def noisy(accelerations: np.ndarray, share: float, seed: int) -> np.ndarray:
    """With white noise of `share` times each channel's own size."""
    noise = np.random.default_rng(seed).normal(size=accelerations.shape)
    return accelerations + share * accelerations.std(axis=0) * noise


def case(name: str) -> tuple[fj.Scene, np.ndarray, str]:
    changes, begin, end, regime = CASES[name]
    scene = paper(**changes)
    y0 = None
    if regime == "limit cycle":
        q = fj.sliding_equilibrium(scene)
        y0 = (q, [-0.9 * float(scene.belt_speed), 0.0, 0.0])
    return scene, clean(scene, begin, end, y0), regime


def recording(accelerations: np.ndarray, regime: str, sampling="averages", rate=RATE, **about) -> fj.Recording:
    signals = {"acceleration 0": accelerations[:, 0], "acceleration 1": accelerations[:, 1]}
    return fj.Recording(rate, signals, regime, sampling, **about)


def off(scene: fj.Scene, names, seed: int, share: float = 0.3) -> fj.Scene:
    """The scene with each of these parameters 30 % too high or too low."""
    signs = np.random.default_rng(1000 + seed).choice([-1.0, 1.0], len(names))
    return scene.replace(**{n: float(scene.parameters[n]) * (1 + share * s) for n, s in zip(names, signs, strict=True)})


def times(scene) -> dict[str, float]:
    """Fractions of time sticking and detached on the limit cycle, over whole periods: a second holds 67 and a half."""
    run = fj.simulate(scene, 3.0, 2e-5, y0=(fj.sliding_equilibrium(scene), [-0.9 * float(scene.belt_speed), 0.0, 0.0]))
    rises = np.flatnonzero((run.velocity[:-1, 0] < 0) & (run.velocity[1:, 0] >= 0) & (run.t[1:] > 2.0))
    whole = run.status[rises[0] : rises[-1]]
    return {"sticking": float(np.mean(whole == 0)), "detached": float(np.mean(whole == 2))}


def scores(fit, scene):
    """How many standard deviations each parameter is from the truth."""
    return {n: abs(fit.values[n] - float(scene.parameters[n])) / fit.uncertainty[n] for n in fit.names}


# What the sample recording shows, beside the paper's values: a response to a kick that dies out, 3 % noise.
SAMPLE = {"mu": 0.2, "c1": 1.3, "k1": 98e3}
SAMPLE_RATE = 2000.0


def sample() -> str:
    """The sample recording as a table: 0.8 s, from an instant on that its reader does not know."""
    accelerations = noisy(points(paper(**SAMPLE), 0.0371, round(0.8 * SAMPLE_RATE), SAMPLE_RATE), 0.03, 0)
    truth = ", ".join(f"{name} = {value:g}" for name, value in SAMPLE.items())
    head = [
        f"# Made by fivjax: the paper's scene with {truth}; a kick of 1.2; 3 % noise. No rig has measured this.",
        "t (s),acceleration 0 (m/s2),acceleration 1 (m/s2)",
    ]
    rows = [f"{k / SAMPLE_RATE:.4f},{a:.5g},{b:.5g}" for k, (a, b) in enumerate(accelerations)]
    return "\n".join([*head, *rows]) + "\n"


if __name__ == "__main__":
    Path(sys.argv[1]).write_text(sample(), encoding="utf-8")
