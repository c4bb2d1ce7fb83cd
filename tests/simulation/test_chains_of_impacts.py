"""Chains of ever shorter flights that end in rest, by closed forms: the motion, its derivatives, and that these exist.

A mass under a force towards the belt rebounds in geometric progression; two masses that the mass matrix couples kick each other up
so. What counts as rest is a matter of rounding; neither motion nor derivatives may depend on it.
"""

import numpy as np
import pytest

import fivjax as fj
from tests.helpers import derivative_cases as cases
from tests.helpers.gradient_reference import point_mass

FEW = fj.EventExact(order=8)
FORCE, DOWN, FALL, MU = 2.0, 0.5, 0.25, 0.3
LANDING = DOWN + FORCE * FALL  # m/s


def dropped(restitution: float, law: str, load=None):
    """A unit mass that is thrown at a fast belt, which drags it ahead while they touch."""
    load = fj.Pulse(FORCE, 1.0, start=50.0) if load is None else load
    scene = fj.Scene(point_mass(0.0), fj.Coulomb(MU), 5.0, load, restitution, impact_law=law)
    return scene, ([0.0, DOWN * FALL + 0.5 * FORCE * FALL**2], [0.0, -DOWN])


@pytest.mark.parametrize("law", ["coulomb", "frictionless", "reset"])
@pytest.mark.parametrize("restitution", [1e-5, 2e-4, 0.05, 0.3, 0.8])
def test_rebounds_that_come_to_rest(restitution, law):
    """They last for 2 V e / (F (1 - e)), without friction: that is lost, unless the impacts have friction."""
    scene, y0 = dropped(restitution, law)
    t1 = 8.0
    found = fj.derivatives(cases.last_state, scene, ["restitution", "mu"], t1, t1, y0=y0, method=FEW)
    assert found.exist and found.closest > min(0.5 * restitution, 1e-3), found.reason
    flights = 2 * LANDING / FORCE * restitution / (1 - restitution)
    dragged = FORCE * (t1 - FALL) + LANDING if law == "coulomb" else FORCE * (t1 - FALL - flights)
    by_restitution = 0.0 if law == "coulomb" else -MU * 2 * LANDING / (1 - restitution) ** 2
    size = MU * 2 * LANDING / (1 - restitution) ** 2
    np.testing.assert_allclose(found.value[2], MU * dragged, rtol=1e-12)
    np.testing.assert_allclose(found["mu"][2], dragged, rtol=1e-12)
    np.testing.assert_allclose(found["restitution"][2], by_restitution, rtol=0, atol=1e-7 * size)
    assert found.value[1] == found.value[3] == 0.0


def test_next_to_no_restitution_a_rebound_is_about_to_vanish():
    """By the restitution only: other parameters change no rebound's share of the speed."""
    scene, y0 = dropped(1e-8, "frictionless")
    by_restitution, by_mu = (
        fj.derivatives(cases.last_state, scene, [name], 1.0, 1.0, y0=y0, method=FEW) for name in ("restitution", "mu")
    )
    assert not by_restitution.exist and "at restitution 0, at t = 0.25 s, 1.0e-08" in by_restitution.reason
    assert by_mu.exist


@pytest.mark.parametrize(("flight", "exist"), [(2, True), (12, False), (40, True)])
def test_a_jump_of_the_load_amid_the_last_flights_of_a_chain(flight, exist):
    """A chain of flights moves as a whole: past a jump of the load that falls in one of a microsecond, however clearly in it."""
    restitution = 0.3
    begin = FALL + 2 * LANDING / FORCE * sum(restitution**k for k in range(1, flight))
    jump = begin + 0.4 * 2 * LANDING / FORCE * restitution**flight if flight < 20 else begin + 0.1
    scene, y0 = dropped(restitution, "coulomb", fj.Pulse(FORCE / 1.5, 1.5, duration=jump))
    found = fj.derivatives(cases.last_state, scene, ["mu"], 2.0, 2.0, y0=y0, method=FEW)
    assert found.exist is exist, found.reason


@pytest.mark.slow
def test_two_masses_kick_each_other_up_ever_less():
    """Both slip ahead all the time, so each contact's impulse along the belt is μ times the one away from it, and these are what
    stops the masses: J = F t - M v. Each landing lifts the other contact by 0.3 of its speed.
    """
    coupling = np.array([[1.0, -0.3], [-0.3, 1.0]])
    structure = fj.Structure(
        np.kron(coupling, np.eye(2)),
        np.zeros((4, 4)),
        np.zeros((4, 4)),
        [0.0, -1.0, 0.0, -1.0],
        contacts=[fj.ContactPoint(0, 1), fj.ContactPoint(2, 3)],
    )
    mu, t1 = np.array([0.3, 0.2]), 4.0
    scene = fj.Scene(structure, [fj.Coulomb(each) for each in mu], 20.0, fj.Pulse(FORCE, 1.0, start=50.0))
    y0 = [0.0, 0.6, 0.0, 0.0], [0.0, -0.5, 0.0, 0.0]
    found = fj.derivatives(cases.last_state, scene, ["mu_0", "mu_1", "force"], t1, t1, y0=y0, method=FEW)
    assert found.exist and found.events > 15 and found.closest > 0.1, found.reason
    impulses = FORCE * t1 * np.ones(2) - coupling @ [-0.5, 0.0]
    ahead = [4, 6]
    # The last flight is cut short, of 7e-9 s.
    np.testing.assert_allclose(found.value[ahead], np.linalg.solve(coupling, mu * impulses), rtol=1e-8)
    for name, change in {"mu_0": [impulses[0], 0.0], "mu_1": [0.0, impulses[1]], "force": mu * t1}.items():
        np.testing.assert_allclose(found[name][ahead], np.linalg.solve(coupling, change), rtol=1e-7)
    assert np.all(found.value[[1, 3, 5, 7]] == 0.0)


@pytest.mark.parametrize("law", ["frictionless", "reset"])
@pytest.mark.parametrize("loss", [1e-13, 1e-10, 0.0])
def test_a_landing_of_next_to_nothing_changes_next_to_nothing(law, loss):
    """Also with hardly any loss, where what its rebounds change would be divided by that: 30 m/s out of 1e-13."""
    scene = fj.Scene(
        fj.belt_oscillator(), fj.Coulomb(0.2), 1.0, fj.ConstantLoad(100.0), restitution=1 - loss, impact_law=law
    )
    y0 = np.concatenate([fj.sliding_equilibrium(scene), [0.0, 0.0, -1e-13]])
    y0[2] = 1e-24
    run = fj.simulate(scene, 1e-3, 1e-4, y0=y0)
    assert run.meaning == "reached its end" and np.max(np.abs(run.velocity)) < 1e-10
