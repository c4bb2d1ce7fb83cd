"""Friction laws, loads, and scenes: Eqs. 1 and 14, the sliding equilibrium of Eq. 3, and what is refused."""

import copy
import math
import pickle
import re
import warnings

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import sparse

import fivjax as fj
from tests.helpers.general_coordinates import in_general_coordinates

# A handful of double-precision operations.
ROUNDING = 1e-14


def eq1(mu_static, mu_dynamic, decay, slip_speed):
    """Eq. 1 as printed."""
    return mu_dynamic - (mu_dynamic - mu_static) * math.exp(-decay * abs(slip_speed))


def sentence(message):
    return message[0].isupper() and message[-1] in ".?" and "\n" not in message


def paper_scene_with(friction=None, load=None, belt_speed=3.0, **options):
    return fj.Scene(fj.belt_oscillator(), friction or fj.Coulomb(0.2), belt_speed, load or fj.Pulse(), **options)


# ---------------------------------------------------------------------------------------- friction


@pytest.mark.parametrize("coefficients", [(0.2, 0.1, 0.5), (0.6, 0.0, 20.0), (0.3, 0.3, 1.0), (0.4, 0.1, 0.0)])
@pytest.mark.parametrize("slip_speed", [0.0, 1e-3, 0.5, 3.0, 100.0])
def test_exponential_decay_is_eq_1(coefficients, slip_speed):
    """The falling friction law is Eq. 1 of the paper, at rest and at any slip speed."""
    with jax.enable_x64(True):
        mu = float(fj.ExponentialDecay(*coefficients)(jnp.asarray(slip_speed)))
    assert mu == pytest.approx(eq1(*coefficients, slip_speed), rel=ROUNDING)


def test_exponential_decay_defaults_to_the_papers_decay():
    """The decay is the paper's 0.5 s/m by default: two coefficients are enough to give its law."""
    law = fj.ExponentialDecay(mu_static=0.2, mu_dynamic=0.1)
    assert float(law.decay) == 0.5
    assert float(law.static) == 0.2


def test_coulomb_is_constant_and_knows_its_static_coefficient():
    """Sliding friction is constant; sticking is limited by the static coefficient, as stick–slip requires."""
    with jax.enable_x64(True):
        speeds = jnp.linspace(0.0, 50.0, 7)
        assert {float(fj.Coulomb(0.23)(speed)) for speed in speeds} == {0.23}
    assert float(fj.Coulomb(0.23).static) == 0.23
    assert float(fj.Coulomb(0.2, mu_static=0.3).static) == 0.3


@pytest.mark.parametrize(
    "law",
    [
        lambda: fj.Coulomb(0.3),
        lambda: fj.Coulomb(0.3, 0.5),
        lambda: fj.ExponentialDecay(0.2, 0.1, 0.5),
        lambda: fj.ExponentialDecay(0.9, 0.0, 30.0),
        lambda: fj.ExponentialDecay(0.4, 0.1, 0.0),
    ],
)
def test_variation_bounds_both_derivatives(law):
    """`variation` bounds slope and curvature of the law above a slip speed: the proof of sliding rests on it."""
    with jax.enable_x64(True):
        law = law()
        speeds = jnp.linspace(0.0, 12.0, 241)
        slope = np.abs(jax.vmap(jax.grad(law))(speeds))
        bend = np.abs(jax.vmap(jax.grad(jax.grad(law)))(speeds))
        slope_bound, bend_bound = (np.asarray(bound) for bound in jax.vmap(law.variation)(speeds))
    # The largest derivative at or above each speed of the grid.
    slope_above = np.maximum.accumulate(slope[::-1])[::-1]
    bend_above = np.maximum.accumulate(bend[::-1])[::-1]
    # The difference that the bound is made of cancels where the law has decayed; that error is absolute in μ.
    allowance = 1 + ROUNDING, 1e-15 * float(law.static) * 30.0**2
    assert np.all(slope_above <= slope_bound * allowance[0] + allowance[1])
    assert np.all(bend_above <= bend_bound * allowance[0] + allowance[1])
    # The bounds are at most twice too large: a looser one would delay a proof, an infinite one would prove nothing.
    assert np.all(slope_bound <= 2 * slope_above + allowance[1])
    assert np.all(bend_bound <= 2 * bend_above + allowance[1])


@pytest.mark.parametrize(
    ("make", "names", "values"),
    [
        (lambda: fj.Coulomb(mu=0.3, mu_static=0.2), ("mu_static", "mu"), ("0.2", "0.3")),
        (lambda: fj.ExponentialDecay(mu_static=0.1, mu_dynamic=0.2), ("mu_static", "mu_dynamic"), ("0.1", "0.2")),
    ],
)
def test_friction_refuses_a_static_coefficient_below_the_sliding_one(make, names, values):
    """Static friction below sliding friction is refused: a contact would alternate between both at one instant."""
    with pytest.raises(ValueError, match="must be at least") as refusal:
        make()
    message = str(refusal.value)
    assert all(f"`{name}`" in message for name in names)
    assert all(value in message for value in values)
    assert sentence(message)


def test_equal_coefficients_are_in_order():
    """Equal coefficients are allowed: falling friction can be reduced continuously to none."""
    assert float(fj.ExponentialDecay(0.2, 0.2).mu_dynamic) == 0.2
    assert float(fj.Coulomb(0.2, 0.2).static) == 0.2


BAD_NUMBERS = [(-0.1, "non-negative", "-0.1"), (math.nan, "finite", "nan"), (math.inf, "finite", "inf")]


@pytest.mark.parametrize(("value", "rule", "shown"), BAD_NUMBERS)
@pytest.mark.parametrize(
    ("kind", "name"),
    [
        ("Coulomb", "mu"),
        ("Coulomb", "mu_static"),
        ("ExponentialDecay", "mu_static"),
        ("ExponentialDecay", "mu_dynamic"),
        ("ExponentialDecay", "decay"),
        ("ConstantLoad", "force"),
        ("Pulse", "force"),
        ("Pulse", "p"),
        ("Pulse", "duration"),
        ("Pulse", "start"),
    ],
)
def test_laws_and_loads_refuse_values_out_of_range(kind, name, value, rule, shown):
    """Negative, infinite and NaN values are refused: negative friction, for one, would drive the motion."""
    good = {
        "Coulomb": dict(mu=0.2),
        "ExponentialDecay": dict(mu_static=0.2, mu_dynamic=0.1, decay=0.5),
        "ConstantLoad": {},
        "Pulse": {},
    }
    with pytest.raises(ValueError, match=rf"^Argument `{name}` must be {rule}, but is {re.escape(shown)}\.$"):
        getattr(fj, kind)(**{**good[kind], name: value})


@pytest.mark.parametrize("value", ["0.2", None, [0.2, 0.3], 0.2j])
def test_friction_refuses_what_is_no_number(value):
    """What is no single real number is refused by the name of its argument, not somewhere inside JAX."""
    with pytest.raises((TypeError, ValueError), match=r"^Argument `mu` must be "):
        fj.Coulomb(value)


# -------------------------------------------------------------------------------------------- load


def test_pulse_is_eq_14():
    """The load is p F0 during the kick and F0 otherwise, as in Eq. 14."""
    pulse = fj.Pulse(force=100.0, p=1.3, duration=0.1, start=0.5)
    inside, outside = 130.0, 100.0
    with jax.enable_x64(True):
        for t, force in {
            -1.0: outside,
            0.25: outside,
            0.501: inside,
            0.599: inside,
            0.601: outside,
            9.0: outside,
        }.items():
            assert float(pulse(jnp.asarray(t))) == pytest.approx(force, rel=ROUNDING)
        np.testing.assert_allclose(np.asarray(pulse.jumps), [0.5, 0.6], rtol=ROUNDING)
        assert float(pulse.final) == outside
    assert float(pulse.force) == outside


def test_pulse_defaults_are_the_papers():
    """A pulse without arguments is the paper's kick."""
    pulse = fj.Pulse()
    assert [float(x) for x in (pulse.force, pulse.p, pulse.duration, pulse.start)] == [100.0, 1.2, 0.1, 0.0]


def test_a_kick_may_also_relieve():
    """A kick may also relieve the contact: p below 1, down to 0, is allowed."""
    with jax.enable_x64(True):
        assert float(fj.Pulse(p=0.0)(jnp.asarray(0.05))) == 0.0


def test_constant_load_never_changes():
    """A constant load has one value at all times and no jumps, so that no step has to end at one."""
    load = fj.ConstantLoad(250.0)
    with jax.enable_x64(True):
        assert load.jumps.shape == (0,)
        assert {float(load(jnp.asarray(t))) for t in (-5.0, 0.0, 0.05, 100.0)} == {250.0}
        assert float(load.final) == 250.0
    # Without a word also where the caller has single precision.
    with warnings.catch_warnings(action="error"):
        assert load.jumps.shape == (0,)


def test_values_keep_double_precision_outside_x64():
    """Parameters keep double precision: rounded, μ = 0.227 would lie at another distance from the stability limit."""
    assert not jax.config.jax_enable_x64
    scene = paper_scene_with(fj.Coulomb(0.227), fj.Pulse(p=1.19))
    assert float(scene.parameters["mu"]) == 0.227
    assert float(scene.parameters["p"]) == 1.19


# ------------------------------------------------------------------------------------------- scene


def test_scene_refuses_parts_of_the_wrong_kind():
    """A number or an array in place of a structure, a law or a load is refused by name, not missed deep inside."""
    structure, friction = fj.belt_oscillator(), fj.Coulomb(0.2)
    for arguments, name, shown in (
        ((np.eye(3), friction), "structure", "array of float64 with shape (3, 3)"),
        ((structure, 0.2), "friction", "0.2 (float)"),
        ((structure, friction, 3.0, 100.0), "load", "100.0 (float)"),
        ((friction, structure), "structure", "Coulomb"),
    ):
        with pytest.raises(TypeError, match=rf"^Argument `{name}` must be .*{re.escape(shown)}") as refusal:
            fj.Scene(*arguments)
        assert sentence(str(refusal.value))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (dict(restitution=-0.1), "Argument `restitution` must be non-negative, but is -0.1."),
        (dict(restitution=1.5), "Argument `restitution` must be at most 1, but is 1.5."),
        (dict(restitution=math.nan), "Argument `restitution` must be finite, but is nan."),
        (dict(belt_speed=math.nan), "Argument `belt_speed` must be finite, but is nan."),
        (dict(belt_speed=-math.inf), "Argument `belt_speed` must be finite, but is -inf."),
        (
            dict(impact_law="newton"),
            'Argument `impact_law` must be one of "coulomb", "frictionless", "reset", but is \'newton\'.',
        ),
        (
            dict(impact_law=None),
            'Argument `impact_law` must be one of "coulomb", "frictionless", "reset", but is None.',
        ),
    ],
)
def test_scene_refuses_values_out_of_range(options, message):
    """Restitution above 1, which creates energy, and misspelt impact laws are refused."""
    with pytest.raises(ValueError, match=f"^{re.escape(message)}$"):
        paper_scene_with(**options)


@pytest.mark.parametrize("restitution", [0, 0.0, 1, 1.0])
def test_both_ends_of_restitution_are_allowed(restitution):
    """Restitution may be 0 or 1: the inelastic and the elastic limit can be studied."""
    assert float(paper_scene_with(restitution=restitution).restitution) == restitution


@pytest.mark.parametrize("law", ["coulomb", "frictionless", "reset"])
def test_impact_laws_are_kept_by_replace(law):
    """`replace` keeps the impact law, so that a whole map has the law of its scene."""
    scene = paper_scene_with(impact_law=law)
    assert scene.impact_law == law
    assert scene.replace(mu=0.1).impact_law == law
    # As an array of words gives it.
    assert repr(paper_scene_with(impact_law=np.array([law])[0]).impact_law) == repr(law)


def test_lists_for_one_contact_are_its_own_values():
    """So that what is written for any number of contacts runs for one, too."""
    law = fj.Coulomb(0.2)
    listed = fj.Scene(fj.belt_oscillator(), [law], [3.0], restitution=np.array([0.4]))
    single = fj.Scene(fj.belt_oscillator(), law, 3.0, restitution=0.4)
    assert eqx.tree_equal(listed, single)
    assert eqx.tree_equal(listed.replace(belt_speed=[2.0]), single.replace(belt_speed=2.0))


def test_replace_reaches_every_part_and_nothing_else():
    """`replace` changes the named parameters, of whichever part of the scene, and no other."""
    scene = paper_scene_with(fj.Coulomb(0.2, 0.25), fj.Pulse(), restitution=0.1)
    changes = dict(mu=0.21, mu_static=0.3, p=1.5, start=0.2, belt_speed=-2.0, restitution=0.4, k2=99e3, theta=0.02)
    before = {name: float(value) for name, value in scene.parameters.items()}
    after = {name: float(value) for name, value in scene.replace(**changes).parameters.items()}
    assert after == {**before, **changes}
    assert {name: float(value) for name, value in scene.parameters.items()} == before


def test_replace_rebuilds_the_matrices():
    """Replacing k2 changes the stiffness matrix too; otherwise k2 would have no effect as an axis of a map."""
    stiffness = np.asarray(paper_scene_with().replace(k2=99e3).structure.stiffness)
    np.testing.assert_array_equal(stiffness, np.asarray(fj.belt_oscillator(k2=99e3).stiffness))


@pytest.mark.parametrize("name", ["k3", "mu_static", "impact_law", "load"])
def test_replace_refuses_unknown_names(name):
    """A name that the scene lacks is refused, with those that it has: ignored, it would change nothing unnoticed."""
    part = rf"( For another `{name}` make a new `fj.Scene` from the parts of this one\.)"
    match = (
        rf"no parameter `{name}`; it has: belt_speed, c1, .*theta\.{part if name in ('impact_law', 'load') else ''}$"
    )
    with pytest.raises(ValueError, match=match) as refusal:
        paper_scene_with().replace(**{name: 0.3})
    assert sentence(str(refusal.value))


@pytest.mark.parametrize(
    ("changes", "fragments"),
    [
        (dict(mu=0.3), ("`mu_static` must be at least `mu`", "0.25", "0.3")),
        (dict(mu=-1.0), ("`mu` must be non-negative", "-1")),
        (dict(p=math.nan), ("`p` must be finite", "nan")),
        (dict(m1=0.0), ("`m1` must be positive", "0")),
        (dict(restitution=2.0), ("`restitution` must be at most 1", "2")),
    ],
)
def test_replace_refuses_what_the_part_refuses(changes, fragments):
    """`replace` refuses every value that the part itself refuses, so that no axis of a map lets one in."""
    with pytest.raises(ValueError, match=re.escape(fragments[0])) as refusal:
        paper_scene_with(fj.Coulomb(0.2, 0.25)).replace(**changes)
    assert all(fragment in str(refusal.value) for fragment in fragments)


def test_parameters_of_a_matrix_structure_are_those_of_the_other_parts():
    """With a structure given as matrices, a scene has only the parameters of friction, load, belt and impact."""
    structure = fj.Structure(np.eye(2), np.eye(2), np.eye(2), [0, -1], tangential=0, normal=1)
    scene = fj.Scene(structure, fj.Coulomb(0.2), 1.0, fj.ConstantLoad())
    assert set(scene.parameters) == {"mu", "force", "belt_speed", "restitution"}


# --------------------------------------------------------------------------------- sliding equilibrium


def eq3(mu, m1, m2, c1, c2, k1, k2, theta):
    """Stiffness of Eq. 3, typed in from the paper; μ counts negative where the mass outruns the belt."""
    s, c = math.sin(theta), math.cos(theta)
    del m1, m2, c1, c2
    return np.array(
        [
            [k2 * s**2 + k1 * c**2 + mu / 2 * (k1 - k2) * math.sin(2 * theta), -k2 * s + mu * k2 * c],
            [-k2 * s, k2],
        ]
    )


@pytest.mark.parametrize("belt_speed", [3.0, -0.7])
@pytest.mark.parametrize("theta", [0.01, 0.4, -0.3])
def test_sliding_equilibrium_solves_eq_3(belt_speed, theta):
    """The sliding equilibrium solves Eq. 3 at rest; a run started elsewhere would vibrate without a kick."""
    parameters = dict(m1=0.53, m2=0.045, c1=1.0, c2=1.0, k1=100e3, k2=130e3, theta=theta)
    law = fj.ExponentialDecay(0.2, 0.1, 0.5)
    load = fj.Pulse(force=80.0, p=3.0)
    q = fj.sliding_equilibrium(fj.Scene(fj.belt_oscillator(**parameters), law, belt_speed, load))
    mu = math.copysign(eq1(0.2, 0.1, 0.5, belt_speed), belt_speed)
    assert q.shape == (3,)
    assert q.dtype == np.float64
    assert q[2] == 0.0
    # Residual of a well-conditioned 2 × 2 system: rounding of the forces in it.
    np.testing.assert_allclose(eq3(mu, **parameters) @ q[:2], [0.0, -80.0], rtol=0, atol=1e-12 * 80.0)


def test_sliding_equilibrium_of_a_large_structure_balances_forces():
    """Forces balance at the sliding equilibrium of a structure with any number of coordinates."""
    rng = np.random.default_rng(3)
    n, tangential, normal, mu, force = 7, 4, 1, 0.3, 12.0
    root = rng.normal(size=(n, n))
    stiffness = root @ root.T + n * np.eye(n)
    direction = np.zeros(n)
    direction[normal] = -1.0
    structure = fj.Structure(np.eye(n), np.eye(n), stiffness, direction, tangential=tangential, normal=normal)
    q = fj.sliding_equilibrium(fj.Scene(structure, fj.Coulomb(mu), -1.0, fj.ConstantLoad(force)))
    contact_forces = stiffness @ q - direction * force
    assert q[normal] == 0.0
    pressing, friction = contact_forces[normal], contact_forces[tangential]
    assert pressing > 0
    # Rounding in sums of n terms of size ‖K‖‖q‖.
    rounding = 1e-13 * np.abs(stiffness).max() * np.abs(q).max() * n
    assert friction == pytest.approx(-mu * pressing, abs=rounding)  # a belt that runs backwards drags backwards
    np.testing.assert_allclose(np.delete(contact_forces, [tangential, normal]), 0.0, atol=rounding)


def test_no_equilibrium_on_a_belt_at_rest():
    """A belt at rest is refused: it has many equilibria, and no direction of friction."""
    with pytest.raises(ValueError, match=r"`belt_speed` must not be zero.*`y0`") as refusal:
        fj.sliding_equilibrium(paper_scene_with(belt_speed=0.0))
    assert sentence(str(refusal.value))


def test_no_equilibrium_where_the_belt_would_have_to_pull():
    """An equilibrium with a negative normal force is refused: the belt cannot pull."""
    structure = fj.Structure(np.eye(2), np.eye(2), np.eye(2), [0.0, 1.0], tangential=0, normal=1)
    with pytest.raises(ValueError, match=r"the belt would have to pull with 5 N") as refusal:
        fj.sliding_equilibrium(fj.Scene(structure, fj.Coulomb(0.2), 1.0, fj.ConstantLoad(5.0)))
    assert sentence(str(refusal.value))


def test_no_equilibrium_where_nothing_holds_against_friction():
    """Where no spring holds against friction there is no equilibrium, and none is given."""
    structure = fj.Structure(np.eye(2), np.eye(2), np.diag([0.0, 1.0]), [0.0, -1.0], tangential=0, normal=1)
    with pytest.raises(ValueError, match=r"sliding stiffness matrix is singular") as refusal:
        fj.sliding_equilibrium(fj.Scene(structure, fj.Coulomb(0.2), 1.0, fj.ConstantLoad(5.0)))
    assert sentence(str(refusal.value))


@pytest.mark.parametrize("seed", [0, 1, 3])
def test_no_equilibrium_where_a_motion_is_free_but_for_rounding(seed):
    """A stiffness matrix that is singular to rounding is refused: its equilibrium would lie 1e16 m away."""
    springs = np.random.default_rng(seed).normal(size=(2, 4))  # two springs for three coordinates that can move
    structure = fj.Structure(np.eye(4), np.eye(4), springs.T @ springs, [0.3, -0.2, -1.0, -1.0], tangential=0, normal=3)
    with pytest.raises(ValueError, match="sliding stiffness matrix is singular"):
        fj.sliding_equilibrium(fj.Scene(structure, fj.Coulomb(0.0), 1.0, fj.ConstantLoad(1.0)))


# ------------------------------------------------------------------------------------------- Painlevé


@pytest.mark.parametrize(("theta", "printed", "digits"), [(0.01, 108.49, 2), (0.5, 2.03, 2), (0.8, 1.14, 2)])
def test_painleve_friction_of_the_belt_oscillator(theta, printed, digits):
    """The Painlevé limit is exact: above it contact forces are not unique, below it no run may be refused."""
    limit = fj.painleve_friction(fj.belt_oscillator(theta=theta))
    assert round(limit, digits) == printed
    m1, m2, s, c = 0.53, 0.045, math.sin(theta), math.cos(theta)
    assert limit == pytest.approx((m2 + m1 * c**2) / (m1 * s * c), rel=1e-12)  # two small linear solves


def test_painleve_friction_is_the_same_for_the_mirrored_belt():
    """The Painlevé limit is the same for θ and −θ: in either case one direction of slip meets the paradox."""
    up, down = (fj.painleve_friction(fj.belt_oscillator(theta=theta)) for theta in (0.5, -0.5))
    assert up == pytest.approx(down, rel=1e-12)


def test_painleve_friction_is_infinite_without_coupling():
    """Without inertial coupling of normal and tangential motion there is no Painlevé limit."""
    plain = fj.belt_oscillator(theta=0.0)
    assert fj.painleve_friction(plain) == fj.painleve_friction(in_general_coordinates(plain)) == math.inf


def test_a_name_that_two_parts_share_is_refused():
    """`replace` and the axes of maps would have changed both."""

    def matrices(mu, c):
        return jnp.eye(2), c * jnp.eye(2), mu * jnp.eye(2), jnp.array([0.0, -1.0])

    structure = fj.Structure.from_parameters(matrices, dict(mu=1e4, c=1.0), tangential=0, normal=1)
    with pytest.raises(ValueError, match="Parameter `mu` of the structure has the name of one of the friction law"):
        fj.Scene(structure, fj.Coulomb(0.2), 1.0, fj.Pulse(10.0, 1.2))


@pytest.mark.parametrize("again", [lambda one: pickle.loads(pickle.dumps(one)), copy.deepcopy])
def test_a_scene_comes_back_from_a_pickle_to_the_last_bit(again):
    """Also in a program in single precision, where JAX's arrays do not."""
    laws = [fj.Coulomb(0.227, 0.3), fj.ExponentialDecay(0.2, 0.1, 0.5)]
    scenes = [fj.Scene(fj.belt_oscillator(m1=0.1 + 0.2), law, 1 / 3, fj.Pulse(100.0, 1.3)) for law in laws]
    with jax.enable_x64(False):
        for scene in scenes:
            found = again(scene)
            for name, value in scene.parameters.items():
                assert found.parameters[name].dtype == value.dtype and float(found.parameters[name]) == float(value)
            np.testing.assert_array_equal(found.structure.stiffness, scene.structure.stiffness)
            assert jax.tree.structure(found) == jax.tree.structure(scene)


def test_scenes_and_sparse_matrices_in_place_of_others_have_a_remedy():
    scene = fj.Scene(fj.belt_oscillator(), fj.Coulomb(0.2), 1.0, fj.Pulse(100.0, 1.2))
    with pytest.raises(TypeError, match=r"such as belt_oscillator\(\), or `scene.structure`"):
        fj.cea.critical_friction(scene)
    with pytest.raises(
        TypeError, match=r"Argument `mass` must be an array, but is of type .*: give it as `.toarray\(\)`"
    ):
        fj.Structure(sparse.eye_array(2), np.eye(2), np.eye(2), [0.0, -1.0], tangential=0, normal=1)
