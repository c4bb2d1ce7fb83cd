"""Limit cycles that ensembles meet on, and trajectories that come to them."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import fivjax as fj
from fivjax.maps import rounds
from fivjax.verdicts.ensemble import KEPT, REACHED, SEEN, Approach, Attractor, Ensemble, approached, met, no_approach

LOOKS, MEMBERS, DECAY = 60, 16, 1.0
GOLDEN = (np.sqrt(5) - 1) / 2


def ensemble(radii, turn=GOLDEN / 14, size=4.0, moving=None):
    """Members one look a second apart that wind around circles of these radii (looks × members), 4 off the origin."""
    phase = 2 * np.pi * (turn * np.arange(LOOKS)[:, None] * 17 + np.arange(MEMBERS) * GOLDEN)
    states = np.stack([size + radii * np.cos(phase), radii * np.sin(phase)], axis=-1)
    times = 0.05 * np.arange(LOOKS)[:, None] * np.ones(MEMBERS)
    events = 3 * np.arange(LOOKS)[:, None] * np.ones(MEMBERS, int)
    return Ensemble(states, np.abs(states[..., 0]), times, events, np.ones(MEMBERS, bool) if moving is None else moving)


def settling(rate, final=0.5):
    """Radii that start apart, some inside, some outside, and come together."""
    start = np.linspace(-0.4, 1.0, MEMBERS)
    return final + start * np.exp(-rate * np.arange(LOOKS))[:, None]


def test_members_from_inside_and_outside_meet_on_a_torus():
    states, amplitude = met(ensemble(settling(0.4)), DECAY)
    assert states.shape == (KEPT, 2)
    np.testing.assert_allclose(np.hypot(states[:, 0] - 4, states[:, 1]), 0.5, atol=1e-4)
    assert amplitude == pytest.approx(4.5, abs=0.01)


def test_members_on_circles_of_their_own_have_not_met():
    """Each returns to where it was itself; nobody else was there."""
    assert met(ensemble(np.linspace(0.2, 2.0, MEMBERS) * np.ones((LOOKS, 1))), DECAY) is None


def test_a_vibration_that_dies_together_is_no_limit_cycle():
    """One path for all, on which nothing sustains them: at the structure's own rate of decay, or at a third of it."""
    for rate in (1.0, 1 / 3):
        fading = np.exp(-rate * 0.05 * np.arange(LOOKS))[:, None] * np.ones(MEMBERS)
        whole = ensemble(0.5 * fading)
        faded = whole._replace(deviations=whole.deviations * fading[..., None])
        assert met(faded, DECAY) is None


def test_a_vibration_without_contact_events_is_no_limit_cycle():
    """Just above the stability limit all members grow on one mode, slowly, and meet on it; the first event is far off."""
    whole = ensemble(settling(0.4))
    assert met(whole._replace(events=np.full_like(whole.events, 7)), DECAY) is None


def test_too_few_members_or_too_short_a_time_prove_nothing():
    few = np.arange(MEMBERS) < 5
    assert met(ensemble(settling(0.4), moving=few), DECAY) is None
    assert met(ensemble(settling(0.4), moving=np.zeros(MEMBERS, bool)), DECAY) is None
    # A structure that hardly decays by itself has to be watched for longer.
    assert met(ensemble(settling(0.4)), 0.1 * DECAY) is None


def looks_until_reached(distances):
    """The look at which a trajectory has reached a cycle of one crossing state, seen at these relative distances from it."""
    with jax.enable_x64(True):
        attractor = Attractor(jnp.ones((KEPT, 3)) / np.sqrt(3), jnp.asarray(1.0))
        approach, away = no_approach(jnp.zeros(3)), jnp.asarray([1.0, -1.0, 0.0]) / np.sqrt(2)
        step = jax.jit(lambda approach, state: approached(approach, attractor, state))
        for look, distance in enumerate(distances):
            approach, reached = step(approach, attractor.crossings[0] + distance * away)
            if reached:
                return look
    return None


def test_a_trajectory_that_stays_close_has_reached_it():
    assert looks_until_reached([0.3, 0.1, 0.019, 0.015, 0.01, 0.005, 0.002]) == 5


def test_a_trajectory_that_passes_by_or_recedes_has_not():
    assert looks_until_reached([0.3, 0.019, 0.015, 0.018, 0.03] * 3) is None
    assert looks_until_reached(0.011 * 1.1 ** np.arange(6)) is None
    assert looks_until_reached([0.021] * 20) is None and REACHED < 0.021


def test_the_same_crossing_state_is_looked_at_once():
    """A slow method looks many times between two crossings."""
    assert looks_until_reached([0.01] * 20) is None


def test_nothing_known_is_never_reached():
    with jax.enable_x64(True):
        unknown = Attractor(jnp.zeros((KEPT, 2)), jnp.asarray(0.0))
        near = Approach(jnp.zeros((SEEN, 2)), jnp.asarray(9), jnp.asarray(0.0))
        assert not approached(near, unknown, jnp.full(2, 1e-9))[1]


def test_known_limit_cycles_change_no_verdict(paper_scene, monkeypatch):
    """A map with trajectories enough to be worth an ensemble, and its halves, whose trajectories see their own orbits return."""
    axes = {"mu": [0.1, 0.16, 0.22], "p": np.linspace(1.05, 3.9, 36)}
    assert len(axes["p"]) // 2 < rounds.WORTH_KNOWING <= len(axes["p"])
    monkeypatch.setattr(rounds, "ENSEMBLES", 2)  # the three are not followed at once
    whole = fj.bistability_map(paper_scene, progress=False, **axes)
    halves = [fj.bistability_map(paper_scene, progress=False, mu=axes["mu"], p=axes["p"][k::2]) for k in (0, 1)]
    verdict, amplitude, when = (
        whole[name].transpose("mu", "p").values for name in ("verdict", "amplitude", "decided_at")
    )
    for k, half in enumerate(halves):
        np.testing.assert_array_equal(half["verdict"].transpose("mu", "p"), verdict[:, k::2])
        np.testing.assert_allclose(half["amplitude"].transpose("mu", "p"), amplitude[:, k::2], rtol=0.01)
    assert np.all(verdict >= 0)
    alone = np.concatenate([half["decided_at"].values[half["verdict"].values == 1] for half in halves])
    assert 0.6 * np.mean(alone) > np.mean(when[verdict == 1])
