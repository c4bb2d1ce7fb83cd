"""The parts of a calibration, each against something that is known: folding, noise, residual tests, least squares, covariance."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import fivjax as fj
from fivjax.calibration.covariance import combinations, covariance_of
from fivjax.calibration.cycle_misfit import BEATS
from fivjax.calibration.folding import folded
from fivjax.calibration.goodness_of_fit import exceeds_noise, residual_tests
from fivjax.calibration.least_squares import Evaluated, minimise
from fivjax.calibration.noise import estimated_noise
from fivjax.calibration.parameters import FreeParameters
from fivjax.calibration.problem import Problem
from fivjax.calibration.search import FitSearch
from tests.helpers.recordings import paper

FREQUENCY = 67.456


def saw(turns):
    """A waveform with two jumps, as an acceleration has where a contact changes its mode."""
    turns = np.mod(turns, 1.0)
    return np.where(turns < 0.3, 2 * turns, np.where(turns < 0.55, -1.0, np.sin(2 * np.pi * turns)))


@pytest.mark.parametrize("rate", [500.0, 1000.0, 20_000.0])
def test_a_second_of_samples_shows_one_period_whatever_the_rate(rate):
    """Seven samples to a period fold into five hundred phases of it. In a spectrum, lines far above the rate would look like others."""
    sigma, rng = 0.02, np.random.default_rng(0)
    t = np.arange(int(rate)) / rate
    samples = saw(FREQUENCY * t)[:, None] + sigma * rng.normal(size=(len(t), 2))
    found = folded(samples, rate, 40.0, 110.0)
    # A tenth of the time by which a period is longer shows after a second.
    assert found.frequency == pytest.approx(FREQUENCY, abs=0.012)
    assert found.noise == pytest.approx(sigma, rel=0.3)
    assert found.sidebands < BEATS
    # Where it is at the middle of the recording, the waveform began an unknown number of turns ago.
    middle = FREQUENCY * 0.5 * (len(t) - 1) / rate
    away = np.abs(np.mod(found.phases[:, None] + middle - [0.0, 0.3, 0.55] + 0.5, 1.0) - 0.5).min(axis=1)
    clear = away > 4 * found.apart + abs(found.frequency - FREQUENCY)
    left = (found.means - saw(found.phases + middle)[:, None]) * np.sqrt(found.counts)[:, None] / sigma
    assert np.mean(clear) > 0.8
    assert np.sqrt(np.mean(left[clear] ** 2)) < 1.5


def test_channels_that_are_still_change_no_frequency():
    """Noise of the size of a vibration, and by itself: beside one that repeats it was taken for a beat."""
    rng, rate = np.random.default_rng(3), 2000.0
    t = np.arange(2000) / rate
    moving = saw(FREQUENCY * t)[:, None] + 0.02 * rng.normal(size=(len(t), 1))
    alone = folded(moving, rate, 40.0, 110.0)
    beside = folded(np.concatenate([moving, rng.normal(size=(len(t), 3))], axis=1), rate, 40.0, 110.0)
    assert beside.frequency == pytest.approx(alone.frequency, abs=1e-3)
    assert alone.sidebands < BEATS and beside.sidebands < BEATS


def test_a_vibration_that_beats_is_told_from_one_that_repeats():
    """Two sidebands of half the depth each; what beats is not any one cycle. At a low rate, too."""
    rng = np.random.default_rng(1)
    for rate in (25_000.0, 1000.0):
        t = np.arange(int(rate)) / rate
        for depth in (0.0, 0.1):
            signal = (saw(FREQUENCY * t) - np.mean(saw(FREQUENCY * t))) * (1 + depth * np.cos(2 * np.pi * 4.8 * t))
            size = folded(signal[:, None] + 0.02 * rng.normal(size=(len(t), 2)), rate, 40.0, 110.0).sidebands
            assert size == pytest.approx(depth / np.sqrt(2), abs=0.02)
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
        assert residual_tests(float(np.sum(left**2)), left.size, [left.T], stated=True).is_noise
    white = rng.normal(size=1112)
    # A moving average with this weight has a correlation of 0.17 and unit variance.
    weight = 0.18
    alike = ((white[1:] + weight * white[:-1]) / np.sqrt(1 + weight**2))[:, None]
    found = residual_tests(float(np.sum(alike**2)), alike.size, [alike.T], stated=False)
    assert 0.13 < found.correlation < 0.21
    assert found.correlated and not found.larger
    # A weak vibration shows in all lags together before it does in the first one.
    vibration = (white[1:] + 0.4 * np.sin(2 * np.pi * np.arange(1111) / 16))[:, None]
    assert residual_tests(1111.0, 1111, [vibration.T], stated=False).correlated


def test_left_overs_are_compared_with_a_stated_noise():
    """A third more than what was stated is no chance over 1,111 blocks, with a noise that was estimated it may be."""
    assert residual_tests(1.25 * 1111, 1111, [], stated=True).larger
    assert not residual_tests(1.25 * 1111, 1111, [], stated=False).larger
    assert residual_tests(0.5 * 1111, 1111, [], stated=False).smaller


def test_what_is_left_far_below_a_stated_noise_is_no_error_of_the_model():
    """One channel of two, stated a hundred times too noisy: its rounding is alike from block to block."""
    rng = np.random.default_rng(1)
    white, smooth = rng.normal(size=500), 0.01 * np.sin(0.1 * np.arange(500))
    found = residual_tests(float(np.sum(white**2)), 1000, [[white, smooth]], stated=True)
    assert not found.correlated
    assert residual_tests(500.0, 1000, [[white, 100 * smooth]], stated=True).correlated


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


def test_where_there_is_no_scene_nothing_is_evaluated():
    """The valley's minimum lies beyond; the fit stays on this side, goes as far as 0.6, and does not claim to have arrived."""
    seen = []

    def evaluate(x, about):
        seen.append(x[0])
        at = rosenbrock(x, about)
        steeper = np.array([1.0, 10.0, 1.0])  # the place along the valley is told, too
        return Evaluated(steeper * at.residual, steeper[:, None] * at.jacobian)

    found = minimise(evaluate, np.array([-1.2, 1.0]), None, 1e-6, 200, lambda x: x[0] < 0.7)
    assert 0.6 < found.x[0] < 0.7 and max(seen) < 0.7
    assert not found.arrived


def test_guesses_that_a_law_refuses_are_drawn_towards_the_scene():
    """A kinetic coefficient above the static one is halved towards the scene's own, together with the other."""
    scene = dataclasses.replace(paper(), friction=fj.ExponentialDecay(0.3, 0.2, 0.5))
    problem = Problem(scene, FreeParameters(scene, ["mu_static", "mu_dynamic"]), ())
    values = [(0.3, 0.2), (0.2, 0.25), (0.4, 0.1)]
    guesses = np.array([problem.parameters.unbounded(pair) for pair in values])
    found = [np.asarray(problem.parameters.values(guess)) for guess in FitSearch(problem, guesses, ()).guesses]
    np.testing.assert_allclose(found[1], [np.sqrt(0.3 * 0.2), np.sqrt(0.2 * 0.25)])
    np.testing.assert_allclose([found[0], found[2]], [values[0], values[2]])


def test_few_samples_do_not_tell_a_beat():
    """Of 75 samples, neighbours in phase lie so far apart that a waveform bends between them: a steady one was said to beat."""
    t = np.arange(75) / 600.0
    steady = saw(FREQUENCY * t)[:, None] + 0.02 * np.random.default_rng(0).normal(size=(len(t), 2))
    assert folded(steady, 600.0, 40.0, 110.0).sidebands == 0.0


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


def test_bounds_are_those_given_where_the_scene_takes_them():
    """A coupling may be negative; a coefficient of friction may not, whatever the bounds."""

    def matrices(k, coupling):
        stiffness = jnp.array([[1.0, coupling, 0.0], [coupling, k, 0.0], [0.0, 0.0, 1.0]])
        return jnp.eye(3), 0.1 * jnp.eye(3), stiffness, jnp.array([0.0, 0.0, -1.0])

    structure = fj.Structure.from_parameters(matrices, {"k": 2.0, "coupling": 0.1}, tangential=0, normal=2)
    scene = fj.Scene(structure, fj.Coulomb(0.2), 1.0, fj.ConstantLoad(1.0))
    wide = dict.fromkeys(("coupling", "mu"), (-0.5, 0.5))
    free = FreeParameters(scene, ["coupling", "mu", "k"], wide)
    np.testing.assert_array_equal(free.lower, [-0.5, 0.0, 0.0])
    negative = scene.replace(coupling=-0.1)
    assert float(FreeParameters(negative, ["coupling"]).lower[0]) == -np.inf
    assert float(FreeParameters(negative, ["coupling"], {"coupling": (-0.5, 0.5)}).lower[0]) == -0.5


@pytest.mark.parametrize("bounds", [(0.0, 1e9), (99_990.0, np.inf), (-1e9, 1e5 + 1e-2)])
def test_a_guess_far_from_one_of_its_bounds_or_near_one_is_not_moved(bounds):
    """Of bounds from 0 to 1e9, a guess of 1e5 was moved to 1e6, from which no limit cycle was found."""
    free = FreeParameters(paper(), ["k1"], {"k1": bounds})
    np.testing.assert_allclose(free.values(free.unbounded([1e5])), 1e5, rtol=1e-7)


def test_bounded_parameters_stay_inside_and_come_back():
    free = FreeParameters(paper(), ["mu", "k1", "theta"], {"mu": (0.1, 0.4)})
    values = [0.15, 7e4, -0.02]
    with jax.enable_x64(True):
        np.testing.assert_allclose(free.values(free.unbounded(values)), values, rtol=1e-12)
        for u in (-1e3, 1e3):
            assert 0.1 <= float(free.values(np.array([u, 0.0, 0.0]))[0]) <= 0.4
