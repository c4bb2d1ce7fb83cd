"""Linear theory against independent routes: Eq. 3 by hand with NumPy and SciPy, closed forms, and itself in disguise."""

import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import brentq, minimize_scalar

import fivjax as fj
from fivjax import contact
from fivjax.foundation.compiling import quick_compiler_options
from fivjax.foundation.linear_solve import solve
from fivjax.linear import cea, linearisation, polynomials, routh_hurwitz
from fivjax.linear.linearisation import linear_sliding
from fivjax.linear.outcomes import Mechanism, StabilityOutcome
from fivjax.model.scene import steady_sliding
from tests.helpers import linear_reference as reference
from tests.helpers.several_contacts import copies

# μ_crit is a root where the growth rate has a slope of some 500/s and rounding of some 1e-12/s: both routes agree to 1e-14.
MU_CRIT = reference.critical_friction()


def belt(**parameters):
    return fj.belt_oscillator(**parameters)


def pulled() -> fj.Scene:
    """The load pulls the mass off the belt."""
    structure = fj.Structure(np.eye(2), np.eye(2), 1e4 * np.eye(2), [0.0, 1.0], tangential=0, normal=1)
    return fj.Scene(structure, fj.ExponentialDecay(0.2, 0.1, 0.5), 1.0, fj.ConstantLoad(100.0))


def matrices(structure):
    return {
        "mass": np.asarray(structure.mass),
        "damping": np.asarray(structure.damping),
        "stiffness": np.asarray(structure.stiffness),
        "tangential": structure.tangential,
        "normal": structure.normal,
    }


def two_coordinates(mass, damping, stiffness):
    """Tangential and normal coordinate; each argument the three entries (tt, tn, nn) of a symmetric matrix."""
    return fj.Structure(*([[tt, tn], [tn, nn]] for tt, tn, nn in (mass, damping, stiffness)), [0.0, -1.0], 0, 1)


# --- the paper's structure


def test_critical_friction_of_table_1():
    limit = cea.stability_limit(belt())
    assert abs(cea.critical_friction(belt()) - MU_CRIT) < 1e-13
    assert limit.mu == cea.critical_friction(belt())
    assert limit.outcome is StabilityOutcome.FOUND
    assert limit.mechanism is Mechanism.FLUTTER
    # 40 digits with mpmath: Re and Im det(-ω²M + iωC + K) = 0.
    assert abs(limit.mu - 0.22822534771804482) < 1e-15
    assert abs(limit.frequency - 67.917734551452) < 1e-9


def test_eigenvalues_are_those_of_equation_3():
    for mu in (0.0, 0.1, 0.2263, MU_CRIT, 0.5):
        found, expected = cea.eigenvalues(belt(), mu), reference.eigenvalues(mu)
        assert found.dtype == np.complex128
        # Close to the coalescence rounding counts 400 times: gap 0.6/s in 427/s.
        for value in expected:
            assert np.min(np.abs(found - value)) < 1e-9
        assert np.all(np.diff(np.abs(found.imag)) >= 0)
        np.testing.assert_array_equal(found[0::2], found[1::2].conj())
        assert np.all(found.imag[0::2] < 0)


def test_eigenvalues_over_an_array_of_friction():
    mu = np.array([[0.0, 0.1, 0.2], [0.3, 0.4, 0.5]])
    found = cea.eigenvalues(belt(), mu)
    assert found.shape == (2, 3, 4)
    np.testing.assert_allclose(found[1, 1], cea.eigenvalues(belt(), 0.4), rtol=1e-13)


@pytest.mark.parametrize("kind", [np.int64, np.float32, np.array, jnp.asarray])
def test_the_direction_may_be_any_number_of_one(kind):
    """As NumPy's sign has it; some functions failed inside JAX."""
    backwards = kind(-1)
    np.testing.assert_array_equal(
        cea.eigenvalues(belt(), [0.1, 0.2], direction=backwards), cea.eigenvalues(belt(), [0.1, 0.2], direction=-1)
    )
    assert cea.sensitivity(belt(), direction=kind(1)).mu_crit == cea.sensitivity(belt()).mu_crit


def test_axes_may_have_names_of_an_array():
    (name,) = np.array(["mu"])
    np.testing.assert_array_equal(
        cea.modes(belt(), **{name: [0.1, 0.2]}).frequency, cea.modes(belt(), mu=[0.1, 0.2]).frequency
    )


def test_linearisation_with_falling_friction():
    speed, law = 0.5, fj.ExponentialDecay(mu_static=0.2, mu_dynamic=0.1, decay=0.5)
    scene = fj.Scene(belt(), law, belt_speed=speed, load=fj.ConstantLoad(100.0))
    mu = 0.1 + 0.1 * np.exp(-0.5 * speed)
    slope = -0.5 * 0.1 * np.exp(-0.5 * speed)
    mass, damping, stiffness = reference.sliding(mu, **reference.TABLE_1)
    damping[0, 0] += reference.normal_force(mu, 100.0, **reference.TABLE_1) * slope
    expected = reference.state_matrix(mass, damping, stiffness)
    # Rounding of one matrix solve.
    np.testing.assert_allclose(cea.linearisation(scene), expected, rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(cea.friction_slope(scene), slope, rtol=1e-14)
    rates = np.linalg.eigvals(expected).real
    np.testing.assert_allclose(cea.growth_rate(scene), rates.max(), rtol=1e-10)


def test_the_sliding_motion_is_the_derivative_of_the_contact_physics():
    """The projected matrices (Eq. 3, with the slope of friction) against automatic differentiation of `contact`."""
    law = fj.ExponentialDecay(mu_static=0.4, mu_dynamic=0.2, decay=0.5)
    scene = fj.Scene(belt(theta=0.3), law, belt_speed=-0.5, load=fj.ConstantLoad(100.0))
    free = [0, 1, 3, 4]

    @jax.jit
    def derivative(scene):
        mechanics, sliding = contact.Mechanics(scene), contact.Contact(np.int32(fj.Status.SLIDE), -1.0)
        q, _ = steady_sliding(scene, 100.0)

        def rates(z):
            y = jax.numpy.concatenate([q, 0 * q]).at[np.array(free)].add(z)
            return jax.numpy.concatenate([y[3:], contact.acceleration(mechanics, sliding, 100.0, y)])[np.array(free)]

        return jax.jacfwd(rates)(jax.numpy.zeros(4)), linear_sliding(scene).matrix

    with jax.enable_x64(True):
        expected, found = derivative(scene)
    np.testing.assert_allclose(found, expected, rtol=1e-11, atol=1e-9)


def test_sensitivities_against_differences_of_the_scipy_route():
    result = cea.sensitivity(belt())
    assert list(result) == list(reference.TABLE_1)
    for name, value in reference.TABLE_1.items():

        def limit(x, name=name):
            return reference.critical_friction(low=0.2268, high=0.2297, **{name: x})

        # A step that moves μ_crit by some 1e-5 relative: brentq leaves 1e-15, so 1e-9 or better remains, and the
        # fourth-order remainder is smaller still. The dampers move it so little that they are stepped further.
        step = value * (2e-3 if name in ("c1", "c2") else 2e-5)
        expected = reference.difference(limit, value, step)
        assert isinstance(result[name], float)
        assert abs(result[name] - expected) < 1e-6 * abs(expected), name
        assert np.isclose(result.normalised[name], expected * value / MU_CRIT, rtol=1e-6)
    assert result.mu_crit == cea.critical_friction(belt())
    assert result.dataset["normalised"].sel(parameter="k1") == result.normalised["k1"]
    assert "k1" in repr(result)


@pytest.mark.slow
def test_many_limits_and_their_gradients_in_one_batch():
    def limit(k1):
        return cea.critical_friction(belt(k1=k1))

    # So many at once that batched LAPACK solves could wait for each other for ever (see `elimination`).
    springs = np.linspace(80e3, 120e3, 10_001)
    with jax.enable_x64(True):
        values, slopes = map(np.asarray, jax.jit(jax.vmap(jax.value_and_grad(limit)))(springs))
    assert np.isfinite(values).all()
    some = slice(0, None, 2000)
    np.testing.assert_allclose(values[some], [limit(k1) for k1 in springs[some]], rtol=1e-12)
    # Differences of fourth order over the batch itself, 4 N/m apart; away from the cusp of repeated frequencies.
    differences = (8 * (values[3:-1] - values[1:-3]) - (values[4:] - values[:-4])) / (12 * (springs[1] - springs[0]))
    smooth = np.abs(springs[2:-2] - 109.6e3) > 2e3
    np.testing.assert_allclose(slopes[2:-2][smooth], differences[smooth], rtol=1e-6, atol=1e-13)


@pytest.mark.slow
def test_forward_derivatives_up_to_the_second():
    def along(function):
        return lambda k1: jax.jvp(function, (k1,), (1.0,))[1]

    first = along(lambda k1: cea.critical_friction(belt(k1=k1)))
    with jax.enable_x64(True):
        first, second = map(float, jax.jit(lambda k1: jax.jvp(first, (k1,), (1.0,)))(100e3))
    # The gradients behind the sensitivities are reverse ones.
    assert np.isclose(first, cea.sensitivity(belt())["k1"], rtol=1e-12)
    expected = reference.difference(lambda k1: cea.sensitivity(belt(k1=k1))["k1"], 100e3, 16.0)
    # The differences are good to 1e-14 in the slope over a step of 16 N/m.
    assert abs(second - expected) < 1e-6 * abs(expected)


@pytest.mark.slow
def test_gradients_without_double_precision():
    """Where a user never turned it on, as in the process that runs the tests."""
    assert not jax.config.jax_enable_x64 and jnp.ones(1).dtype == np.float32
    structure = fj.belt_oscillator()
    gradient = jax.jit(jax.grad(cea.critical_friction))(structure.as_matrices())
    assert gradient.stiffness.dtype == np.float64 and gradient.mass.dtype == np.float64
    by_name = -4.6249593467e-05
    row = np.array([np.cos(0.01), 0.0, -np.sin(0.01)])
    assert abs(row @ np.asarray(gradient.stiffness) @ row - by_name) < 1e-9 * abs(by_name)
    by_parameter = jax.grad(cea.critical_friction)(structure).parameters["k1"]
    assert abs(float(by_parameter) - by_name) < 1e-9 * abs(by_name)
    rate = jax.grad(lambda mu: cea.growth_rate(structure, mu))(0.3)
    assert abs(rate - 38.567295) < 1e-4
    assert isinstance(cea.critical_friction(structure), np.float64)
    assert cea.eigenvalues(structure, 0.2).dtype == np.complex128
    assert not jax.config.jax_enable_x64 and jnp.ones(1).dtype == np.float32


def test_growth_rate_gradient_is_that_of_the_eigenvalues():
    with jax.enable_x64(True):
        slope = float(jax.grad(lambda mu: cea.growth_rate(belt(), mu))(0.3))
    assert abs(slope - reference.difference(reference.growth, 0.3, 1e-3)) < 1e-6 * slope


@pytest.mark.parametrize("hessian", [jax.hessian, lambda f: jax.jacfwd(jax.jacfwd(f))], ids=["reverse", "forward"])
def test_the_growth_rate_has_second_derivatives(hessian):
    with jax.enable_x64(True):
        curvature = float(hessian(lambda mu: cea.growth_rate(belt(), mu))(0.3))

    def difference(step):
        above, here, below = (reference.growth(0.3 + k * step) for k in (1, 0, -1))
        return (above - 2 * here + below) / step**2

    assert abs(curvature - (4 * difference(5e-4) - difference(1e-3)) / 3) < 1e-6 * abs(curvature)


# --- coalescence and slope


def test_undamped_coalescence_is_where_two_frequencies_become_one():
    def discriminant(mu):
        mass, _, stiffness = reference.sliding(mu, **reference.TABLE_1)
        ratio = np.linalg.solve(mass, stiffness)
        return np.trace(ratio) ** 2 - 4 * np.linalg.det(ratio)

    # A difference of two squares of 1e11 with a rounding of 1e-5 and a slope of 1e10.
    expected = brentq(discriminant, 0.2, 0.24, xtol=1e-16)
    meeting = cea.coalescence(belt())
    assert not meeting.damped
    assert abs(meeting.mu - expected) < 1e-12
    mass, _, stiffness = reference.sliding(expected, **reference.TABLE_1)
    assert np.isclose(meeting.frequency, np.sqrt(np.trace(np.linalg.solve(mass, stiffness)) / 2) / (2 * np.pi))
    limit = cea.stability_limit(belt(c1=0.0, c2=0.0))
    assert limit.mechanism is Mechanism.COALESCENCE
    assert abs(limit.mu - meeting.mu) < 1e-14


def test_damped_coalescence_is_the_closest_approach():
    def distance(mu):
        upper = [value for value in reference.eigenvalues(mu) if value.imag > 0]
        return abs(upper[0] - upper[1])

    closest = minimize_scalar(distance, bounds=(0.2262, 0.2265), method="bounded", options={"xatol": 1e-12})
    meeting = cea.coalescence(belt(), damped=True)
    assert meeting.damped
    assert meeting.outcome is StabilityOutcome.FOUND
    # They differ by the square of the imperfection, 2e-4.
    assert abs(meeting.mu - closest.x) < 1e-8
    assert 0 < meeting.imperfection < 1e-3
    # At the complex friction itself the two eigenvalues are one.
    mu = meeting.mu + 1j * meeting.imperfection
    for sign in (1, -1):
        mass, damping, stiffness = (
            np.array(a) + (mu.real + sign * 1j * mu.imag) * (np.array(b) - np.array(a))
            for a, b in zip(
                reference.sliding(0.0, **reference.TABLE_1), reference.sliding(1.0, **reference.TABLE_1), strict=True
            )
        )
        m = np.zeros((4, 4), complex)
        m[:2, 2:] = np.eye(2)
        m[2:, :2], m[2:, 2:] = -np.linalg.solve(mass, stiffness), -np.linalg.solve(mass, damping)
        values = np.linalg.eigvals(m)
        gaps = np.abs(values[:, None] - values[None, :]) + 1e9 * np.eye(4)
        # A double eigenvalue is known to the root of rounding.
        assert gaps.min() < 1e-4


def test_proportional_damping_coalesces_on_the_real_axis():
    # With C = βK the eigenvalues follow from those of the undamped structure, so they meet at the same friction.
    plain = belt(c1=0.0, c2=0.0)
    structure = fj.Structure(plain.mass, 1e-5 * np.asarray(plain.stiffness), plain.stiffness, plain.load_direction)
    damped, undamped = cea.coalescence(structure, damped=True), cea.coalescence(structure)
    assert abs(damped.mu - undamped.mu) < 1e-12
    assert damped.imperfection < 1e-9
    assert cea.critical_friction(structure) > undamped.mu


@pytest.mark.parametrize("mu", [0.05, 0.2])
def test_critical_slope(mu):
    def growth(slope):
        mass, damping, stiffness = reference.sliding(mu, **reference.TABLE_1)
        damping[0, 0] += reference.normal_force(mu, 100.0, **reference.TABLE_1) * slope
        return np.linalg.eigvals(reference.state_matrix(mass, damping, stiffness)).real.max()

    scene = fj.Scene(belt(), fj.Coulomb(mu), belt_speed=3.0, load=fj.ConstantLoad(100.0))
    expected = brentq(growth, -0.5, 0.0, xtol=1e-16)
    assert abs(cea.critical_slope(scene) - expected) < 1e-10 * abs(expected)


def test_section_3_2_is_unstable_by_its_slope():
    scene = fj.Scene(belt(), fj.ExponentialDecay(0.2, 0.1, 0.5), belt_speed=0.5)
    assert cea.friction_slope(scene) < cea.critical_slope(scene) < 0
    assert cea.growth_rate(scene) > 0


@pytest.mark.slow
def test_critical_slope_is_differentiable():
    scene = fj.Scene(belt(), fj.ExponentialDecay(0.2, 0.1, 0.5), belt_speed=0.5)
    with jax.enable_x64(True):
        # Differentiable in the whole scene; by load the slope goes as 1/N, and N as the load.
        gradient = jax.grad(cea.critical_slope)(scene)
    assert np.isclose(float(gradient.load.force), -cea.critical_slope(scene) / 100.0, rtol=1e-9)


def test_critical_slope_has_named_ends():
    coupled = fj.Scene(belt(), fj.Coulomb(0.3))
    assert cea.critical_slope(coupled) == 0
    unloaded = fj.Scene(belt(), fj.Coulomb(0.1), load=fj.ConstantLoad(0.0))
    assert cea.critical_slope(unloaded) == -np.inf


# --- closed forms and corners


@pytest.mark.parametrize(
    ("mass", "damping", "stiffness", "mu", "mechanism", "frequency"),
    [
        # (m - μ m') x'' + (c - μ c') x' + (k - μ k') x = 0
        ((1, 0.0, 1), (1, 0.5, 1), (10, 1, 10), 2.0, Mechanism.FLUTTER, np.sqrt(8.0) / (2 * np.pi)),
        ((1, 0.0, 1), (1, 0.0, 1), (10, 4, 10), 2.5, Mechanism.DIVERGENCE, 0.0),
        ((1, 0.8, 1), (1, 0.1, 1), (10, 1, 10), 1.25, Mechanism.PAINLEVE, np.inf),
        ((1, 0.0, 1), (0, 0.0, 0), (10, 1, 10), 10.0, Mechanism.DIVERGENCE, 0.0),
        ((1, 0.0, 1), (1, -0.5, 1), (10, -1, 10), np.inf, Mechanism.NONE, np.nan),
    ],
)
def test_two_degrees_of_freedom(mass, damping, stiffness, mu, mechanism, frequency):
    limit = cea.stability_limit(two_coordinates(mass, damping, stiffness))
    np.testing.assert_allclose(limit.mu, mu, rtol=1e-14)
    assert limit.mechanism is mechanism
    np.testing.assert_allclose(limit.frequency, frequency, rtol=1e-14)
    assert limit.outcome is (StabilityOutcome.FOUND if np.isfinite(mu) else StabilityOutcome.NEVER_UNSTABLE)


@pytest.mark.parametrize("parameters", [{"theta": 0.0}, {"theta": 0.0, "c1": 0.0, "c2": 0.0}, {"c1": 1e3, "c2": 1e3}])
def test_never_unstable_is_said_by_name(parameters):
    structure = belt(**parameters)
    limit = cea.stability_limit(structure)
    assert limit.outcome is StabilityOutcome.NEVER_UNSTABLE
    assert limit.mu == np.inf
    assert np.max([reference.growth(mu, **parameters) for mu in np.linspace(0, 50, 501)]) < 1e-10
    with pytest.raises(ValueError, match="never unstable"):
        cea.sensitivity(structure)
    with jax.enable_x64(True):
        assert np.isnan(jax.grad(lambda k1: cea.critical_friction(structure.replace(k1=k1)))(100e3))


def partly_damped(sign):
    """A mode that no damper reaches, driven through one that is damped: unstable at the slightest friction, or never."""
    undamped, damped = np.array([np.cos(0.6), np.sin(0.6)]), np.array([-np.sin(0.6), np.cos(0.6)])
    stiffness = np.diag([0.0, 0.0, 1e3])
    stiffness[:2, :2] = 100 * np.outer(undamped, undamped) + 200 * np.outer(damped, damped)
    stiffness[2, :2] = stiffness[:2, 2] = sign * 5 * undamped + 8 * damped
    damping = np.zeros((3, 3))
    damping[:2, :2] = 0.5 * np.outer(damped, damped)
    return fj.Structure(np.eye(3), damping, stiffness, [0.0, 0.0, -1.0])


@pytest.mark.parametrize(
    ("sign", "outcome"), [(1, StabilityOutcome.ALWAYS_UNSTABLE), (-1, StabilityOutcome.NEVER_UNSTABLE)]
)
def test_a_mode_that_no_damper_reaches(sign, outcome):
    structure = partly_damped(sign)
    growth = np.linalg.eigvals(reference.general_state_matrix(0.1, **matrices(structure))).real.max()
    assert (growth > 1e-7) == (outcome is StabilityOutcome.ALWAYS_UNSTABLE)
    limit = cea.stability_limit(structure)
    assert limit.outcome is outcome
    assert limit.mu == (0.0 if sign > 0 else np.inf)


def test_one_damper_alone_destabilises():
    # Ziegler: with either damper gone the limit falls far below the undamped 0.226.
    for missing in ("c1", "c2"):
        expected = reference.critical_friction(0.005, 0.1, **{missing: 0.0})
        # The growth rate is almost flat there (rounding 1e-13/s over a slope of 1e-3/s).
        assert abs(cea.critical_friction(belt(**{missing: 0.0})) - expected) < 1e-8
        assert expected < 0.02


def test_light_damping_has_its_own_limit():
    # As damping goes to zero the limit tends to a value of its own, not to the coalescence.
    values = [cea.critical_friction(belt(c1=c, c2=c)) for c in (1e-4, 1e-6, 1e-8)]
    # The next term is quadratic in the damping ratio, 2e-7 for the first of them, times 1/0.003 of relative detuning.
    assert np.ptp(values) < 1e-10
    assert cea.critical_friction(belt(c1=0.0, c2=0.0)) - values[-1] > 5e-6


def test_repeated_frequencies_couple_at_once():
    # With equal frequencies at μ = tan θ, where one coupling term changes sign, the modes meet exactly there.
    theta, mu = 0.01, np.tan(0.01)

    def detuning(k1):
        mass, _, stiffness = reference.sliding(mu, **{**reference.TABLE_1, "k1": k1})
        return stiffness[0, 0] / mass[0, 0] - stiffness[1, 1] / mass[1, 1]

    k1 = brentq(detuning, 1e5, 1.2e5, xtol=1e-9)
    # k1 is known to 1e-9 N/m, and the limit moves with its square root of the detuning: (1e-14) relative.
    assert abs(cea.critical_friction(belt(k1=k1, c1=0.0, c2=0.0, theta=theta)) - mu) < 1e-12


def test_undamped_sensitivities():
    result = cea.sensitivity(belt(c1=0.0, c2=0.0))
    assert np.isnan(result["c1"])
    assert np.isnan(result["c2"])

    def limit(k1):
        return cea.critical_friction(belt(c1=0.0, c2=0.0, k1=k1))

    expected = reference.difference(limit, 100e3, 10.0)
    assert abs(result["k1"] - expected) < 1e-7 * abs(expected)


def test_a_structure_given_as_matrices_has_its_entries_as_parameters():
    named, plain = belt(), belt()
    plain = fj.Structure(plain.mass, plain.damping, plain.stiffness, plain.load_direction)
    result = cea.sensitivity(plain)
    assert len(result) == 18
    sin, cos = np.sin(0.01), np.cos(0.01)
    by_entries = cos**2 * result["stiffness[0,0]"] - sin * cos * result["stiffness[0,2]"]
    by_entries += sin**2 * result["stiffness[2,2]"]
    assert np.isclose(by_entries, cea.sensitivity(named)["k1"], rtol=1e-10)


def test_the_other_direction_is_the_mirror_image():
    # Mirroring the tangential coordinate turns θ into -θ.
    for theta in (0.3, -0.3):
        mirrored = cea.stability_limit(belt(theta=-theta))
        turned = cea.stability_limit(belt(theta=theta), direction=-1)
        assert np.isclose(turned.mu, mirrored.mu, rtol=1e-12)
        assert turned.mechanism is mirrored.mechanism


# --- any number of degrees of freedom


def random_structure(seed, n, proportional):
    rng = np.random.default_rng(seed)

    def gram(size):
        x = rng.normal(size=(n, n))
        return size * x @ x.T

    mass = np.diag(rng.uniform(0.1, 2.0, n)) + gram(0.02)
    stiffness = gram(1e4) + np.diag(rng.uniform(0, 1e4, n))
    damping = 1e-4 * stiffness + 0.1 * mass if proportional else gram(0.05)
    return fj.Structure(mass, damping, stiffness, np.ones(n), 0, n - 1)


@pytest.mark.parametrize(
    ("seed", "n"), [(0, 2), (1, 3), (2, 3), pytest.param(3, 6, marks=pytest.mark.slow), (4, 12), (5, 12)]
)
def test_random_structures(seed, n):
    structure = random_structure(seed, n, proportional=seed % 2 == 0)
    limit = cea.stability_limit(structure)
    # The grid of the reference is finer than any window of instability met here.
    top = min(1.05 * limit.mu, 20.0)
    expected = reference.general_critical_friction(top, 301, **matrices(structure))
    if np.isinf(expected):
        assert limit.mu > top or limit.outcome is StabilityOutcome.NEVER_UNSTABLE
    else:
        assert abs(limit.mu - expected) < 1e-10 * expected
    found = cea.eigenvalues(structure, 0.3)
    values = np.linalg.eigvals(reference.general_state_matrix(0.3, **matrices(structure)))
    assert found.shape == (2 * (n - 1),)
    for value in values:
        assert np.min(np.abs(found - value)) < 1e-9 * np.abs(values).max()
    if np.isfinite(limit.mu):
        # The smooth route changes sign at the same place.
        assert cea.margin(structure, limit.mu * (1 - 1e-8)) > 0 > cea.margin(structure, limit.mu * (1 + 1e-8))


@settings(max_examples=20, deadline=None)
@given(
    mass=st.floats(1e-3, 1e3),
    time=st.floats(1e-3, 1e3),
    k1=st.floats(90e3, 120e3),
    theta=st.floats(0.005, 0.5),
)
def test_units_do_not_matter(mass, time, k1, theta):
    base = {**reference.TABLE_1, "k1": k1, "theta": theta}
    units = {"m": mass, "c": mass / time, "k": mass / time**2, "t": 1.0}
    scaled = {name: value * units[name[0]] for name, value in base.items()}
    # Scaled matrices are rounded anew; the limit feels 1e-16 of a spring some twenty times, near repeated
    # frequencies some thousand times.
    assert np.isclose(cea.critical_friction(belt(**scaled)), cea.critical_friction(belt(**base)), rtol=1e-10)


# --- the smooth route


def test_margin_is_the_product_of_sums_of_eigenvalues():
    mu = 0.1
    with jax.enable_x64(True):
        scale = float(linearisation.time_scale(belt()))
    values = reference.eigenvalues(mu) / scale
    product = np.prod([-(values[i] + values[j]) for i in range(4) for j in range(i)]).real
    # Third of the determinants of the polynomial, made of differences of terms 1e6 times larger.
    mass, damping, stiffness = reference.sliding(mu, **reference.TABLE_1)
    with jax.enable_x64(True):
        coefficients = polynomials.characteristic_polynomial(mass, damping, stiffness, scale)
        np.testing.assert_allclose(routh_hurwitz.hurwitz_determinants(coefficients)[2], product, rtol=1e-8)
        np.testing.assert_allclose(coefficients, np.poly(values).real, rtol=1e-12)
        sums = np.linalg.eigvals(routh_hurwitz.bialternate_sum(reference.state_matrix(mass, damping, stiffness) / 400))
    expected = [(values[i] + values[j]) * scale / 400 for i in range(4) for j in range(i)]
    for value in expected:
        assert np.min(np.abs(sums - value)) < 1e-9


@pytest.mark.parametrize("of_users", [False, True], ids=["those of the tests", "those of users"])
def test_a_slope_is_right_with_the_options_that_compile_quickly(of_users, monkeypatch):
    """With level 0 of LLVM's optimisations and its quick choice of instructions XLA makes of this slope a zero."""
    monkeypatch.delenv("XLA_FLAGS", raising=False)
    options = quick_compiler_options.__wrapped__() if of_users else {}

    def instability(mu):
        return -cea.margin(belt(), mu)

    with jax.enable_x64(True):
        mu = jnp.asarray(0.99)
        value, slope = jax.jit(lambda mu: jax.jvp(instability, (mu,), (jnp.ones_like(mu),)), compiler_options=options)(
            mu
        )
    assert value == pytest.approx(instability(0.99), rel=1e-12)
    assert slope == pytest.approx(reference.difference(instability, 0.99, 1e-5), rel=1e-6)


def test_margin_is_smooth_through_the_coalescence():
    with jax.enable_x64(True):
        slope = jax.grad(lambda mu: cea.margin(belt(), mu))
        for mu in (cea.coalescence(belt()).mu, cea.coalescence(belt(), damped=True).mu, MU_CRIT):
            expected = reference.difference(lambda x: cea.margin(belt(), x), mu, 1e-5)
            assert np.isclose(slope(mu), expected, rtol=1e-5)


def test_chart_of_a_structure():
    chart = cea.chart(belt(), mu=np.linspace(0.0, 0.5, 41), k1=np.linspace(80e3, 120e3, 37))
    assert chart["growth_rate"].dims == ("mu", "k1")
    assert chart["growth_rate"].attrs["units"] == "1/s"
    rng = np.random.default_rng(1)
    for i, j in zip(rng.integers(0, 41, 30), rng.integers(0, 37, 30), strict=True):
        values = reference.eigenvalues(chart["mu"].values[i], k1=chart["k1"].values[j])
        fastest = values[np.argmax(values.real)]
        # Near a coalescence rounding in 400/s shows as 1e-8/s.
        assert abs(chart["growth_rate"].values[i, j] - fastest.real) < 1e-7
        assert abs(chart["frequency"].values[i, j] - abs(fastest.imag) / (2 * np.pi)) < 1e-7
    np.testing.assert_array_equal(chart["margin"] > 0, chart["growth_rate"] < 0)


def test_chart_of_a_scene_knows_the_slope():
    scene = fj.Scene(belt(), fj.ExponentialDecay(0.2, 0.1, 0.5), belt_speed=0.5)
    chart = cea.chart(scene, belt_speed=[0.2, 0.5, 5.0], mu_static=[0.15, 0.2, 0.3])
    for i in range(3):
        for j in range(3):
            point = scene.replace(belt_speed=chart["belt_speed"].values[i], mu_static=chart["mu_static"].values[j])
            assert np.isclose(chart["growth_rate"].values[i, j], cea.growth_rate(point), rtol=1e-8)
    mu = 0.1 + 0.1 * np.exp(-0.5 * 0.5)
    expected = reference.normal_force(mu, 100.0, **reference.TABLE_1)
    assert np.isclose(chart["normal_force"].values[1, 1], expected, rtol=1e-12)


def test_chart_without_steady_sliding_is_empty_there():
    # Beyond tan of the angle of the support the belt would have to pull.
    scene = fj.Scene(belt(theta=0.5), fj.ExponentialDecay(0.2, 0.1, 0.5), belt_speed=-1.0)
    chart = cea.chart(scene, mu_static=[0.2, 5.0], theta=[0.5, 0.6])
    assert np.isfinite(chart["growth_rate"].values[0]).all()
    assert np.isnan(chart["growth_rate"].values[chart["normal_force"].values < 0]).all()


def test_small_systems_by_elimination():
    rng = np.random.default_rng(3)
    matrices = rng.normal(size=(50, 4, 4)) + 1j * rng.normal(size=(50, 4, 4))
    matrices[0, 0, 0] = 0.0
    right = rng.normal(size=(50, 4, 2))
    with jax.enable_x64(True):
        found = jax.vmap(solve)(matrices, right + 0j)
        np.testing.assert_allclose(found, np.linalg.solve(matrices, right), rtol=1e-10, atol=1e-12)
        assert not np.isfinite(solve(jax.numpy.zeros((2, 2)), jax.numpy.ones(2))).any()


# --- modes along an axis


def test_modes_are_not_swapped_at_the_coalescence():
    fine = cea.modes(belt(), mu=np.linspace(0.0, 0.5, 501))
    coarse = cea.modes(belt(), mu=np.linspace(0.0, 0.5, 6))
    # What is followed does not depend on where one looks.
    np.testing.assert_allclose(fine["eigenvalue"].values[::100], coarse["eigenvalue"].values, rtol=1e-9)
    growth = fine["growth_rate"].values
    assert np.all(np.diff(growth[:, 1])[120:] > 0)  # one grows ever faster,
    assert np.all(np.diff(growth[:, 0])[120:] < 0)  # the other decays
    steps = np.abs(np.diff(fine["eigenvalue"].values, axis=0))
    assert steps.max() < 2.0  # a swap would jump by up to 20/s
    assert fine["frequency"].attrs["units"] == "Hz"
    assert float(fine["mu_crit"]) == cea.critical_friction(belt())
    assert fine["mu_crit"].attrs["mechanism"] == "flutter"
    assert "scene" in fine.attrs


def test_mode_shapes_solve_the_eigenvalue_problem():
    modes = cea.modes(belt(), mu=[0.1, 0.4])
    for mu in (0.1, 0.4):
        mass, damping, stiffness = reference.sliding(mu, **reference.TABLE_1)
        for mode in (0, 1):
            at = modes.sel(mu=mu, mode=mode)
            s, shape = complex(at["eigenvalue"]), at["shape"].values[:2]
            residual = (s**2 * mass + s * damping + stiffness) @ shape
            assert np.abs(residual).max() < 1e-9 * np.abs(stiffness).max()
            assert np.isclose(np.abs(shape).max(), 1.0)
            assert np.isclose(at["damping_ratio"], -s.real / abs(s))
            assert at["shape"].values[2] == 0


def test_modes_that_only_cross_keep_their_shapes():
    # θ = 0: the horizontal motion is on its own, and its frequency crosses that of the other mode.
    modes = cea.modes(belt(theta=0.0), mu=0.0, k1=np.linspace(90e3, 130e3, 12))
    horizontal = np.sqrt(modes["k1"].values / 0.575 - (1 / 1.15) ** 2) / (2 * np.pi)
    np.testing.assert_allclose(modes["frequency"].values[:, 0], horizontal, rtol=1e-10)
    np.testing.assert_allclose(modes["frequency"].values[:, 1], modes["frequency"].values[0, 1], rtol=1e-10)
    np.testing.assert_allclose(np.abs(modes["shape"].values[:, 0, 0]), 1.0)


def test_undamped_modes_meet_and_part():
    modes = cea.modes(belt(c1=0.0, c2=0.0), mu=np.linspace(0.0, 0.5, 11))
    assert np.abs(modes["growth_rate"].values[:5]).max() < 1e-9
    assert np.all(np.diff(modes["growth_rate"].values[4:, 1]) > 0)
    assert np.all(np.diff(modes["growth_rate"].values[4:, 0]) < 0)


def test_modes_that_are_one_all_along():
    # Two identical oscillators: nothing tells them apart, and nothing needs to.
    stiffness = np.diag([200.0, 200.0, 50.0])
    structure = fj.Structure(np.eye(3), 0.01 * stiffness, stiffness, [0, 0, -1.0])
    modes = cea.modes(structure, mu=np.linspace(0.0, 1.0, 3))
    np.testing.assert_allclose(modes["frequency"].values, np.sqrt(200 - 1.0) / (2 * np.pi), rtol=1e-9)


def test_overdamped_modes():
    modes = cea.modes(belt(c1=900.0, c2=900.0), mu=np.linspace(0.0, 0.5, 6))
    assert np.isfinite(modes["eigenvalue"]).all()
    everything = np.concatenate([modes["eigenvalue"].values, modes["partner"].values], axis=1)
    for k, mu in enumerate(modes["mu"].values):
        for value in reference.eigenvalues(mu, c1=900.0, c2=900.0):
            assert np.min(np.abs(everything[k] - value)) < 1e-8 * abs(value)


def test_modes_of_a_scene_along_belt_speed():
    scene = fj.Scene(belt(), fj.ExponentialDecay(0.2, 0.1, 0.5), belt_speed=0.5)
    modes = cea.modes(scene, belt_speed=[0.5, 1.0, 2.0])
    assert "mu_crit" not in modes
    assert np.isclose(modes["growth_rate"].values[0].max(), cea.growth_rate(scene), rtol=1e-10)


# --- refusals


SCENE = fj.Scene(fj.belt_oscillator(), fj.Coulomb(0.2))
FALLING = fj.Scene(fj.belt_oscillator(), fj.ExponentialDecay(0.5, 0.05, 0.5))


@pytest.mark.parametrize(
    ("call", "sentence"),
    [
        (lambda: cea.eigenvalues(belt(), -0.1), "`mu` must be non-negative, but is -0.1"),
        (lambda: cea.eigenvalues(belt(), [0.1, -0.2]), "`mu` must be non-negative and finite, but holds -0.2"),
        (lambda: cea.eigenvalues(belt(), []), "`mu` must hold at least one value"),
        (lambda: cea.eigenvalues(belt()), "`mu` must be given with a structure"),
        (lambda: cea.eigenvalues(SCENE, 0.2), "must not be given with a scene"),
        (lambda: cea.eigenvalues(belt(), 0.2, direction=0), "`direction` must be 1 or -1"),
        (lambda: cea.eigenvalues(belt(), "much"), "`mu` must be numeric"),
        (lambda: cea.linearisation(SCENE, direction=-1), "`direction` must not be given with a scene"),
        (lambda: cea.linearisation(SCENE.replace(belt_speed=0.0)), "nothing slides steadily"),
        (lambda: cea.critical_friction(SCENE), "must be a Structure"),
        (lambda: cea.critical_slope(belt()), "must be a Scene"),
        (lambda: cea.critical_slope(pulled()), "no sliding equilibrium: the belt would have to pull"),
        (lambda: cea.coalescence(belt(), damped=1), "`damped` must be True or False"),
        (lambda: cea.margin(belt(), np.nan), "`mu` must be finite"),
        (lambda: cea.chart(belt(), mu=[0.1, 0.2]), "exactly two axes"),
        (lambda: cea.chart(belt(), k1=[1e5, 2e5], k2=[1e5, 2e5]), "`mu` must be given with a structure"),
        (lambda: cea.chart(belt(), mu=[0.1, 0.2], k9=[1.0, 2.0]), "Unknown parameter `k9`"),
        (lambda: cea.chart(belt(), mu=[0.2, 0.1], k1=[1e5, 2e5]), "must be strictly increasing"),
        (lambda: cea.chart(belt(), mu=[0.1, 0.2], k1=[-1e5, 2e5]), "`k1` must be non-negative"),
        # At one corner of the grid only: the first value of one axis with the last of the other.
        (lambda: cea.chart(FALLING, mu_static=[0.2, 0.4], mu_dynamic=[0.1, 0.3]), "`mu_static` must be at least"),
        (lambda: cea.modes(belt(), mu=0.2), "exactly one axis"),
        (lambda: cea.modes("belt", mu=[0.2]), "must be a Structure or a Scene"),
    ],
)
def test_refusals_are_sentences(call, sentence):
    with pytest.raises((ValueError, TypeError), match=sentence):
        call()


def test_margin_refuses_what_would_take_for_ever():
    n = 40
    large = fj.Structure(np.eye(n), np.eye(n), np.eye(n), np.ones(n), 0, 1)
    with pytest.raises(ValueError, match="at most 32 coordinates"):
        cea.margin(large, 0.1)


def with_a_free_mass(*, tangential: int = 0) -> fj.Structure:
    """k_x = 1 N/m along the belt, coupled by 2 N/m to the normal direction; the third coordinate has a mass and nothing else."""
    stiffness = np.array([[1.0, 2.0, 0.0], [2.0, 9.0, 0.0], [0.0, 0.0, 0.0]])
    return fj.Structure(
        np.eye(3), np.diag([0.1, 0.0, 0.0]), stiffness, [0.0, -1.0, 0.0], tangential=tangential, normal=1
    )


def test_a_free_mass_beside_it_does_not_hide_divergence():
    """x'' + c x' + (k_x - μ k_xn) x = 0 loses its stiffness at μ = k_x / k_xn."""
    limit = fj.cea.stability_limit(with_a_free_mass())
    assert limit.mu == pytest.approx(0.5, rel=1e-12) and limit.mechanism is fj.cea.Mechanism.DIVERGENCE
    slopes = fj.cea.sensitivity(with_a_free_mass())
    assert slopes["stiffness[0,0]"] == pytest.approx(0.5, rel=1e-9)
    assert slopes["stiffness[0,1]"] == pytest.approx(-0.25, rel=1e-9)


def with_a_stiff_coordinate(ratio: float, *, damping: float, coupling: float) -> fj.Structure:
    """The paper's structure and a mass on its first coordinate by a spring: in frequency so many times above the structure."""
    own = belt()
    mass, _, stiffness, load = (np.asarray(matrix) for matrix in own.matrices)
    frequency = ratio * np.sqrt(np.trace(stiffness) / np.trace(mass))
    added = [1.0, 2 * damping * frequency, frequency**2]
    matrices = [
        np.block([[np.asarray(m), np.zeros((len(m), 1))], [np.zeros(len(m)), a]])
        for m, a in zip(own.matrices[:3], added, strict=True)
    ]
    matrices[2][0, -1] = matrices[2][-1, 0] = coupling * stiffness[0, 0]
    return fj.Structure(*matrices, np.append(load, 0.0), contacts=own.contacts)


@pytest.mark.parametrize("ratio", [1e-6, 1e5, 1e7])
@pytest.mark.parametrize(("damping", "coupling"), [(0.0, 0.0), (0.3, 0.0), (0.01, 0.4)])
def test_a_far_stiffer_or_softer_coordinate_changes_no_limit(ratio, damping, coupling):
    """A spring that couples it adds coupling² k₁₁² / k to the stiffness, which is of the order of 1 / ratio²."""
    stiff = with_a_stiff_coordinate(ratio, damping=damping, coupling=coupling if ratio > 1 else 0.0)
    limit = fj.cea.stability_limit(stiff)
    assert limit.mu == pytest.approx(MU_CRIT, rel=1e-8)
    assert limit.mechanism is Mechanism.FLUTTER
    assert float(fj.cea.critical_friction(stiff)) == limit.mu
    growing = fj.cea.complex_modes(stiff, 0.3)
    (place,) = growing.unstable
    assert growing.growth_rates[place] == pytest.approx(fj.cea.growth_rate(belt(), 0.3), rel=1e-6)


def test_what_friction_moves_ever_further_has_no_limit_of_steady_sliding():
    for limit_of in (fj.cea.critical_friction, fj.cea.stability_limit):
        with pytest.raises(ValueError, match="friction moves a part of the structure that no spring holds"):
            limit_of(with_a_free_mass(tangential=2))
    # What else was asked for is there, without it.
    modes = fj.cea.modes(with_a_free_mass(tangential=2), mu=[0.1, 0.2])
    assert np.isnan(modes["mu_crit"]) and "no spring holds" in modes["mu_crit"].attrs["outcome"]
    assert modes["mu_crit"].attrs["mechanism"] == "none"
    assert fj.cea.coalescence(belt(), damped=np.bool_(True)).mu == fj.cea.coalescence(belt(), damped=True).mu


@pytest.mark.parametrize("damping", [2.0, 20.0])
def test_damping_in_proportion_to_mass_has_the_derivatives_of_flutter(damping):
    """The modes of the undamped structure meet at the very frequency of flutter, which by rounding was taken for the limit."""

    def limit(k, c1, c2):
        stiffness = jnp.array([[k, -3e3, 0.0], [-3e3, 1e4, -2e3], [0.0, -2e3, 9e3]])
        structure = fj.Structure(jnp.eye(3), jnp.diag(jnp.array([c1, c2, 0.0])), stiffness, [0.0, -1.0, 0.0])
        return fj.cea.critical_friction(structure)

    def by_hand(k, c):
        # The product of the couplings, 3e3 and 2e3 μ - 3e3, is the square of half the distance of the modes, and of damping.
        return ((((k - 1e4) / 2) ** 2 + c**2 * (k + 1e4) / 2) / 3e3 + 3e3) / 2e3

    with jax.enable_x64(True):
        mu, slopes = jax.value_and_grad(limit, (0, 1, 2))(12e3, damping, damping)
    exact = by_hand(12e3, damping), (1000.0 + damping**2 / 2) / 6e6, 2 * damping * 11e3 / 6e6
    assert float(mu) == pytest.approx(exact[0], rel=1e-10)
    assert float(slopes[0]) == pytest.approx(exact[1], rel=1e-8)
    assert float(slopes[1]) + float(slopes[2]) == pytest.approx(exact[2], rel=1e-8)


def test_the_first_derivative_of_a_limit_waits_for_no_compiler(compilations):
    """NumPy computes it, because XLA takes seconds to compile it; within a caller's program the two are the same."""

    def limit(k1):
        return fj.cea.critical_friction(fj.belt_oscillator(k1=k1))

    with jax.enable_x64(True):
        jax.grad(lambda k1: fj.belt_oscillator(k1=k1).stiffness[0, 0])(1e5)
        before = len(compilations)
        slope = jax.grad(limit)(1.1e5)
        assert not [name for name in compilations[before:] if "value" in name or "limit" in name]
        assert float(slope) == pytest.approx(float(jax.jit(jax.grad(limit))(1.1e5)), rel=1e-9)
        assert any("limit" in name for name in compilations[before:])


def test_a_function_of_parameters_is_differentiated_in_a_program_in_single_precision():
    def matrices(k, c):
        stiffness = jnp.array([[k, -3e3, 0.0], [-3e3, 1e4, -2e3], [0.0, -2e3, 9e3]])
        return jnp.eye(3), jnp.diag(jnp.array([c, c, c])), stiffness, jnp.array([0.0, -1.0, 0.0])

    structure = fj.Structure.from_parameters(matrices, dict(k=12e3, c=2.0), tangential=0, normal=2)
    with jax.enable_x64(False):
        slope = jax.grad(lambda c: fj.cea.critical_friction(structure.replace(c=c)))(2.1)
    ahead, behind = (float(fj.cea.critical_friction(structure.replace(c=2.1 + h))) for h in (1e-3, -1e-3))
    assert float(slope) == pytest.approx((ahead - behind) / 2e-3, rel=1e-5)


def test_modes_of_contacts_with_belts_of_their_own():
    """Where all belts run one way there is a limit; the scene's own directions are told."""
    structure = copies(2)
    mus = np.linspace(0.1, 0.3, 3)
    one_way, both, backwards = (
        cea.modes(fj.Scene(structure, fj.Coulomb(0.2), belts, fj.ConstantLoad(100.0)), mu=mus)
        for belts in ([1.0, 2.0], [1.0, -2.0], [-1.0, -2.0])
    )
    assert float(one_way["mu_crit"]) == pytest.approx(float(cea.critical_friction(structure)))
    assert "mu_crit" not in both
    told = [json.loads(found.attrs["settings"])["direction"] for found in (one_way, both, backwards)]
    assert told == [1, "several", -1]


@pytest.mark.parametrize("tangential", [0, 1])
def test_a_chart_ends_at_painleve_s_limit_whichever_coordinate_is_the_tangential_one(tangential):
    """Against the tangential direction, where sliding beyond it has no solution, or two."""
    order = [0, 1, 2] if tangential == 0 else [1, 0, 2]
    mass, damping, stiffness, load = (np.asarray(matrix) for matrix in fj.belt_oscillator().matrices)
    square = np.ix_(order, order)
    structure = fj.Structure(
        mass[square], damping[square], stiffness[square], load[order], tangential=tangential, normal=2
    )
    mus = float(fj.painleve_friction(structure)) * np.array([0.5, 0.999, 1.001, 1.5])
    # Without a load, because the normal force is negative before that limit.
    scene = fj.Scene(structure, fj.Coulomb(0.2), -1.0, fj.ConstantLoad(0.0))
    chart = cea.chart(scene, mu=mus, force=np.array([0.0, 1.0]))
    assert np.isnan(chart["growth_rate"].values[:, 0]).tolist() == [False, False, True, True]
