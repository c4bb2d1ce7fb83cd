"""Critical kicks by Newton's method, and their derivatives, against scaling laws and an independent solver."""

import json
import signal

import numpy as np
import pytest

import fivjax as fj
from fivjax.kicks.stable_manifold import critical_kick
from fivjax.maps import engine
from fivjax.maps.basin_map import verdicts_from
from tests.helpers import reference
from tests.helpers.several_contacts import coupled, scene_of

SCENE = fj.Scene(fj.belt_oscillator(), fj.Coulomb(0.227), belt_speed=1.0, load=fj.Pulse(force=100.0, p=1.2))


@pytest.fixture(scope="module")
def critical():
    """Two belt speeds with saddles of two kinds: one that sticks, one that takes off."""
    return fj.critical_perturbation(
        SCENE,
        belt_speed=[1.0, 5.0],
        p_range=(1.10, 1.20),
        p_step=0.01,
        tolerance=1e-4,
        derivatives=True,
        progress=False,
    )


@pytest.mark.slow
def test_both_ends_are_proved_next_to_a_kick_that_is_exact(critical):
    assert list(critical.kind.values) == ["manifold", "manifold"] and not any(critical.why_none.values)
    assert np.all(critical.p_crit_low < critical.p_crit) and np.all(critical.p_crit < critical.p_crit_high)
    np.testing.assert_allclose(critical.p_crit_high - critical.p_crit_low, 2e-9 * critical.p_crit, rtol=1e-6)
    assert np.all(critical.newton_trajectories <= 8)


@pytest.mark.slow
def test_derivatives_in_the_belt_speed_have_closed_forms(critical):
    """Where the saddle only slides and sticks, kicks scale with the belt speed; where it never reaches that, nothing does."""
    by_speed = critical.d_p_crit.sel(parameter="belt_speed").values
    assert by_speed[0] == pytest.approx(float(critical.p_crit[0]) - 1.0, abs=1e-10)
    assert by_speed[0] == pytest.approx(0.1072058084, abs=1e-8)
    assert by_speed[1] == pytest.approx(0.0, abs=1e-8)


@pytest.mark.slow
def test_derivatives_obey_the_scaling_of_time_and_force(critical):
    for row, speed in enumerate((1.0, 5.0)):
        slope = critical.d_p_crit.isel(belt_speed=row)
        # Displacements are forces over stiffness: N, and everything with it, scales.
        assert 100.0 * float(slope.sel(parameter="force")) == pytest.approx(
            -speed * float(slope.sel(parameter="belt_speed")), abs=1e-8
        )
        parameters = dict(
            m1=(0.53, 2), m2=(0.045, 2), c1=(1.0, 1), c2=(1.0, 1), duration=(0.1, 1), belt_speed=(speed, -1)
        )
        change = sum(x * share * float(slope.sel(parameter=name)) for name, (x, share) in parameters.items())
        assert change == pytest.approx(0.0, abs=1e-6)


@pytest.mark.slow
@pytest.mark.skipif(not reference.available(), reason="no C++ compiler")
def test_a_derivative_is_the_difference_of_an_independent_solver_s_kicks(critical):
    """The mass on the belt, where lift-off and impact lie on the way to the saddle."""
    by, kicks = 1e-6, []
    for m2 in (0.045 - by, 0.045 + by):
        guess = float(critical.p_crit[1]) + float(critical.d_p_crit.sel(parameter="m2")[1]) * (m2 - 0.045)
        low, high = guess - 1e-7, guess + 1e-7
        while high - low > 1e-12:
            tried = np.linspace(low, high, 10)[1:-1]
            fates = reference.fate([reference.paper_scene(m2=m2, belt_speed=5.0, p=p) for p in tried]).fate
            first = int(np.argmax(fates != "slides")) if np.any(fates != "slides") else len(tried)
            low, high = (low if first == 0 else tried[first - 1]), (high if first == len(tried) else tried[first])
        kicks.append(0.5 * (low + high))
    found = float(critical.d_p_crit.sel(parameter="m2")[1])
    assert (kicks[1] - kicks[0]) / (2 * by) == pytest.approx(found, rel=1e-5)


def test_derivatives_are_refused_with_steps_that_are_not_exact():
    with pytest.raises(ValueError, match="needs the method EventExact"):
        fj.critical_perturbation(SCENE, derivatives=True, method=fj.WhereSwitched(dt=1e-5))


@pytest.mark.slow
def test_derivatives_of_several_contacts_are_differences_of_kicks():
    """Two oscillators that a spring couples, under different loads: forces and belt speeds scale, and kicks of other scenes."""
    scene = scene_of(coupled(2), belt=1.0, p=1.3)
    found = fj.critical_perturbation(
        scene, force=[100.0], p_range=(1.42, 1.45), p_step=0.01, derivatives=True, progress=False
    ).isel(force=0)
    p_crit, bracket = float(found.p_crit), (float(found.p_crit) - 1e-4, float(found.p_crit) + 1e-4)
    assert str(found.kind.values) == "manifold" and not str(found.why_none.values)
    assert float(found.p_crit_high - found.p_crit_low) == pytest.approx(2e-9 * p_crit, rel=1e-6)

    def kick(**changes) -> float:
        there = critical_kick(scene.replace(**changes), bracket, ())
        assert there is not None
        return there.p

    for names, value, by in (
        (("force",), 100.0, 1e-3),
        (("mu_0", "mu_static_0"), 0.2, 1e-6),
        (("duration",), 0.1, 2e-8),
    ):
        slope = sum(float(found.d_p_crit.sel(parameter=name)) for name in names)
        difference = (kick(**dict.fromkeys(names, value + by)) - kick(**dict.fromkeys(names, value - by))) / (2 * by)
        assert slope == pytest.approx(difference, rel=1e-6)
    # Displacements are forces over stiffness: with the belt's speeds, all scales.
    faster = (kick(belt_speed=np.full(2, 1 + 1e-6)) - kick(belt_speed=np.full(2, 1 - 1e-6))) / 2e-6
    assert 100.0 * float(found.d_p_crit.sel(parameter="force")) == pytest.approx(-faster, rel=1e-6)


@pytest.mark.parametrize("at_the_end", [False, True])
def test_a_search_that_is_interrupted_says_nothing_of_what_it_has_not_run(monkeypatch, at_the_end):
    """Rows without a scan were said to have no critical kick, and smallest kicks came out larger."""
    real = engine._Run.follow

    def follow(self, part):
        if at_the_end:
            real(self, part)
        signal.raise_signal(signal.SIGINT)
        if not at_the_end:
            real(self, part)

    monkeypatch.setattr(engine._Run, "follow", follow)
    with pytest.raises(KeyboardInterrupt):
        fj.critical_perturbation(SCENE, mu=[0.2, 0.227], p_range=(1.0, 1.2), p_step=0.1, progress=False)
    with pytest.raises(KeyboardInterrupt):
        verdicts_from(SCENE, np.zeros((2, 6)), "states")
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


def test_a_narrow_range_is_scanned_in_steps_that_fit_in():
    found = fj.critical_perturbation(SCENE, p_range=(1.105, 1.11), tolerance=1e-3, progress=False)
    assert float(found.p_crit_low[0]) < 1.1072058 < float(found.p_crit_high[0])
    assert json.loads(found.attrs["settings"])["p_step"] == pytest.approx(0.005)
    with pytest.raises(fj.NoSquealingKick, match="the certified bound, none does") as none:
        fj.smallest_kick(SCENE, over="p", bounds={"p": (1.0, 1.005)}, progress=False)
    # What was proved is not lost; it is the bound of the search that finds one.
    assert none.value.certified == fj.smallest_kick(SCENE, over="p", bounds={"p": (1.0, 1.2)}, progress=False).certified


@pytest.mark.slow
def test_a_saddle_is_found_that_motions_come_to_in_other_modes():
    """Static friction is 3.6 times kinetic. The critical motion does not stick for 90 returns, then does as the saddle does, and
    kicks apart by 1e-6 part before. The reference is by bisection with a solver of its own.
    """
    mu, law = 0.1461210197926363, fj.Coulomb(0.1461210197926363, 3.5664993323201046 * 0.1461210197926363)
    load = fj.Pulse(force=100.0, p=1.5, duration=0.062305784881210094)
    scene = fj.Scene(fj.belt_oscillator(), law, belt_speed=2.4027836606445323, load=load)
    step = 1e-6
    found = fj.critical_perturbation(
        scene, mu=[mu - step, mu, mu + step], p_range=(1.5, 1.7), derivatives=True, progress=False
    )
    assert set(found["kind"].values) == {"manifold"} and not np.any(found["why_none"].values)
    low, p, high = found["p_crit"].values
    assert p == pytest.approx(1.57153522489, abs=1e-11)
    assert found["d_p_crit"].sel(parameter="mu").values[1] == pytest.approx((high - low) / (2 * step), rel=1e-6)


@pytest.mark.slow
def test_a_saddle_may_slide_all_the_time():
    """Under falling friction, below a subcritical Hopf point. Rejects asking a saddle for events."""
    friction, load = fj.ExponentialDecay(0.23, 0.1276, 1.76), fj.Pulse(100.0, p=1.8, duration=0.031)
    scene = fj.Scene(fj.belt_oscillator(c1=3.5, c2=4.2), friction, belt_speed=1.12, load=load)
    assert {phase.status for phase in fj.saddle_cycle(scene).word} == {fj.Status.SLIDE}
    step = 1e-5
    speeds = np.array([1.12 - step, 1.12, 1.12 + step])
    found = fj.critical_perturbation(
        scene, belt_speed=speeds, p_range=(1.75, 1.9), p_step=0.05, derivatives=True, progress=False
    )
    assert set(found["kind"].values) == {"manifold"}
    low, p, high = found["p_crit"].values
    slope = found["d_p_crit"].sel(parameter="belt_speed").values[1]
    assert slope == pytest.approx((high - low) / (2 * step), rel=1e-5)
    verdicts = fj.bistability_map(scene, p=[p - 1e-7, p + 1e-7], progress=False)["verdict"].values
    assert verdicts.tolist() == [0, 1]


@pytest.mark.slow
def test_a_saddle_is_found_although_sliding_fades_slowly_beyond_it():
    """Under falling friction. Sliding repeats better than the motion near the saddle, which swings in another mode yet: `kind`
    was "none".
    """
    structure = fj.Structure(
        np.diag([0.904, 1.831, 1.405]),
        [[0.258, -0.139, -0.035], [-0.139, 0.358, 0.031], [-0.035, 0.031, 0.283]],
        [[1993.0, -1100.9, -377.0], [-1100.9, 2501.2, 248.5], [-377.0, 248.5, 2086.4]],
        [0.0, -1.0, -0.386],
        contacts=[fj.ContactPoint(0, 1)],
    )
    scene = fj.Scene(structure, fj.ExponentialDecay(0.805, 0.46, 0.555), load=fj.Pulse(2.0, p=3.0, duration=0.397))
    step = 1e-6
    speeds = np.array([0.1154 - step, 0.1154, 0.1154 + step])
    found = fj.critical_perturbation(scene, belt_speed=speeds, p_range=(2.0, 2.6), derivatives=True, progress=False)
    assert set(found["kind"].values) == {"manifold"}
    low, _, high = found["p_crit"].values
    slope = found["d_p_crit"].sel(parameter="belt_speed").values[1]
    assert slope == pytest.approx((high - low) / (2 * step), rel=1e-5)


def test_a_long_kick_has_its_derivatives():
    """While it lasts the motion has as many steps as it takes; those after it are counted anew."""
    found = fj.critical_perturbation(
        SCENE.replace(mu=0.227, belt_speed=1.0, duration=25.0), p_range=(1.12, 1.14), derivatives=True, progress=False
    )
    assert found["kind"].item() == "manifold" and np.all(np.isfinite(found["d_p_crit"]))
    below, above = (
        fj.bistability_map(
            SCENE.replace(mu=0.227, belt_speed=1.0, duration=25.0), p=[found["p_crit"].item() + by], progress=False
        )
        for by in (-1e-6, 1e-6)
    )
    assert below["verdict"].item() == fj.Verdict.SLIDING and above["verdict"].item() == fj.Verdict.LIMIT_CYCLE
