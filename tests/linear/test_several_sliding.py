"""Linear theory of several sliding contacts: eigenvalues, critical friction and its derivatives."""

import itertools

import jax
import numpy as np
import pytest
from scipy import linalg

import fivjax as fj
from fivjax.linear.linearisation import LOWEST_SLIP, linear_sliding
from fivjax.verdicts.sliding_proof import why_withheld
from tests.helpers.general_coordinates import in_general_coordinates


def coupled(coupling: float = 0.0, stretch: float = 1.0) -> fj.Structure:
    """Two paper oscillators, the second with stiffer springs, joined along the belt and vertically; N/m."""
    one, other = fj.belt_oscillator(), fj.belt_oscillator(k1=stretch * 100e3)
    matrices = [np.asarray(linalg.block_diag(a, b)) for a, b in zip(one.matrices[:3], other.matrices[:3], strict=True)]
    for place in (0, 1):
        joint = np.eye(6)[place] - np.eye(6)[3 + place]
        matrices[2] = matrices[2] + coupling * np.outer(joint, joint)
    # Held a little in all directions, so that a spring may also be made softer.
    matrices[2] = matrices[2] + 0.05 * coupling * np.eye(6)
    contacts = [fj.ContactPoint(one.tangential, one.normal), fj.ContactPoint(3 + one.tangential, 3 + one.normal)]
    return fj.Structure(*matrices, np.tile(one.load_direction, 2), contacts=contacts)


def test_two_copies_are_two_copies():
    """Uncoupled oscillators lose stability where one does, at its frequency, and have its eigenvalues twice."""
    one, pair = fj.belt_oscillator(), coupled()
    limit, wanted = fj.cea.stability_limit(pair), fj.cea.stability_limit(one)
    assert limit.mu == pytest.approx(wanted.mu, rel=1e-9)
    assert limit.frequency == pytest.approx(wanted.frequency, rel=1e-6)
    assert limit.mechanism is fj.cea.Mechanism.FLUTTER
    both, single = (np.sort(fj.cea.eigenvalues(system, 0.15).imag) for system in (pair, one))
    np.testing.assert_allclose(both, np.repeat(single, 2), rtol=1e-9)


@pytest.mark.parametrize("ratio", [1e-6, 1e5, 1e7])
def test_a_far_stiffer_or_softer_coordinate_changes_no_limit(ratio):
    pair = coupled(2e4, 1.05)
    mass, damping, stiffness, load = map(np.asarray, pair.matrices)
    added = 1.0, 0.02 * ratio * 1e3, (ratio * 1e3) ** 2
    matrices = [linalg.block_diag(m, a) for m, a in zip((mass, damping, stiffness), added, strict=True)]
    limit = fj.cea.stability_limit(fj.Structure(*matrices, np.append(load, 0.0), contacts=pair.contacts))
    assert limit.mu == pytest.approx(fj.cea.critical_friction(pair), rel=1e-8)


def test_critical_friction_is_where_growth_begins_and_moves_as_differences_say():
    """Of coupled contacts: growth on one side only, and the sensitivities are those of differences."""
    pair = coupled(2e4, 1.05)
    mu = fj.cea.critical_friction(pair)
    assert fj.cea.growth_rate(pair, 0.999 * mu) < 0 < fj.cea.growth_rate(pair, 1.001 * mu)
    slopes = fj.cea.sensitivity(pair)
    for name, i, j in (("stiffness", 1, 1), ("mass", 0, 1), ("stiffness", 1, 4)):
        ends = []
        for sign in (1, -1):
            matrices = dict(zip(("mass", "damping", "stiffness"), map(np.array, pair.matrices[:3]), strict=True))
            step = 1e-5 * matrices[name][i, i]
            matrices[name][i, j] += sign * step
            matrices[name][j, i] = matrices[name][i, j]
            moved = fj.Structure(**matrices, load_direction=pair.load_direction, contacts=pair.contacts)
            ends.append(float(fj.cea.critical_friction(moved)))
        assert slopes[f"{name}[{i},{j}]"] == pytest.approx((ends[0] - ends[1]) / (2 * step), rel=1e-4)
    mass, _, stiffness, load = map(np.asarray, pair.matrices)
    undamped = fj.Structure(mass, np.zeros((6, 6)), stiffness, load, contacts=pair.contacts)
    assert fj.cea.stability_limit(undamped).mechanism is fj.cea.Mechanism.COALESCENCE
    slopes = fj.cea.sensitivity(undamped)
    assert np.isnan(slopes["mass[0,0]"])
    assert np.isnan(slopes["stiffness[1,4]"])


def test_falling_friction_and_vectors():
    """A scene whose friction falls with speed, and contacts by vectors instead of coordinates: the same eigenvalues."""
    one, pair = fj.belt_oscillator(), coupled()
    law, load = fj.ExponentialDecay(0.3, 0.1, 0.5), fj.ConstantLoad(100.0)
    assert fj.cea.growth_rate(fj.Scene(pair, law, 3.0, load)) == pytest.approx(
        fj.cea.growth_rate(fj.Scene(one, law, 3.0, load)), rel=1e-9
    )
    # The same structure seen from turned coordinates.
    pair = coupled(2e4, 1.05)
    turn = linalg.block_diag(*[linalg.expm(0.4 * np.array([[0, 1, 0], [-1, 0, 1], [0, -1, 0]]))] * 2)
    matrices = [0.5 * (m + m.T) for m in (turn.T @ np.asarray(m) @ turn for m in pair.matrices[:3])]
    contacts = [
        fj.ContactPoint(turn.T @ pair.tangential_directions[:, i], turn.T @ pair.normal_directions[:, i])
        for i in (0, 1)
    ]
    turned = fj.Structure(*matrices, turn.T @ np.asarray(pair.load_direction), contacts=contacts)
    np.testing.assert_allclose(
        fj.cea.eigenvalues(fj.Scene(turned, fj.Coulomb(0.3), 3.0, load)), fj.cea.eigenvalues(pair, 0.3), rtol=1e-8
    )


def test_modes_along_friction_and_what_has_no_steady_sliding():
    """Curves of modes have as many modes as coordinates are free; a load that lifts a contact off is refused."""
    modes = fj.cea.modes(coupled(2e4, 1.05), mu=np.linspace(0.0, 0.3, 4))
    assert modes.sizes["mode"] == 4
    assert 0 < modes["mu_crit"] < 0.3
    assert np.all(modes["shape"].sel(coordinate=[2, 5]) == 0)
    # One contact by vectors: its free coordinates are those of the contacts, not what its vectors look like as places.
    pair, one, unit = coupled(2e4, 1.05), fj.belt_oscillator(), np.eye(6)
    first = fj.ContactPoint(unit[one.tangential], unit[one.normal])
    mixed = fj.Structure(*pair.matrices, contacts=[first, pair.contacts[1]])
    same = fj.cea.modes(mixed, mu=np.linspace(0.0, 0.3, 4))
    np.testing.assert_allclose(same["frequency"], modes["frequency"], rtol=1e-9)
    assert np.all(same["shape"].sel(coordinate=[2, 5]) == 0)
    pair = coupled(2e4, 1.05)
    upwards = fj.Structure(*pair.matrices[:3], -np.asarray(pair.load_direction), contacts=pair.contacts)
    lifted = fj.Scene(upwards, fj.Coulomb(0.2), 3.0, fj.ConstantLoad(100.0))
    with pytest.raises(ValueError, match="There is no sliding equilibrium: the belt would have to pull"):
        fj.cea.growth_rate(lifted)


def test_one_law_on_belts_of_two_speeds_is_looked_at_for_each_contact():
    """A map says in the end why nothing was proved; the law is one, the speeds are two."""
    steep = fj.ExponentialDecay(0.3, 0.1, 1.0)
    for law in (fj.Coulomb(0.2), steep):
        assert why_withheld(fj.Scene(coupled(), law, np.array([1.0, 2.0]), fj.Pulse(100.0, 1.2))) is None


def test_up_to_the_reach_no_contact_of_several_lifts_off():
    """The exact forces of all contacts, where slips and linear forces deviate by that share: `LinearSliding.reach` and its equation.

    Under steeply falling friction the force of one contact changes with the slip of the others, most by those that bear most.
    """
    rng, scenes = np.random.default_rng(5), []
    speed, sign, corners = np.array([0.4, 0.3]), np.array([1.0, -1.0]), list(itertools.product((-1.0, 1.0), repeat=2))
    for most, shape in zip(rng.uniform(0.3, 0.9, (40, 2)), rng.normal(size=(40, 5, 5)), strict=True):
        load, contacts = (
            np.array([0.0, 0.0, -rng.uniform(0.05, 20.0), -1.0, 0.0]),
            [fj.ContactPoint(0, 2), fj.ContactPoint(1, 3)],
        )
        structure = fj.Structure(shape @ shape.T + np.eye(5), 0.1 * np.eye(5), 1e3 * np.eye(5), load, contacts=contacts)
        laws = [fj.ExponentialDecay(float(mu), 0.1, decay=5.0) for mu in most]
        scenes.append((most, fj.Scene(structure, laws, sign * speed, fj.ConstantLoad(10.0))))
    with jax.enable_x64(True):
        stacked = jax.tree.map(lambda *leaves: np.stack(leaves), *(scene for _, scene in scenes))
        linear = jax.jit(jax.vmap(linear_sliding))(stacked)
    bounded = 0
    for k, (most, scene) in enumerate(scenes):
        reach, forces = float(linear.reach[k]), np.asarray(linear.pressing_margin[k])
        if not (linear.exists[k] and linear.solvable[k] and reach > 0):
            continue
        bounded += reach < LOWEST_SLIP
        inverse = np.linalg.inv(np.asarray(scene.structure.mass))
        friction = lambda v, most=most: sign * (0.1 + (most - 0.1) * np.exp(-5.0 * v))  # noqa: E731
        handed_on = np.linalg.solve(inverse[2:4, 2:4] + inverse[2:4, :2] * friction(speed), inverse[2:4, :2])
        for slips, loads in itertools.product(corners, repeat=2):
            change = friction(speed * (1 + reach * np.array(slips))) - friction(speed)
            # Constant friction leaves no force within the reach; what is left is due to the other contacts' friction.
            normal = forces * (1 + 0.999999 * reach * np.array(loads))
            assert np.all(np.linalg.solve(np.eye(2) + handed_on * change, normal) > 0)
    assert bounded > 5


def test_the_limit_of_several_contacts_is_compiled_within_a_program_in_single_precision():
    one = fj.belt_oscillator()
    mass, damping, stiffness = (np.kron(np.eye(2), np.asarray(part)) for part in (one.mass, one.damping, one.stiffness))
    spring = np.zeros((6, 6))
    spring[np.ix_((0, 3), (0, 3))] = [[1, -1], [-1, 1]]
    contacts, load = [fj.ContactPoint(0, 2), fj.ContactPoint(3, 5)], np.tile(np.asarray(one.load_direction), 2)

    def limit(k):
        return fj.cea.critical_friction(fj.Structure(mass, damping, stiffness + k * spring, load, contacts=contacts))

    with jax.enable_x64(False):
        found = float(jax.jit(limit)(500.0))
    assert found == pytest.approx(float(limit(500.0)), rel=1e-5)


def test_each_contact_has_the_slope_of_its_own_law_at_its_own_speed():
    laws = [fj.ExponentialDecay(0.3, 0.1, 0.5), fj.Coulomb(0.2)]
    scene = fj.Scene(coupled(), laws, [0.8, 0.3], fj.ConstantLoad(100.0))
    np.testing.assert_allclose(fj.cea.friction_slope(scene), [-0.2 * 0.5 * np.exp(-0.5 * 0.8), 0.0], rtol=1e-12)
    with pytest.raises(ValueError, match=r"`critical_slope` takes structures with one contact, but this one has 2"):
        fj.cea.critical_slope(scene)


@pytest.mark.parametrize("changed", [{"k2": 130e3, "theta": 0.003}, {"theta": -0.01}, {}])
def test_one_contact_given_by_vectors_has_the_limit_of_one_at_coordinates(changed):
    """Also above 2, up to which limits of several contacts are sought."""
    plain = fj.belt_oscillator(**changed)
    expected, found = fj.cea.stability_limit(plain), fj.cea.stability_limit(in_general_coordinates(plain))
    assert found.mechanism is expected.mechanism
    assert found.mu == pytest.approx(expected.mu, rel=1e-8)
    assert float(fj.cea.critical_friction(in_general_coordinates(plain))) == pytest.approx(expected.mu, rel=1e-8)


def test_without_damping_a_contact_given_by_vectors_has_sensitivities():
    """Limits of several contacts have none then. Differences are the reference."""
    structure = in_general_coordinates(fj.belt_oscillator(c1=0.0, c2=0.0))
    found = fj.cea.sensitivity(structure)["stiffness[0,0]"]

    def limit(step):
        stiffness = np.array(structure.stiffness)
        stiffness[0, 0] += step
        matrices = np.asarray(structure.mass), np.asarray(structure.damping), stiffness
        return float(
            fj.cea.critical_friction(fj.Structure(*matrices, structure.load_direction, contacts=structure.contacts))
        )

    # To one side, because nothing holds the structure in one direction but the belt.
    assert found == pytest.approx((4 * limit(1.0) - limit(2.0) - 3 * limit(0.0)) / 2, rel=1e-5)


def test_a_chart_of_several_contacts_has_their_growth_rates():
    """Point by point, those of `growth_rate`; and NaN where there is no steady sliding."""
    structure = coupled(1e5)
    mu, force = np.linspace(0.25, 0.6, 4), [50.0, 100.0]
    scene = fj.Scene(structure, fj.ExponentialDecay(0.3, 0.2, 0.5), 1.5, fj.Pulse(100.0, 1.2))
    chart = fj.cea.chart(scene, mu_static=mu, force=force)
    for i, value in enumerate(mu):
        for j, load in enumerate(force):
            own = scene.replace(mu_static=float(value), force=load)
            assert chart["growth_rate"].values[i, j] == pytest.approx(
                float(fj.cea.growth_rate(own)), rel=1e-9, abs=1e-9
            )
    assert "margin" not in chart and np.all(chart["normal_force"] > 0)
    # On a belt that runs the other way, so much friction lifts one of them off.
    mixed = fj.cea.chart(scene.replace(belt_speed=-1.5), mu_static=[0.3, 1e3], force=force)
    assert np.isfinite(mixed["growth_rate"].values[0]).all() and np.isnan(mixed["growth_rate"].values[1]).all()
    # So are frequencies: a picture has a gap there, and no fall to zero.
    assert np.isnan(mixed["frequency"].values[1]).all()
    falling = fj.cea.modes(fj.Scene(fj.belt_oscillator(), scene.friction, 1.5, scene.load), belt_speed=[-1.0, 0.0, 1.0])
    assert np.isnan(falling["frequency"].values).all(axis=1).tolist() == [False, True, False]
    for function in (lambda: fj.cea.margin(structure, 0.2), lambda: fj.cea.coalescence(structure)):
        with pytest.raises(ValueError, match="takes structures with one contact, but this one has 2"):
            function()
