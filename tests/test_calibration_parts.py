"""The parts of a calibration, each against something that is known: harmonics, noise, residual tests, least squares, covariance."""

import jax
import numpy as np
import pytest
from recordings import paper

import fivjax as fj
from fivjax.calibration.covariance import combinations, covariance_of
from fivjax.calibration.cycle_misfit import BEATS, cycle_rate
from fivjax.calibration.goodness_of_fit import exceeds_noise, what_is_left
from fivjax.calibration.harmonics import beating, fitted_harmonics, referred
from fivjax.calibration.least_squares import Evaluated, minimise
from fivjax.calibration.noise import estimated_noise
from fivjax.calibration.parameters import FreeParameters
from fivjax.io.recordings import averaged


def test_lines_of_a_train_of_pulses_do_not_depend_on_where_they_are_looked_at():
    """Pulses have lines without end. What blocks fold down of them between the lines must not reach those that are fitted."""
    t = np.arange(25_000) / 25_000
    pulses = (np.mod(67.456 * t[:, None] + np.linspace(0.2, 0.2 + 67.456 / 25_000, 9), 1.0) < 0.05).mean(axis=1)
    data = fj.Recording(25e3, {"a0": pulses - pulses.mean()}, "limit cycle")
    with jax.enable_x64(True):
        blocks = averaged(data, cycle_rate(data, paper()))
        width = float(np.diff(blocks.edges[:2])[0])
        whole, part = (
            fitted_harmonics(blocks.means[begin:end], width, 8, 50.0, 90.0, np.ones(1)).values
            for begin, end in ((0, None), (301, 301 + int(30 / 67.456 / width)))
        )
    assert whole[0] == pytest.approx(67.456, rel=1e-5)
    # The whole recording, and thirty periods out of its middle. At 1 % noise a line is good to some 1e-3 of the largest;
    # at eight samples to a block, which would be as good a choice otherwise, this is 1.6e-3.
    np.testing.assert_allclose(part[1:], whole[1:], rtol=0, atol=1e-3 * whole[1])


def harmonic(rng, frequency, dt, count=600, channels=2):
    """Signals of eight harmonics, and their complex amplitudes at the middle instant."""
    lines = (rng.normal(size=(8, channels)) + 1j * rng.normal(size=(8, channels))) / np.arange(1, 9)[:, None]
    t = dt * (np.arange(count) - 0.5 * (count - 1))
    waves = np.exp(2j * np.pi * frequency * t[:, None] * np.arange(1, 9))
    return (waves @ lines).real, lines


def test_harmonics_err_as_they_are_said_to():
    """A covariance of frequency and lines that is too small, or without their correlation, is rejected: the parameters rest on it."""
    rng = np.random.default_rng(0)
    signals, lines = harmonic(rng, 67.456, 4.4e-4)
    sigma = np.array([0.05, 0.02])
    exact = fitted_harmonics(signals, 4.4e-4, 8, 50.0, 90.0, sigma)
    np.testing.assert_allclose(exact.values, referred(67.456, lines)[0], atol=1e-12)
    found = [
        fitted_harmonics(signals + sigma * rng.normal(size=signals.shape), 4.4e-4, 8, 50.0, 90.0, sigma).values
        for _ in range(400)
    ]
    whitened = np.linalg.solve(np.linalg.cholesky(exact.covariance), (found - exact.values).T)
    # Each of 32 means is good to 0.05, their squares to 0.07, and eigenvalues of the covariance lie in (1 ± √(32/400))².
    assert np.abs(whitened.mean(axis=1)).max() < 0.2
    eigenvalues = np.linalg.eigvalsh(np.cov(whitened))
    assert eigenvalues.min() > 0.45 and eigenvalues.max() < 1.75


def test_a_vibration_that_beats_is_told_from_one_that_repeats():
    """Two sidebands of half the depth each; the harmonics of what beats are not those of any one cycle."""
    rng = np.random.default_rng(1)
    signals, _ = harmonic(rng, 67.456, 1 / 25e3, 25_000)
    t = np.arange(25_000) / 25e3
    for depth in (0.0, 0.1):
        modulated = signals * (1 + depth * np.cos(2 * np.pi * 4.8 * t))[:, None]
        sigma = 0.05 * signals.std(axis=0)
        size = beating(modulated + sigma * rng.normal(size=signals.shape), 1 / 25e3, 67.456, sigma)
        assert size == pytest.approx(depth / np.sqrt(2), abs=0.005)
        assert (size > BEATS) is (depth > 0)


T = np.arange(20_000) / 25e3


@pytest.mark.parametrize(
    ("signal", "tolerance"),
    [
        (np.exp(2 * T) * np.sin(2 * np.pi * 67.9 * T), 0.03),
        # Twelve samples a period: differences take the vibration for noise, the spectrum does not.
        (50 * np.sin(2 * np.pi * 2083.0 * T), 0.03),
        # Impacts at irregular times: the spectrum has no gaps, but most samples are between them.
        (200.0 * (np.random.default_rng(0).random(len(T)) < 0.008), 0.08),
        (0 * T + 9.81, 0.03),
    ],
    ids=["growing", "sparse samples", "impacts", "constant"],
)
def test_noise_is_measured_where_no_signal_is(signal, tolerance):
    """White noise of 0.1, whatever the signal beside it is; the estimate knows no model."""
    noise = 0.1 * np.random.default_rng(1).normal(size=len(T))
    found = estimated_noise((signal + noise)[:, None])
    assert found[0] == pytest.approx(0.1, rel=tolerance)


def test_noise_is_no_smaller_than_the_last_digit():
    """A file with one digit after the point is off by up to 0.05, however smooth it looks."""
    written = np.round(np.sin(2 * np.pi * 3 * T), 1)[:, None]
    assert estimated_noise(written)[0] == pytest.approx(0.1 / np.sqrt(12), rel=1e-6)


def test_white_noise_is_taken_for_noise_and_an_alikeness_within_its_scatter_is_not():
    """0.16 over 1,111 blocks, as a wrong fixed spring leaves, is 5.4 times the scatter of that correlation."""
    rng = np.random.default_rng(0)
    for _ in range(300):
        left = rng.normal(size=(1111, 2))
        assert what_is_left(float(np.sum(left**2)), left.size, [left], stated=True).is_noise
    white = rng.normal(size=1112)
    # A moving average with this weight has a correlation of 0.17 and unit variance.
    weight = 0.18
    alike = ((white[1:] + weight * white[:-1]) / np.sqrt(1 + weight**2))[:, None]
    found = what_is_left(float(np.sum(alike**2)), alike.size, [alike], stated=False)
    assert 0.13 < found.correlation < 0.21
    assert found.correlated and not found.larger
    # A weak vibration shows in all lags together before it does in the first one.
    vibration = (white[1:] + 0.4 * np.sin(2 * np.pi * np.arange(1111) / 16))[:, None]
    assert what_is_left(1111.0, 1111, [vibration], stated=False).correlated


def test_left_overs_are_compared_with_a_stated_noise():
    """A third more than what was stated is no chance over 1,111 blocks, with a noise that was estimated it may be."""
    assert what_is_left(1.25 * 1111, 1111, [], stated=True).larger
    assert not what_is_left(1.25 * 1111, 1111, [], stated=False).larger
    assert what_is_left(0.5 * 1111, 1111, [], stated=False).smaller


def test_a_recording_that_holds_more_than_noise():
    """A sine of a tenth of the noise's size over 20,000 blocks is a signal; a constant offset of a sensor is none."""
    noise = np.random.default_rng(0).normal(size=(20_000, 1))
    assert not exceeds_noise(noise + 3.0, np.ones(1))
    assert exceeds_noise(noise + 0.3 * np.sin(2 * np.pi * 500 * T)[:, None], np.ones(1))


def rosenbrock(x, about):
    """Rosenbrock's valley in units of noise; nothing can be evaluated above 10."""
    a, b = x
    residual = np.array([100.0 * (b - a**2), 1.0 - a, 3.0]) if a < 10 else np.full(3, np.inf)
    return Evaluated(residual, np.array([[-200.0 * a, 100.0], [-1.0, 0.0], [0.0, 0.0]]), {"seen": a})


@pytest.mark.parametrize("start", [(-1.2, 1.0), (0.5, -2.0)])
def test_minimum_of_a_valley(start):
    """Reached to rounding, with what belongs to it."""
    found = minimise(rosenbrock, np.array(start), None, 1e-6, 200)
    np.testing.assert_allclose(found.x, 1.0, atol=1e-5)
    assert found.at.about["seen"] == pytest.approx(1.0, abs=1e-5)
    assert found.arrived and found.at.cost == pytest.approx(9.0)


def test_a_start_from_which_nothing_can_be_evaluated_does_not_arrive():
    found = minimise(rosenbrock, np.array([20.0, 1.0]), None, 1e-6, 100)
    assert not found.arrived and found.at.cost == np.inf


def test_every_point_is_evaluated_once():
    """Residual and Jacobian come from one evaluation, and each is told what belongs to the best point before it."""
    seen = []

    def evaluate(x, about):
        assert about is None or about["seen"] in [point[0] for point in seen]
        seen.append(tuple(x))
        return rosenbrock(x, about)

    found = minimise(evaluate, np.array([-1.2, 1.0]), None, 1e-6, 200)
    assert len(seen) == len(set(seen)) <= found.evaluations


def test_a_combination_that_is_not_told_does_not_keep_a_fit_from_ending():
    """Only the sum is told; the slope along the difference is far below the noise, but not zero."""

    def evaluate(x, about):
        jacobian = np.array([[50.0, 50.0], [1e-3, -1e-3]])
        return Evaluated(jacobian @ x - [50.0, 1.0], jacobian)

    found = minimise(evaluate, np.zeros(2), None, 1e-6, 100)
    assert found.arrived and found.evaluations < 40
    assert found.x.sum() == pytest.approx(1.0, abs=1e-6)


def test_covariance_of_a_linear_fit():
    """(JᵀJ)⁻¹, and infinite along a direction that the data do not see, with the other parameters untouched."""
    rng = np.random.default_rng(0)
    jacobian = rng.normal(size=(50, 3))
    deviations, correlation, _ = covariance_of(jacobian)
    expected = np.linalg.inv(jacobian.T @ jacobian)
    np.testing.assert_allclose(deviations, np.sqrt(np.diag(expected)), rtol=1e-12)
    np.testing.assert_allclose(correlation, expected / np.outer(deviations, deviations), rtol=1e-10)
    lost = np.stack([jacobian[:, 0], jacobian[:, 1], jacobian[:, 1]], axis=1)
    deviations, _, singular = covariance_of(lost)
    assert np.all(np.isinf(deviations[1:])) and singular[-1] < 1e-12
    two = np.linalg.inv(lost[:, :2].T @ lost[:, :2])
    assert deviations[0] == pytest.approx(np.sqrt(two[0, 0]), rel=1e-9)


def test_parameters_told_in_combination_are_grouped():
    """Chains of correlations make one group; the largest one is named with its sign."""
    correlation = np.eye(4)
    for i, j, value in ((0, 1, 0.95), (1, 3, -0.97), (0, 2, 0.5)):
        correlation[i, j] = correlation[j, i] = value
    assert combinations(("mu", "c1", "k1", "k2"), correlation) == [(("mu", "c1", "k2"), -0.97)]
    assert combinations(("mu", "c1"), np.eye(2)) == []


def test_bounded_parameters_stay_inside_and_come_back():
    free = FreeParameters(paper(), ["mu", "k1", "theta"], {"mu": (0.1, 0.4)})
    values = [0.15, 7e4, -0.02]
    with jax.enable_x64(True):
        np.testing.assert_allclose(free.values(free.unbounded(values)), values, rtol=1e-12)
        for u in (-1e3, 1e3):
            assert 0.1 <= float(free.values(np.array([u, 0.0, 0.0]))[0]) <= 0.4
