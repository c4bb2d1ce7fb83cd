"""What must hold for any structure, law, load and state: invariants, and changes that change nothing."""

import equinox as eqx
import jax
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import fivjax as fj
from fivjax import contact as physics
from fivjax.contact import Mechanics, Status
from fivjax.maps import engine, plan

# Few and repeatable: every example runs a trajectory. One compilation serves all of a kind.
FEW = settings(max_examples=12, deadline=None, derandomize=True)
MANY = settings(max_examples=60, deadline=None, derandomize=True)
T1, ROWS = 0.2, 200


def positive(matrix: np.ndarray) -> np.ndarray:
    return matrix @ matrix.T


@st.composite
def structures(draw, size: int = 3) -> dict:
    """Matrices of a structure whose fastest vibration is some 1e3 rad/s, pressed onto the belt."""
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    mass = 0.1 * (np.eye(size) + 0.3 * positive(rng.normal(size=(size, size))))
    stiffness = 1e4 * (np.eye(size) + 0.3 * positive(rng.normal(size=(size, size))))
    damping = draw(st.floats(0.0, 5e-4)) * stiffness
    direction = rng.normal(size=size)
    normal = min(2, size - 1)
    direction[normal] = -abs(direction[normal]) - 1.0
    return dict(mass=mass, damping=damping, stiffness=stiffness, load_direction=direction)


@st.composite
def cases(draw, constant: bool | None = None, sizes=(3,)) -> dict:
    """A structure with what surrounds it, as plain numbers."""
    static = draw(st.floats(0.05, 0.4))
    return dict(
        structure=draw(structures(draw(st.sampled_from(sizes)))),
        mu=(static, static * draw(st.floats(0.3, 1.0))),
        decay=draw(st.floats(0.0, 5.0)),
        constant=draw(st.booleans()) if constant is None else constant,
        belt_speed=draw(st.floats(0.01, 5.0)) * draw(st.sampled_from([-1.0, 1.0])),
        force=draw(st.floats(1.0, 1e3)),
        p=draw(st.floats(0.0, 5.0)),
        restitution=draw(st.sampled_from([0.0, 0.3, 0.9])),
        seed=draw(st.integers(0, 2**32 - 1)),
    )


def normal_of(case: dict) -> int:
    return min(2, len(case["structure"]["load_direction"]) - 1)


def scene_of(case: dict, *, length=1.0, force=1.0, time=1.0, start=0.0) -> fj.Scene:
    """The scene of a case, in units in which lengths, forces and times have these numbers for what was one."""
    structure = case["structure"]
    built = fj.Structure(
        structure["mass"] * (force * time**2 / length),
        structure["damping"] * (force * time / length),
        structure["stiffness"] * (force / length),
        structure["load_direction"],
        tangential=0,
        normal=normal_of(case),
    )
    static, dynamic = case["mu"]
    friction = (
        fj.Coulomb(dynamic, static)
        if case["constant"]
        else fj.ExponentialDecay(static, dynamic, case["decay"] * time / length)
    )
    load = fj.Pulse(case["force"] * force, case["p"], 0.05 * time, start * time)
    return fj.Scene(built, friction, case["belt_speed"] * length / time, load, restitution=case["restitution"])


def start_of(case: dict) -> np.ndarray:
    """A state that is not at rest: touching, or a little above the belt."""
    rng = np.random.default_rng(case["seed"])
    size, n, normal = case["force"] / 1e4, len(case["structure"]["load_direction"]), normal_of(case)
    q, v = size * rng.normal(size=n), 100 * size * rng.normal(size=n)
    q[normal] = rng.choice([0.0, 0.1]) * abs(q[normal])
    v[normal] = abs(v[normal]) if q[normal] == 0 else v[normal]
    return np.concatenate([q, v])


def run_of(case: dict, **units):
    length, time = units.get("length", 1.0), units.get("time", 1.0)
    y0 = start_of(case) * np.repeat([length, length / time], 3)
    return fj.simulate(scene_of(case, **units), T1 * time, T1 * time / ROWS, y0=y0, energy=True)


@FEW
@given(cases())
def test_invariants_of_any_trajectory(case):
    """Friction opposes sliding and stays in its cone; the belt only presses, and is never entered; energy is accounted for."""
    run = run_of(case)
    if run.outcome != fj.Ending.FINISHED:
        assert run.meaning.strip() and np.any(np.isnan(run.velocity))
        return
    force, friction, slip = run.normal_force, run.friction_force, run.slip_velocity
    size = np.max(np.abs(force)) + case["force"]
    assert np.min(run.gap) >= -1e-9 * np.max(np.abs(run.displacement))
    assert np.min(force) >= -1e-9 * size
    assert np.all(np.abs(friction) <= case["mu"][0] * force + 1e-9 * size)
    assert np.all((friction * slip)[run.status == Status.SLIDE] <= 1e-12 * size * np.max(np.abs(slip)))
    touching = run.status != Status.DETACH
    assert np.all(run.gap[touching] == 0) and np.all(friction[~touching] == 0) and np.all(force[~touching] == 0)
    assert np.all(slip[run.status == Status.STICK] == 0)
    assert np.max(np.abs(run.energy.residual)) <= 1e-10 * np.max(run.energy.exchanged)


@FEW
@given(cases(), st.floats(-6, 6), st.floats(-6, 6), st.floats(-6, 6))
def test_a_change_of_units_changes_nothing(case, length, force, time):
    """Powers of two, so that no number is rounded on the way: what differs would be a constant that has a unit."""
    units = dict(length=2.0 ** round(4 * length), force=2.0 ** round(4 * force), time=2.0 ** round(2 * time))
    ours, theirs = run_of(case), run_of(case, **units)
    assert ours.outcome == theirs.outcome
    if ours.outcome != fj.Ending.FINISHED:
        return
    # Trajectories with many events may part where rounding decides; the first tenth has few.
    rows = slice(0, ROWS // 10)
    size = np.max(np.abs(ours.displacement[rows]))
    np.testing.assert_allclose(
        theirs.displacement[rows] / units["length"], ours.displacement[rows], rtol=0, atol=1e-9 * size
    )
    np.testing.assert_array_equal(theirs.status[rows], ours.status[rows])


@FEW
@given(cases(constant=True), st.integers(-20, 20))
def test_load_speed_and_motion_scale_together_under_constant_friction(case, power):
    """With constant friction nothing sets a force's size: k times load and belt speed is k times the motion."""
    factor = 2.0**power
    scaled = {**case, "force": case["force"] * factor, "belt_speed": case["belt_speed"] * factor}
    ours, theirs = run_of(case), run_of(scaled)
    assert ours.outcome == theirs.outcome
    if ours.outcome == fj.Ending.FINISHED:
        rows = slice(0, ROWS // 10)
        size = np.max(np.abs(ours.velocity[rows]))
        np.testing.assert_allclose(theirs.velocity[rows] / factor, ours.velocity[rows], rtol=0, atol=1e-9 * size)


@FEW
@given(cases(), st.floats(0.01, 0.1))
def test_a_later_start_of_the_pulse_is_the_same_motion_later(case, wait):
    """From the equilibrium nothing happens until the pulse: the clock's zero is no part of the physics."""
    now, later = scene_of(case), scene_of(case, start=wait)
    try:
        # With as many rows as elsewhere, and the ledger: compiled already.
        first = fj.simulate(now, 0.03, 0.03 / ROWS, energy=True)
    except ValueError:  # no sliding equilibrium
        return
    second = fj.simulate(later, wait + 0.03, (wait + 0.03) / ROWS, energy=True)
    if first.outcome == second.outcome == fj.Ending.FINISHED:
        size = np.max(np.abs(first.displacement))
        np.testing.assert_allclose(second.displacement[-1], first.displacement[-1], rtol=0, atol=1e-6 * size)


@eqx.filter_jit
def chosen(scene, y):
    """What the forces choose in a state: the contact, friction, normal force and slip velocity."""
    mechanics, load = Mechanics(scene), scene.load.force
    contact = physics.status_from_forces(mechanics, load, y)
    return contact, *physics.contact_forces(mechanics, contact, load, y), physics.relative_velocity(mechanics, y)


@eqx.filter_jit
def landed(scene, y):
    return physics.impact(Mechanics(scene), y)


@MANY
@given(cases(sizes=(2, 3, 6)))
def test_the_next_status_is_one_that_its_forces_allow(case):
    """From any state: what is chosen presses, holds within the cone, or is open."""
    with jax.enable_x64(True):
        scene = scene_of(case)
        y = start_of(case)
        contact, friction, force, slip = chosen(scene, y)
        if contact.status == Status.DETACH:
            assert force == 0 and friction == 0
        else:
            normal = normal_of(case)
            assert y[normal] == 0 and y[len(y) // 2 + normal] <= 0 and force >= 0
            assert abs(friction) <= scene.friction.static * force * (1 + 1e-12)
            assert float(friction) * slip <= 0


@MANY
@given(cases(sizes=(2, 3, 6)))
def test_an_impact_never_creates_energy_against_a_belt_at_rest(case):
    """Restitution 0: whatever the coupling of the coordinates, a landing on a belt that stands still takes energy."""
    with jax.enable_x64(True):
        scene = scene_of({**case, "restitution": 0.0, "belt_speed": 0.0})
        y = start_of(case)
        n, normal = len(y) // 2, normal_of(case)
        y[normal], y[n + normal] = 0.0, -abs(y[n + normal])
        after = np.asarray(landed(scene, y))
    mass = case["structure"]["mass"]
    before, behind = y[n:] @ mass @ y[n:], after[n:] @ mass @ after[n:]
    assert after[n + normal] == 0 and behind <= before * (1 + 1e-12)


@settings(max_examples=2, deadline=None, derandomize=True)
@given(st.integers(0, 2**32 - 1))
def test_batch_order_and_blocks_change_nothing(seed):
    """Trajectories of a map in any order, and in jobs of any size, are the same, bit for bit."""
    rng = np.random.default_rng(seed)
    scene = fj.Scene(fj.belt_oscillator(), fj.Coulomb(0.2), 3.0, fj.Pulse(100.0, 1.2))
    values = {"mu": rng.choice([0.1, 0.2, 0.227], 24), "p": rng.uniform(1.0, 3.0, 24)}
    order = rng.permutation(24)

    def run(values, in_a_job=plan.IN_A_JOB):
        with jax.enable_x64(True), pytest.MonkeyPatch.context() as patch:
            patch.setattr(plan, "IN_A_JOB", in_a_job)
            means = engine.RunOptions("", memory=1e9, progress=False)
            return engine.run_to_verdict(scene, plan.TrajectoryList(values), fj.EventExact(), engine.Limits(3.0), means)

    whole = run(values)
    mixed = run({name: column[order] for name, column in values.items()})
    blocks = run(values, in_a_job=7)
    for name in ("verdict", "amplitude", "decided_at", "events", "last_event"):
        expected = getattr(whole, name)
        np.testing.assert_array_equal(getattr(mixed, name), expected[order])
        np.testing.assert_array_equal(getattr(blocks, name), expected)
