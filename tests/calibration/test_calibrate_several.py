"""Calibration of structures with several contacts; the response to a kick is in `test_calibrate.py`."""

import numpy as np
import pytest

import fivjax as fj
from fivjax.calibration.result import FitOutcome
from tests.helpers.recordings import clean, noisy, off, pair, recording, slid

QUIET = np.zeros((400, 1)) + 1e-3


def scores(fit, scene):
    return {n: abs(fit.values[n] - float(scene.parameters[n])) / fit.uncertainty[n] for n in fit.names}


@pytest.mark.slow
def test_a_small_motion_tells_both_frictions_and_the_spring_between():
    """All four sliding coordinates of a decay whose origin is not known."""
    scene = pair(4e3)
    accelerations = noisy(slid(scene, 0.12, 0.92, 5000.0), 0.02, 1)
    channels = {f"a{place}": accelerations[:, k] for k, place in enumerate((0, 1, 3, 4))}
    names = ["mu_0", "mu_1", "coupling"]
    fit = fj.calibrate(off(scene, names, 0), fj.Recording(5000.0, channels, "sliding"), names, starts=4, progress=False)
    assert fit.outcome is FitOutcome.CONVERGED and all(fit.identifiable.values())
    assert max(scores(fit, scene).values()) < 4


@pytest.mark.slow
def test_a_kick_through_the_events_of_both_contacts():
    """A hundred and thirty of them: the derivatives of the fit go through all."""
    scene = pair(300.0, 0.2, p=2.0)
    accelerations = noisy(clean(scene, 0.0372, 0.4372, rate=5000.0), 0.02, 3)
    channels = {"a0": accelerations[:, 0], "a1": accelerations[:, 1]}
    # The first sample is the mean over its step.
    data = fj.Recording(5000.0, channels, "kick", offset=0.0372 + 0.5 / 5000)
    start = scene.replace(mu_0=0.23, c1=0.85, k1=107e3)
    fit = fj.calibrate(start, data, ["mu_0", "c1", "k1"], starts=2, progress=False)
    assert fit.outcome is FitOutcome.CONVERGED and all(fit.identifiable.values())
    assert max(scores(fit, scene).values()) < 4


@pytest.mark.slow
@pytest.mark.parametrize(("coupling", "friction"), [(0.0, 0.3), (300.0, 0.35)], ids=["uncoupled", "coupled"])
def test_a_limit_cycle_beside_a_contact_without_events(coupling, friction):
    """The second contact slides on through the whole cycle: that its gap stays closed is no equation that could close it, and
    the system was singular."""
    scene = pair(coupling, 0.05, mu_0=friction, belt_speed=1.0)
    velocity = np.array([-0.9, 0.0, 0.0, 0.0, 0.0, 0.0])
    accelerations = clean(scene, 2.0, 3.0, (fj.sliding_equilibrium(scene), velocity))
    data = recording(noisy(accelerations, 0.02, 2), "limit cycle")
    names = ["mu_0", "k1"]
    fit = fj.calibrate(scene.replace(mu_0=1.05 * friction, k1=95e3), data, names, starts=3, progress=False)
    assert fit.outcome is FitOutcome.CONVERGED
    assert max(scores(fit, scene).values()) < 4


@pytest.mark.parametrize("place", [2, 5])
def test_no_contact_s_normal_coordinate_moves_while_sliding(place):
    """A channel there has no signal; the second contact's was not looked at."""
    data = fj.Recording(25e3, {f"a{place}": QUIET[:, 0]}, "sliding")
    with pytest.raises(ValueError, match=rf"acceleration {place}.*normal coordinate does not move"):
        fj.calibrate(pair(0.0), data, ["mu_0"])


def test_a_value_for_each_contact_is_no_single_number():
    """Speeds in an array can be neither free nor known: a fit changes numbers."""
    scene = pair(0.0, belt_speed=np.array([3.0, 2.0]))
    data = {"t": 25e3, "signals": {"a0": QUIET[:, 0]}}
    with pytest.raises(ValueError, match=r"`belt_speed` cannot be free.*one number for all contacts"):
        fj.calibrate(scene, fj.Recording(*data.values()), ["belt_speed"])
    with pytest.raises(ValueError, match="`belt_speed` cannot be stated by recording 0"):
        fj.calibrate(scene, fj.Recording(*data.values(), belt_speed=2.0), ["mu_0"])


def test_fractions_of_time_are_of_one_contact():
    """Of which of several contacts they would be is not said."""
    wave = np.sin(2 * np.pi * 67 * np.arange(25_000) / 25e3)
    data = fj.Recording(25e3, {"a0": wave}, "limit cycle", sticking=(0.2, 0.01))
    with pytest.raises(ValueError, match="with several contacts it is not known of which"):
        fj.calibrate(pair(0.0), data, ["mu_0"])
