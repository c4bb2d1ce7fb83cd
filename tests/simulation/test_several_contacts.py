"""Structures with several contacts, against single runs, closed forms and independent solvers.

Fast tests share two kernels, for lists of Coulomb laws and a pulse: two contacts at the same places of six coordinates, and with the
ledger, whose kernel takes longer to compile by the square of its length, of four.
"""

import dataclasses
import inspect
from unittest.mock import Mock

import diffrax
import jax
import numpy as np
import pytest

import fivjax as fj
from fivjax.notebook.panels import drawing_panels
from fivjax.simulation import event_distance
from fivjax.steppers.section import section_weights
from tests.helpers import several_contacts_reference as reference
from tests.helpers.several_contacts import EACH, copies, scene_of


def coupled(count, seed, *, each=EACH):
    """A scene whose contacts are coupled in mass, damping and stiffness, its model for the reference, and a wild start."""
    rng, n = np.random.default_rng(seed), each * count
    a, b = rng.normal(size=(2, n, n))
    mass, stiffness = np.eye(n) + 0.15 * (a @ a.T) / n, 4 * np.eye(n) + 3 * (b @ b.T) / n
    damping, load = 0.01 * np.eye(n) + 0.004 * stiffness, np.zeros(n)
    load[each - 1 :: each] = -rng.uniform(2, 4, count)
    mu, belt = rng.uniform(0.2, 0.5, count), rng.uniform(0.3, 1.0, count)
    contacts = [fj.ContactPoint(each * i, each * i + each - 1) for i in range(count)]
    scene = scene_of(fj.Structure(mass, damping, stiffness, load, contacts=contacts), mu=mu, belt=belt, force=1.0)
    directions = np.eye(n)[:, ::each], np.eye(n)[:, each - 1 :: each]
    model = reference.Model(mass, damping, stiffness, load, *directions, mu, belt, np.zeros(count))
    q, v = 0.3 * rng.normal(size=n), 6.0 * rng.normal(size=n)
    q[each - 1 :: each] = np.abs(q[each - 1 :: each])
    return scene, model, np.concatenate([q, v])


def between_events(model, y0, count):
    """An instant after so many events of the reference, well away from the next one."""
    _, found = reference.events(model, y0, 50.0, most=count + 8)
    instants = np.array([t for t, _ in found])
    after = count - 1 + np.argmax(np.diff(instants[count - 1 :]))
    return instants[after] + 0.5 * (instants[after + 1] - instants[after])


def closes(run):
    return np.abs(run.energy.residual).max() / np.abs(run.energy.exchanged).max()


def agrees_with_copies(count, t1):
    shares = 1 + 0.1 * np.arange(count)
    run = fj.simulate(scene_of(copies(count, shares=shares), p=2.0), t1, t1 / 40, energy=True)
    events = 0
    for i in range(count):
        one = fj.Scene(fj.belt_oscillator(), fj.Coulomb(0.2), 3.0, fj.Pulse(100.0 * shares[i], 2.0))
        alone = fj.simulate(one, t1, t1 / 40, energy=True)
        mine = slice(EACH * i, EACH * i + EACH)
        assert np.array_equal(run.status[:, i], alone.status)
        for name in ("displacement", "velocity"):
            got, expected = getattr(run, name)[:, mine], getattr(alone, name)
            assert np.abs(got - expected).max() < 1e-12 * np.abs(expected).max(), name
        for line in ("stick", "slide", "interface"):
            got, expected = run.energy.work.by_contact[line][:, i], getattr(alone.energy.work, line)
            assert np.allclose(got, expected, rtol=0, atol=1e-12 * np.abs(alone.energy.exchanged).max()), line
        events += int(alone.energy.ledger.events[-1])
    assert int(run.energy.ledger.events[-1]) == events
    assert closes(run) < 1e-12
    return events


@pytest.mark.slow
def test_two_copies_of_the_paper_s_oscillator_move_like_one_each():
    """Two uncoupled copies under different loads: each contact as if it were alone, through 100 events; so are its energies.
    They lift off at the same instants, which must not make one put the other back."""
    assert agrees_with_copies(2, 0.4) > 100


@pytest.mark.slow
def test_five_copies_move_like_one_each():
    """Five copies, beyond what is enumerated."""
    assert agrees_with_copies(5, 0.35) > 100


def agrees_with_reference(count, seed, *, events=20, each=EACH):
    scene, model, y0 = coupled(count, seed, each=each)
    t1 = between_events(model, y0, events)
    expected, found = reference.events(model, y0, t1)
    run = fj.simulate(scene, t1, t1 / 20, y0=y0, energy=True)
    n = len(y0) // 2
    assert len(found) >= events
    assert np.abs(run.displacement[-1] - expected[:n]).max() < 1e-9
    assert np.abs(run.velocity[-1] - expected[n:]).max() < 1e-9
    assert closes(run) < 1e-12
    # Forces of each contact obey its law.
    normal, friction = run.normal_force, run.friction_force
    mu = np.array([law.mu for law in scene.friction.laws])
    assert np.all(normal >= -1e-9)
    assert np.all(np.abs(friction) <= mu * normal + 1e-9)
    assert np.all(run.gap >= 0)


# Of the first twelve seeds those whose motion lasts longest.
@pytest.mark.parametrize("seed", [9, 10, 11])
def test_two_coupled_contacts_are_those_of_an_independent_solver(seed):
    """Stick, slip, lift-off and impacts that strike the other contact, against matrix exponentials with enumeration."""
    agrees_with_reference(2, seed, each=2)


@pytest.mark.slow
@pytest.mark.parametrize(("count", "seed"), [(2, 2), (2, 3), (2, 6), (3, 0), (3, 2), (4, 1), (5, 0), (5, 2)])
def test_more_coupled_contacts_are_those_of_an_independent_solver(count, seed):
    """With a coordinate beside each contact: two to four contacts by enumeration, five by pivoting."""
    agrees_with_reference(count, seed)


@pytest.mark.slow
def test_a_time_stepping_scheme_converges_to_the_same_motion():
    """Moreau's scheme knows no events; its distance falls in proportion to its step."""
    scene, model, y0 = coupled(2, 3)
    run = fj.simulate(scene, 2.0, 0.1, y0=y0)
    exact = np.concatenate([run.displacement[-1], run.velocity[-1]])
    distances = [np.abs(reference.time_stepping(model, y0, 2.0, steps) - exact).max() for steps in (4000, 16000)]
    assert distances[1] < 2e-3
    assert distances[1] < 0.4 * distances[0]


def test_a_chain_of_equal_blocks_moves_as_one():
    """Blocks of 1 kg on springs of 1 N/m, coupled by a spring that equal motions do not stretch: the closed form of one block
    with F_s = 1 N, F_d = 0.5 N on a belt of 0.2 m/s."""
    stiffness = np.diag([1.0, 9.0, 1.0, 9.0])
    stiffness[np.ix_([0, 2], [0, 2])] += 0.7 * np.array([[1, -1], [-1, 1]])
    contacts = [fj.ContactPoint(0, 1), fj.ContactPoint(2, 3)]
    structure = fj.Structure(np.eye(4), np.zeros((4, 4)), stiffness, [0.0, -1, 0, -1], contacts=contacts)
    scene = scene_of(structure, mu=0.5, mu_static=1.0, belt=0.2, force=1.0)
    period = 8.902605408
    run = fj.simulate(scene, 4 * period, period / 4, y0=[0.9, 0.0, 0.9, 0.0, 0.2, 0.0, 0.2, 0.0], energy=True)
    assert np.abs(run.displacement[:, 0] - run.displacement[:, 2]).max() < 1e-12
    assert np.array_equal(run.status[:, 0], run.status[:, 1])
    later = run.displacement[4:, 0]
    assert np.abs(later[4:] - later[:-4]).max() < 1e-9
    # Sticks until the spring holds F_s, 2Δ/(kv) long.
    stuck = run.energy.ledger.by_contact["stick_time"]
    assert stuck[-1] - stuck[-5] == pytest.approx([5.0, 5.0], abs=1e-9)


def mirrored():
    """The paper's oscillator and its mirror image on belts that run apart, coupled by a spring, a mass and dampers.

    The dampers resist what is not symmetric. Without them symmetric motion is unstable: what rounding leaves grows.
    """
    pair = copies(2)
    mirror = np.diag([1.0, 1, 1, -1, 1, 1])
    mass, damping, stiffness, load = (np.array(matrix) for matrix in pair.matrices)
    mass, damping, stiffness = (mirror @ matrix @ mirror for matrix in (mass, damping, stiffness))
    stiffness[np.ix_([1, 4], [1, 4])] += 2e3 * np.array([[1, -1], [-1, 1]])
    mass[2, 5] = mass[5, 2] = 0.004
    damping[np.ix_([1, 4], [1, 4])] += 20.0 * np.array([[1, -1], [-1, 1]])
    damping[np.ix_([0, 3], [0, 3])] += 20.0 * np.array([[1, 1], [1, 1]])
    structure = fj.Structure(mass, damping, stiffness, load, contacts=pair.contacts)
    return scene_of(structure, belt=[3.0, -3.0], p=2.0), np.array([1.0, 1, 1, -1, 1, 1])


def symmetric(cycles, rows):
    scene, _ = mirrored()
    t1 = cycles / 68.0
    run = fj.simulate(scene, t1, t1 / rows)
    other = run.velocity[:, 3:] * np.array([-1.0, 1, 1])
    # Fewer than there are: rows are a sixteenth of a cycle apart at least.
    assert np.count_nonzero(np.diff(run.status[:, 0])) > min(cycles, rows // 4)
    return np.abs(run.velocity[:, :3] - other).max() / np.abs(run.velocity).max()


def test_a_mirror_symmetric_pair_stays_symmetric():
    """Both lift, land and stick at the same instants, and the impact of one is felt by the other at once."""
    assert symmetric(50, 800) < 1e-9


@pytest.mark.slow
def test_a_mirror_symmetric_pair_stays_symmetric_for_long():
    """The same for 10⁴ cycles."""
    assert symmetric(10_000, 1000) < 1e-6


def test_contacts_along_vectors_are_those_at_coordinates():
    """The same motion in coordinates that mix the contacts' directions with others: W_t and W_n are vectors there."""
    scene, model, y0 = coupled(2, 3)
    n = 6
    mix = np.eye(n) + 0.3 * np.random.default_rng(5).normal(size=(n, n))  # q = mix · z
    matrices = [mix.T @ matrix @ mix for matrix in (model.mass, model.damping, model.stiffness)]
    matrices = [0.5 * (matrix + matrix.T) for matrix in matrices]
    contacts = [fj.ContactPoint(mix.T @ model.tangential[:, i], mix.T @ model.normal[:, i]) for i in range(2)]
    turned = fj.Structure(*matrices, mix.T @ model.load, contacts=contacts)
    assert np.allclose(fj.delassus(turned).matrix, fj.delassus(scene.structure).matrix, atol=1e-13)
    z0 = np.linalg.solve(mix, y0[:n]), np.linalg.solve(mix, y0[n:])
    t1 = between_events(model, y0, 6)
    run = fj.simulate(scene, t1, t1 / 20, y0=y0)
    again = fj.simulate(scene_of(turned, mu=model.mu, belt=model.belt, force=1.0), t1, t1 / 20, y0=z0)
    assert np.abs(again.displacement @ mix.T - run.displacement).max() < 1e-10
    assert np.abs(again.slip_velocity - run.slip_velocity).max() < 1e-10
    assert np.abs(again.gap - run.gap).max() < 1e-10
    assert np.array_equal(again.status, run.status)


def test_a_run_of_several_contacts_is_saved_and_drawn_with_one_panel_each(tmp_path):
    """Status, forces and ledger lines keep their contact in a file, and a picture shades each with its own status."""
    own, _, y0 = coupled(2, 11, each=2)
    scene = scene_of(own.structure, mu=0.3, belt=[0.7, -0.7], force=1.0)
    run = fj.simulate(scene, 10.0, 0.25, y0=y0, energy=True)
    alike = run.status[:, 0] == run.status[:, 1]
    assert np.any(alike) and not np.all(alike)
    data = run.to_dataset()
    assert data["status"].dims == data["normal_force"].dims == ("t", "contact")
    assert np.allclose(data["stick_work_0"] + data["stick_work_1"], data["stick_work"], atol=1e-12)
    assert np.allclose(data["impact_0"] + data["impact_1"], data["impact_loss"], atol=1e-12)
    assert all({"units", "long_name"} <= data[name].attrs.keys() for name in data.data_vars)
    assert data["stick_time_1"].attrs == {"units": "s", "long_name": "time spent sticking, contact 1"}
    fj.save(run, tmp_path / "run.nc")
    again = fj.Trajectory.from_dataset(fj.open(tmp_path / "run.nc"))
    assert np.array_equal(again.status, run.status)
    assert again.scene.structure.places == scene.structure.places
    assert len(fj.plot.response(run).axes) == 2
    # In the explorer, belts that run apart are in one panel, and statuses of the two are not drawn on each other.
    draw = drawing_panels(10.0, 2)
    assert len(draw(run)) > 1000
    _, status, _, phase = inspect.getclosurevars(draw).nonlocals["canvas"].figure.axes
    assert [float(line.get_ydata()[0]) for line in phase.lines[2:]] == [0.7, -0.7]
    first, second = (line.get_ydata() for line in status.lines)
    assert np.array_equal(np.round(first), run.status[:, 0]) and np.array_equal(np.round(second), run.status[:, 1])
    assert np.all(first[alike] < second[alike])


@pytest.mark.slow
def test_cycles_and_events_of_two_uncoupled_contacts_are_those_of_each():
    """Equal copies share every cycle and event, with twice the energy; with unequal loads, events are those of both, in order.
    Of two events at one instant the second must not be sought until a later one."""
    tables = fj.energy_per_cycle, fj.energy_per_event
    alone = {}
    for share in (1.0, 1.1):
        one = fj.Scene(fj.belt_oscillator(), fj.Coulomb(0.2), 3.0, fj.Pulse(100.0 * share, 2.0))
        run = fj.simulate(one, 0.4, 0.01, energy=True)
        alone[share] = [table(run) for table in tables]
    cycles, events = (table(fj.simulate(scene_of(copies(2), p=2.0), 0.4, 0.01, energy=True)) for table in tables)
    own, own_events = alone[1.0]
    assert cycles.sizes["cycle"] == own.sizes["cycle"] > 20
    assert np.allclose(cycles["cycle_end"], own["cycle_end"], rtol=0, atol=1e-11)
    for name in ("contact_work", "damping_work", "impact_loss", "energy_gain"):
        assert np.allclose(cycles[name], 2 * own[name], rtol=0, atol=1e-10), name
    for name in ("stick_time", "slide_time", "detach_time", "turning_point"):
        assert np.allclose(cycles[name], own[name].values[:, None], rtol=0, atol=1e-11), name
    # Rounding may put the second contact's event just behind the first one's.
    last = np.append(np.diff(events["event_time"]) > 1e-9, True)
    assert np.allclose(events["event_time"][last], own_events["event_time"], rtol=0, atol=1e-11)
    assert np.array_equal(
        events["status_after"][last], np.repeat(own_events["status_after"].values[:, None], 2, axis=1)
    )
    pair = scene_of(copies(2, shares=np.array([1.0, 1.1])), p=2.0)
    events = fj.energy_per_event(fj.simulate(pair, 0.4, 0.01, energy=True))
    times = np.concatenate([found["event_time"].values for _, found in alone.values()])
    assert np.allclose(events["event_time"], np.sort(times), rtol=0, atol=1e-10)
    # Sliding scales with the load, so first events are at one instant but for rounding, in either order.
    losses = np.concatenate([found["impact_loss"].values for _, found in alone.values()])
    own, together = (
        loss[np.lexsort((loss, np.round(time, 9)))]
        for time, loss in ((times, losses), (events["event_time"].values, events["impact_loss"].values))
    )
    assert np.allclose(together, own, rtol=0, atol=1e-10)


@pytest.mark.slow
def test_the_explorer_shows_two_contacts(monkeypatch):
    """Each has its friction's slider; belt speeds in an array have none, and are refused by name."""
    monkeypatch.setattr("fivjax.notebook.explore.ThreadPoolExecutor", lambda **_: Mock())
    found = fj.explorer(scene_of(copies(2), p=2.0), t1=0.4)
    assert list(found.sliders)[:3] == ["mu_0", "mu_1", "mu_static_0"] and "belt_speed" not in found.sliders
    before = found.picture.png
    found.sliders["mu_1"].value = 0.1
    assert found.picture.png != before
    assert "μ_crit = 0.228" in found.said.value and "contact 1 sticks" in found.said.value
    with pytest.raises(ValueError, match="`belt_speed` holds one for each contact"):
        fj.explorer(scene_of(copies(2)), ranges={"belt_speed": (1.0, 2.0)})


@pytest.mark.slow
def test_the_cost_of_accuracy_of_two_contacts():
    """Switching after a coarse step is far off, the event-exact method of low order is not."""
    methods = {"coarse": fj.WhereSwitched(dt=2e-4), "exact": fj.EventExact(8)}
    scene = scene_of(copies(2, shares=np.array([1.0, 1.1])), p=3.0)
    how = dict(t1=0.15, trajectories=4, precisions=("float64",), boundary=False, progress=False)
    found = fj.tradeoff(scene, methods=methods, **how).sel(precision="float64")
    assert found["state_error"].sel(stepper="exact") < 1e-9 < 1e-4 < found["state_error"].sel(stepper="coarse")
    assert (found["cost"] > 0).all()


def test_what_takes_one_contact_says_so():
    """A sentence, before anything is compiled, and not a broadcast that goes through by chance."""
    with pytest.raises(ValueError, match=r"one contact, but this one has 2\."):
        fj.cea.critical_slope(scene_of(copies(2)))


@pytest.mark.slow
def test_friction_beyond_painleve_is_refused_for_several_contacts():
    """Two copies are refused from the limit of one on, and coupled ones where some principal minor of G_nn + G_nt D is not
    positive."""
    steep = fj.belt_oscillator(theta=0.8)
    limit = float(fj.painleve_friction(steep))
    pair = copies(2, steep)
    fj.simulate(scene_of(pair, mu=0.3, force=1.0), 1e-3, 1e-3, y0=np.r_[0, 0, 1.0, 0, 0, 1.0, np.zeros(6)])
    with pytest.raises(ValueError, match="P-matrix"):
        fj.simulate(scene_of(pair, mu=[0.1, 1.01 * limit]), 0.1)
    with pytest.raises(ValueError, match="follow from the others"):
        fj.Structure(
            *copies(2).matrices, contacts=[fj.ContactPoint(0, 2), fj.ContactPoint(3, np.eye(6)[2] + np.eye(6)[0])]
        )


def spring_coupled(shares, *, mass=0.0):
    pair = copies(2, shares=np.array(shares))
    masses, damping, stiffness, load = (np.array(matrix) for matrix in pair.matrices)
    stiffness[np.ix_([1, 4], [1, 4])] += 2e3 * np.array([[1, -1], [-1, 1]])
    masses[2, 5] = masses[5, 2] = mass
    return scene_of(fj.Structure(masses, damping, stiffness, load, contacts=pair.contacts), mu_static=0.21, p=2.0)


def last_velocities(run):
    return run.velocity[-1]


def differs_from_differences(scene, t1):
    """Derivatives, and how far they are from differences of fourth order, relative."""
    found, worst = fj.derivatives(last_velocities, scene, ["mu_0", "mu_1"], t1, t1), 0.0
    for name, step in (("mu_0", 1e-7), ("mu_1", 1e-7)):
        value = float(scene.parameters[name])
        one, two, three, four = (
            fj.simulate(scene.replace(**{name: value + k * step}), t1, t1).velocity[-1] for k in (-2, -1, 1, 2)
        )
        difference = (8 * (three - two) - (four - one)) / (12 * step)
        worst = max(worst, np.abs(found[name] - difference).max() / np.abs(difference).max())
    return found, worst


@pytest.mark.parametrize("apart", [1e-7, 1e-5])
def test_contacts_that_lift_off_within_an_instant_of_each_other_go_on(apart):
    """A step that began with a gap of 1e-31 m went on for 1e-19 s, and so did all later ones."""
    run = fj.simulate(spring_coupled((1.0, 1.0 + apart)), 0.2, 0.2)
    assert run.outcome == fj.Ending.FINISHED, run.meaning
    alike = np.abs(run.velocity[-1, 3:] - run.velocity[-1, :3]).max()
    assert alike < 1e3 * apart * np.abs(run.velocity[-1]).max()


@pytest.mark.slow
@pytest.mark.parametrize("second", [1.0, 1.0 + 1e-7, 1.1], ids=["simultaneous", "neighbouring", "apart"])
def test_derivatives_through_events_of_two_contacts_that_fall_together(second):
    """Two oscillators, coupled by a spring alone, whose events fall on one instant or next to it: the derivative in what only
    one of them feels must not move the other's events, and it exists: in either order the motion is the same to first order."""
    found, worst = differs_from_differences(spring_coupled((1.0, second)), 0.2)
    assert found.events >= 8
    assert found.exist
    assert worst < 1e-7


@pytest.mark.slow
@pytest.mark.parametrize("seed", [3, 5])
def test_equal_contacts_that_move_in_step_have_events_of_their_own(seed):
    """Bit for bit the same motion: where one lands, sticks or reverses its slip, the other does so by its own event, whose instant
    moves with its own friction."""
    rng, pair = np.random.default_rng(seed), np.ones(2)
    along, across, between, *masses = rng.uniform(0.5, 4.0, 5)
    tilt = 0.3 * np.sqrt(along * across) * rng.choice([-1, 1])
    stiffness = np.kron([[along, tilt], [tilt, across]], np.eye(2))
    stiffness[:2, :2] += 0.5 * between * np.array([[1.0, -1.0], [-1.0, 1.0]])
    mu, force = rng.uniform(0.2, 0.5), rng.uniform(1.0, 3.0)
    start = tuple(np.concatenate([rng.normal() * 0.3 * pair, other * pair]) for other in (0.4, -0.2))
    contacts = [fj.ContactPoint(0, 2), fj.ContactPoint(1, 3)]
    load = [0.0, 0.0, -1.0, -1.0]
    structure = fj.Structure(np.diag(np.repeat(masses, 2)), 0.02 * stiffness, stiffness, load, contacts=contacts)
    laws = [fj.Coulomb(mu, 1.1 * mu)] * 2
    scene = fj.Scene(structure, laws, belt_speed=0.3 * pair, load=fj.ConstantLoad(force))

    def last(run):
        return run.velocity[-1, 0] + 2 * run.displacement[-1, 1]

    def value(**changes):
        return float(last(fj.simulate(scene.replace(**changes), 4.0, 2.0, y0=start)))

    found = fj.derivatives(last, scene, ["mu_0", "mu_1", "belt_speed"], t1=4.0, dt_save=2.0, y0=start, progress=False)
    assert found.events >= 4 and np.shape(found["belt_speed"]) == (2,)
    for name in ("mu_0", "mu_1"):
        expected = (value(**{name: mu + 2e-6}) - value(**{name: mu - 2e-6})) / 4e-6
        assert float(found[name]) == pytest.approx(expected, abs=1e-8)


@pytest.mark.slow
def test_simultaneous_events_that_strike_one_another_have_no_derivative():
    """Coupled in the mass matrix, the two feel each other's events at once: which of them is first matters, and differences in
    what only one of them feels disagree with any derivative. With events apart the derivative exists, and is theirs."""
    found, worst = differs_from_differences(spring_coupled((1.0, 1.0), mass=0.004), 0.2)
    assert worst > 1e-4
    assert not found.exist
    found, worst = differs_from_differences(spring_coupled((1.0, 1.1), mass=0.004), 0.2)
    assert found.exist
    assert worst < 1e-7


TURN = np.array([[1.0, 0.3, 0.2], [0.1, 1.0, -0.4], [0.2, 0.0, 1.0]])  # q = TURN · z
SINGLE = fj.belt_oscillator()


def turned_matrices(k1):
    mass, damping, stiffness, load = fj.belt_oscillator(k1=k1).matrices
    return *(TURN.T @ matrix @ TURN for matrix in (mass, damping, stiffness)), TURN.T @ load


def turned(k1=100e3) -> fj.Structure:
    """The belt oscillator in other coordinates, in which its one contact is given by vectors."""
    contact = fj.ContactPoint(TURN[SINGLE.tangential], TURN[SINGLE.normal])
    return fj.Structure.from_parameters(turned_matrices, {"k1": k1}, contacts=[contact], builder=turned)


def on_both(make):
    """Of the scene with the contact at coordinates, and of that with it along vectors."""
    return [make(fj.Scene(one, fj.Coulomb(0.227), 1.0, fj.Pulse(100.0, 1.2))) for one in (SINGLE, turned())]


@pytest.mark.slow
def test_a_contact_that_comes_to_rest_without_an_event_does_not_end_the_search_for_close_calls(monkeypatch):
    """As at the end of a chain of impacts; an advance in which nothing changes does."""
    scene, looks_until = scene_of(copies(2), p=1.3), event_distance._looks_until
    y0 = np.concatenate([fj.sliding_equilibrium(scene), np.zeros(2 * EACH)])

    def closest(status):
        def looks(*args):
            first, *others = looks_until(*args)
            rest = dataclasses.replace(first.contact, status=np.array(status, np.int32))
            standing = {"y": y0, "contact": rest, "h": np.zeros(()), "ended": np.zeros(2, bool)}
            yield dataclasses.replace(first, **standing, left=np.ones(()))
            yield from (first, *others)

        monkeypatch.setattr(event_distance, "_looks_until", looks)
        with jax.enable_x64(True):
            return event_distance.closest_call(scene, fj.EventExact(), y0, 0.05)

    assert "finite" in closest([1, 1]).event and "finite" not in closest([1, 0]).event


def test_one_contact_along_vectors_is_the_one_at_coordinates():
    """Rejects one contact refused where two worked: the same motion, limits and equilibrium in other coordinates."""
    right, mine = on_both(lambda scene: fj.simulate(scene, 0.2, 1e-2))
    np.testing.assert_allclose(mine.velocity @ TURN.T, right.velocity, atol=1e-11)
    np.testing.assert_allclose(mine.normal_force, right.normal_force, rtol=1e-9, atol=1e-9)
    right, mine = on_both(fj.sliding_equilibrium)
    np.testing.assert_allclose(TURN @ mine, right, atol=1e-14)
    for quantity in (
        lambda scene: fj.painleve_friction(scene.structure),
        fj.cea.growth_rate,
        fj.cea.critical_slope,
        lambda scene: fj.cea.coalescence(scene.structure).mu,
        lambda scene: fj.cea.critical_friction(scene.structure),
    ):
        right, mine = on_both(quantity)
        assert float(mine) == pytest.approx(float(right), rel=1e-6)


@pytest.mark.slow
def test_one_contact_along_vectors_in_derivatives_maps_and_cycles():
    """The parameters of a structure are known in contact coordinates, and results come back in the structure's own."""
    right, mine = on_both(
        lambda scene: fj.derivatives(lambda run: run.slip_velocity[-1], scene, ["mu", "k1"], 0.15, 1e-2)
    )
    assert all(mine[name] == pytest.approx(right[name], rel=1e-9) for name in ("mu", "k1"))
    right, mine = on_both(lambda scene: fj.bistability_map(scene, k1=[99e3, 1e5], p=[1.0, 3.0], progress=False))
    assert np.array_equal(right["verdict"], mine["verdict"])
    assert fj.Scene.from_dataset(mine).structure.places == turned().places
    right, mine = on_both(fj.limit_cycle)
    assert mine.period == pytest.approx(right.period, rel=1e-11)
    np.testing.assert_allclose(np.kron(np.eye(2), TURN) @ mine.state, right.state, atol=1e-12)
    end = mine.trajectory(4)
    np.testing.assert_allclose(np.concatenate([end.displacement[-1], end.velocity[-1]]), mine.state, atol=1e-10)


def test_a_contact_whose_slip_an_impact_elsewhere_ends_sticks_if_static_friction_holds_it():
    """The other one lands, coupled by the mass matrix, and its impulse ends the slip: the force that holds the contact then is
    above what sliding has, and below what sticking can have.
    """
    mass = np.array(
        [[1.35, 0.0, -0.22, -0.07], [0.0, 2.18, 0.03, 0.61], [-0.22, 0.03, 1.85, 0.29], [-0.07, 0.61, 0.29, 1.43]]
    )
    load = np.array([-0.34, -1.0, 0.5, -1.0])
    contacts = [fj.ContactPoint(0, 1), fj.ContactPoint(2, 3)]
    structure = fj.Structure(mass, np.zeros((4, 4)), 3.0 * np.eye(4), load, contacts=contacts)
    scene = fj.Scene(structure, fj.Coulomb(0.3, 0.9), belt_speed=1.0, load=fj.ConstantLoad(5.0))
    velocity, height, t1 = np.array([0.79, -1.0, 1.02, 0.0]), 1e-3, 2e-3
    start = np.array([0.0, height, 0.0, 0.0])
    run = fj.simulate(scene, t1, 1e-4, y0=(start, velocity))
    # Both impulses lie in the cone of kinetic friction: nothing moves relative to the belt then.
    slip = velocity - [1.0, 0.0, 1.0, 0.0]
    impulses = -mass @ slip
    assert np.all(np.abs(impulses[::2]) < 0.3 * impulses[1::2])
    # What holds both: nothing accelerates.
    holding = 3.0 * np.asarray(run.displacement)[-1] - 5.0 * load
    shares = holding[::2] / holding[1::2]
    assert 0.3 < abs(shares[1]) < 0.9 and abs(shares[0]) < 0.9
    assert np.asarray(run.status)[-1].tolist() == [fj.Status.STICK, fj.Status.STICK]
    np.testing.assert_allclose(np.asarray(run.friction_force)[-1] / np.asarray(run.normal_force)[-1], shares, rtol=1e-9)


@pytest.mark.parametrize("count", range(2, 13))
def test_weights_of_the_section_lie_far_apart_however_many_there_are(count):
    """Of so many in [1, 2), all would be 1/count apart at best, and are more than half of that: no two contacts cancel."""
    weights = np.sort(section_weights(count))
    assert weights[0] == 1.0 and weights[-1] < 2.0
    assert np.min(np.diff(np.append(weights, 2.0))) > 0.5 / count


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, 2, 3, 9, 12, 13])
def test_the_order_in_which_contacts_are_listed_changes_nothing(seed):
    """Two to four contacts that the mass matrix couples, some with static friction above kinetic. What breaks away is the contact
    whose limit is reached, not another one that is listed later and would relieve it."""
    rng = np.random.default_rng(seed)
    count = int(rng.integers(2, 5))
    n = 2 * count + int(rng.integers(0, 2))
    root, springs = rng.normal(size=(n, n)), rng.normal(size=(n, n))
    mass = np.eye(n) + 0.05 * (root + root.T) / np.sqrt(n)
    stiffness = springs @ springs.T / n + np.diag(rng.uniform(0.5, 4.0, n))
    load, belts = np.zeros(n), rng.uniform(0.05, 0.5, count)
    load[1 : 2 * count : 2] = -rng.uniform(0.5, 2.0, count)
    kinetic = rng.uniform(0.1, 0.6, count)
    static = kinetic + rng.choice([0.0, 0.2, 0.5], count)
    q, v = 0.4 * rng.normal(size=n), np.zeros(n)
    q[1 : 2 * count : 2], v[: 2 * count : 2] = 0.0, np.where(rng.random(count) < 0.6, belts, 0.0)
    motions = []
    for order in (np.arange(count), np.arange(count)[::-1]):
        contacts = [fj.ContactPoint(2 * i, 2 * i + 1) for i in order]
        structure = fj.Structure(mass, 0.02 * mass + 0.01 * stiffness, stiffness, load, contacts=contacts)
        laws = [fj.Coulomb(float(kinetic[i]), float(static[i])) for i in order]
        motions.append(
            fj.simulate(fj.Scene(structure, laws, belts[order], fj.ConstantLoad(1.0)), 15.0, 0.05, y0=(q, v))
        )
    listed, turned = motions
    np.testing.assert_array_equal(turned.status, listed.status[:, ::-1])
    np.testing.assert_allclose(turned.displacement, listed.displacement, atol=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize(("static", "belt"), [(0.55, 0.2), (0.7, 0.15), (0.8, 0.3)])
def test_two_equal_contacts_break_away_at_the_same_instant(static, belt):
    """Masses that inertia couples move as one of the whole mass: neither spares the other."""
    coupled = np.array([[1.0, 0.0, 0.1, 0.0], [0.0, 1.0, 0.0, 0.0], [0.1, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0]])
    contacts = [fj.ContactPoint(0, 1), fj.ContactPoint(2, 3)]
    pair = fj.Structure(coupled, 0.02 * np.eye(4), np.eye(4), [0.0, -1.0, 0.0, -1.0], contacts=contacts)
    one = fj.Structure(np.diag([1.1, 1.0]), 0.02 * np.eye(2), np.eye(2), [0.0, -1.0], tangential=0, normal=1)
    both, alone = (
        fj.simulate(
            fj.Scene(structure, fj.Coulomb(0.4, static), belt, fj.ConstantLoad(1.0)),
            60.0,
            0.01,
            y0=([0.3, 0.0] * count, [belt, 0.0] * count),
        )
        for structure, count in ((pair, 2), (one, 1))
    )
    assert set(np.unique(alone.status)) == {fj.Status.STICK, fj.Status.SLIDE}
    for contact in (0, 1):
        np.testing.assert_array_equal(both.status[:, contact], np.ravel(alone.status))
        np.testing.assert_allclose(both.velocity[:, 2 * contact], alone.velocity[:, 0], atol=1e-12)


def test_steps_of_one_length_come_to_rest_where_an_impact_lifts_another_contact():
    """The mass matrix couples the two: each landing lifted the other off, step by step, for ever."""
    mass = np.eye(4)
    mass[2, 3] = mass[3, 2] = -0.5
    stiffness = np.diag([30.0, 40.0, 200.0, 300.0])
    structure = fj.Structure(
        mass, 0.01 * stiffness, stiffness, [0, 0, -1, -1], contacts=[fj.ContactPoint(0, 2), fj.ContactPoint(1, 3)]
    )
    scene = fj.Scene(structure, fj.Coulomb(0.2), np.ones(2), fj.ConstantLoad(10.0), impact_law="frictionless")
    y0 = [0.0, 0.0, 0.1, 0.0, *np.zeros(4)]
    exact = fj.simulate(scene, 2.0, 0.01, y0=y0)
    stepped = fj.simulate(scene, 2.0, 0.01, fj.WhereSwitched(diffrax.Heun(), dt=1e-3), y0=y0)
    assert np.mean(np.any(stepped.status != exact.status, axis=1)) < 0.02 and np.any(exact.status == 2)
    # Of first order: 0.0033 of the size. It was 0.25 with any step, and 0.0057 as long as the other contact felt no impulse.
    np.testing.assert_allclose(stepped.displacement, exact.displacement, atol=4e-3 * np.abs(exact.displacement).max())
