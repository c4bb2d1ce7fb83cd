"""Both steppers against closed forms, against each other, and in a plain `diffrax.diffeqsolve`."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import fivjax as fj
from fivjax.contact import Contact, Mechanics, Status, status_from_forces
from fivjax.foundation.compiling import compiled
from fivjax.section.about_sliding import mechanics_about_sliding
from fivjax.steppers.core import follow
from tests.helpers import oracle
from tests.helpers.catalogue import LOW_ORDER

# Each is compiled anew.
RUNGE_KUTTA = [diffrax.Heun]
RUNGE_KUTTA += [
    pytest.param(solver, marks=pytest.mark.slow)
    for solver in (diffrax.Midpoint, diffrax.Ralston, diffrax.Bosh3, diffrax.Dopri5, diffrax.Tsit5, diffrax.Dopri8)
]


def point_mass(mu=0.0, mu_static=None, stiffness=1.0, belt_speed=0.0, force=1.0, restitution=0.0) -> fj.Scene:
    """One unit mass with a spring along the belt, pressed on by a load."""
    structure = fj.Structure(
        mass=np.eye(2),
        damping=np.zeros((2, 2)),
        stiffness=np.diag([stiffness, 0.0]),
        load_direction=[0.0, -1.0],
        tangential=0,
        normal=1,
    )
    # One kind of friction for all, so that they share what is compiled.
    friction = fj.Coulomb(mu, mu if mu_static is None else mu_static)
    return fj.Scene(structure, friction, belt_speed, fj.ConstantLoad(force), restitution=restitution)


@compiled
def begun(scene, y):
    mechanics, load = Mechanics(scene), scene.load(0.0)
    return mechanics, load, status_from_forces(mechanics, load, y)


@compiled
def advanced(method, mechanics, contact, load, y, h):
    return method.advance(mechanics, contact, load, y, h)


def events(scene: fj.Scene, y0, t1: float, method=None) -> list[tuple[float, int]]:
    """(time, new status) of every status change, from the stepper's own advances."""
    method = method or fj.EventExact()
    with jax.enable_x64(True):
        y = jnp.asarray(y0, float)
        mechanics, load, contact = begun(scene, y)
        t, seen = 0.0, []
        while t < t1:
            after = advanced(method, mechanics, contact, load, y, jnp.asarray(t1 - t))
            t += float(after.h)
            if int(after.contact.status) != int(contact.status):
                seen.append((t, int(after.contact.status)))
            y, contact = after.y, after.contact
    return seen


def test_stick_slip_period_of_a_block_with_two_friction_forces():
    """t_stick = 2Δ/(kv) and t_slip = (2/ω)(π - arctan(Δω/(kv))): wrong if an event is late or the status after it is."""
    v, delta = 0.2, 0.5
    scene = point_mass(mu=0.5, mu_static=1.0, belt_speed=v)
    seen = events(scene, [1.0, 0.0, v, 0.0], 40.0)
    ends = [t for t, status in seen if status == Status.SLIDE]
    begins = [t for t, status in seen if status == Status.STICK]
    stick, slip = 2 * delta / v, 2 * (np.pi - np.arctan(delta / v))
    # Rounding of times near 40 s, through four periods.
    np.testing.assert_allclose(np.diff(ends), stick + slip, atol=1e-12)
    np.testing.assert_allclose(np.array(begins) - np.array(ends[: len(begins)]), slip, atol=1e-12)
    assert stick + slip == pytest.approx(8.902605408, abs=1e-9)


def test_oscillator_with_coulomb_friction_comes_to_rest_where_it_should():
    """Each half period takes 2μN/k off the amplitude; the mass stays where the spring can no longer move it."""
    scene = point_mass(mu=1.0)
    run = fj.simulate(scene, 30.0, 0.01, y0=([12.0, 0.0], [6.0, 0.0]))
    peak = np.hypot(13.0, 6.0) - 1.0
    assert run.displacement[:, 0].max() == pytest.approx(peak, abs=1e-4)  # the peak lies between saved instants
    assert run.displacement[-1, 0] == pytest.approx(14.0 - peak, abs=1e-12)
    assert run.status[-1] == Status.STICK
    at_rest = [t for t, status in events(scene, [12.0, 0.0, 6.0, 0.0], 30.0) if status == Status.STICK]
    assert at_rest[-1] == pytest.approx(np.arctan2(6.0, 13.0) + 7 * np.pi, abs=1e-12)


def test_bouncing_mass_comes_to_rest_after_endless_bounces():
    """At rest after √(2h/g)(1+e)/(1-e), never below the floor: the sum of a geometric series of bounces."""
    scene = point_mass(force=9.81, restitution=0.5, stiffness=0.0)
    run = fj.simulate(scene, 2.0, 0.001, y0=([0.0, 1.0], [0.0, 0.0]))
    assert run.gap.min() >= 0
    rest = np.sqrt(2 / 9.81) * 1.5 / 0.5
    touching = [t for t, status in events(scene, [0.0, 1.0, 0.0, 0.0], 2.0) if status != Status.DETACH]
    # Bounces below a millionth of the first are not followed, which ends the series that much early.
    assert touching[0] == pytest.approx(rest, abs=1e-6)
    assert np.all(run.gap[run.t > rest] == 0)
    assert np.all(run.normal_force[run.t > rest] == pytest.approx(9.81))


@pytest.mark.slow
def test_where_switched_meets_the_closed_forms_to_first_order():
    """Halving the step halves the error in the resting place and the stick–slip state, and nothing stays below the floor."""
    errors = []
    for dt in (2e-3, 1e-3, 5e-4):
        run = fj.simulate(point_mass(mu=1.0), 30.0, 0.5, fj.WhereSwitched(dt=dt), y0=([12.0, 0.0], [6.0, 0.0]))
        errors.append(abs(run.displacement[-1, 0] - (15.0 - np.hypot(13.0, 6.0))))
        bounce = fj.simulate(
            point_mass(force=9.81, restitution=0.5, stiffness=0.0),
            2.0,
            0.01,
            fj.WhereSwitched(dt=dt),
            y0=([0.0, 1.0], [0.0, 0.0]),
        )
        assert bounce.gap.min() >= 0
        assert np.all(bounce.gap[bounce.t > 1.4] == 0)
    assert errors[-1] < 2 * 5e-4
    assert errors[-1] < errors[0]


@pytest.mark.parametrize("solver", RUNGE_KUTTA, ids=lambda solver: solver.__name__)
def test_where_switched_has_the_order_of_its_solver_while_the_status_lasts(solver, paper_scene):
    """Within one status the wrapped Runge–Kutta method must keep its order: the field it integrates is smooth."""
    scene = paper_scene.replace(p=1.05)
    exact = oracle.propagate(oracle.paper_model(mu=0.227, belt_speed=3.0, p=1.05), 0.05, np.array([0.0, 0.05]))
    order = solver().order(None)
    # Coarse enough that the error of the best of them stands clear of rounding.
    steps = {2: [100, 200], 3: [100, 200], 5: [40, 80], 8: [8, 16]}[order]
    errors = []
    for count in steps:
        run = fj.simulate(scene, 0.05, 0.05, fj.WhereSwitched(solver(), dt=0.05 / count))
        assert set(run.status) == {Status.SLIDE}
        errors.append(np.abs(run.velocity[-1] - exact.v[-1]).max())
    observed = np.log2(errors[0] / errors[1])
    assert observed > order - 0.4


def test_where_switched_error_falls_in_proportion_to_the_step_after_events(paper_scene):
    """First order after events, as its documentation says: not worse, and not silently something else."""
    scene = paper_scene.replace(p=1.3)
    exact = fj.simulate(scene, 0.5, 0.5)
    # Compiled for up to 256 steps from row to row, and up to 4096.
    steps = [2e-4, 1e-4, 5e-5, 2.5e-5, 1.25e-5]
    errors = [
        np.abs(fj.simulate(scene, 0.5, 0.05, fj.WhereSwitched(dt=dt)).velocity[-1] - exact.velocity[-1]).max()
        for dt in steps
    ]
    slope = np.polyfit(np.log(steps), np.log(errors), 1)[0]
    # The phase of events within steps scatters the errors about the trend.
    assert 0.6 < slope < 1.6
    assert errors[-1] < 2e-4


def test_plain_diffeqsolve_gives_what_simulate_gives(paper_scene):
    """A stepper is a diffrax solver: the scene in `args`, the status in the solver state, dense output inside steps."""
    scene, method = paper_scene.replace(p=1.3), fj.WhereSwitched(dt=1e-4)
    run = fj.simulate(scene, 0.5, 1e-4, method)
    with jax.enable_x64(True):
        solution = diffrax.diffeqsolve(
            diffrax.ODETerm(fj.vector_field),
            method,
            0.0,
            0.5,
            None,
            jnp.concatenate([run.displacement[0], run.velocity[0]]),
            args=scene,
            stepsize_controller=diffrax.StepTo(jnp.asarray(run.t)),
            saveat=diffrax.SaveAt(ts=jnp.asarray(run.t[::100])),
            max_steps=10_000,
        )
    ys = np.asarray(solution.ys)
    assert solution.result == diffrax.RESULTS.successful
    # The same steps in the same order; interpolation at their ends rounds.
    np.testing.assert_allclose(ys[:, :3], run.displacement[::100], atol=1e-13)
    np.testing.assert_allclose(ys[:, 3:], run.velocity[::100], atol=1e-10)


@pytest.mark.slow
def test_a_first_step_over_a_jump_of_the_load_begins_in_the_mode_before_it():
    """It sticks until the load has fallen to a quarter. In the middle of the step it could not."""
    structure = fj.Structure(np.eye(2), np.zeros((2, 2)), np.eye(2), [0.0, -1.0], tangential=0, normal=1)
    scene = fj.Scene(structure, fj.Coulomb(0.25, 0.5), 0.1, fj.Pulse(0.5, p=4.0, duration=0.3))
    y0 = np.array([0.9, 0.0, 0.1, 0.0])
    run = fj.simulate(scene, 1.0, 0.25, LOW_ORDER, y0=y0)
    assert run.status.tolist()[:3] == [0, 0, 1]
    with jax.enable_x64(True):
        term = diffrax.ODETerm(fj.vector_field)
        solution = diffrax.diffeqsolve(term, LOW_ORDER, 0.0, 1.0, 1.0, jnp.asarray(y0), args=scene)
    np.testing.assert_allclose(solution.ys[-1, :2], run.displacement[-1], atol=1e-10)


@pytest.mark.slow
def test_event_exact_interpolates_through_events_inside_a_step(paper_scene):
    """The other stepper is one too, and its dense output as exact as the step, also with several events inside one, and with a
    jump of the load.
    """
    scene = paper_scene.replace(p=2.0, duration=0.1234)
    run = fj.simulate(scene, 0.3, 0.3 / 63, LOW_ORDER)
    with jax.enable_x64(True):
        solution = diffrax.diffeqsolve(
            diffrax.ODETerm(fj.vector_field),
            LOW_ORDER,
            0.0,
            0.3,
            None,
            jnp.concatenate([run.displacement[0], run.velocity[0]]),
            args=scene,
            stepsize_controller=diffrax.StepTo(jnp.array([0.0, 0.1, 0.2, 0.3])),
            saveat=diffrax.SaveAt(ts=jnp.asarray(run.t), dense=True),
        )
        dense = jax.jit(jax.vmap(solution.evaluate))(jnp.asarray(run.t[1:]))
    assert np.count_nonzero(np.diff(run.status)) > 15
    # Rounding, multiplied by the growth of differences through some thirty events.
    ys = np.asarray(solution.ys)
    assert solution.result == diffrax.RESULTS.successful
    np.testing.assert_allclose(ys[:, :3], run.displacement, atol=1e-13)
    np.testing.assert_allclose(ys[:, 3:], run.velocity, atol=1e-10)
    np.testing.assert_allclose(dense, ys[1:], atol=1e-14)


@pytest.mark.parametrize(
    ("change", "kind", "sentence"),
    [
        ({"args": None}, TypeError, "Argument `args` must be the scene"),
        ({"double": False}, TypeError, "Turn on double precision around the call"),
        ({"terms": diffrax.ODETerm(lambda t, y, args: -y)}, ValueError, "a stepper knows of no other motion"),
        ({"t1": -0.1, "dt0": -0.05}, RuntimeError, "friction has no way back in time"),
    ],
    ids=["scene", "precision", "term", "time"],
)
def test_diffeqsolve_with_a_stepper_is_refused_by_a_sentence(paper_scene, change, kind, sentence):
    given = {
        "terms": diffrax.ODETerm(fj.vector_field),
        "t1": 0.1,
        "dt0": 0.1,
        "args": paper_scene,
        "double": True,
        **change,
    }
    terms, t1, double = (given.pop(name) for name in ("terms", "t1", "double"))
    with jax.enable_x64(double), pytest.raises(kind, match=sentence):
        diffrax.diffeqsolve(terms, fj.WhereSwitched(), 0.0, t1, y0=jnp.zeros(6), **given)


def test_a_grazing_dip_inside_one_advance_is_found():
    """A gap that closes and opens again within one step must be seen, though it is open at both of the step's ends."""
    from fivjax.steppers.guard_roots import march_to_roots

    march = jax.jit(march_to_roots)
    with jax.enable_x64(True):
        for depth in (1e-1, 1e-4, 1e-8, 1e-12):
            # (x - 0.6)² - depth: positive at both ends, two roots in between.
            c = jnp.array([[0.36 - depth], [-1.2], [1.0]])
            x, fires = march(c)
            assert bool(fires[0])
            assert float(x[0]) == pytest.approx(0.6 - np.sqrt(depth), abs=1e-7)
            # And raised by as much, it stays clear: no event.
            c = jnp.array([[0.36 + depth], [-1.2], [1.0]])
            assert not bool(march(c)[1][0])


def test_first_roots_of_random_polynomials_agree_with_all_their_roots():
    """The march must stop at the first real root in [0, 1] and nowhere else; NumPy finds all roots."""
    from fivjax.steppers.guard_roots import march_to_roots

    rng = np.random.default_rng(1)
    coefficients = rng.normal(size=(400, 8)) / np.arange(1, 9)
    coefficients[:, 0] = np.abs(coefficients[:, 0]) + 1e-3
    with jax.enable_x64(True):
        alone = jax.jit(jax.vmap(lambda c: march_to_roots(c[:, None])))
        x, fires = (np.asarray(part)[:, 0] for part in alone(jnp.asarray(coefficients)))
        together = [np.asarray(part) for part in jax.jit(march_to_roots)(jnp.asarray(coefficients[:9].T))]
    # Side by side the first root of all is found, and none before it.
    first = np.argmin(np.where(fires, x, np.inf)[:9])
    assert together[1][first] and together[0][first] == x[first] == np.min(together[0])
    for row, position, fired in zip(coefficients, x, fires, strict=True):
        roots = np.roots(row[::-1])
        real = np.sort(roots[(np.abs(roots.imag) < 1e-9) & (roots.real > 0) & (roots.real < 1)].real)
        assert fired == bool(len(real))
        if fired:
            assert position == pytest.approx(real[0], abs=1e-7)  # NumPy's own accuracy at near-double roots
    assert fires.sum() > 50


def test_the_first_of_several_series_that_begin_at_zero_to_run_out_is_found():
    """As guards do: series of order 20, some of which begin at zero, marched along together. NumPy finds all roots."""
    from fivjax.steppers.guard_roots import march_to_roots

    rng = np.random.default_rng(3)
    c = rng.normal(size=(600, 21, 3)) * rng.uniform(0.5, 3.0, (600, 1, 3)) ** np.arange(21)[:, None]
    c /= np.cumprod(np.maximum(np.arange(21), 1.0))[:, None]
    begins = rng.integers(0, 4, (600, 3))
    c[np.arange(21)[:, None] < begins[:, None]] = 0.0
    lead = np.take_along_axis(c, begins[:, None], axis=1)
    np.put_along_axis(c, begins[:, None], np.abs(lead) + 1e-3, axis=1)
    with jax.enable_x64(True):
        x, fires = map(np.asarray, jax.jit(jax.vmap(march_to_roots))(c))
    found, given_up, none = 0, 0, 0
    for own, first, ends, fired in zip(c, begins, x, fires, strict=True):
        roots = [np.roots(own[k:, g][::-1]) for g, k in enumerate(first)]
        real = [one[(np.abs(one.imag) < 1e-7) & (one.real > 0) & (one.real < 1)].real for one in roots]
        expected = np.array([np.min(one, initial=np.inf) for one in real])
        every = np.concatenate(roots)
        nearly = (np.abs(every.imag) < 1e-5) & (every.real > -1e-6) & (every.real < 1 + 1e-6)
        if np.sum(nearly) > sum(map(len, real)) or np.any(np.abs(every[nearly].real - 1) < 1e-6):
            continue  # a root that hardly is one
        if not np.isfinite(expected).any():
            assert not fired.any() and (ends == 1.0).all()
            none += 1
            continue
        earliest = np.argmin(expected)
        if not fired[np.argmin(ends)]:  # so far there is no root, but the steps were used up
            assert np.min(ends) < expected[earliest]
            given_up += 1
            continue
        assert fired[earliest] and ends[earliest] == pytest.approx(expected[earliest], rel=1e-8)
        assert np.min(ends) == ends[earliest]
        found += 1
    assert found > 200 and none > 20 and given_up < 5


@pytest.mark.parametrize("size", [1e-3, 1e-9, 1e-14])
def test_a_series_next_to_zero_with_its_derivatives_is_left_behind(size):
    """As a gap is that opened an instant ago, by a force that grows: (u³ - b u + a) size³ with x = size u, beside higher terms."""
    from fivjax.steppers.guard_roots import march_to_roots

    with jax.enable_x64(True):
        march = jax.jit(march_to_roots)
        # Rising; dipping, but not to zero; to zero, which is the first root.
        for below, rest in ((-1.0, 1.0), (1.0, 0.4), (1.0, 0.38)):
            c = np.array([rest * size**3, -below * size**2, 0.0, 1.0, -1.5])
            x, fires = march(jnp.asarray(c[:, None]), exact=jnp.array([True]))
            roots = np.roots([-1.5 * size, 1.0, 0.0, -below, rest])
            first = np.min(roots[(np.abs(roots.imag) < 1e-9) & (roots.real > 0)].real) * size
            # Where steps are used up on the way, it has left behind what it began in.
            assert x.item() == pytest.approx(first, rel=1e-9) if fires.item() else 1e6 * size < x.item() < first


def test_only_what_ends_the_advance_stops_the_march_along_others():
    """Velocity that falls through the section is no event: a guard that runs out later is still found."""
    from fivjax.steppers.guard_roots import march_to_roots

    with jax.enable_x64(True):
        # (0.7 - x) (1 - x + x²)³, and 0.3 - x.
        slow = np.polynomial.Polynomial([0.7, -1.0]) * np.polynomial.Polynomial([1.0, -1.0, 1.0]) ** 3
        c = jnp.stack([slow.coef, np.pad([0.3, -1.0], (0, len(slow.coef) - 2))], axis=1)
        late, soon = 0.7, 0.3
        x, fires = jax.jit(march_to_roots)(c, ends=jnp.array([True, False]))
        np.testing.assert_allclose(x, [late, soon], rtol=1e-14)
        assert fires.tolist() == [True, True]
        x, fires = jax.jit(march_to_roots)(c, ends=jnp.array([True, True]))
        assert fires.tolist() == [False, True] and x[1] == pytest.approx(soon, rel=1e-15) and x[0] < 0.6


def test_a_step_clipped_to_any_length_is_exact(paper_scene):
    """Event times must not depend on where advances happen to end: saved at different distances, the states agree."""
    scene = paper_scene.replace(p=1.3)
    runs = [fj.simulate(scene, 1.2, dt) for dt in (0.4, 0.02, 4e-4)]
    for run, every in zip(runs, (1, 20, 1000), strict=True):
        # A contact event every few milliseconds, rounding multiplied on the way.
        np.testing.assert_allclose(run.displacement[::every], runs[0].displacement, atol=1e-12)


def test_a_guard_about_to_run_out_is_not_taken_for_one_that_has_just_begun():
    """An advance may end a rounding short of a root. The next one must find it at once, not divide it out as its own start."""
    from fivjax.steppers.guard_roots import march_to_roots

    with jax.enable_x64(True):

        def march(*c):
            x, fires = jax.jit(march_to_roots)(jnp.array(c)[:, None])
            return float(x[0]), bool(fires[0])

        assert march(1e-14, -1.0, 0.5) == (0.0, True)
        assert march(-1e-3, 1.0, 0.5) == (0.0, True)  # used up already, though it would recover
        assert march(0.0, 0.0, 1e-14, 1.0, -1.1)[0] == pytest.approx(1 / 1.1)  # just lifted off; comes down later
        assert march(1e-15, 1.0, -2.0)[0] == pytest.approx(0.5)  # just begun to slip; stops later
        assert march(0.0, 1.0, 1.0) == (1.0, False)


def test_a_slip_that_is_small_beside_what_follows_is_no_zero():
    """A belt of 1 µm/s under 10⁹ N and a thousandfold kick: taken for used up at its start, slip ended without end."""
    parameters = dict(
        theta=-0.368,
        mu=0.352,
        belt_speed=1e-6,
        force=1e9,
        p=1000.0,
        duration=174.0,
        m2=34.7,
        k2=0.286,
        c1=3496.0,
        c2=47.9,
    )
    own = {name: parameters[name] for name in ("theta", "m2", "k2", "c1", "c2")}
    load = fj.Pulse(parameters["force"], parameters["p"], parameters["duration"])
    scene = fj.Scene(fj.belt_oscillator(**own), fj.Coulomb(parameters["mu"]), parameters["belt_speed"], load)
    run = fj.simulate(scene, 0.5, 0.5)
    right = oracle.propagate(oracle.paper_model(**parameters), 0.5, np.array([0.0, 0.5]))
    assert run.outcome == fj.Ending.FINISHED
    np.testing.assert_allclose(run.displacement[-1], right.q[-1], rtol=0, atol=1e-9 * np.abs(right.q[-1]).max())
    np.testing.assert_allclose(run.velocity[-1], right.v[-1], rtol=0, atol=1e-9 * np.abs(right.v[-1]).max())


@pytest.mark.slow
def test_a_load_that_jumps_at_rest_does_not_lengthen_the_first_step():
    """A motion that starts with neither displacement nor velocity is rejected where its series is trusted for a whole period."""
    scene = fj.Scene(fj.belt_oscillator(), fj.Coulomb(0.2), belt_speed=1.0, load=fj.ConstantLoad(100.0))
    with jax.enable_x64(True):
        sliding = Contact(jnp.asarray(1, jnp.int32), jnp.asarray(1.0))

        @compiled
        def moved(y, h):
            mechanics = mechanics_about_sliding(scene)
            return follow(fj.EventExact(), mechanics, sliding, jnp.asarray(20.0), y, h, kind="lax").y

        once, often = np.asarray(moved(jnp.zeros(6), 0.01)), jnp.zeros(6)
        for _ in range(50):
            often = moved(often, 0.01 / 50)
        often = np.asarray(often)
    np.testing.assert_allclose(once, often, rtol=0, atol=1e-13 * np.max(np.abs(often)))


@pytest.mark.parametrize(
    ("law", "belt_speed", "p"),
    [
        ((0.1813749829420785, 0.15860493947766804, 29.617975771010283), 2.737578714968063, 3.295321884578655),
        ((0.5922, 0.3212, 0.1734), 3.944, 3.7735),
        ((0.5, 0.1, 12.0), 0.4, 2.5),
    ],
)
def test_a_law_that_falls_fast_does_not_ask_how_often_the_run_is_saved(law, belt_speed, p):
    """Rejects a step over exp(-d u) as it grows from e^-80 to 1, which the last terms of a series do not show: 7e-6 of error."""
    scene = fj.Scene(fj.belt_oscillator(), fj.ExponentialDecay(*law), belt_speed, fj.Pulse(100.0, p))
    coarse, fine = (fj.simulate(scene, 0.3, dt) for dt in (1e-2, 1e-4))
    np.testing.assert_allclose(coarse.velocity, fine.velocity[::100], atol=1e-11)
    np.testing.assert_allclose(coarse.displacement, fine.displacement[::100], atol=1e-11)


def test_a_motion_takes_no_more_segments_than_it_is_allowed():
    """A spring swings for ten periods, of which a step covers a part: a few segments leave time over, thousands none."""
    scene = point_mass(belt_speed=1.0)
    with jax.enable_x64(True):
        mechanics, load, contact = begun(scene, jnp.array([0.5, 0.0, 0.0, 0.0]))

        @jax.jit
        def after(most):
            return follow(
                LOW_ORDER, mechanics, contact, load, jnp.array([0.5, 0.0, 0.0, 0.0]), 20 * jnp.pi, most=most, kind="lax"
            )

        few, many = (jax.tree.map(np.asarray, after(most)) for most in (3, 10_000))
    assert not few.enough and 0 < few.left < 20 * np.pi
    assert many.enough and many.left == 0
    np.testing.assert_allclose(many.y, [0.5, 0.0, 0.0, 0.0], atol=1e-9)
