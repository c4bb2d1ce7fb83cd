"""How samples follow from a motion: at points, by averages, through a low-pass; each against a finely stepped run."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.signal

import fivjax as fj
from fivjax.calibration.responses import response_of
from fivjax.calibration.samples import sampled
from fivjax.io.low_pass import LowPass
from fivjax.io.recordings import averaged, channel
from tests.helpers.recordings import paper

RATE, BEGIN, COUNT, FINER = 2000.0, 0.0371, 320, 20
NAMES = ("displacement 1", "velocity 0", "acceleration 1")
CHANNELS = tuple(map(channel, NAMES))


def run(scene):
    """The channels at the fine instants; a sample lies on every twentieth."""
    dt = 1 / (RATE * FINER)
    first = round(BEGIN / dt)
    found = fj.simulate(scene, BEGIN + (COUNT + 1) / RATE, dt)
    parts = {"displacement": found.displacement, "velocity": found.velocity, "acceleration": found.acceleration}
    signals = np.stack([parts[one.quantity][:, one.coordinate] for one in CHANNELS], axis=1)
    return signals[first - FINER :]


def predicted(scene, sampling, rate, **about):
    data = fj.Recording(RATE, dict.fromkeys(NAMES, np.zeros(COUNT)), "kick", sampling, **about)
    with jax.enable_x64(True):
        blocks = averaged(data, rate)
        way = sampled(data, blocks)

        @jax.jit
        def response(scene):
            begin = jnp.asarray(BEGIN + blocks.edges[0])
            found = response_of(scene, fj.EventExact(), None, way, begin, CHANNELS)
            return way.of_blocks(found.means), found

        means, found = response(scene)
    return np.asarray(means), found, blocks.per_block


def of_blocks(samples, per_block):
    return samples[: len(samples) // per_block * per_block].reshape(-1, per_block, samples.shape[1]).mean(axis=1)


@pytest.mark.parametrize("p", [1.2, 3.0])
@pytest.mark.parametrize("rate", [2000.0, 500.0])
def test_points_and_averages_are_those_of_a_run(p, rate):
    """A decaying response and one with two dozen landings: every block without an event or a jump of the load."""
    scene = paper(mu=0.2, p=p)
    fine = run(scene)
    size = fine.std(axis=0)
    means, found, per_block = predicted(scene, "points", rate)
    quiet = ~np.asarray(found.contacts | found.loads)
    assert quiet.mean() > (0.9 if p < 2 else 0.3)
    assert np.any(found.landings) == (p > 2)
    wanted = of_blocks(fine[FINER::FINER][:COUNT], per_block)
    assert np.abs((means - wanted) / size)[quiet].max() < 1e-6
    means, found, _ = predicted(scene, "averages", rate)
    weight = np.ones(FINER + 1)
    weight[1:-1:2], weight[2:-1:2] = 4.0, 2.0
    windows = np.lib.stride_tricks.sliding_window_view(fine, FINER + 1, axis=0)[FINER // 2 :: FINER][:COUNT]
    wanted = of_blocks(windows @ (weight / weight.sum()), per_block)
    # By Simpson's rule. After a landing a fast vibration has only a dozen of its steps to a period.
    assert np.abs((means - wanted) / size)[quiet].max() < (1e-5 if p < 2 else 2e-4)


@pytest.mark.slow
def test_an_average_holds_the_impulse_of_a_landing():
    """The change of velocity over each step is exact, whatever happens in it."""
    scene = paper(mu=0.2, p=3.0)
    means, found, _ = predicted(scene, "averages", RATE)
    assert np.any(found.landings)
    edges = BEGIN + (np.arange(COUNT + 1) - 0.5) / RATE
    dt = 5e-5
    fine = fj.simulate(scene, edges[-1] + dt, dt)
    at = np.rint(edges / dt).astype(int)
    np.testing.assert_allclose(edges, fine.t[at], atol=1e-12)
    wanted = np.diff(fine.velocity[at, 1]) * RATE
    np.testing.assert_allclose(means[:, 2], wanted, atol=1e-6 * np.abs(wanted).max())


def butterworth(order):
    """SciPy's coefficients of an analogue filter of 400 Hz."""
    above, below = scipy.signal.butter(order, 2 * np.pi * 400.0, analog=True)
    return above, below


def test_a_low_pass_is_butterworths():
    """Against SciPy's analogue filter; half of the power passes at the cut-off."""
    frequencies = np.linspace(0, 3000, 301)
    for order in (1, 2, 5):
        above, below = butterworth(order)
        _, wanted = scipy.signal.freqs(above, below, 2 * np.pi * frequencies)
        np.testing.assert_allclose(LowPass(400.0, order)(frequencies), wanted, atol=1e-10)


@pytest.mark.slow
@pytest.mark.parametrize("given", [(400.0, 4), lambda frequency: LowPass(400.0, 4)(frequency)])
def test_samples_through_a_low_pass_are_those_of_the_filtered_motion(given):
    """A kick's response, filtered in time by SciPy from a finely stepped run, with events and impulses."""
    scene = paper(mu=0.2, p=3.0)
    means, *_ = predicted(scene, "points", RATE, filter=given)
    dt = 1e-5
    fine = fj.simulate(scene, BEGIN + (COUNT + 1) / RATE, dt)
    # Accelerations are changes of velocity, in which impulses are whole; each is the mean over its step.
    motion = np.diff(fine.velocity[:, 1]) / dt
    middles = 0.5 * (fine.t[1:] + fine.t[:-1])
    _, filtered, _ = scipy.signal.lsim(scipy.signal.TransferFunction(*butterworth(4)), motion, middles - middles[0])
    instants = BEGIN + np.arange(COUNT) / RATE
    wanted = np.interp(instants, middles, filtered)
    assert np.abs(means[:, 2] - wanted).max() < 3e-3 * np.abs(wanted).max()


T = np.arange(40) / 1000.0


@pytest.mark.parametrize(
    ("about", "fragments"),
    [
        (dict(sampling="instants"), ["`sampling`", "'instants'", '"averages"']),
        (dict(filter=400.0), ["`filter`", "cut-off", "400.0"]),
        (dict(filter=(400.0, 1.5)), ["`filter[1]`"]),
        (dict(filter=(-400.0, 2)), ["`filter[0]`", "positive"]),
        (dict(filter=lambda frequency: np.nan * frequency), ["`filter`", "finite factor"]),
        (dict(y0=([0.0] * 3, [0.0] * 3), offset=-0.1), ["`offset`", "`y0`"]),
        (dict(regime="sliding", y0=([0.0] * 3, [0.0] * 3)), ["`y0`", '"kick"']),
    ],
)
def test_what_a_recording_says_of_its_samples_is_checked(about, fragments):
    with pytest.raises((ValueError, TypeError)) as refusal:
        fj.Recording(T, {"d0": T}, **about)
    for fragment in fragments:
        assert fragment in str(refusal.value)


def test_a_displacement_is_a_channel():
    data = fj.Recording(T, {"d0": T, "displacement 1": T, "disp_2": T})
    assert [str(one) for one in data.channels] == ["displacement 0", "displacement 1", "displacement 2"]
