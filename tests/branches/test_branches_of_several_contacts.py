"""Branches of cycles of several contacts: as those of one of them alone, and against a solver that shares no code."""

import numpy as np
import pytest

import fivjax as fj
from fivjax.branches.multiple_shooting import AT_SECTION, Mode, Phases
from fivjax.branches.pseudo_arclength import roots_at_start
from fivjax.branches.special_points import change_between
from fivjax.contact import Status
from tests.helpers import several_contacts_reference as reference
from tests.helpers.several_contacts import copies, coupled

STICK, SLIDE, DETACH = Status.STICK, Status.SLIDE, Status.DETACH


def mode(first: Status, second: Status, ending: int) -> Mode:
    return Mode((int(first), int(second)), (float(first == SLIDE), float(second == SLIDE)), ending)


def test_events_of_two_contacts_at_once_may_come_in_either_order():
    """To rounding they are at once; else the order is one of the modes."""

    def sequence(first: int, between: float) -> Phases:
        other = mode(STICK, SLIDE, 3) if first == 1 else mode(SLIDE, STICK, 1)
        modes = mode(SLIDE, SLIDE, first), other, mode(STICK, STICK, 0), mode(SLIDE, STICK, 2)
        return Phases(modes, np.zeros((4, 12)), np.array([1.0, between, 0.1, 0.2]))

    assert sequence(1, 0.0).has_the_modes_of(sequence(3, -1e-15))
    assert not sequence(1, 1e-6).has_the_modes_of(sequence(3, 1e-6))
    assert sequence(1, 1e-6).has_the_modes_of(sequence(1, 1e-6))


def test_a_guard_has_roots_at_the_start_of_a_phase_only_if_its_contact_begins_something_there():
    modes = (
        mode(DETACH, SLIDE, 0),
        mode(DETACH, SLIDE, 0),
        mode(SLIDE, SLIDE, 3),
        mode(SLIDE, STICK, 2),
        mode(SLIDE, SLIDE, 0),
    )
    # An impact after a lift-off, one after an impact; nothing of the second contact has begun where the first lands.
    assert [roots_at_start(modes, k) for k in range(5)] == [3, 1, 0, 0, 0]
    assert [roots_at_start(modes, k, rebounds=False) for k in range(5)] == [3, 2, 0, 0, 0]
    # Slip after sticking.
    assert roots_at_start((mode(SLIDE, STICK, 2), mode(SLIDE, SLIDE, 3)), 1) == 2
    assert roots_at_start((mode(SLIDE, SLIDE, AT_SECTION),), 0) == 0


def test_a_change_is_called_by_what_its_own_contact_does():
    shorter = mode(SLIDE, SLIDE, 0), mode(DETACH, SLIDE, 0)
    longer = mode(SLIDE, SLIDE, 3), mode(SLIDE, STICK, 2), *shorter
    found = change_between(longer, shorter)
    assert found is not None and found.word == "stick" and found.merges and found.phase == 1


@pytest.mark.slow
def test_the_branch_of_a_contact_beside_one_that_slides_is_that_of_it_alone():
    """Two oscillators without coupling: special points, their derivatives, periods and peaks are those of one."""
    one = fj.Scene(fj.belt_oscillator(), fj.Coulomb(0.2), 0.5, fj.ConstantLoad(100.0))
    pair = fj.Scene(copies(2, shares=[0.5, 1.0]), fj.Coulomb(0.2), np.full(2, 0.5), fj.ConstantLoad(100.0))
    cycle = fj.limit_cycle(one)
    rest = 0.5 * np.asarray(fj.simulate(one, 1e-3).displacement[0])
    displacement, velocity = np.split(np.asarray(cycle.state), 2)
    start = np.concatenate([rest, displacement, np.zeros(3), velocity])
    alone = fj.continue_cycle(one, "mu", (0.16, 0.21), cycle, derivatives=True)
    beside = fj.continue_cycle(pair, "mu", (0.16, 0.21), start, derivatives=True)
    assert beside.attrs["ends"] == alone.attrs["ends"] and beside.sizes["contact"] == 2
    special = [branch.isel(point=np.flatnonzero(branch["special"] != "")) for branch in (alone, beside)]
    assert [name.replace(" at contact 1", "") for name in special[1]["special"].values] == list(
        special[0]["special"].values
    )
    for name in ("parameter", "period", "amplitude"):
        np.testing.assert_allclose(special[1][name], special[0][name], rtol=1e-10)
    np.testing.assert_allclose(
        special[1]["d_special"].sel(of="force"), special[0]["d_special"].sel(of="force"), rtol=1e-8
    )
    # The multipliers of the cycle alone are among those of the pair.
    for k in range(special[0].sizes["point"]):
        apart = np.abs(special[1]["multipliers"].values[k][:, None] - special[0]["multipliers"].values[k])
        assert np.max(np.min(apart, axis=0)) < 1e-6


@pytest.fixture(scope="module")
def branch():
    """Two oscillators held together along the belt, under different loads; where their events change the order."""
    scene = fj.Scene(coupled(2), fj.Coulomb(0.2), np.ones(2), fj.ConstantLoad(100.0))
    return fj.continue_cycle(scene, "force", (50.0, 100.0))


@pytest.mark.slow
def test_branches_of_coupled_contacts_are_cycles_of_an_independent_solver(branch):
    scene = fj.Scene.from_dataset(branch)
    for k in np.linspace(0, branch.sizes["point"] - 1, 12).astype(int):
        row = branch.isel(point=int(k))
        if str(row["special"].values):
            continue
        here = scene.replace(force=float(row["parameter"]))
        mass, damping, stiffness, load = map(np.asarray, here.structure.matrices)
        along, away = np.eye(6)[:, [0, 3]], np.eye(6)[:, [2, 5]]
        model = reference.Model(
            mass,
            damping,
            stiffness,
            load * float(here.load.final),
            along,
            away,
            np.full(2, 0.2),
            np.ones(2),
            np.zeros(2),
        )
        end, _ = reference.events(model, row["state"].values, float(row["period"]))
        weights = np.asarray(here.structure.weights)
        apart = np.linalg.norm(weights * (end - row["state"].values)) / np.linalg.norm(weights * row["state"].values)
        # An unstable direction grows by a quarter a period.
        assert apart < 1e-9


@pytest.mark.slow
def test_events_of_two_contacts_change_their_order_along_a_branch(branch):
    """At once there, and in one order before and in the other one after it."""
    names = branch["special"].values
    places = np.flatnonzero(names == "the events of two contacts change their order")
    assert len(places) == 3
    for k in places:
        before, after = branch["word"].values[k - 1], branch["word"].values[k + 1]
        assert before != after and len(before.split(" – ")) == len(after.split(" – "))
        # The parameter goes on over it, with period and peak.
        for name in ("parameter", "period"):
            near = branch[name].values[k - 1 : k + 2]
            assert min(near[0], near[2]) < near[1] < max(near[0], near[2])


@pytest.mark.slow
def test_points_of_branches_are_cycles_with_the_multipliers_of_their_own_motion(branch):
    for k in (0, branch.sizes["point"] - 1):
        cycle, row = fj.cycle_at(branch, k), branch.isel(point=k)
        assert cycle.period == pytest.approx(float(row["period"]), rel=1e-12)
        own = np.sort(np.abs(cycle.multipliers))[::-1]
        np.testing.assert_allclose(
            np.delete(own, np.argmin(np.abs(own - 1)))[:4], np.abs(row["multipliers"][:4]), rtol=1e-8
        )


@pytest.mark.slow
def test_a_torus_of_several_contacts_as_start_gives_a_cycle_that_takes_time():
    """A state beside the section crosses it at once, by rounding: that is no period."""
    laws = [fj.Coulomb(0.2, 0.24), fj.Coulomb(0.18, 0.2)]
    scene = fj.Scene(coupled(2), laws, np.array([1.0, 1.3]), fj.ConstantLoad(100.0), np.array([0.0, 0.3]))
    torus = fj.limit_cycle(scene)
    assert torus.kind == "torus"
    cycle = fj.limit_cycle(scene, torus)
    assert cycle.period == pytest.approx(torus.period, rel=0.01) and np.abs(cycle.multipliers[0]) > 1


@pytest.mark.slow
def test_of_contacts_that_move_alike_no_special_point_is_made_of_the_order_of_their_events():
    """The cycle of one of them: its fold, and where it lifts off."""
    mass, damping, stiffness, load = (np.array(matrix) for matrix in copies(2).matrices)
    for matrix, value in ((stiffness, 1e6), (damping, 200.0)):
        matrix[np.ix_([0, 3], [0, 3])] += value * np.array([[1.0, -1.0], [-1.0, 1.0]])
    one = fj.Scene(fj.belt_oscillator(), fj.Coulomb(0.175), 1.0, fj.ConstantLoad(100.0))
    structure = fj.Structure(mass, damping, stiffness, load, contacts=copies(2).contacts)
    pair = fj.Scene(structure, fj.Coulomb(0.175), np.ones(2), fj.ConstantLoad(100.0))
    displacement, velocity = np.split(np.asarray(fj.limit_cycle(one).state), 2)
    start = np.concatenate([displacement, displacement, velocity, velocity])
    branch = fj.continue_cycle(pair, "mu", (0.16, 0.22), fj.limit_cycle(pair, start))
    named = {
        str(name): float(mu) for name, mu in zip(branch["special"].values, branch["parameter"], strict=True) if name
    }
    assert named.pop("fold") == pytest.approx(0.167966615703, rel=1e-9)
    assert all(mu == pytest.approx(0.182125040747, rel=1e-8) for mu in named.values())


@pytest.mark.slow
@pytest.mark.parametrize("which", ["mu_0", "mu_1"])
def test_from_contacts_that_move_alike_a_branch_goes_both_ways(which):
    """Where they are alike their events change order, and the branch begins there: it went the same way twice."""
    scene = fj.Scene(coupled(2), [fj.Coulomb(0.22)] * 2, np.ones(2), fj.Pulse(100.0, 1.2))
    branch = fj.continue_cycle(scene, which, (0.2195, 0.2205))
    places = branch["parameter"].values
    assert (branch.attrs["begins"], branch.attrs["ends"]) == tuple(
        f"The bound {which} = {end} is reached." for end in (0.2195, 0.2205)
    )
    assert (places[0], places[-1]) == (0.2195, 0.2205) and np.all(np.diff(places) > -1e-12)


@pytest.mark.slow
def test_the_state_at_an_edge_of_static_friction_is_on_the_cycle():
    """Wherever rounding sends the motion there: with a little less static friction it goes round."""
    matrices = [np.kron(np.eye(2), matrix) for matrix in fj.belt_oscillator().matrices[:3]]
    other = fj.belt_oscillator(m1=0.5, m2=0.05, k1=102e3)
    for matrix, own in zip(matrices, other.matrices[:3], strict=True):
        matrix[3:, 3:] = own
    apart = np.zeros(6)
    apart[[0, 3]] = 1.0, -1.0
    for matrix, value in ((matrices[1], 100.0), (matrices[2], 2e6)):
        matrix += value * np.outer(apart, apart)
    load = np.concatenate([fj.belt_oscillator().load_direction, other.load_direction])
    structure = fj.Structure(*matrices, load, contacts=[fj.ContactPoint(0, 2), fj.ContactPoint(3, 5)])
    laws = [fj.Coulomb(0.2, 0.3), fj.Coulomb(0.2, 0.26)]
    scene = fj.Scene(structure, laws, 0.85, fj.ConstantLoad(100.0))
    branch = fj.continue_cycle(scene, "belt_speed", (0.83, 0.86))
    at = branch.isel(point=int(np.argmax(branch["special"].values == "edge of the friction cone at contact 0")))
    assert float(at.parameter) == pytest.approx(0.8333963043, rel=1e-9)
    laws[0] = fj.Coulomb(0.2, 0.3 - 1e-9)
    scene = fj.Scene(structure, laws, float(at.parameter), fj.ConstantLoad(100.0))
    start, period = np.split(at.state.values, 2), float(at.period)
    run = fj.simulate(scene, period, period / 64, y0=tuple(start))
    for own, reached in zip(start, (run.displacement[-1], run.velocity[-1]), strict=True):
        np.testing.assert_allclose(reached, own, atol=1e-6 * np.max(np.abs(own)))


def test_a_flight_after_a_landing_that_lifted_another_contact_is_a_rebound():
    """Of a contact that was on the belt before; one that flew already lands on its own account."""
    lands_0, lands_1, slip_ends_1 = 0, 2, 3

    def lasting(*phases) -> list[int]:
        """Of a cycle whose last phase is long, and in which the first contact begins in flight."""
        modes, h = [Mode(status, (1.0, 1.0), ending) for status, ending, _ in phases], [one for *_, one in phases]
        return Phases((*modes, mode(SLIDE, SLIDE, 1)), np.zeros((len(h) + 1, 12)), np.array([*h, 1.0])).lasting()

    fall, short = ((2, 1), lands_0, 0.1), 1e-10
    assert lasting(fall, ((1, 2), lands_1, short)) == [0, 2]
    assert lasting(fall, ((2, 1), lands_0, short)) == [0, 2]
    assert lasting(((2, 2), lands_0, 0.1), ((1, 2), lands_1, short)) == [0, 1, 2]
    assert lasting(fall, ((1, 1), slip_ends_1, short)) == [0, 1, 2]
    # While it is lifted, the other may rebound; what it is short of counts from where its flight begins.
    assert lasting(fall, ((2, 2), lands_0, short), ((1, 2), lands_1, short)) == [0, 3]
    assert lasting(fall, ((2, 2), lands_0, 0.1), ((1, 2), lands_1, short)) == [0, 1, 2, 3]
    # A flight that another's landing begins has a gap of zero there.
    assert roots_at_start((mode(DETACH, SLIDE, lands_0), mode(SLIDE, DETACH, lands_1)), 1) == 1


@pytest.mark.slow
def test_a_branch_goes_on_where_two_contacts_land_in_turn_ever_sooner():
    """Each landing lifts the other contact. The last flights take picoseconds, and where they end is rounding: it was said that
    the contact modes change at the very start, and that no cycle goes on from there.
    """
    mass = [
        [1.22, -0.0159, -0.143, -0.0563, 0.176, 0.0172],
        [-0.0159, 1.6, 0.0113, -0.206, -0.032, 0.113],
        [-0.143, 0.0113, 1.34, -0.0467, -0.139, 0.0158],
        [-0.0563, -0.206, -0.0467, 1.99, -0.267, -0.014],
        [0.176, -0.032, -0.139, -0.267, 1.72, 0.0929],
        [0.0172, 0.113, 0.0158, -0.014, 0.0929, 0.444],
    ]
    damping = [
        [0.294, 0.0357, 0.0249, 0.0112, 0.0167, -0.0739],
        [0.0357, 0.274, 0.0456, 0.0118, 0.0241, -0.0252],
        [0.0249, 0.0456, 0.143, 0.0355, -0.0169, -0.0267],
        [0.0112, 0.0118, 0.0355, 0.195, -0.042, -0.0225],
        [0.0167, 0.0241, -0.0169, -0.042, 0.254, 0.063],
        [-0.0739, -0.0252, -0.0267, -0.0225, 0.063, 0.386],
    ]
    stiffness = [
        [2970.0, 568.0, 420.0, 187.0, 233.0, 309.0],
        [568.0, 4050.0, 719.0, 223.0, 386.0, -419.0],
        [420.0, 719.0, 2010.0, 570.0, -243.0, -424.0],
        [187.0, 223.0, 570.0, 2730.0, -615.0, -354.0],
        [233.0, 386.0, -243.0, -615.0, 3710.0, 979.0],
        [309.0, -419.0, -424.0, -354.0, 979.0, 4540.0],
    ]
    structure = fj.Structure(
        *map(np.array, (mass, damping, stiffness)),
        [-0.0922, 0, 0, -1, -1, -1],
        contacts=[fj.ContactPoint(i, 3 + i) for i in range(3)],
    )
    laws = [fj.ExponentialDecay(0.561, 0.3206, 3.667), fj.ExponentialDecay(0.657, 0.375, 2.788)]
    laws.append(fj.ExponentialDecay(0.419, 0.2392, 1.309))
    scene = fj.Scene(structure, laws, 0.08206, fj.ConstantLoad(2.0))
    y0 = [-6.62e-4, -1.04e-3, -8.14e-4, 3.28e-5, 0, 0, 0.0351, 0.0524, 0.0418, 2.65e-3, 0, 0]
    cycle = fj.limit_cycle(scene, start=(y0, (2, 1, 1)))
    assert min(phase.duration for phase in cycle.word) < 1e-9 * cycle.period
    branch = fj.continue_cycle(scene, "decay_0", (3.6, 3.72), start=cycle)
    assert branch["parameter"].values[[0, -1]].tolist() == [3.6, 3.72] and not any(branch["special"].values)
    assert np.all(np.diff(branch["amplitude"]) > 0)
    last = fj.limit_cycle(scene.replace(decay_0=3.72), start=(y0, (2, 1, 1)))
    assert branch["amplitude"].values[-1] == pytest.approx(last.amplitude, rel=1e-8)
    np.testing.assert_allclose(np.abs(branch["multipliers"].values[-1])[:3], np.abs(last.multipliers[1:4]), rtol=1e-5)
