"""What is proved of several contacts: sliding for ever, limit cycles, maps; against the same of each contact alone."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.linalg import block_diag

import fivjax as fj
from fivjax.contact import Contact, Mechanics, Status, slides_uniquely
from fivjax.linear.linearisation import linear_sliding
from fivjax.section.free_directions import directions_of_several
from fivjax.verdicts.sliding_proof import margin_share_bound, sliding_modes
from tests.helpers.several_contacts import copies, scene_of

SHARES = np.array([1.0, 0.8])


def alone(friction, share):
    return fj.Scene(fj.belt_oscillator(), friction, 3.0, fj.ConstantLoad(100.0 * share))


def together(friction):
    return fj.Scene(copies(2, shares=SHARES), [friction, friction], 3.0, fj.ConstantLoad(100.0))


def proofs(scene, deviations):
    """Which of these deviations from sliding are proved to slide for ever."""
    with jax.enable_x64(True):
        modes = sliding_modes(jax.tree.map(lambda leaf: leaf[None], eqx.filter_jit(linear_sliding)(scene)))
        modes = jax.tree.map(lambda leaf: jnp.asarray(leaf[0]), modes)
        mechanics = eqx.filter_jit(Mechanics)(scene)
        one = jnp.ones(jnp.shape(mechanics.belt_speed))
        contact = Contact((Status.SLIDE * one).astype(jnp.int32), one)
        prove = jax.jit(jax.vmap(lambda y: margin_share_bound(mechanics, modes, contact, y, True) < 1))
        return np.asarray(prove(jnp.asarray(deviations)))


def some(count, seed):
    """Deviations of one oscillator from far below to above what events need, and the contact closed."""
    rng = np.random.default_rng(seed)
    y = rng.normal(size=(count, 6)) / np.asarray(fj.belt_oscillator().weights)
    y[:, [2, 5]] = 0.0
    return y * 10 ** rng.uniform(-4, 1, size=(count, 1))


def side_by_side(first, second):
    return np.concatenate([first[:, :3], second[:, :3], first[:, 3:], second[:, 3:]], axis=1)


def test_two_uncoupled_contacts_are_proved_to_slide_where_each_is():
    """The bound for both at once is that of each alone: as sharp, and never proving what one of them does not."""
    a, b = some(1000, 0), some(1000, 1)
    friction = fj.Coulomb(0.2)
    both = proofs(together(friction), side_by_side(a, b))
    each = proofs(alone(friction, SHARES[0]), a) & proofs(alone(friction, SHARES[1]), b)
    assert np.array_equal(both, each)
    assert 100 < both.sum() < 900


@pytest.mark.slow
def test_proved_sliding_of_several_contacts_under_falling_friction_has_no_event():
    """Friction that falls with speed: a long run of the largest deviations that are proved must show no event."""
    scene = together(fj.ExponentialDecay(0.2, 0.19, 0.5))
    y = side_by_side(some(400, 2), some(400, 3))
    proved = np.flatnonzero(proofs(scene, y))
    assert len(proved) > 20
    weights, q = np.asarray(scene.structure.weights), fj.sliding_equilibrium(scene)
    largest = proved[np.argsort(-np.linalg.norm(weights * y[proved], axis=1))[:6]]
    for row in largest:
        run = fj.simulate(scene, 6.0, 5e-3, y0=(q + y[row, :6], y[row, 6:]))
        assert np.all(run.status == Status.SLIDE)


def test_free_directions_keep_the_section_and_the_contact_modes():
    """What a neighbourhood is checked in: one direction goes for the section, two for a closed contact, three for one that sticks."""
    weights, section = np.arange(1.0, 13.0), np.array([1.0, 0, 0, 1.6, 0, 0])
    for status, held in (([2, 2], 0), ([1, 2], 2), ([1, 1], 4), ([0, 1], 5)):
        basis = directions_of_several(weights, section, np.array([0, 3]), np.array([2, 5]), np.array(status))
        assert basis.shape == (12, 11 - held)
        y = basis / weights[:, None]
        assert np.abs(section @ y[6:]).max() < 1e-14
        for place, one in zip((2, 5), status, strict=True):
            if one != Status.DETACH:
                assert np.abs(y[[place, 6 + place]]).max() < 1e-14


@eqx.filter_jit
def uniquely(scene):
    return slides_uniquely(Mechanics(scene))


def unique(structure, mu):
    with jax.enable_x64(True):
        return bool(uniquely(scene_of(structure, mu=mu)))


def test_friction_without_a_unique_answer_is_known_for_one_of_many_scenes():
    """The test inside a batch says what the one by NumPy does, of three coupled contacts too."""
    steep = fj.belt_oscillator(theta=0.8)
    limit = float(fj.painleve_friction(steep))
    pair = copies(2, steep)
    assert unique(pair, [0.1, 0.99 * limit])
    assert not unique(pair, [0.1, 1.01 * limit])


def with_friction(place, mu):
    """Two copies of which one hardly rubs, so that it slides again after any kick."""
    laws = [fj.Coulomb(0.02), fj.Coulomb(0.02)]
    laws[place] = fj.Coulomb(mu)
    return fj.Scene(copies(2), laws, 1.0, fj.Pulse(100.0, 1.5))


@pytest.mark.slow
@pytest.mark.parametrize("place", [0, 1])
def test_the_map_of_two_contacts_is_that_of_the_one_that_vibrates(place):
    """While the other copy comes back to sliding, verdicts are those of the oscillator alone, and amplitude and period of the
    limit cycle those of its own to rounding, whichever contact it is."""
    axes = {"mu": [0.2, 0.21], "p": [1.02, 1.2, 1.5, 2.0]}
    one = fj.bistability_map(fj.Scene(fj.belt_oscillator(), fj.Coulomb(0.2), 1.0, fj.Pulse(100.0, 1.5)), **axes)
    both = fj.bistability_map(with_friction(place, 0.2), t_max=10.0, **{f"mu_{place}": axes["mu"], "p": axes["p"]})
    assert np.array_equal(both["verdict"], one["verdict"])
    assert set(np.unique(one["verdict"])) == {0, 1}
    assert np.allclose(both["amplitude"], one["amplitude"], rtol=1e-12)
    assert np.allclose(both["attractor_period"], one["attractor_period"], rtol=1e-12)


@pytest.mark.slow
def test_the_limit_cycle_of_one_of_two_contacts_is_its_own():
    """Period, peak and multipliers: those of the oscillator alone, and those of the sliding copy."""
    scene, single = with_friction(1, 0.2), fj.Scene(fj.belt_oscillator(), fj.Coulomb(0.2), 1.0, fj.Pulse(100.0, 1.5))
    cycle = fj.limit_cycle(scene, start=fj.simulate(scene, 4.0, 0.01))
    own = fj.limit_cycle(single, start=fj.simulate(single, 4.0, 0.01))
    assert cycle.period == pytest.approx(own.period, rel=1e-12)
    assert cycle.amplitude == pytest.approx(own.amplitude, rel=1e-12)
    assert cycle.stable
    assert not cycle.in_family
    for start in (cycle, (cycle.state, cycle.contact.status), cycle.state):
        assert fj.limit_cycle(scene, start=start).period == pytest.approx(cycle.period, rel=1e-12)
    sliding = np.exp(fj.cea.eigenvalues(fj.belt_oscillator(), 0.02) * cycle.period)
    for value in np.concatenate([own.multipliers[:4], sliding]):
        assert np.min(np.abs(cycle.multipliers - value)) < 1e-6


@pytest.mark.slow
def test_two_copies_that_both_vibrate_are_one_of_a_family_and_no_limit_cycle():
    """Shifted against each other in time they are another periodic motion: a second multiplier is 1. That is said, and a map
    leaves it undecided."""
    scene = fj.Scene(copies(2), fj.Coulomb(0.2), 1.0, fj.Pulse(100.0, 1.5))
    cycle = fj.limit_cycle(scene, start=fj.simulate(scene, 4.0, 0.01))
    assert cycle.in_family
    assert not cycle.stable
    assert "second multiplier is 1" in str(cycle)
    m = fj.bistability_map(scene, p=[1.02, 1.5], t_max=3.0)
    assert m["verdict"].values.tolist() == [fj.Verdict.SLIDING, fj.Verdict.UNDECIDED]


@pytest.mark.slow
def test_the_limit_cycle_of_a_chain_of_equal_blocks_is_that_of_one_block():
    """Blocks of 1 kg on springs of 1 N/m, F_s = 1 N, F_d = 0.5 N, on a belt of 0.2 m/s: the closed form has the period
    8.902605408 s; the spring between them is never stretched."""
    stiffness = np.diag([1.0, 5.0, 1.0, 5.0])
    stiffness[np.ix_([0, 2], [0, 2])] += 0.7 * np.array([[1, -1], [-1, 1]])
    damping = np.diag([0.0, 1.0, 0.0, 1.0])
    contacts = [fj.ContactPoint(0, 1), fj.ContactPoint(2, 3)]
    structure = fj.Structure(np.eye(4), damping, stiffness, [0.0, -1, 0, -1], contacts=contacts)
    scene = scene_of(structure, mu=0.5, mu_static=1.0, belt=0.2, force=1.0)
    start = np.array([0.9, 0, 0.9, 0, 0.2, 0, 0.2, 0])
    cycle = fj.limit_cycle(scene, start=(start, (Status.STICK, Status.STICK)))
    assert cycle.period == pytest.approx(8.902605408, abs=1e-9)
    assert [phase.status for phase in cycle.word] == [(Status.SLIDE, Status.SLIDE), (Status.STICK, Status.STICK)] or [
        phase.status for phase in cycle.word
    ] == [(Status.STICK, Status.STICK), (Status.SLIDE, Status.SLIDE)]
    points = cycle.trajectory(50)
    assert np.abs(points.displacement[:, 0] - points.displacement[:, 2]).max() < 1e-12


@pytest.mark.slow
def test_the_torus_of_one_of_two_contacts_is_found_too():
    """At 3 m/s the paper's cycle beats: the set that the released trajectories meet on is that of one oscillator alone."""
    axes = {"mu": [0.2], "p": [1.2, 1.5, 2.0]}
    laws = [fj.Coulomb(0.2), fj.Coulomb(0.02)]
    one = fj.bistability_map(fj.Scene(fj.belt_oscillator(), fj.Coulomb(0.2), 3.0, fj.Pulse(100.0, 1.5)), **axes)
    scene = fj.Scene(copies(2), laws, 3.0, fj.Pulse(100.0, 1.5))
    both = fj.bistability_map(scene, t_max=8.0, mu_0=axes["mu"], p=axes["p"])
    assert np.array_equal(both["verdict"], one["verdict"])
    assert np.allclose(both["amplitude"], one["amplitude"], rtol=1e-3)
    assert list(both["attractor_kind"].values) == list(one["attractor_kind"].values) == ["torus"]


@pytest.mark.slow
def test_the_critical_kick_of_one_of_two_contacts_is_its_own():
    """The same scan and the same narrowing: the same bracket, to the last digit."""
    laws = [fj.Coulomb(0.2), fj.Coulomb(0.02)]
    one = fj.Scene(fj.belt_oscillator(), fj.Coulomb(0.2), 1.0, fj.Pulse(100.0, 1.2))
    both = fj.Scene(copies(2), laws, 1.0, fj.Pulse(100.0, 1.2))
    how = {"p_range": (1.2, 1.6), "p_step": 0.05, "tolerance": 1e-3, "t_max": 8.0, "force": [100.0]}
    expected, found = (fj.critical_perturbation(scene, **how) for scene in (one, both))
    assert np.isfinite(expected["p_crit"].values).all()
    for name in ("p_crit", "p_crit_low", "p_crit_high"):
        assert np.array_equal(found[name], expected[name])


@pytest.mark.slow
def test_the_saddle_cycle_of_one_of_two_contacts_is_its_own():
    """Edge tracking and Newton's method in the space of both: the unstable cycle of the oscillator alone."""
    scene, single = with_friction(0, 0.2), fj.Scene(fj.belt_oscillator(), fj.Coulomb(0.2), 1.0, fj.Pulse(100.0, 1.5))
    found, own = (
        fj.saddle_cycle(each, fj.limit_cycle(each, start=fj.simulate(each, 4.0, 0.01))) for each in (scene, single)
    )
    assert found.unstable_directions == own.unstable_directions == 1
    assert found.period == pytest.approx(own.period, rel=1e-10)
    assert found.amplitude == pytest.approx(own.amplitude, rel=1e-10)


@pytest.mark.parametrize("place", [0, 1])
def test_nothing_is_proved_of_a_contact_slower_than_what_the_bounds_on_friction_are_made_for(place):
    """They hold above half of the belt's speed, be the friction as good as constant and the other contact at rest."""
    scene = together(fj.ExponentialDecay(0.1, 0.1 - 1e-6, 0.5))
    shares = np.array([0.0, 0.02, 0.1, 0.51, 0.6, 0.9])
    y = np.zeros((len(shares), 12))
    y[:, 6 + scene.structure.contacts[place].tangential] = -3.0 * shares
    assert proofs(scene, y).tolist() == [True] * 3 + [False] * 3


@pytest.mark.slow
def test_growth_of_one_contact_beside_a_quiet_one_is_followed_to_its_cycle():
    """For minutes no contact has an event; then the motion is that of the oscillator alone, whose growth is bounded."""
    unstable, damped = fj.belt_oscillator(), fj.belt_oscillator(c1=200.0, c2=200.0)
    *matrices, load_directions = zip(unstable.matrices, damped.matrices, strict=True)
    contacts = [fj.ContactPoint(0, 2), fj.ContactPoint(3, 5)]
    pair = fj.Structure(*(block_diag(*own) for own in matrices), np.concatenate(load_directions), contacts=contacts)
    friction, load = fj.Coulomb(1.00003 * float(fj.cea.critical_friction(unstable))), fj.Pulse(100.0, p=1.05)
    both = fj.bistability_map(fj.Scene(pair, [friction, friction], [1.0, 1.3], load), p=[1.05], progress=False)
    one = fj.bistability_map(fj.Scene(unstable, friction, 1.0, load), p=[1.05], progress=False)
    assert both.verdict[0] == one.verdict[0] == fj.Verdict.LIMIT_CYCLE
    assert float(both.amplitude[0]) == pytest.approx(float(one.amplitude[0]), rel=1e-6)
    assert both.decided_at[0] > 40.0


def test_a_value_of_the_scene_that_is_on_an_axis_changes_no_bit_of_a_map():
    """Neither verdicts nor attractors, nor when they are proved: by scenes that are wrong by orders of magnitude."""
    scene = fj.Scene(fj.belt_oscillator(), fj.Coulomb(0.227), 1.0, fj.Pulse(100.0, 1.2))
    axes = {"k1": [99.5e3, 100e3], "p": [1.05, 1.2, 1.5, 2.0]}
    whole = fj.bistability_map(scene, progress=False, **axes)
    assert set(whole["verdict"].values.ravel().tolist()) == {0, 1}
    for own in (1e2, 1e9):
        other = fj.bistability_map(scene.replace(k1=own), progress=False, **axes)
        for name, variable in whole.data_vars.items():
            np.testing.assert_array_equal(other[name].values, variable.values, err_msg=str(name))
