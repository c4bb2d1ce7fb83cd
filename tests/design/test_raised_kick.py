"""Raising the critical kick by design: the smallest change, against SciPy's optimiser and a closed form."""

import numpy as np
import pytest
from scipy.optimize import minimize

import fivjax as fj
from fivjax.design.critical_kick import smallest_change

SCENE = fj.Scene(fj.belt_oscillator(), fj.Coulomb(0.227), belt_speed=1.0, load=fj.Pulse(force=100.0, p=1.2))


def test_the_smallest_change_is_that_of_an_optimiser():
    """A step that is merely along the gradient, or clipped after it was scaled, is rejected where bounds hold."""
    draw = np.random.default_rng(0)
    for _ in range(20):
        gradient, low, high = draw.normal(size=4), -draw.uniform(0.1, 1, 4), draw.uniform(0.1, 1, 4)
        level = draw.uniform(-0.9, 0.9) * min(
            np.where(gradient > 0, high, low) @ gradient, -np.where(gradient > 0, low, high) @ gradient
        )
        found = smallest_change(gradient, level, low, high)
        reached = {"type": "eq", "fun": lambda r, g=gradient, b=level: g @ r - b, "jac": lambda r, g=gradient: g}
        expected = minimize(
            lambda r: 0.5 * r @ r,
            np.zeros(4),
            jac=lambda r: r,
            bounds=list(zip(low, high, strict=True)),
            constraints=reached,
            method="SLSQP",
            options={"ftol": 1e-15},
        )
        np.testing.assert_allclose(found, expected.x, atol=1e-9)
        assert gradient @ found == pytest.approx(level, abs=1e-12)


def test_what_cannot_be_reached_is_approached_as_far_as_the_bounds_go():
    found = smallest_change(np.array([2.0, -1.0, 0.0]), 100.0, -0.5 * np.ones(3), np.ones(3))
    np.testing.assert_array_equal(found, [1.0, -0.5, 0.0])


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        ({"free": ["k9"]}, "`free` must be one of"),
        ({}, "at least one parameter"),
        ({"free": ["restitution"]}, "zero, so a relative change"),
        ({"free": ["k1"], "bounds": {"k1": (1.0, 2.0)}}, "hold its own value"),
        ({"free": ["k1"], "bounds": {"k2": (9e4, 2e5)}}, "which is not free"),
        ({"free": ["k1"], "by": 0.0}, "must be positive"),
        ({"free": ["k1"], "bounds": {"k1": (-9e4, 2e5)}}, "`k1` must be non-negative"),
    ],
)
def test_what_makes_no_sense_is_refused(options, sentence):
    with pytest.raises(ValueError, match=sentence):
        fj.design.raise_critical_perturbation(SCENE, **options)


@pytest.mark.slow
def test_the_belt_speed_that_raises_the_kick_has_a_closed_form():
    """Where the saddle slides and sticks, p_crit - 1 is proportional to the belt speed."""
    raised = fj.design.raise_critical_perturbation(SCENE, 0.05, ["belt_speed"], p_range=(1.0, 1.3))
    assert raised.reached and raised.after_bracket[0] <= raised.after <= raised.after_bracket[1]
    expected = (1.05 * raised.before - 1) / (raised.before - 1)
    assert raised.changes["belt_speed"][1] == pytest.approx(expected, rel=1e-5)
    assert raised.after == pytest.approx(1.05 * raised.before, rel=2e-6)


@pytest.mark.slow
def test_a_kick_that_no_belt_speed_raises_further_is_said():
    """From 1.78 m/s on it is the contact's opening that decides, which knows no belt speed."""
    raised = fj.design.raise_critical_perturbation(SCENE, 0.2, ["belt_speed"], p_range=(1.0, 1.4))
    assert not raised.reached and "Widen `bounds`" in str(raised)
    assert raised.after == pytest.approx(1.190283, abs=1e-5)


@pytest.mark.slow
def test_a_step_to_what_no_scene_has_ends_the_search_and_loses_nothing():
    """Less static friction raises the kick, but static friction below the dynamic one is refused: that was the end of the call."""
    scene = fj.Scene(SCENE.structure, fj.ExponentialDecay(0.222, 0.221, 0.5), 1.0, SCENE.load)
    raised = fj.design.raise_critical_perturbation(scene, 0.2, ["mu_static"], p_range=(1.0, 2.0), steps=6)
    assert not raised.reached and "no scene has that (Argument `mu_static` must be at least" in raised.why


@pytest.mark.slow
def test_a_kink_of_the_critical_kick_is_no_end_of_the_search():
    """Two crossings take turns as the first one, so slopes jump: steps to the smallest change went to and fro until they were used
    up, a hundred-thousandth below the target.
    """
    scene = fj.Scene(fj.belt_oscillator(), fj.Coulomb(0.227), 1.0, fj.Pulse(100.0, 1.2))
    raised = fj.design.raise_critical_perturbation(scene, by=0.02, free=["c1", "c2"], p_range=(1.0, 1.3))
    assert raised.reached and raised.target <= raised.after <= raised.target * (1 + 2e-6)
