"""Does a calibration say whether its model fits: right ones, ones a little wrong, signals that no model has, and noise."""

import numpy as np
import pytest

import fivjax as fj
from fivjax.calibration.result import FitOutcome
from tests.helpers.recordings import case, noisy, off, recording, scores

LINEAR = ["mu", "c1", "k1"]


@pytest.fixture(scope="module")
def growing():
    """The start of squeal, sliding throughout; and a function that fits any samples of this length, compiled once."""
    scene, accelerations, regime = case("linear phase")

    def fitted(samples, guess=scene, **about):
        return fj.calibrate(guess, recording(samples, regime, **about), LINEAR, starts=2, progress=False)

    return scene, accelerations, fitted


def test_a_model_that_fits_has_a_misfit_of_one_and_says_what_is_told_together(growing):
    """Noise of 10 % that the fit does not know; friction, damper and spring are told, but hardly apart."""
    scene, accelerations, fitted = growing
    fit = fitted(noisy(accelerations, 0.1, 3), off(scene, LINEAR, 0, 0.1))
    assert fit.outcome is FitOutcome.CONVERGED
    assert fit.misfit == pytest.approx(1, abs=0.15)
    assert max(scores(fit, scene).values()) < 4
    assert fit.combinations[0][0] == ("mu", "c1", "k1")
    assert "mu, c1, k1: known, but their errors go together (correlation -" in str(fit)


@pytest.mark.parametrize("wrong", [{"k2": 1.001}, {"theta": 0.98}], ids=["spring", "angle"])
def test_a_small_error_of_what_is_taken_as_known_is_found_out(growing, wrong):
    """A fixed spring 0.1 % or an angle 2 % off moves friction by several standard deviations: none may be given."""
    scene, accelerations, fitted = growing
    ((name, factor),) = wrong.items()
    fit = fitted(noisy(accelerations, 0.1, 3), scene.replace(**{name: factor * float(scene.parameters[name])}))
    assert fit.outcome is FitOutcome.STRUCTURE_LEFT
    # The correlation of neighbours is far below what looks like structure, but not below its own scatter.
    assert abs(fit.left.correlation) < 0.25
    assert all(np.isnan(value) for value in fit.uncertainty.values())
    assert np.isfinite(fit.values["mu"])
    assert "not known" in str(fit) and "alike from block to block" in str(fit)


@pytest.mark.parametrize("frequency", [31.3, 200.0])
def test_a_vibration_that_the_model_cannot_have_is_no_noise(growing, frequency):
    """A sine without any noise: the model does not fit, and its misfit says by how much."""
    _, accelerations, fitted = growing
    t = np.arange(len(accelerations)) / 25e3
    fit = fitted(np.stack([np.sin(2 * np.pi * frequency * t)] * 2, axis=1))
    assert fit.outcome is FitOutcome.DOES_NOT_FIT and not fit.converged
    assert fit.misfit > 1e6
    assert all(np.isnan(value) for value in fit.values.values())
    assert "does not fit" in str(fit)


def test_friction_from_a_quiet_run_is_not_identifiable(growing):
    """Noise alone has peaks to be fitted; taken for a vibration, they would give a friction with small errors."""
    _, accelerations, fitted = growing
    fit = fitted(np.random.default_rng(3).normal(size=accelerations.shape))
    assert fit.outcome is FitOutcome.NO_SIGNAL
    assert not any(fit.identifiable.values())
    assert np.isnan(fit.values["mu"])
    assert "not identifiable" in str(fit)


def test_a_stated_noise_that_is_too_small_is_found_out(growing):
    """What is left is compared with the noise that the user states, for all channels alike or for each."""
    scene, accelerations, fitted = growing
    sigma = 0.05 * accelerations.std(axis=0)
    samples = accelerations + sigma * np.random.default_rng(0).normal(size=accelerations.shape)
    right = fitted(samples, scene, noise={"a0": sigma[0], "a1": sigma[1]})
    assert right.outcome is FitOutcome.CONVERGED
    small = fitted(samples, scene, noise=0.5 * sigma.min())
    assert small.outcome is FitOutcome.STRUCTURE_LEFT and small.misfit > 3
