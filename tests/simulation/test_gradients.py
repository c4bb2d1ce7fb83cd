"""Derivatives through contact against differences and closed forms; where there is none, that the result says so.

The whole table, reverse mode included, is printed by `python -m benchmarks.gradients`.
"""

import math
import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg

import fivjax as fj
from tests.helpers import derivative_cases as cases
from tests.helpers.gradient_reference import point_mass

# As exact as the default, in more steps, of which short motions need few: it compiles in half the time.
FEW = fj.EventExact(order=8)
# One functional, one parameter and one end for each number of coordinates, and structures, friction and loads of one kind:
# so they share what is compiled.
END = {2: 4.0, 3: 2.5}


def steady(force: float) -> fj.Pulse:
    """A load that does not change."""
    return fj.Pulse(force, 1.0, start=100.0)


def structure(stiffness, mass=None, damping=None, load_direction=None) -> fj.Structure:
    """Coordinates of which the first is along the belt and the last away from it; pressed on along the last."""
    n = len(stiffness)
    mass, damping = np.eye(n) if mass is None else mass, np.zeros((n, n)) if damping is None else damping
    load_direction = -np.eye(n)[-1] if load_direction is None else load_direction
    return fj.Structure(mass, damping, stiffness, load_direction, tangential=0, normal=n - 1)


def test_state_in_all_parameters_through_nine_events():
    """Wrong if an event time, a jump of the load or a status is left out of the derivative."""
    changes, t1 = cases.CASES["v = 3, p = 1.3, 0.5 s"]
    found, forward = cases.jacobian(cases.paper(**changes), t1)
    expected, _ = cases.differences(cases.paper(**changes), t1)
    assert found.events == 9
    assert found.exist
    # What extrapolated differences of a state computed to 1e-13 are good for.
    assert cases.relative(forward, expected).max() < 1e-6


def test_bouncing_mass_and_stick_slip_block_forward():
    """Rounding alone is allowed between the solver's derivative and that of the closed form."""
    for _, found, expected in cases.closed_forms("forward", FEW):
        assert cases.relative(found, expected).max() < 1e-10


@pytest.mark.parametrize("mode", ["forward", "reverse"])
def test_slip_that_a_jump_of_the_load_begins(mode):
    """A mass held on the belt by a raised load, until that falls: it slips from the jump on, whose instant depends on nothing."""
    stiffness, mu, force, speed, jump, end = 4.0, 0.3, 2.0, 0.5, 0.6, 1.1

    def simulated(values):
        belt, load = values["belt_speed"], fj.Pulse(values["force"], 3.0, duration=jump)
        scene = fj.Scene(point_mass(stiffness), fj.Coulomb(values["mu"]), belt, load)
        run = fj.simulate(scene, end, end, FEW, y0=jnp.stack([0.0 * belt, 0.0 * belt, belt, 0.0 * belt]))
        return jnp.stack([run.displacement[-1, 0], run.velocity[-1, 0]])

    def closed(values):
        rate, t = jnp.sqrt(stiffness), end - jump
        held = values["mu"] * values["force"] / stiffness
        apart, swing = values["belt_speed"] * jump - held, values["belt_speed"] / rate
        along = held + apart * jnp.cos(rate * t) + swing * jnp.sin(rate * t)
        return jnp.stack([along, values["belt_speed"] * jnp.cos(rate * t) - apart * rate * jnp.sin(rate * t)])

    with jax.enable_x64(True):
        values = {"mu": jnp.asarray(mu), "force": jnp.asarray(force), "belt_speed": jnp.asarray(speed)}
        jacobian = jax.jacfwd if mode == "forward" else jax.jacrev

        # Value and derivatives in one program each: without `jit` every operation would be compiled by itself.
        def both(function, jacobian):
            return jax.jit(lambda values: (function(values), jacobian(function)(values)))(values)

        (here, found), (there, expected) = both(simulated, jacobian), both(closed, jax.jacfwd)
        np.testing.assert_allclose(here, there, rtol=1e-12)
    for name in values:
        np.testing.assert_allclose(found[name], expected[name], rtol=1e-10, atol=1e-10)


@pytest.mark.slow
def test_second_derivatives_through_the_onset_of_slip():
    """Wrong if the tangents of an event's instant are taken for constants."""
    stiffness, force, end = 4.0, 2.0, 1.1

    def simulated(values):
        mu, belt = values
        scene = fj.Scene(point_mass(stiffness), fj.Coulomb(mu), belt, load=fj.ConstantLoad(force))
        run = fj.simulate(scene, end, end, FEW, y0=jnp.stack([0.0 * belt, 0.0 * belt, belt, 0.0 * belt]))
        return run.displacement[-1, 0]

    def closed(values):
        mu, belt = values
        held, rate = mu * force / stiffness, jnp.sqrt(stiffness)
        return held + belt / rate * jnp.sin(rate * (end - held / belt))

    with jax.enable_x64(True):
        values = jnp.array([0.3, 0.5])
        np.testing.assert_allclose(jax.hessian(simulated)(values), jax.hessian(closed)(values), rtol=1e-9)


def test_a_start_that_sticks_by_the_belt_speed():
    """A faster belt takes a given start along by an impulse. The momentum of what the mass matrix couples to it stays as it is."""
    mass = np.array([[1.0, 0.4, 0.0], [0.4, 2.0, 0.0], [0.0, 0.0, 1.0]])
    own, y0 = structure(np.zeros((3, 3)), mass), np.array([0.0, 0.0, 0.0, 0.5, 0.3, 0.0])

    def end(belt):
        run = fj.simulate(fj.Scene(own, fj.Coulomb(0.3), belt, steady(1.0)), 2.0, 2.0, FEW, y0=y0)
        return jnp.concatenate([run.displacement[-1], run.velocity[-1]])

    with jax.enable_x64(True):
        slope = jax.jit(jax.jacfwd(end))(0.5)
    np.testing.assert_allclose(slope, [2.0, -0.4, 0.0, 1.0, -0.2, 0.0], atol=1e-12)


def test_bouncing_mass_reverse():
    """In reverse mode a stretch may use only what it is given, and a step worked out elsewhere is refused by JAX."""
    _, found, expected = next(cases.closed_forms("reverse", FEW))
    assert cases.relative(found, expected).max() < 1e-10


@pytest.mark.slow
def test_a_step_that_is_told_takes_part_in_reverse_mode():
    """The steps of `WhereSwitched` are an array, so that not every step is compiled: of the same rounding in both modes."""
    scene, method = cases.paper(p=1.3, start=0.0), fj.WhereSwitched(dt=1e-5)
    found = [
        fj.derivatives(cases.last_state, scene, ["mu", "k1"], 0.02, 0.01, mode=mode, method=method)
        for mode in ("forward", "reverse")
    ]
    for name in ("mu", "k1"):
        np.testing.assert_allclose(found[0][name], found[1][name], rtol=1e-10)


@pytest.mark.slow
def test_reverse_equals_forward_in_the_table():
    """Both modes through up to 35 events, sticking included: one transposed wrong would differ in the first digits."""
    for changes, t1 in cases.CASES.values():
        scene = cases.paper(**changes)
        found, forward = cases.jacobian(scene, t1)
        assert found.exist
        _, reverse = cases.jacobian(scene, t1, "reverse")
        expected, _ = cases.differences(scene, t1)
        assert cases.relative(reverse, forward).max() < 1e-10
        assert cases.relative(forward, expected).max() < 1e-6


@pytest.mark.slow
def test_bouncing_mass_and_stick_slip_block_reverse():
    for _, found, expected in cases.closed_forms("reverse"):
        assert cases.relative(found, expected).max() < 1e-10


@pytest.mark.slow
def test_energy_in_reverse_and_a_run_that_may_be_differentiated_both_ways():
    """The ledger's own derivative takes part in that of a span; JAX's loop without `derivatives` says the same."""
    scene = cases.paper(p=1.3, start=0.0)
    with jax.enable_x64(True):

        def loss(mu, derivatives):
            run = fj.simulate(scene.replace(mu=mu), 0.3, 0.01, energy=True, derivatives=derivatives)
            return run.energy.work.damping[-1] + run.energy.impact[-1] + jnp.sum(run.velocity[:, 0] ** 2)

        forward = jax.jvp(lambda mu: loss(mu, "forward"), (0.227,), (1.0,))[1]
        reverse = jax.grad(lambda mu: loss(mu, "reverse"))(0.227)
        both = jax.grad(lambda mu: loss(mu, "both"))(0.227)
    assert float(reverse) == pytest.approx(float(forward), rel=1e-10)
    assert float(both) == pytest.approx(float(forward), rel=1e-10)


@pytest.mark.slow
def test_the_end_of_a_kick_on_a_saved_instant():
    """A step of no length between the saved instant and the jump of the load must pass the derivative on, not lose it."""
    with jax.enable_x64(True):

        def speed(duration, dt_save):
            scene = cases.paper(p=1.05, start=0.0, duration=duration)
            return fj.simulate(scene, 0.15, dt_save).velocity[-1, 0]

        on_it, between = (jax.jvp(lambda x, dt=dt: speed(x, dt), (0.1,), (1.0,))[1] for dt in (0.05, 0.15))
    assert float(on_it) == pytest.approx(float(between), rel=1e-9)


def existing(scene, y0) -> fj.Derivatives:
    t1 = END[scene.structure.size]
    return fj.derivatives(cases.last_state, scene, ["force"], t1, t1, y0=y0, method=FEW)


@pytest.mark.parametrize(("touch", "exist"), [(1e-9, False), (-1e-9, False), (0.3, True), (-0.3, True)])
def test_a_graze_is_said_to_have_no_derivative(touch, exist):
    """A gap q = F + (h - F) cos t with a lifting load F comes down to 2F - h: just above or just below the belt, the
    velocity after it turns by twice itself with the next digit of F."""
    lifted = structure(np.eye(2), load_direction=[0.0, 1.0])
    scene = fj.Scene(lifted, fj.Coulomb(0.0), 0.0, steady(0.5 * (1.0 + touch)), restitution=1.0)
    d = existing(scene, ([0.0, 1.0], [0.0, 0.0]))
    assert d.exist is exist
    assert d.events == (1 if touch < 0 else 0)
    assert "the gap closing" in d.reason
    lift = 0.5 * (1.0 + touch)
    assert d.closest_at == pytest.approx(np.arccos(max(-lift / (1.0 - lift), -1.0)), abs=0.05)


@pytest.mark.parametrize(("late", "exist"), [(1e-9, False), (-1e-9, False), (0.1, True), (-0.1, True)])
def test_two_events_that_swap_order_have_no_derivative(late, exist):
    """N = 1 + 2 cos t runs out at 2π/3, the slip 1 - r cos(t - b) at that instant or a moment beside it: the next digit
    of either decides which of the two happens."""
    # A mass along the belt, and another above it that presses by a spring: N swings on its own.
    stiffness = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, -1.0], [0.0, -1.0, 1.0]])
    pressed = structure(stiffness, load_direction=[0.0, -1.0, 0.0])
    scene = fj.Scene(pressed, fj.Coulomb(0.0, 0.0), 1.0, steady(1.0))
    # x = r sin(t - b), whose speed has grown to that of the belt at this instant.
    r, ends = 1.5, 2 * np.pi / 3 + late
    b = ends + np.arccos(1 / r)
    d = existing(scene, ([-r * np.sin(b), -3.0, 0.0], [r * np.cos(b), 0.0, 0.0]))
    assert d.exist is exist, d.reason


@pytest.mark.parametrize(("late", "exist"), [(1e-10, False), (-1e-10, False), (0.1, True), (-0.1, True)])
def test_an_event_on_a_jump_of_the_load_has_no_derivative(late, exist):
    """A mass falls onto the belt at the instant at which the load jumps: it lands under the one load or the other."""
    load = fj.Pulse(1.0, 2.0, start=np.sqrt(2.0) + late, duration=10.0)
    scene = fj.Scene(structure(np.zeros((2, 2))), fj.Coulomb(0.0), 0.0, load, restitution=1.0)
    d = existing(scene, ([0.0, 1.0], [0.0, 0.0]))
    assert d.exist is exist, d.reason


@pytest.mark.parametrize(("begin", "exist"), [(3.0 - 1e-9, False), (3.0 + 1e-9, False), (2.7, True), (3.3, True)])
def test_rest_at_the_edge_of_the_friction_cone_has_no_derivative(begin, exist):
    """A block that swings about μN/k = 1 turns at 2 - x₀ = -1: where friction just holds it, or just does not."""
    scene = fj.Scene(structure(np.diag([1.0, 0.0])), fj.Coulomb(1.0), 0.0, steady(1.0))
    d = existing(scene, ([begin, 0.0], [0.0, 0.0]))
    assert d.exist is exist, d.reason
    if begin == 3.0 - 1e-9:
        assert "either sticks or slips back" in d.reason


@pytest.mark.parametrize(("late", "exist"), [(1e-10, False), (0.1, True)])
def test_an_event_at_the_very_end_has_no_derivative(late, exist):
    """The last row is before the impact, or after it."""
    scene = fj.Scene(structure(np.diag([1.0, 0.0])), fj.Coulomb(0.0), 0.0, steady(1.0), restitution=0.5)
    height = 0.5 * (END[2] - late) ** 2
    assert existing(scene, ([0.0, height], [0.0, 0.0])).exist is exist


def test_quiet_motion_has_derivatives_and_says_so():
    """The paper's oscillator, all of it a hundred times as slow: in few steps."""
    paper = cases.paper()
    mass, damping, stiffness, load_direction = map(np.asarray, paper.structure.matrices)
    slow = structure(1e-4 * stiffness, mass, 1e-2 * damping, load_direction)
    scene = fj.Scene(slow, fj.Coulomb(0.227, 0.227), 0.03, steady(1e-2))
    d = existing(scene, (fj.sliding_equilibrium(paper), np.zeros(3)))
    assert d.exist and d.events == 0


def test_a_mode_at_rest_is_differentiated_in_steps_of_its_own():
    """The block rides the belt, a straight line that any step follows; the mass above it rests, and answers more load by a vibration.

    The closed form is the step response of that mass alone. One row is saved: the steps in between are the method's.
    """
    matrices = fj.belt_oscillator(m1=0.9, m2=0.1, c1=0.0, c2=0.1, k1=1.0, k2=1.0, theta=0.0).matrices
    mass, damping, stiffness, load_direction = map(np.asarray, matrices)
    level = structure(stiffness, mass, damping, load_direction)
    scene = fj.Scene(level, fj.Coulomb(0.5, mu_static=1.0), belt_speed=0.2, load=steady(1.0))
    d = existing(scene, ([-0.4, -1.0, 0.0], [0.2, 0.0, 0.0]))
    rates = np.array([[0.0, 1.0], [-1.0 / 0.9, -0.1 / 0.9]])
    answer = np.linalg.solve(rates, (scipy.linalg.expm(END[3] * rates) - np.eye(2)) @ [0.0, -1.0 / 0.9])
    np.testing.assert_allclose(d["force"], [0.0, answer[0], 0.0, 0.0, answer[1], 0.0], rtol=0, atol=1e-12)


def test_a_run_that_did_not_reach_its_end_has_no_derivatives():
    """Too few rows for the steps in between: the value is not finite, and a derivative of zero would be false.

    The mass slides where it stays, in one step for the motion and in thousands for what deviates from it.
    """
    stiffness = 1e6
    scene = fj.Scene(structure(np.diag([stiffness, 0.0])), fj.Coulomb(0.2), 1.0, steady(1.0))
    d = existing(scene, ([0.2 / stiffness, 0.0], [0.0, 0.0]))
    assert not d.exist and np.all(np.isnan(d["force"])) and "not finite" in d.reason


@pytest.mark.parametrize(
    ("options", "error", "fragments"),
    [
        (dict(functional=3), TypeError, ["`functional`", "3"]),
        (dict(functional=lambda run: float(run.t[-1])), TypeError, ["`functional`", "while it is traced", "`float`"]),
        (dict(functional=lambda run: run.status[-1]), TypeError, ["`functional`", "real numbers", "`status`"]),
        (dict(functional=lambda run: None), TypeError, ["`functional`", "real numbers", "None"]),
        (dict(wrt="mu"), TypeError, ["`wrt`", "'mu'"]),
        (dict(wrt=["muu"]), ValueError, ["`wrt`", "'muu'", "belt_speed"]),
        (dict(wrt=[]), ValueError, ["`wrt`", "is empty"]),
        (dict(mode="backward"), ValueError, ["`mode`", "forward", "reverse"]),
        (dict(margin=-1.0), ValueError, ["`margin`", "-1"]),
        (dict(t1=0.0), ValueError, ["`t1`", "positive"]),
        (dict(method="exact"), TypeError, ["`method`", "EventExact()"]),
    ],
)
def test_refusals(options, error, fragments):
    """Refused before anything compiles, by name."""
    given = {"functional": lambda run: run.velocity[-1, 0], "scene": cases.paper(), "wrt": ["mu"], **options}
    with pytest.raises(error) as refusal:
        fj.derivatives(**given)
    for fragment in fragments:
        assert fragment in str(refusal.value)


@pytest.mark.parametrize(
    ("functional", "said"),
    [
        (lambda run: (run.velocity[-1, 0],), r"value -?\d.*; d/d mu = -?\d"),
        (lambda run: {"a": run.velocity[-1, 0], "b": run.t}, r"value \(-?\d.*, array of shape \(.*\)\); d/d mu = \("),
    ],
)
def test_derivatives_of_several_numbers_are_printed(functional, said):
    assert re.match(said, repr(fj.derivatives(functional, cases.paper(), ["mu"], 1e-3)))


def test_an_order_beyond_the_factorials_has_steps():
    """The factorial of 171 is no number of double precision; an error of the series is as far away as Stirling has it."""
    angles = [fj.EventExact(order=order)._angle(np.float64) for order in (20, 100, 168, 200)]
    tolerance = (angles[0] ** 21) / math.factorial(21)
    for order, angle in zip((100, 168), angles[1:], strict=False):
        assert angle == pytest.approx((tolerance * math.factorial(order + 1)) ** (1 / (order + 1)), rel=1e-10)
    stirling = 201 / math.e * (tolerance * math.sqrt(2 * math.pi * 201)) ** (1 / 201)
    assert angles[-1] == pytest.approx(stirling, rel=1e-5)


@pytest.mark.slow
def test_a_structure_of_ones_own_takes_part():
    """Parameters of a builder that is not fivjax's are parameters like any other: as in the closed forms above, by `derivatives`."""
    scene = fj.Scene(point_mass(1.0, 0.1), fj.Coulomb(0.2), 1.0, fj.ConstantLoad(1.0))
    start = ([0.0, 0.0], [0.5, 0.0])
    d = fj.derivatives(cases.last_state, scene, ["stiffness", "damping"], 1.0, 1.0, y0=start, method=FEW)
    assert d.exist and all(np.all(np.isfinite(d[name])) for name in ("stiffness", "damping"))
    assert jnp.shape(d["damping"]) == (4,)
    # Slips towards rest about F μ / k; more stiffness holds it back.
    assert d["stiffness"][0] < 0 and d["damping"][0] < 0
