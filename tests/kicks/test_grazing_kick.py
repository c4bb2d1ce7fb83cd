"""A critical kick that just touches sticking, where static friction exceeds kinetic friction."""

import numpy as np
import pytest
from scipy.linalg import expm
from scipy.optimize import brentq

import fivjax as fj
from fivjax.kicks.critical_derivatives import differentiable
from fivjax.kicks.touching import grazing_kick
from tests.helpers import reference
from tests.helpers.several_contacts import copies, scene_of

SCENE = fj.Scene(
    fj.belt_oscillator(), fj.Coulomb(0.227, mu_static=0.5), belt_speed=1.0, load=fj.Pulse(force=100.0, p=1.2)
)
# Where the touch lies by `touching`, after which nothing is left to find but the last digits.
P_CRIT = 1.0962363003


def touching(**changes) -> float:
    """The kick whose linear sliding motion only just reaches the belt's speed, by matrix exponentials."""
    scene = SCENE.replace(**changes)
    linear = reference.linear(reference.of_scene(scene))
    k = len(linear.matrix) // 2
    free = [i for i in range(2 * k + 2) if i not in (scene.structure.normal, scene.structure.normal + k + 1)]
    # Linear in p - 1: the state at the end of a kick of one more load, by the shift of the equilibrium.
    shift = np.concatenate([linear.q_eq, np.zeros(k + 1)])[free]
    duration = float(scene.load.duration)
    begin = shift - expm(duration * linear.matrix) @ shift
    values, vectors = np.linalg.eig(linear.matrix)
    shares = vectors[k + 0] * np.linalg.solve(vectors, begin.astype(complex))
    speed = lambda t: float(np.real(np.sum(shares * np.exp(values * t))))  # noqa: E731
    times = np.linspace(0.0, 4.0, 400_001)
    most = times[np.argmax(np.real(np.exp(np.outer(times, values)) @ shares))]
    slope = lambda t: float(np.real(np.sum(values * shares * np.exp(values * t))))  # noqa: E731
    at = brentq(slope, most - 1e-4, most + 1e-4, xtol=1e-14)
    return 1 + float(scene.belt_speed) / speed(at)


@pytest.mark.slow
def test_a_kick_that_touches_as_it_ends():
    """Of a block on a spring the speed is largest at the end of a short kick, not smoothly: v = μ (p - 1) F e^(-δ T) sin(ω T) / ω."""
    delta, duration, mu, belt_speed = 0.05, 0.5, 0.4, 0.2
    structure = fj.Structure(
        np.eye(2), np.diag([2 * delta, 1.0]), np.diag([1.0, 9.0]), [0.0, -1.0], tangential=0, normal=1
    )
    scene = fj.Scene(structure, fj.Coulomb(mu, mu_static=0.8), belt_speed, fj.Pulse(1.0, 2.0, duration=duration))
    rate = np.sqrt(1.0 - delta**2)
    more = belt_speed * rate * np.exp(delta * duration) / (mu * np.sin(rate * duration))
    found = grazing_kick(scene, (1.0 + more - 2e-6, 1.0 + more + 3e-6), differentiable(scene))
    assert found is not None and found.p == pytest.approx(1.0 + more, abs=1e-14) and found.time == duration
    by_duration = more * (delta - rate / np.tan(rate * duration))
    expected = {"belt_speed": more / belt_speed, "mu": -more / mu, "force": -more, "duration": by_duration}
    for name, slope in found.d_p.items():
        assert slope == pytest.approx(expected.get(name, 0.0), rel=1e-12, abs=1e-14)


@pytest.mark.slow
def test_the_kick_that_touches_is_that_of_linear_sliding():
    """Newton's method on the touching condition, and its derivatives, against matrix exponentials and their differences."""
    names = differentiable(SCENE)
    # The next swing is as large within 6e-7: the first event of the upper kick is not at the swing that touches first.
    found = grazing_kick(SCENE, (P_CRIT - 2e-6, P_CRIT + 3e-6), names)
    assert found is not None and found.events == 0 and found.trajectories <= 6
    assert found.p == pytest.approx(touching(), abs=1e-11)
    for name in ("k1", "m2", "c2", "mu", "duration", "theta"):
        value = float(SCENE.parameters[name])
        # So little that the same swing is the largest.
        by = 1e-7 * value
        difference = (touching(**{name: value + by}) - touching(**{name: value - by})) / (2 * by)
        assert found.d_p[name] == pytest.approx(difference, rel=1e-5)
    assert found.d_p["belt_speed"] == pytest.approx(found.p - 1.0, abs=1e-11)
    assert found.d_p["mu_static"] == found.d_p["restitution"] == 0.0
    # Kicks on one side of it only do not part.
    assert grazing_kick(SCENE, (P_CRIT - 3e-6, P_CRIT - 2e-6), names) is None


@pytest.mark.slow
def test_the_kind_is_named_and_both_sides_are_proved():
    found = fj.critical_perturbation(SCENE, p_range=(1.0, 1.3), derivatives=True, progress=False).isel(belt_speed=0)
    assert str(found.kind.values) == "grazing" and not str(found.why_none.values)
    assert float(found.p_crit) == pytest.approx(P_CRIT, abs=1e-9)
    assert float(found.p_crit_high - found.p_crit_low) == pytest.approx(2e-9 * P_CRIT, rel=1e-6)


@pytest.mark.slow
@pytest.mark.skipif(not reference.available(), reason="no C++ compiler")
def test_a_touch_after_lift_offs_is_where_the_independent_solver_begins_to_stick():
    """The motion lifts off twice in its first swings, and comes to rest on the belt 0.44 s later or only just not."""
    scene = SCENE.replace(mu=0.2, mu_static=5.0, belt_speed=1.9)
    found = fj.critical_perturbation(scene, p_range=(1.0, 3.0), p_step=0.02, derivatives=True, progress=False)
    p_crit = float(found.p_crit[0])
    touch = grazing_kick(scene, (p_crit * (1 - 1e-6), p_crit * (1 + 1e-6)), ("mu",))
    assert str(found.kind.values[0]) == "grazing" and touch is not None and touch.events == 4
    assert touch.p == pytest.approx(p_crit, abs=1e-9)

    def boundary(**changes):
        guess = touch.p + sum(
            float(found.d_p_crit.sel(parameter=name)[0]) * (value - float(scene.parameters[name]))
            for name, value in changes.items()
        )
        low, high = guess - 1e-7, guess + 1e-7
        while high - low > 1e-13:
            p = 0.5 * (low + high)
            motion = reference.trajectory(reference.of_scene(scene.replace(p=p, **changes)), touch.time + 0.005)
            # Of its events only those are counted that begin to stick.
            sticks = any(after == fj.Status.STICK for _, _, after in motion.events)
            low, high = (low, p) if sticks else (p, high)
        return 0.5 * (low + high)

    assert boundary() == pytest.approx(p_crit, abs=1e-11)
    for name in ("k1", "m2", "c2", "mu", "theta"):
        value = float(scene.parameters[name])
        kicks = [boundary(**{name: (1 + by) * value}) for by in (-1e-6, 1e-6)]
        slope = float(found.d_p_crit.sel(parameter=name)[0])
        assert slope == pytest.approx((kicks[1] - kicks[0]) / (2e-6 * value), rel=1e-4)


@pytest.mark.slow
def test_of_several_contacts_the_one_that_touches_is_found():
    """Two oscillators without coupling, of which the second is loaded more: it touches first, as if it were alone."""
    names = ("duration", "mu_1", "mu_0")
    scene = scene_of(copies(2, shares=[0.9, 1.0]), mu=0.227, mu_static=0.5, belt=1.0, p=1.2)
    alone = grazing_kick(SCENE, (P_CRIT - 2e-6, P_CRIT + 3e-6), ("duration", "mu"))
    found = grazing_kick(scene, (P_CRIT - 2e-6, P_CRIT + 3e-6), names)
    assert alone is not None and found is not None
    assert found.p == pytest.approx(touching(), abs=1e-11)
    assert found.d_p["duration"] == pytest.approx(alone.d_p["duration"], rel=1e-8)
    assert found.d_p["mu_1"] == pytest.approx(alone.d_p["mu"], rel=1e-8) and abs(found.d_p["mu_0"]) < 1e-8
