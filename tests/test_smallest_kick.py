"""The smallest kick: below the certified bound nothing happens, and what was found squeals."""

import numpy as np
import pytest

import fivjax as fj
from fivjax.maps.smallest import certified_excess

SCENE = fj.Scene(fj.belt_oscillator(), fj.Coulomb(0.227), belt_speed=1.0, load=fj.Pulse(force=100.0, p=1.2))


def test_below_the_certified_bound_no_kick_has_an_event_and_a_fifth_above_one_has():
    """A bound that is too high is rejected by the durations that hurt most, one that is far too low by the touch above it."""
    excess = certified_excess(SCENE, 0.0, 0.2)
    durations = 0.0147 * np.array([0.5, 2.5, 4.5, 8.5])
    kicks = fj.bistability_map(SCENE, p=1 + excess * np.array([0.999, 1.2]), duration=durations)
    events = kicks["contact_events"].values
    assert not events[0].any() and events[1].any()
    assert np.all(kicks["verdict"].values[0] == fj.Verdict.SLIDING)


def test_the_bound_grows_with_the_belt_speed_while_it_is_slip_that_ends():
    assert certified_excess(SCENE.replace(belt_speed=0.5), 0.1, 0.1) == pytest.approx(
        0.5 * certified_excess(SCENE, 0.1, 0.1), rel=1e-12
    )


def test_what_has_no_bound_is_refused():
    falling = fj.Scene(fj.belt_oscillator(), fj.ExponentialDecay(0.2, 0.1), load=fj.Pulse())
    with pytest.raises(ValueError, match="constant friction"):
        fj.smallest_kick(falling)
    with pytest.raises(ValueError, match="must hold"):
        fj.smallest_kick(SCENE, over=("duration",))
    with pytest.raises(ValueError, match="slide steadily and stably"):
        fj.smallest_kick(SCENE.replace(mu=0.25))


@pytest.mark.slow
def test_the_paper_s_smallest_kick_is_certified_to_more_than_half():
    kick = fj.smallest_kick(SCENE, bounds={"p": (1.0, 1.3)})
    assert 0.5 <= kick.ratio < 1 and kick.certified < kick.proved_low < kick.p < kick.proved_high
    assert kick.p < 1.0647 and kick.duration == pytest.approx(4.5 * 0.0147237, rel=1e-2)
    assert "slides for ever" in str(kick)
