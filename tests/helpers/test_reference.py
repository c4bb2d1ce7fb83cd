"""The reference solver in C++ against closed forms and against `oracle`, with which it shares nothing."""

import numpy as np
import pytest
from scipy.linalg import expm

from tests.helpers import oracle, reference
from tests.helpers.reference import cycles

pytestmark = pytest.mark.skipif(not reference.available(), reason="The reference solver needs the compiler g++.")

BLOCK = dict(
    mass=np.eye(2), damping=np.zeros((2, 2)), stiffness=np.diag([1.0, 0.0]), load_direction=np.array([0.0, -1.0]),
    tangential=0, normal=1, mu=0.5, mu_static=1.0, belt_speed=0.2, force=1.0,
)  # fmt: skip


def test_block_on_a_belt_has_the_period_of_the_closed_form():
    run = reference.trajectory({**BLOCK, "y0": ([0.0, 0.0], [0.2, 0.0])}, 60.0)
    slip = 2.0 * (np.pi - np.arctan(0.5 / 0.2))
    stick = 2.0 * 0.5 / 0.2
    released = [t for t, _, after in run.events if after == reference.SLIDE]
    np.testing.assert_allclose(np.diff(released), slip + stick, rtol=1e-14)
    np.testing.assert_allclose(np.diff(run.crossing_t), 8.902605408, atol=5e-10)


def test_dry_friction_takes_two_from_each_half_swing_and_stops():
    run = reference.trajectory({**BLOCK, "mu": 1.0, "belt_speed": 0.0, "y0": ([12.0, 0.0], [6.0, 0.0])}, 30.0, [30.0])
    assert run.events[-1][2] == reference.STICK
    assert run.events[-1][0] == pytest.approx(np.arctan(6.0 / 13.0) + 7.0 * np.pi, abs=1e-12)
    assert run.q[-1, 0] == pytest.approx(0.682179, abs=5e-7)


def test_bouncing_mass_comes_to_rest_and_never_goes_below_the_floor():
    ball = {**BLOCK, "mu": 0.0, "mu_static": 0.0, "stiffness": np.zeros((2, 2)), "force": 9.81, "restitution": 0.5}
    run = reference.trajectory({**ball, "y0": ([0.0, 1.0], [0.0, 0.0])}, 2.0, np.linspace(0.0, 2.0, 1001))
    rest = np.sqrt(2.0 / 9.81) * 1.5 / 0.5
    assert run.events[-1][0] == pytest.approx(rest, rel=1e-6)  # the chatter is cut at 1e-7 of the first impact
    assert run.q[:, 1].min() == 0.0


@pytest.mark.parametrize(
    "scene",
    [
        dict(mu=0.227, belt_speed=3.0, p=2.0),
        dict(mu=0.2, mu_static=0.3, belt_speed=0.5, p=2.0, restitution=0.3),
        dict(mu=0.25, belt_speed=-1.0, p=0.2, theta=0.3, duration=0.03),
    ],
    ids=["detaching", "sticking and bouncing", "belt the other way"],
)
def test_trajectories_are_the_oracle_s(scene):
    times = np.linspace(0.0, 0.4, 81)
    run = reference.trajectory(reference.paper_scene(**scene), 0.4, times)
    other = oracle.propagate(oracle.paper_model(**scene), 0.4, times)
    assert [e[1:] for e in run.events] == [e[1:] for e in other.events] and len(run.events) > 5
    np.testing.assert_allclose([e[0] for e in run.events], [e[0] for e in other.events], atol=1e-11)
    np.testing.assert_allclose(run.q, other.q, atol=1e-9 * np.abs(other.q).max())
    np.testing.assert_allclose(run.N, other.N, atol=1e-7 * other.N.max())
    np.testing.assert_allclose(run.T, other.T, atol=1e-7 * other.N.max())
    np.testing.assert_array_equal(run.mode, other.status)


def test_falling_friction_is_the_oracle_s():
    law = dict(mu_static=0.25, mu_dynamic=0.1, decay=5.0, belt_speed=0.5, p=2.5)
    times = np.linspace(0.0, 0.06, 31)
    run = reference.trajectory(reference.paper_scene(**law, theta=0.3), 0.06, times)
    other = oracle.simulate(oracle.paper_model(**law, theta=0.3), 0.06, times)
    assert [e[1:] for e in run.events] == [e[1:] for e in other.events] and len(run.events) > 3
    np.testing.assert_allclose([e[0] for e in run.events], [e[0] for e in other.events], atol=1e-11)
    np.testing.assert_allclose(run.q, other.q, atol=1e-10 * np.abs(other.q).max())
    np.testing.assert_allclose(run.N, other.N, atol=1e-9 * other.N.max())


TABLE_2 = {0.5: 1.06, 1.0: 1.11, 1.5: 1.17, 3.0: 1.20, 5.0: 1.20, 10.0: 1.20, 100.0: 1.20}


def test_fates_reproduce_table_2():
    below = [reference.paper_scene(mu=0.227, belt_speed=v, p=p - 0.01) for v, p in TABLE_2.items()]
    at = [reference.paper_scene(mu=0.227, belt_speed=v, p=p) for v, p in TABLE_2.items()]
    found = reference.fate(below + at, periods=2000)
    assert list(found.fate) == ["slides"] * len(below) + ["sustained"] * len(at)


def test_what_is_said_to_slide_has_no_event_any_more():
    scene = reference.paper_scene(mu=0.227, belt_speed=1.0, p=1.10)
    found = reference.fate([scene])
    run = reference.trajectory(scene, 20.0)
    assert found.fate[0] == "slides" and run.events[-1][0] == found.last_event[0]
    assert found.t_end[0] < 5.0


@pytest.mark.parametrize(
    "law", [dict(mu=0.2), dict(mu_static=0.2, mu_dynamic=0.1, decay=0.5)], ids=["constant", "falling"]
)
def test_a_small_motion_keeps_its_digits(law):
    """Near its equilibrium sliding is linear: a motion of 1e-15 m is the exponential of the linearised one."""
    scene = reference.paper_scene(belt_speed=2.0, **law)
    x, v = 1e-15 * np.array([1.0, -2.0, 0.0]), 1e-13 * np.array([1.0, 3.0, 0.0])
    t, x1, v1 = reference.crossing_map(scene, x, v, crossings=20)
    linear = expm(reference.linear(scene).matrix * t) @ [*x[:2], *v[:2]]
    np.testing.assert_allclose([*x1[:2], *v1[:2] / 400.0], linear / [1, 1, 400, 400], atol=1e-11 * np.abs(x).max())


def benchmark_a(belt_speed, **start):
    law = dict(mu=None, mu_static=1.0, mu_dynamic=0.5, decay=2.0)
    return {**BLOCK, **law, "damping": np.diag([0.1, 0.0]), "belt_speed": belt_speed, **start}


@pytest.mark.parametrize("speed", ["1.2", "1.8"])
def test_cycles_of_benchmark_a_are_those_of_a_general_solver(speed):
    """The stored values are DOP853's; the C++ solver uses Taylor series."""
    cycle = cycles.stored()["benchmark_a"]["stick_slip"][speed]
    v = float(speed)
    run = reference.trajectory(benchmark_a(v, y0=([cycle["stick_ends"] - 0.1, 0.0], [v, 0.0])), 3.0 * cycle["period"])
    stops = [t for t, _, after in run.events if after == reference.STICK]
    starts = [t for t, before, _ in run.events if before == reference.STICK]
    np.testing.assert_allclose(stops[0] - starts[0], cycle["slip_time"], atol=1e-12)
    np.testing.assert_allclose(starts[1] - stops[0], cycle["stick_time"], atol=1e-12)

    cycle = cycles.stored()["benchmark_a"]["sliding"][speed]
    scene = benchmark_a(v)
    x = [cycle["lowest"] - reference.linear(scene).q_eq[0], 0.0]
    t, again, _ = reference.crossing_map(scene, x, [0.0, 0.0])
    assert t == pytest.approx(cycle["period"], abs=1e-12)
    np.testing.assert_allclose(again, x, atol=1e-12)
    step = 1e-5
    beside = [reference.crossing_map(scene, [x[0] + h, 0.0], [0.0, 0.0])[1][0] for h in (step, -step)]
    assert (beside[0] - beside[1]) / (2.0 * step) == pytest.approx(cycle["multiplier"], rel=1e-8)


@pytest.mark.slow
def test_stored_cycles_are_found_again():
    found, stored = cycles.find(), cycles.stored()

    def leaves(tree):
        if isinstance(tree, dict | list):
            for branch in tree.values() if isinstance(tree, dict) else tree:
                yield from leaves(branch)
        else:
            yield tree

    for a, b in zip(leaves(found), leaves(stored), strict=True):
        assert a == (b if isinstance(b, str) else pytest.approx(b, rel=1e-9, abs=1e-9))
