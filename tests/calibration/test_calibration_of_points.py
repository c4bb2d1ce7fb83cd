"""Calibration on samples at instants: of limit cycles at any rate, of kicks too slow to be told, and of a free decay."""

import numpy as np
import pytest

import fivjax as fj
from fivjax.calibration.result import FitOutcome
from tests.helpers.recordings import FREE, noisy, off, paper, points, recording, scores

STIFFNESS, DAMPING, FORCE, PULLED = 400.0, 0.4, 0.5, 0.1


def decay(t):
    """Displacement and velocity of a mass of 1 kg that is pulled and let go on a floor at rest: in closed form, half a period
    after the other (Liang and Feeny 1998)."""
    omega = np.sqrt(STIFFNESS)
    share = DAMPING / (2 * omega)
    damped = omega * np.sqrt(1 - share**2)
    half, left = np.pi / damped, np.exp(-share * omega * np.pi / damped)
    x, v, start, begin = np.zeros_like(t), np.zeros_like(t), PULLED, 0.0
    while abs(start) > FORCE / STIFFNESS:
        now = (t >= begin) & (t < begin + half)
        shift = np.sign(start) * FORCE / STIFFNESS
        fade, angle = np.exp(-share * omega * (t[now] - begin)), damped * (t[now] - begin)
        x[now] = shift + (start - shift) * fade * (np.cos(angle) + share * omega / damped * np.sin(angle))
        v[now] = -(start - shift) * fade * omega**2 / damped * np.sin(angle)
        start, begin = shift - left * (start - shift), begin + half
    x[t >= begin] = start
    return x, v


def on_a_floor():
    def matrices(k, c):
        return np.eye(2), np.diag([1.0, 0.0]) * c, np.diag([1.0, 0.0]) * k, np.array([0.0, -1.0])

    structure = fj.Structure.from_parameters(matrices, {"k": STIFFNESS, "c": DAMPING}, tangential=0, normal=1)
    return fj.Scene(structure, fj.Coulomb(FORCE / 10.0), belt_speed=0.0, load=fj.ConstantLoad(10.0))


@pytest.mark.slow
@pytest.mark.parametrize("known", [False, True], ids=["unknown start", "known start"])
def test_friction_and_damping_from_a_free_decay(known):
    """From a displacement and from a velocity, with noise; where the start is not known, it is fitted."""
    t = np.arange(600) / 250.0
    x, v = decay(t)
    noise = np.random.default_rng(0).normal(size=(2, len(t)))
    signals = {"displacement 0": x + 1e-4 * noise[0], "velocity 0": v + 2e-3 * noise[1]}
    data = fj.Recording(t, signals, y0=([PULLED, 0.0], [0.0, 0.0]) if known else None)
    fit = fj.calibrate(on_a_floor().replace(mu=0.08, c=0.6), data, ["mu", "c"], starts=1, progress=False)
    assert fit.outcome is FitOutcome.CONVERGED
    assert max(scores(fit, on_a_floor()).values()) < 4
    assert fit.uncertainty["mu"] < 2e-4
    assert fit.values["mu"] == pytest.approx(0.05, abs=1e-3)


def cycle(rate: int, first: float, seed: int):
    scene = paper(mu=0.3, belt_speed=1.0)
    y0 = (fj.sliding_equilibrium(scene), [-0.9, 0.0, 0.0])
    accelerations = points(scene, first, rate, float(rate), y0)
    return scene, noisy(accelerations, 0.02, seed)


@pytest.mark.slow
@pytest.mark.parametrize("rate", [500, 1000, 4000])
def test_a_limit_cycle_sampled_at_instants_is_fitted_at_any_rate(rate):
    """Averages were predicted where points were measured: friction was 10 to 16 of its standard deviations off at 1 kHz."""
    scene, samples = cycle(rate, 2.2, 1)
    data = recording(samples, "limit cycle", "points", float(rate))
    fit = fj.calibrate(off(scene, FREE[3], 1, 0.1), data, FREE[3], starts=2, progress=False)
    assert fit.outcome is FitOutcome.CONVERGED
    assert max(scores(fit, scene).values()) < 4


@pytest.mark.slow
def test_points_taken_for_averages_are_found_out():
    """The same samples, said to be averages over their millisecond."""
    scene, samples = cycle(1000, 2.2, 1)
    data = recording(samples, "limit cycle", "averages", 1000.0)
    fit = fj.calibrate(off(scene, FREE[3], 1, 0.1), data, FREE[3], starts=2, progress=False)
    assert fit.outcome is not FitOutcome.CONVERGED


def test_samples_on_the_same_instants_of_every_period_show_no_waveform():
    """Eight instants of each period tell eight numbers, whatever happens between them."""
    t = np.arange(1000) / 544.0
    wave = np.sin(2 * np.pi * 68.0 * t) + 0.3 * np.cos(2 * np.pi * 204.0 * t)
    noise = 0.01 * np.random.default_rng(0).normal(size=(1000, 2))
    data = recording(wave[:, None] + noise, "limit cycle", "points", 544.0)
    fit = fj.calibrate(paper(mu=0.3), data, FREE[3], progress=False)
    assert fit.outcome is FitOutcome.TOO_SLOW and not fit.converged
    assert np.isnan(fit.values["mu"]) and "higher rate" in str(fit)
