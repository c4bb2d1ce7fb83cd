"""The oracle against closed forms, against the paper's printed numbers, and its two engines against each other."""

import math

import numpy as np
import pytest

from tests.helpers import oracle
from tests.helpers.oracle import (
    DETACH,
    SLIDE,
    STICK,
    Constant,
    ContactError,
    ExponentialDecay,
    Load,
    Model,
    ZenoError,
    paper_model,
    propagate,
    simulate,
    verdict,
)

ENGINES = pytest.mark.parametrize("engine", [propagate, simulate])
PRESS = np.array([0.0, -1.0])  # a load onto the contact of a structure with coordinates (tangential, normal)


# ----------------------------------------------------------------------- equations of the paper


def _eq3(mu, m1=0.53, m2=0.045, c1=1.0, c2=1.0, k1=1e5, k2=1.01e5, theta=0.01):
    s, c = math.sin(theta), math.cos(theta)
    M = np.array([[m2 + m1 * c**2 + mu * m1 * c * s, 0.0], [0.0, m1]])
    C = np.array(
        [[c2 * s**2 + c1 * c**2 + mu * (c1 - c2) * c * s, -c2 * s + mu * c2 * c], [-c2 * s, c2]],
    )
    K = np.array(
        [[k2 * s**2 + k1 * c**2 + mu / 2 * (k1 - k2) * math.sin(2 * theta), -k2 * s + mu * k2 * c], [-k2 * s, k2]],
    )
    return M, C, K


@pytest.mark.parametrize("theta", [0.01, 0.4])
def test_sliding_and_sticking_project_to_eq_3_and_eq_6(theta):
    values = {"m1": 0.7, "m2": 0.2, "c1": 3.0, "c2": 5.0, "k1": 1e5, "k2": 1.3e5, "theta": theta}
    model = paper_model(mu=0.3, belt_speed=2.0, **values)
    m = oracle._Mechanics(model)
    q, v, f = np.array([1e-3, -2e-3, 0.0]), np.array([0.4, -0.7, 0.0]), 100.0
    a, N, T = m.slide(q, v, f, 1.0, 0.3)
    M, C, K = _eq3(0.3, **values)
    expected = np.linalg.solve(M, np.array([0.0, -f]) - C @ v[:2] - K @ q[:2])
    np.testing.assert_allclose(a, [*expected, 0.0], rtol=1e-12)
    assert pytest.approx(0.3 * N) == T

    v[0] = 2.0
    a, N, T = m.stick(q, v, f)
    s = math.sin(theta)
    expected = -(5.0 * (v[1] - v[0] * s) + 1.3e5 * (q[1] - q[0] * s) + f) / 0.7
    np.testing.assert_allclose(a, [0.0, expected, 0.0], rtol=1e-12)
    residual = model.mass @ a + model.damping @ v + model.stiffness @ q - [T, -f, N]
    np.testing.assert_allclose(residual, 0.0, atol=1e-10)


@pytest.mark.parametrize("restitution", [0.0, 0.5])
@pytest.mark.parametrize(("slip", "sticks"), [(-0.046, True), (-2.0, False), (3.0, False)])
def test_impact_is_newton_with_a_coulomb_impulse(restitution, slip, sticks):
    model = paper_model(mu=0.3, belt_speed=2.0, theta=0.1, restitution=restitution)
    # the normal impulse alone would change the slip by 0.046 (1 + e)
    v = np.array([2.0 + slip * (1.0 + restitution), 0.4, -0.5])
    after = oracle._Mechanics(model).impact(v)
    P = model.mass @ (after - v)
    assert after[2] == pytest.approx(0.5 * restitution)
    assert P[1] == pytest.approx(0.0, abs=1e-15)
    assert P[2] > 0.0
    assert bool(after[0] == 2.0) is sticks
    if sticks:
        assert abs(P[0]) <= 0.3 * P[2]
    else:
        assert P[0] == pytest.approx(-math.copysign(0.3, slip) * P[2])
        assert (after[0] - 2.0) * slip > 0.0
    belt = np.array([2.0, 0.0, 0.0])
    assert (after + v - 2.0 * belt) @ P <= 1e-12  # seen from the belt, an impact only takes energy


def test_critical_friction():
    def growth(mu):
        M, C, K = _eq3(mu)
        A = np.block([[np.zeros((2, 2)), np.eye(2)], [-np.linalg.solve(M, K), -np.linalg.solve(M, C)]])
        return np.linalg.eigvals(A).real.max()

    assert growth(0.22822) < 0.0 < growth(0.22824)


# --------------------------------------------------------------------------------- closed forms


@ENGINES
def test_block_on_a_belt(engine):
    # m = k = 1, v = 0.2, F_s = 1, F_d = 0.5: sticks for 2 D / (k v), slips for (2 / w) (pi - atan(D w / (k v)))
    model = Model(np.eye(2), np.zeros((2, 2)), np.eye(2), PRESS, 0, 1, Constant(0.5, 1.0), 0.2, Load(1.0))
    run = engine(model, 50.0, t_eval=[0.0, 50.0], y0=([0.0, 0.0], [0.2, 0.0]))
    times = np.array([e[0] for e in run.events])
    assert [e[1:] for e in run.events[:4]] == [(0, 1), (1, 0), (0, 1), (1, 0)]
    t_slip = 2.0 * (math.pi - math.atan(0.5 / 0.2))
    np.testing.assert_allclose(np.diff(times)[::2], t_slip, rtol=1e-11)
    np.testing.assert_allclose(np.diff(times)[1::2], 5.0, rtol=1e-11)
    np.testing.assert_allclose(times[2] - times[0], 8.902605408, atol=1e-9)


@ENGINES
def test_coulomb_damped_oscillator(engine):
    model = Model(np.eye(2), np.zeros((2, 2)), np.eye(2), PRESS, 0, 1, Constant(1.0), 0.0, Load(1.0))
    stops = math.atan2(6.0, 13.0) + math.pi * np.arange(8)  # about the shifted centre x = -1, then every half cycle
    run = engine(model, 25.0, t_eval=[0.0, *stops, 25.0], y0=([12.0, 0.0], [6.0, 0.0]))
    np.testing.assert_allclose([e[0] for e in run.events], stops, rtol=1e-11)
    assert [e[1:] for e in run.events] == [(SLIDE, SLIDE)] * 7 + [(SLIDE, STICK)]
    peak = math.hypot(13.0, 6.0) - 1.0
    expected = (peak - 2.0 * np.arange(8)) * (-1.0) ** np.arange(8)
    np.testing.assert_allclose(run.q[1:-1, 0], expected, rtol=1e-10)
    assert run.status[-1] == STICK
    np.testing.assert_allclose(run.q[-1, 0], expected[-1], rtol=1e-10)
    np.testing.assert_allclose([run.q[-1, 0], stops[-1]], [0.682179, 22.4236], atol=1e-4)


@ENGINES
def test_bouncing_mass(engine):
    # frictionless, on a belt that moves so that the contact slides once it is closed
    model = Model(np.eye(2), np.zeros((2, 2)), np.diag([1.0, 0.0]), PRESS, 0, 1, Constant(0.0), 1.0, Load(9.81), 0.5)
    run = engine(model, 2.0, t_eval=np.linspace(0.0, 2.0, 4001), y0=([0.0, 1.0], [0.0, 0.0]))
    assert run.q[:, 1].min() >= 0.0
    assert run.events[-1][1:] == (DETACH, SLIDE)
    # the chatter is cut when the rebound is 1e-7 of the first impact
    assert run.events[-1][0] == pytest.approx(3.0 * math.sqrt(2.0 / 9.81), abs=1e-6)
    first = math.sqrt(2.0 / 9.81)
    hops = np.diff([e[0] for e in run.events[:10]])
    np.testing.assert_allclose(hops, first * 0.5 ** np.arange(9), rtol=1e-9)
    assert run.status[-1] == SLIDE
    assert run.N[-1] == pytest.approx(9.81)


# --------------------------------------------------------------------------- engines and physics

CASES = {
    "sticking": {"belt_speed": 1.0, "p": 1.11},
    "all transitions": {"belt_speed": 3.0, "p": 1.6},
    "steep belt": {"belt_speed": 3.0, "p": 4.0, "mu": 0.1, "theta": 0.3},
    "larger static coefficient": {"belt_speed": 1.0, "p": 1.5, "mu": 0.2, "mu_static": 0.4},
    "reversed belt": {"belt_speed": -2.0, "p": 3.0, "mu": 0.3, "theta": 0.2},
    "elastic impact": {"belt_speed": 3.0, "p": 1.6, "restitution": 0.4},
}


RARER = ("larger static coefficient", "elastic impact", "sticking", "steep belt", "reversed belt")


@pytest.mark.parametrize("case", [pytest.param(k, marks=pytest.mark.slow if k in RARER else ()) for k in CASES])
def test_engines_agree(case):
    model = paper_model(**CASES[case])
    t = np.linspace(0.0, 0.7, 1401)
    a, b = propagate(model, 0.7, t), simulate(model, 0.7, t)
    assert [e[1:] for e in a.events] == [e[1:] for e in b.events]
    np.testing.assert_allclose([e[0] for e in a.events], [e[0] for e in b.events], rtol=1e-11)
    for name in ("q", "v", "a", "N", "T"):
        x, y = getattr(a, name), getattr(b, name)
        np.testing.assert_allclose(x, y, atol=1e-9 * np.abs(x).max(), rtol=0.0, err_msg=name)
    np.testing.assert_array_equal(a.status, b.status)


@pytest.mark.parametrize("case", CASES)
def test_contact_laws_hold(case):
    model = paper_model(**CASES[case])
    t = np.linspace(0.0, 1.2, 9601)
    run = propagate(model, 1.2, t)
    mu, mu_s, vb = model.friction.mu, model.friction.static, model.belt_speed
    load = np.array([model.load(s) for s in t])
    residual = (
        run.a @ model.mass + run.v @ model.damping + run.q @ model.stiffness - np.outer(load, model.load_direction)
    )
    residual[:, 0] -= run.T
    residual[:, 2] -= run.N
    assert np.abs(residual).max() < 1e-8 * 100.0
    assert run.q[:, 2].min() > -1e-15
    assert run.N.min() > -1e-8
    stick, slide, off = (run.status == s for s in (STICK, SLIDE, DETACH))
    np.testing.assert_array_equal(run.v[stick, 0], vb)
    assert np.all(np.abs(run.T[stick]) <= mu_s * run.N[stick] + 1e-8)
    assert np.all(run.q[~off, 2] == 0.0)
    slip = run.v[slide, 0] - vb
    np.testing.assert_allclose(run.T[slide], -np.sign(slip) * mu * run.N[slide], atol=1e-8)
    assert np.all(run.T[off] == 0.0)
    assert np.all(run.N[off] == 0.0)


@pytest.mark.slow
def test_exponential_law_contains_the_constant_one():
    t = np.linspace(0.0, 0.4, 401)
    same = paper_model(belt_speed=1.0, p=1.4, mu_static=0.227, mu_dynamic=0.227, decay=0.5)
    assert isinstance(same.friction, ExponentialDecay)
    a, b = propagate(paper_model(belt_speed=1.0, p=1.4), 0.4, t), simulate(same, 0.4, t)
    assert len(a.events) == len(b.events) > 5
    np.testing.assert_allclose(a.q, b.q, atol=1e-10 * np.abs(a.q).max(), rtol=0.0)


@pytest.mark.slow
def test_exponential_law_agrees_with_itself_at_a_looser_tolerance():
    model = paper_model(belt_speed=0.5, p=1.5, mu_static=0.6, mu_dynamic=0.5, decay=0.5)
    t = np.linspace(0.0, 0.2, 2001)
    a, b = simulate(model, 0.2, t, rtol=1e-12), simulate(model, 0.2, t, rtol=1e-8)
    assert len(a.events) == len(b.events) > 5
    np.testing.assert_allclose(a.q, b.q, atol=1e-6 * np.abs(a.q).max(), rtol=0.0)
    slide = a.status == SLIDE
    speed = np.abs(a.v[:, 0] - 0.5)
    mu = 0.5 + 0.1 * np.exp(-0.5 * speed)
    np.testing.assert_allclose(np.abs(a.T[slide]), (mu * a.N)[slide], rtol=1e-10)


def test_refusals():
    with pytest.raises(ContactError, match="y0"):
        simulate(paper_model(belt_speed=0.0), 0.1)
    with pytest.raises(ContactError, match="below"):
        simulate(paper_model(), 0.1, y0=([0.0, 0.0, -1e-6], [0.0, 0.0, 0.0]))
    with pytest.raises(ContactError, match="Painleve"):
        # reverse slip at theta = 0.8: the limit is 1.14
        simulate(paper_model(mu=1.3, theta=0.8), 0.1, y0=(np.zeros(3), [4.0, 0.0, 0.0]))
    chatter = Model(np.eye(2), np.zeros((2, 2)), np.diag([1.0, 0.0]), PRESS, 0, 1, Constant(0.0), 1.0, Load(9.81), 0.99)
    with pytest.raises(ZenoError):
        propagate(chatter, 200.0, t_eval=[0.0], y0=([0.0, 1.0], [0.0, 0.0]))


# ------------------------------------------------------------------------------------- verdicts
# The dearest are slow: they are asked when the oracle changes.


@pytest.mark.parametrize(
    ("belt_speed", "p", "kind", "regime"),
    [
        (0.5, 1.05, "sliding", ""),
        (0.5, 1.06, "limit cycle", "periodic"),
        (1.0, 1.10, "sliding", ""),
        (1.0, 1.11, "limit cycle", "periodic"),
        (1.5, 1.16, "sliding", ""),
        pytest.param(1.5, 1.17, "limit cycle", "periodic", marks=pytest.mark.slow),
        (3.0, 1.19, "sliding", ""),
        (3.0, 1.20, "limit cycle", "quasi-periodic"),
        pytest.param(5.0, 1.20, "limit cycle", "quasi-periodic", marks=pytest.mark.slow),
        (100.0, 1.19, "sliding", ""),
        pytest.param(100.0, 1.20, "limit cycle", "quasi-periodic", marks=pytest.mark.slow),
    ],
)
def test_neighbours_of_table_2(belt_speed, p, kind, regime):
    answer = verdict(paper_model(mu=0.227, belt_speed=belt_speed, p=p))
    assert (answer.kind, answer.regime) == (kind, regime)


def test_first_contact_event_may_come_late():
    answer = verdict(paper_model(p=1.193))
    assert answer.kind == "limit cycle"
    assert answer.first_event == pytest.approx(1.0734582715, abs=1e-9)


@pytest.mark.slow
def test_small_kick_slides_and_large_friction_does_not():
    quiet = verdict(paper_model(mu=0.22, p=1.01))
    assert quiet.kind == "sliding"
    assert quiet.events == 0
    assert verdict(paper_model(mu=0.5, p=1.05)).kind == "limit cycle"
    # an island of sliding inside the unstable region
    assert verdict(paper_model(mu=0.05, p=7.0)).kind == "sliding"


@pytest.mark.slow
def test_sliding_verdict_against_simulate():
    model = paper_model(belt_speed=1.0, p=1.10)
    answer = verdict(model)
    run = simulate(model, 2.2, t_eval=np.linspace(1.4, 2.2, 4001))
    assert len(run.events) == answer.events
    assert run.events[-1][0] == pytest.approx(answer.last_event, abs=1e-10)
    assert np.all(run.status == SLIDE)
    assert run.N.min() > 0.0
    assert run.v[:, 0].max() < 1.0


def test_periodic_verdict_against_simulate():
    model = paper_model(belt_speed=1.0, p=1.11)
    answer = verdict(model)
    _, q, v = answer.section
    still = paper_model(belt_speed=1.0)
    run = simulate(still, 5.0 * answer.period, t_eval=answer.period * np.arange(6), y0=(q, v))
    np.testing.assert_allclose(run.q, np.tile(q, (6, 1)), atol=1e-7 * answer.amplitude)
    assert len(run.events) > 5


@pytest.mark.slow
def test_quasi_periodic_verdict_against_simulate():
    answer = verdict(paper_model(belt_speed=10.0, p=1.3))
    _, q, v = answer.section
    still = paper_model(belt_speed=10.0)
    t = np.linspace(0.0, 0.6, 1201)
    run, exact = simulate(still, 0.6, t, (q, v)), propagate(still, 0.6, t, (q, v))
    assert [e[1:] for e in run.events] == [e[1:] for e in exact.events]
    np.testing.assert_allclose(run.q, exact.q, atol=1e-9 * np.abs(run.q).max())
    assert abs(np.abs(run.q[:, 0]).max() / answer.amplitude - 1.0) < 0.05


@pytest.mark.slow
def test_unstable_orbit_at_the_boundary_is_not_taken_for_a_limit_cycle():
    # 1e-8 on either side of the crossing both runs first linger on the same unstable orbit
    below, above = 1.1072058074 - 1e-8, 1.1072058074 + 1e-8
    a = verdict(paper_model(belt_speed=1.0, p=below))
    b = verdict(paper_model(belt_speed=1.0, p=above))
    assert (a.kind, b.kind) == ("sliding", "limit cycle")
    assert a.events > 500
    assert b.amplitude == pytest.approx(2.7132675e-3, rel=1e-6)


@pytest.mark.slow
def test_threshold_scales_with_the_belt_speed_where_only_sticking_acts():
    # the motion is linear in (p - 1, belt_speed) as long as the contact does not open
    crossing = 0.10720580743
    for speed in (0.5, 1.5):
        for sign, kind in ((-1.0, "sliding"), (1.0, "limit cycle")):
            p = 1.0 + speed * (crossing + sign * 1e-7)
            assert verdict(paper_model(belt_speed=speed, p=p)).kind == kind


@pytest.mark.slow
def test_verdicts_of_an_exponential_law():
    damped = paper_model(belt_speed=20.0, p=1.5, c1=20.0, c2=20.0, mu_static=0.2, mu_dynamic=0.1, decay=0.5)
    assert verdict(damped).kind == "sliding"
    # negative slope: unstable at any amplitude, with sticking on the cycle
    falling = paper_model(belt_speed=0.5, p=1.5, mu_static=0.2, mu_dynamic=0.1, decay=0.5)
    assert verdict(falling, t_max=0.5).kind == "undecided"
