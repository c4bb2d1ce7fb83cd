"""Trajectories against the independent oracle, and the three transients of Section 3."""

import os
import signal
import threading

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import fivjax as fj
from fivjax.contact import Status
from fivjax.foundation.compiling import compiled
from fivjax.simulation import trajectory
from fivjax.simulation.rows import IN_A_PART
from tests.helpers import oracle
from tests.helpers.catalogue import LOW_ORDER, QUICK, steady
from tests.helpers.transients import CASES, scene_of


@pytest.mark.parametrize("name", CASES)
def test_every_saved_quantity_agrees_with_the_oracle(name):
    """SciPy's `solve_ivp` with events and restarts, written apart from the package, is the reference."""
    parameters, t1 = CASES[name]
    agrees_with_the_oracle(parameters, t1, 100)


def test_a_run_of_many_rows_agrees_with_the_oracle():
    """It is computed in parts; here the load jumps where two parts meet, twice."""
    border = IN_A_PART * 1e-4
    parameters = {"mu": 0.227, "belt_speed": 1.0, "p": 5.0, "start": border, "duration": border}
    agrees_with_the_oracle(parameters, 0.25, 2500)


def agrees_with_the_oracle(parameters: dict, t1: float, intervals: int) -> None:
    t = np.linspace(0.0, t1, intervals + 1)
    reference = oracle.simulate(oracle.paper_model(**parameters), t1, t, rtol=1e-12)
    run = fj.simulate(scene_of(parameters), t1, t1 / intervals)
    assert run.t[0] == 0 and run.t[-1] == t1 and len(run.t) == intervals + 1
    np.testing.assert_allclose(run.t, t, rtol=1e-12)
    # The reference's tolerance, multiplied through the events.
    np.testing.assert_allclose(run.displacement, reference.q, atol=1e-9 * np.abs(reference.q).max())
    np.testing.assert_allclose(run.velocity, reference.v, atol=1e-9 * np.abs(reference.v).max())
    # On a jump of the load or of the status, the two may show different sides of it.
    jumps = [parameters.get("start", 0.0), parameters.get("start", 0.0) + parameters.get("duration", 0.1)]
    instants = np.array(jumps + [event[0] for event in reference.events])
    clear = np.abs(t[:, None] - instants).min(axis=1) > 1e-9
    np.testing.assert_array_equal(run.status[clear], reference.status[clear])
    np.testing.assert_allclose(run.acceleration[clear], reference.a[clear], atol=1e-8 * np.abs(reference.a).max())
    np.testing.assert_allclose(run.normal_force[clear], reference.N[clear], atol=1e-8 * np.abs(reference.N).max())
    np.testing.assert_allclose(run.friction_force[clear], reference.T[clear], atol=1e-8 * np.abs(reference.N).max())
    assert reference.events, "this case is meant to have contact events"


def test_the_cases_visit_every_status():
    """A comparison that never sticks or detaches would prove little."""
    seen = set()
    for parameters, t1 in CASES.values():
        seen |= set(fj.simulate(scene_of(parameters), t1, t1 / 100).status.tolist())
    assert seen == {Status.STICK, Status.SLIDE, Status.DETACH}


def test_invariants_along_a_run(paper_scene):
    """N ≥ 0, never below the belt, |T| ≤ μN, friction against slip, no creep while sticking, no force while detached."""
    for scene in (paper_scene.replace(p=2.0), paper_scene.replace(belt_speed=0.5, p=1.3)):
        run = fj.simulate(scene, 1.0, 2.5e-4, QUICK)
        rounding = 1e-9 * run.normal_force.max()
        assert run.gap.min() >= 0
        assert run.normal_force.min() >= -rounding
        assert np.all(np.abs(run.friction_force) <= 0.227 * run.normal_force + rounding)
        slide, stick, detach = (run.status == status for status in (Status.SLIDE, Status.STICK, Status.DETACH))
        assert np.all(run.friction_force[slide] * run.slip_velocity[slide] <= 0)
        assert np.all(run.slip_velocity[stick] == 0)
        assert np.all(run.gap[slide | stick] == 0)
        assert np.all(run.normal_force[detach] == 0) and np.all(run.friction_force[detach] == 0)


def test_p_1_19_decays_and_1_20_grows(paper_scene):
    """Fig. 9: the same parameters, a kick of 1.19 dies out and one of 1.20 ends in squeal."""
    quiet = fj.simulate(paper_scene.replace(p=1.19), 12.0, 3e-3, QUICK)
    loud = fj.simulate(paper_scene.replace(p=1.20), 12.0, 3e-3, QUICK)
    end = quiet.t > 11.0
    assert np.abs(quiet.velocity[end, 0]).max() < 0.1
    assert np.abs(loud.velocity[end, 0]).max() > 2.5
    assert set(quiet.status[end]) == {Status.SLIDE}
    assert Status.DETACH in loud.status[end]


def away_from_equilibrium(scene: fj.Scene):
    q = fj.sliding_equilibrium(scene)
    return 1.001 * q, np.zeros_like(q)


def test_mode_coupling_grows_to_a_limit_cycle_with_detachment():
    """Section 3.1: μ = 0.5 at 3 m/s, exponential growth to a limit cycle with harmonics from detachment."""
    scene = fj.Scene(fj.belt_oscillator(), fj.Coulomb(0.5), 3.0, steady())
    run = fj.simulate(scene, 3.0, 1e-3, QUICK, y0=away_from_equilibrium(scene))
    peak = np.abs(run.velocity[:, 0])
    assert peak[run.t < 0.1].max() < 0.05
    assert peak[run.t > 2.0].max() > 3.0
    assert set(run.status[run.t < 0.3]) == {Status.SLIDE}
    assert Status.DETACH in run.status[run.t > 2.0]


def test_negative_slope_grows_to_a_limit_cycle_of_sticking_without_detachment():
    """Section 3.2: friction that falls from 0.2 to 0.1 at 0.5 m/s; sticking is the only nonlinearity."""
    scene = fj.Scene(fj.belt_oscillator(), fj.ExponentialDecay(0.2, 0.1, 0.5), 0.5, steady())
    run = fj.simulate(scene, 8.0, 2e-3, QUICK, y0=away_from_equilibrium(scene))
    late = run.t > 6.0
    assert set(run.status[late]) == {Status.STICK, Status.SLIDE}
    assert np.abs(run.velocity[late, 0]).max() == pytest.approx(0.5, abs=0.03)
    first = np.argmax(run.status == Status.STICK)
    assert np.abs(run.velocity[: first // 2, 0]).max() < 0.3 * np.abs(run.velocity[late, 0]).max()


def test_both_together_grow_exponentially_then_linearly_with_sticking_then_detach():
    """Section 3.3: 0.6 to 0.5 at 0.5 m/s; sticking straightens the growth, detachment ends it."""
    scene = fj.Scene(fj.belt_oscillator(), fj.ExponentialDecay(0.6, 0.5, 0.5), 0.5, steady())
    # Rows a 150th of a period apart: peaks are read to 2e-4 of themselves, what they grow by in half the time to 1 %.
    run = fj.simulate(scene, 3.0, 1e-4, QUICK, y0=away_from_equilibrium(scene))
    stick = run.t[np.argmax(run.status == Status.STICK)]
    detach = run.t[np.argmax(run.status == Status.DETACH)]
    assert 0.1 < stick < detach - 0.2 < 2.0
    # Amplitude per cycle. Exponential growth before sticking: as much in the logarithm in the second half as in the
    # first. Linear growth with sticking: about as much amplitude, where exponential growth would have brought many times.
    x = run.displacement[:, 0] - fj.sliding_equilibrium(scene)[0]

    def amplitude(t):
        return np.abs(x[np.abs(run.t - t) < 1 / 68]).max()

    def growth(begin, end, measure):
        values = [measure(amplitude(t)) for t in (begin, 0.5 * (begin + end), end)]
        return (values[2] - values[1]) / (values[1] - values[0])

    assert growth(0.1, stick - 0.02, np.log) == pytest.approx(1.0, abs=0.05)
    assert growth(0.1, stick - 0.02, float) > 5.0
    # It is straight to 6 %, and read to 1 %.
    assert growth(stick + 0.1, detach - 0.02, float) == pytest.approx(1.0, abs=0.08)
    rate = np.log(amplitude(stick - 0.02) / amplitude(0.1)) / (stick - 0.12)
    assert amplitude(detach) < 0.2 * amplitude(stick) * np.exp(rate * (detach - stick))
    assert np.abs(run.velocity[run.t > 2.5, 0]).max() > 0.6


def test_batch_equals_loop(paper_scene):
    """Rejects a batch in which one trajectory changes another: `vmap` over kicks gives what single runs give."""
    kicks = np.array([1.1, 1.3, 2.0, 3.5])

    def end(p):
        run = fj.simulate(paper_scene.replace(p=p), 0.3, 0.05, LOW_ORDER, derivatives="none")
        return run.displacement, run.status

    with jax.enable_x64(True):
        displacement, status = compiled(jax.vmap(end))(kicks)
    for i, p in enumerate(kicks):
        alone = fj.simulate(paper_scene.replace(p=p), 0.3, 0.05, LOW_ORDER)
        # Vectorised arithmetic is ordered differently; the rounding grows through events.
        np.testing.assert_allclose(displacement[i], alone.displacement, atol=1e-13)
        np.testing.assert_array_equal(status[i], alone.status)


@pytest.mark.slow
def test_derivatives_through_events_agree_forward_reverse_and_with_differences(paper_scene):
    """μ = 0.227, p = 1.3, nine events: the derivative of the state in μ and p, three ways."""

    def end(parameters):
        scene = paper_scene.replace(mu=parameters[0], p=parameters[1])
        return fj.simulate(scene, 0.5, 0.05).displacement[-1, 0]

    with jax.enable_x64(True):
        at = np.array([0.227, 1.3])
        reverse = np.asarray(jax.grad(end)(at))
        forward = np.asarray(jax.jacfwd(end)(at))
        step = 1e-5

        def difference(i, h):
            up, down = at.copy(), at.copy()
            up[i] += h
            down[i] -= h
            return (end(up) - end(down)) / (2 * h)

        richardson = [(4 * difference(i, step) - difference(i, 2 * step)) / 3 for i in range(2)]
    np.testing.assert_allclose(forward, reverse, rtol=1e-10)
    # Differences lose half of the digits to rounding at this step.
    np.testing.assert_allclose(forward, richardson, rtol=1e-6)


def _energies(run) -> jax.Array:
    energy = run.energy
    return jnp.stack([energy.mechanical[-1], energy.work.damping[-1], energy.impact[-1], energy.work.contact[-1]])


@pytest.mark.slow
def test_energies_have_the_derivatives_of_differences(paper_scene):
    """Through twelve events, of which some are impacts."""
    scene = paper_scene.replace(mu=0.22, p=3.0, duration=0.02)
    found = fj.derivatives(_energies, scene, ["mu", "k1"], 0.12, 0.12, energy=True)
    assert found.exist and found.events == 12
    for name, value in (("mu", 0.22), ("k1", 1e5)):
        runs = [fj.simulate(scene.replace(**{name: value * (1 + h)}), 0.12, 0.12, energy=True) for h in (-1e-6, 1e-6)]
        with jax.enable_x64(True):
            ends = [np.array(_energies(run)) for run in runs]
        np.testing.assert_allclose(found[name], (ends[1] - ends[0]) / (2e-6 * value), rtol=1e-6)


@pytest.mark.slow
def test_energies_whose_derivatives_are_not_worked_out_are_not_relied_on(paper_scene):
    """The work of what holds a start on the belt; and the share of landings, by a restitution of 0."""
    held = np.array([1e-4, 0.0, 0.0, float(paper_scene.belt_speed), 0.0, 0.0])
    found = fj.derivatives(_energies, paper_scene, ["belt_speed"], 0.01, 0.01, y0=held, energy=True)
    assert not found.exist and "the work of the impulse that holds a given start" in found.reason
    falling = np.array([0.0, 0.0, 1e-3, 0.0, 0.0, -0.1])
    found = fj.derivatives(_energies, paper_scene, ["restitution"], 0.1, 0.1, y0=falling, energy=True)
    assert not found.exist and "by a restitution of 0" in found.reason


@pytest.mark.slow
def test_functionals_may_be_trees_of_numbers_by_a_parameter_of_several(paper_scene):
    own = paper_scene.structure
    matrices = [np.kron(np.eye(2), np.asarray(matrix)) for matrix in own.matrices[:3]]
    points = [fj.ContactPoint(own.tangential + 3 * k, own.normal + 3 * k) for k in (0, 1)]
    pair = fj.Structure(*matrices, np.tile(own.load_direction, 2), contacts=points)
    scene = fj.Scene(pair, fj.Coulomb(0.2), [1.0, 0.8], fj.Pulse(100.0, 1.3))

    def functional(run):
        return {
            "mu": run.velocity[-1, :2],
            "other": jnp.stack([run.displacement[-1, 0], jnp.nan * run.displacement[-1, 0]]),
        }

    found = fj.derivatives(functional, scene, ["belt_speed", "mu"], 0.01, 0.01)
    assert found["belt_speed"]["mu"].shape == (2, 2) and found["mu"]["mu"].shape == (2,)
    assert np.isnan(found["belt_speed"]["other"]).tolist() == [[False, False], [True, True]]


def test_a_functional_of_energies_is_told_how_to_get_them(paper_scene):
    with pytest.raises(TypeError, match="give `energy=True`"):
        fj.derivatives(_energies, paper_scene, ["mu"], 0.1, 0.1)


def test_the_dataset_of_a_run_says_what_it_is(paper_scene):
    """Units on every variable, and the scene it came from."""
    run = fj.simulate(paper_scene, 0.1, 1e-3)
    dataset = run.to_dataset()
    assert {"displacement", "velocity", "acceleration", "status", "normal_force", "friction_force"} <= set(dataset)
    assert all("units" in dataset[name].attrs for name in dataset)
    assert '"mu": 0.227' in dataset.attrs["scene"]
    assert dataset.attrs["fivjax"]


def test_a_run_says_how_it_ended(paper_scene):
    """Finished, or why not: too fast a vibration between two rows is no endless chatter, and is told apart from it."""
    run = fj.simulate(paper_scene, 0.1, 1e-3)
    assert run.outcome == fj.Ending.FINISHED and run.to_dataset().attrs["outcome"] == "finished"
    fast = fj.simulate(paper_scene.replace(m2=0.53e-6, k2=1e11), 1.0, 0.5)
    assert fast.outcome == fj.Ending.STEP_FAILURE and "dt_save" in fast.meaning
    assert np.all(np.isnan(fast.velocity[-1]))


@pytest.mark.parametrize(
    "method", [QUICK, pytest.param(fj.WhereSwitched(diffrax.Tsit5(), dt=1e-4), marks=pytest.mark.slow)]
)
def test_a_belt_that_would_have_to_pull_is_told_inside_a_transformation(paper_scene, method):
    """Where nothing can be refused, the lanes without a steady sliding to start from say so, and the others go on."""

    def run(scale):
        run = fj.simulate(paper_scene.replace(force=100.0 * scale), 5e-3, 1e-3, method, derivatives="none")
        return run.outcome, run.displacement

    outcome, rows = jax.jit(jax.vmap(run))(np.array([1.0, -1.0]))
    assert outcome.tolist() == [fj.Ending.FINISHED, fj.Ending.NO_EQUILIBRIUM]
    assert np.all(np.isfinite(rows[0])) and np.all(np.isnan(rows[1]))


@pytest.mark.parametrize("derivatives", ["both", "reverse"])
def test_a_run_that_cannot_begin_has_no_derivative_either(paper_scene, derivatives):
    """It was zero, as at a minimum."""

    def speed(force):
        return fj.simulate(paper_scene.replace(force=force), 5e-3, 1e-3, derivatives=derivatives).velocity[-1, 0]

    with jax.enable_x64(True):
        slopes = jax.vmap(jax.grad(speed))(np.array([100.0, -100.0]))
    assert np.isfinite(slopes[0]) and np.isnan(slopes[1])


def test_growth_without_bound_is_a_failure_with_a_name(paper_scene):
    """Rejects a run of Tsit5 with steps far too long that ends at 1e123 m/s and is said to have reached its end."""
    run = fj.simulate(paper_scene, 0.5, 1e-2, fj.WhereSwitched(diffrax.Tsit5(), dt=5e-3))
    assert run.outcome == fj.Ending.UNBOUNDED
    assert "smaller step" in run.meaning
    lost = np.isnan(run.velocity[:, 0])
    assert lost[-1]
    assert not lost[0]
    # Nothing follows the first row that is lost.
    assert np.all(np.diff(lost.astype(int)) >= 0)
    assert np.nanmax(np.abs(run.velocity)) < 1e12


def test_rows_that_are_lost_are_lost_in_all_later_parts(paper_scene):
    run = fj.simulate(paper_scene, 25.0, 1e-2, fj.WhereSwitched(diffrax.Tsit5(), dt=5e-3))
    assert run.outcome == fj.Ending.UNBOUNDED
    lost = np.isnan(run.velocity).all(axis=1)
    assert np.flatnonzero(lost)[0] < IN_A_PART
    assert np.all(np.diff(lost.astype(int)) >= 0) and not lost[0]
    for rows in (run.displacement, run.acceleration, run.normal_force, run.friction_force):
        assert np.all(np.isnan(rows[lost])) and np.all(np.isfinite(rows[~lost]))


def test_a_mass_that_nothing_holds_back_does_not_grow_without_bound():
    """Shows that free fall from rest, without a belt's motion to compare with, is no failure however far it goes."""
    structure = fj.Structure(np.eye(2), np.zeros((2, 2)), np.zeros((2, 2)), [1.0, 1.0], tangential=0, normal=1)
    scene = fj.Scene(structure, fj.Coulomb(0.0), 0.0, fj.ConstantLoad(1.0))
    run = fj.simulate(scene, 1e6, 1e5, LOW_ORDER, y0=([0.0, 1e-9], [0.0, 0.0]))
    assert run.outcome == fj.Ending.FINISHED
    assert run.displacement[-1] == pytest.approx([5e11, 5e11], rel=1e-9)
    # Pushed once, it goes on at 1 m/s; the load in later parts would not explain how far.
    scene = fj.Scene(structure, fj.Coulomb(0.0), 0.0, fj.Pulse(1e-15, p=1e15, duration=1.0))
    run = fj.simulate(scene, 3e6, 1e3, LOW_ORDER, y0=([0.0, 1e-9], [0.0, 0.0]))
    assert run.outcome == fj.Ending.FINISHED
    assert run.displacement[-1] == pytest.approx([3e6 - 0.5] * 2, rel=1e-6)


@pytest.mark.parametrize("seed", range(6))
def test_an_undamped_mass_slides_on_after_it_has_stuck_once(seed):
    """With equal coefficients its slip, harmonic once it has begun at the edge of the friction cone, comes back to zero once a period,
    and only touches it: the margin at which it would stick again is a rounding error, the motion before that is straight."""
    k, m, mu, force = np.random.default_rng(seed).uniform([0.5, 0.5, 0.1, 1.0], [4.0, 4.0, 0.6, 3.0])
    structure = fj.Structure(
        np.diag([m, 1.0]), np.zeros((2, 2)), np.diag([k, 2.0]), [0.0, -1.0], tangential=0, normal=1
    )
    scene = fj.Scene(structure, fj.Coulomb(mu), belt_speed=0.3, load=fj.ConstantLoad(force))
    run = fj.simulate(scene, 60.0, 0.5, y0=([0.0, 0.0], [0.3, 0.0]))
    assert run.meaning == "reached its end"
    rate, edge = np.sqrt(k / m), mu * force / k
    since = run.t - edge / 0.3
    expected = np.where(since < 0, 0.3 * run.t, edge + 0.3 / rate * np.sin(rate * since))
    np.testing.assert_allclose(run.displacement[:, 0], expected, atol=1e-7)


def test_one_program_serves_runs_of_any_length_however_often_they_save(paper_scene, compilations):
    """Also for fixed steps of any length."""
    for method in (None, fj.WhereSwitched(diffrax.Tsit5(), dt=1e-4)):
        fj.simulate(paper_scene, 0.05, 1e-3, method)
        compilations.clear()
        for t1, dt_save in ((0.02, 1e-3), (0.3, 2e-4), (0.4, 5e-2)):
            run = fj.simulate(paper_scene, t1, dt_save, method and fj.WhereSwitched(diffrax.Tsit5(), dt=dt_save / 4))
            assert len(run.t) == round(t1 / dt_save) + 1 and run.t[-1] == t1
        assert compilations == []


def test_an_undeformed_structure_at_rest_is_pressed_a_moment_later():
    """No force is in the contact when the load is put on: it neither lifts off nor lands without end."""
    scene = fj.Scene(fj.belt_oscillator(), fj.Coulomb(0.22), belt_speed=1.0, load=fj.Pulse(100.0, p=1.2))
    run = fj.simulate(scene, 0.05, 0.05, y0=np.zeros(6))
    model = oracle.paper_model(mu=0.22, belt_speed=1.0, p=1.2)
    expected = oracle.propagate(model, 0.05, y0=(np.zeros(3), np.zeros(3)))
    np.testing.assert_allclose(run.displacement[-1], expected.q[-1], atol=1e-9 * np.abs(expected.q[-1]).max())
    np.testing.assert_allclose(run.velocity[-1], expected.v[-1], atol=1e-9 * np.abs(expected.v[-1]).max())


@pytest.mark.parametrize("contacts", [1, 2])
@pytest.mark.parametrize(("mu", "angle"), [(0.05, 1.2), (0.5, -1.2)])
def test_an_undeformed_structure_on_a_belt_at_rest_slips_the_way_it_is_pushed(mu, angle, contacts):
    """The load reaches each contact by an inclined spring: no force is in it at first, then one outside of the cone."""
    inclined = np.array([np.sin(angle), np.cos(angle), -np.cos(angle)])
    stiffness = np.diag([1e4, 2e3, 5e3]) + 5e4 * np.outer(inclined, inclined)
    mass, load = np.diag([1.0, 1.0, 0.5]), np.array([0.0, 0.0, -1.0])
    damping = 2.0 * mass + 2e-4 * stiffness
    matrices = (np.kron(np.eye(contacts), matrix) for matrix in (mass, damping, stiffness))
    points = [fj.ContactPoint(3 * k, 3 * k + 1) for k in range(contacts)]
    structure = fj.Structure(*matrices, np.tile(load, contacts), contacts=points)
    scene = fj.Scene(structure, fj.Coulomb(mu), 0.0, fj.ConstantLoad(100.0))
    run = fj.simulate(scene, 8e-3, 1e-3, y0=np.zeros(6 * contacts))
    assert run.outcome == fj.Ending.FINISHED

    def sliding(_, state):
        """With two coordinates left, friction is in proportion to what presses the contact."""
        x, z, *rates = state
        forces = 100.0 * load - stiffness @ [x, 0.0, z] - damping @ [rates[0], 0.0, rates[1]]
        friction = mu * -forces[1] * np.sign(angle)
        return [*rates, forces[0] + friction, forces[2] / 0.5]

    expected = solve_ivp(sliding, (0.0, 8e-3), np.zeros(4), t_eval=run.t, rtol=1e-11, atol=1e-16).y
    moved = run.displacement.reshape(-1, contacts, 3)[:, :, [0, 2]]
    np.testing.assert_allclose(moved, np.repeat(expected[:2].T[:, None], contacts, axis=1), rtol=1e-8, atol=1e-14)
    assert np.abs(expected[0, -1]) > 1e-4 and np.all(run.status[1:] == Status.SLIDE)


def test_a_run_shorter_than_its_rows_are_apart_has_its_start_and_its_end(paper_scene):
    for t1 in (1e-9, 1e-3):
        assert fj.simulate(paper_scene, t1, 1.0).t.tolist() == [0.0, t1]


def test_what_no_load_presses_stays_where_it_is():
    resting = fj.Scene(fj.belt_oscillator(), fj.Coulomb(0.3), 0.0, fj.Pulse(100.0, 0.0, duration=0.01))
    run = fj.simulate(resting, 0.02, 1e-3, y0=np.zeros(6))
    assert run.outcome == fj.Ending.FINISHED and np.all(run.status == Status.STICK)
    assert np.all(run.displacement[:11] == 0) and run.displacement[-1, 1] < -1e-5


def test_a_batch_of_trajectories_is_refused_where_one_is_asked_for(paper_scene):
    """As `jax.vmap` makes it. Rejects indexing its first axis as if it were time."""
    with jax.enable_x64(True):
        runs = jax.vmap(lambda p: fj.simulate(paper_scene.replace(p=p), 0.02, 0.01))(np.array([1.0, 1.2, 1.4]))
    one = fj.simulate(paper_scene.replace(p=1.2), 0.02, 0.01)
    asked = [lambda: runs.gap, lambda: runs.slip_velocity, lambda: runs.meaning, runs.to_dataset]
    asked += [lambda: fj.plot.response(runs), lambda: fj.energy_per_cycle(runs)]
    for ask in asked:
        with pytest.raises(ValueError, match=r"here is a batch of shape \(3,\)"):
            ask()
    np.testing.assert_array_equal(jax.tree.map(lambda x: x[1], runs).gap, one.gap)
    np.testing.assert_array_equal(np.asarray(jax.vmap(lambda run: run.displacement)(runs))[1], one.displacement)


def test_a_motion_fades_to_nothing_and_the_run_goes_on():
    """Until its numbers lose their digits, and on: what is left of it after 2,000 s of exp(-t) is less than any number."""
    structure = fj.Structure(np.eye(2), np.diag([2.0, 0.0]), 10.0 * np.eye(2), [0.0, -1.0], tangential=0, normal=1)
    scene = fj.Scene(structure, fj.Coulomb(0.0), 1.0, fj.ConstantLoad(100.0))
    run = fj.simulate(scene, 2000.0, 50.0, y0=[0.01, 0.0, 0.0, 0.0])
    assert run.meaning == "reached its end"
    decay = np.exp(-run.t) * (np.cos(3 * run.t) + np.sin(3 * run.t) / 3)
    np.testing.assert_allclose(run.displacement[:13, 0], 0.01 * decay[:13], rtol=1e-9)
    assert np.all(np.abs(run.displacement[15:, 0]) < 1e-300)


def test_a_long_run_obeys_ctrl_c(paper_scene, monkeypatch):
    """It is inside compiled code, where Python handles no signal."""
    inside, ends = threading.Event(), threading.Event()

    def compiled_code(*_):
        # The main thread could not handle a signal in here.
        assert threading.current_thread() is not threading.main_thread()
        inside.set()
        ends.wait(60)

    monkeypatch.setattr(trajectory, "rows_by_kernel", compiled_code)
    threading.Thread(target=lambda: inside.wait(60) and os.kill(os.getpid(), signal.SIGINT)).start()
    with pytest.raises(KeyboardInterrupt):
        fj.simulate(paper_scene, 10.0)
    assert not ends.is_set()
    ends.set()


def test_steps_of_no_length_are_refused(paper_scene):
    """They would take weeks."""
    with pytest.raises(ValueError, match=r"has steps of 1e-14 s, of which 1e\+10 lie between two saved rows"):
        fj.simulate(paper_scene, 1.0, method=fj.EventExact(dt=1e-14))
    # Not where there are few, because the run ends long before the next saved row.
    assert len(fj.simulate(paper_scene, 1e-3, 1e9, fj.EventExact(dt=1e-4)).t) == 2
