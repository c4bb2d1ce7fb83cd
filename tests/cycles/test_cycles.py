"""Limit cycles against closed forms, against ODE solvers of another kind (`reference/cycles.json`), and against trajectories."""

import dataclasses
from types import SimpleNamespace

import jax
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import fivjax as fj
from fivjax.attractors.closing import close, closed_at
from fivjax.contact import Contact
from fivjax.cycles import search
from fivjax.cycles.cycle import limit_cycle_of
from fivjax.cycles.one_period import PeriodSegments, word
from fivjax.cycles.torus import _rotation, off_the_curve
from fivjax.section.crossings import Point
from fivjax.section.return_maps import ReturnMaps, Section
from tests.helpers import reference
from tests.helpers.catalogue import full_matrices
from tests.helpers.general_coordinates import in_general_coordinates
from tests.helpers.reference.cycles import stored
from tests.helpers.several_contacts import copies

REFERENCE = stored()


def paper(belt_speed: float, mu: float = 0.227, **others) -> fj.Scene:
    return fj.Scene(fj.belt_oscillator(), fj.Coulomb(mu), belt_speed=belt_speed, load=fj.ConstantLoad(100.0), **others)


def benchmark_a(belt_speed: float) -> fj.Scene:
    """A unit mass on a belt with exponentially falling friction; its normal coordinate never opens."""
    structure = fj.Structure(np.eye(2), np.diag([0.1, 0.0]), np.eye(2), np.array([0.0, -1.0]), tangential=0, normal=1)
    return fj.Scene(structure, fj.ExponentialDecay(1.0, 0.5, 2.0), belt_speed, fj.ConstantLoad(1.0))


@pytest.fixture(scope="module")
def cycle() -> fj.LimitCycle:
    return fj.limit_cycle(paper(1.0))


@pytest.fixture(scope="module")
def saddle(cycle) -> fj.LimitCycle:
    return fj.saddle_cycle(paper(1.0), cycle)


def test_a_saved_cycle_comes_back_to_the_last_bit(cycle, saddle, tmp_path):
    """Also one that is unstable, which no search would find again."""
    for one in (cycle, saddle):
        fj.save(one, tmp_path / "cycle.nc")
        dataset = fj.open(tmp_path / "cycle.nc")
        # Coordinates are names.
        assert [name for name in dataset.variables if "units" not in dataset[name].attrs] == ["coordinate"]
        found = fj.LimitCycle.from_dataset(dataset)
        assert (repr(found), found.word, repr(found.scene)) == (repr(one), one.word, repr(one.scene))
        for own, other in zip(jax.tree.leaves(one), jax.tree.leaves(found), strict=True):
            np.testing.assert_array_equal(own, other)
    run = found.trajectory(64)
    np.testing.assert_allclose(run.velocity[-1], run.velocity[0], atol=1e-10 * np.abs(run.velocity).max())
    with pytest.raises(ValueError, match="must be a saved limit cycle"):
        fj.LimitCycle.from_dataset(run.to_dataset())
    with pytest.raises(ValueError, match="must be a saved limit cycle"):
        fj.LimitCycle.from_dataset(cycle.to_dataset().isel(t=slice(3, None)))


def test_a_cycle_in_other_coordinates_is_no_start(cycle):
    """Its states are others there: another cycle was found."""
    turned = fj.Scene(in_general_coordinates(cycle.scene.structure), fj.Coulomb(0.227), 1.0, fj.ConstantLoad(100.0))
    with pytest.raises(ValueError, match="`start` must be a cycle whose contacts are"):
        fj.limit_cycle(turned, start=cycle)
    with pytest.raises(ValueError, match="`cycle` must be a cycle whose contacts are"):
        fj.saddle_cycle(turned, cycle)


@pytest.mark.slow
def test_block_on_a_belt_has_the_closed_form_s_period_and_multipliers():
    """Stick and slip times follow from Δ = F_s - F_d alone; after sticking nothing is left of a deviation along the belt.

    The paper's model on a level belt: the mass above it would swing on its own, and decay by its own eigenvalues. It rests, also
    while the block sticks for long: the derivative must not be that of a series which only the block's motion allows.
    """
    structure = fj.belt_oscillator(m1=0.9, m2=0.1, c1=0.0, c2=0.1, k1=1.0, k2=1.0, theta=0.0)
    scene = fj.Scene(structure, fj.Coulomb(0.5, mu_static=1.0), belt_speed=0.2, load=fj.ConstantLoad(1.0))
    cycle = fj.limit_cycle(scene)
    slip, stick = 2.0 * (np.pi - np.arctan(0.5 / 0.2)), 2.0 * 0.5 / 0.2
    assert cycle.period == pytest.approx(slip + stick, rel=1e-12)
    durations = {phase.status: phase.duration for phase in cycle.word}
    assert durations[fj.Status.STICK] == pytest.approx(stick, rel=1e-12)
    assert durations[fj.Status.SLIDE] == pytest.approx(slip, rel=1e-12)
    above = np.exp(np.roots([0.9, 0.1, 1.0]) * cycle.period)
    expected = [1.0, *above, 0.0]
    np.testing.assert_allclose(np.sort_complex(cycle.multipliers), np.sort_complex(expected), atol=1e-12)
    assert cycle.stable


@pytest.mark.slow
@pytest.mark.parametrize("speed", [0.2, 1e-3])
def test_a_slow_belt_sticks_for_hundreds_of_natural_periods(speed):
    """The section is crossed once in a thousand seconds, and the next crossing was waited for a hundred natural periods."""
    structure = fj.Structure(
        np.eye(2), np.zeros((2, 2)), np.eye(2), np.array([0.0, -1.0]), contacts=[fj.ContactPoint(0, 1)]
    )
    cycle = fj.limit_cycle(fj.Scene(structure, fj.Coulomb(0.5, mu_static=1.0), speed, fj.ConstantLoad(1.0)))
    assert cycle.period == pytest.approx(2 * (np.pi - np.arctan(0.5 / speed)) + 1.0 / speed, rel=1e-12)
    np.testing.assert_allclose(cycle.multipliers, [1.0, 0.0], atol=1e-10)


def test_the_paper_s_cycle_is_the_reference_s(cycle):
    expected = next(case for case in REFERENCE["paper"]["periodic"] if case["belt_speed"] == 1.0)
    assert cycle.kind == "periodic" and cycle.stable and cycle.residual < 1e-12
    assert cycle.period == pytest.approx(expected["period"], rel=1e-12)
    assert cycle.amplitude == pytest.approx(expected["peak_speed"], rel=1e-12)
    np.testing.assert_allclose(cycle.deviation[:3], expected["deviation"], atol=1e-14)
    np.testing.assert_allclose(cycle.state[3:], expected["velocity"], atol=1e-11)
    nontrivial = [complex(*value) for value in expected["multipliers"]]
    np.testing.assert_allclose(cycle.multipliers, [1.0, *nontrivial], atol=1e-9)
    # The reference begins its cycle elsewhere in the word, and cuts the phase that the section is in.
    modes = [int(phase.status) for phase in cycle.word]
    assert modes == expected["modes"][:-1]
    assert sum(phase.duration for phase in cycle.word) == pytest.approx(cycle.period, rel=1e-13)


def test_one_period_by_simulation_ends_where_it_began(cycle):
    run = cycle.trajectory(2000)
    assert run.t[-1] == pytest.approx(cycle.period, rel=1e-14)
    np.testing.assert_allclose(run.velocity[-1], run.velocity[0], atol=1e-11)
    np.testing.assert_allclose(run.displacement[-1], run.displacement[0], atol=1e-14)
    assert np.abs(run.velocity[:, 0]).max() == pytest.approx(cycle.amplitude, rel=1e-3)
    lines = np.fft.rfft(run.velocity[:-1, 0])[1:4] * 2 / 2000
    np.testing.assert_allclose(np.abs(cycle.harmonics[:3, 0]), np.abs(lines), rtol=1e-3)


def test_a_cycle_is_shown_as_one_closed_period(cycle):
    response, phase_plane = fj.show(cycle).axes
    assert response.get_xlim()[1] == pytest.approx(cycle.period)
    x, v = phase_plane.lines[0].get_data()
    assert np.hypot((x[-1] - x[0]) / np.ptp(x), (v[-1] - v[0]) / np.ptp(v)) < 1e-9
    assert np.ptp(v) > cycle.amplitude


def test_energy_per_period_balances(cycle):
    """Over a period nothing is stored: what the contact puts in, dampers and impacts take."""
    energy = cycle.energy
    gained = energy["stick_work"] + energy["slide_work"] + energy["load_work"]
    lost = energy["damping_work"] + energy["impact_loss"]
    assert lost > 1e-3
    assert gained == pytest.approx(lost, rel=1e-9)
    # Its periods are whole cycles of its trajectory, which begins and ends on the section: rounding left out the first, or two.
    for periods in (1, 3):
        of_each = fj.energy_per_cycle(cycle.trajectory(2 * periods, periods=periods, energy=True))
        np.testing.assert_allclose(of_each["damping_work"], periods * [energy["damping_work"]], rtol=1e-9)


@pytest.mark.parametrize("restitution", [0.0, 0.3])
def test_energy_per_period_has_the_impact_that_leads_to_the_section(restitution):
    """A trajectory over the period begins just after it and ends just before it. What the masses lose in it is taken by hand."""
    if restitution:
        structure = fj.belt_oscillator(theta=0.417, k2=110.7e3, c1=1.5, c2=3.33)
        scene = fj.Scene(structure, fj.Coulomb(0.725, 0.942), 0.278, fj.ConstantLoad(91.6), restitution=restitution)
    else:
        structure = fj.belt_oscillator(theta=0.12, k2=133.4e3, c1=3.5, c2=4.9)
        scene = fj.Scene(structure, fj.Coulomb(0.318), 0.995, fj.ConstantLoad(113.8))
    cycle = _begun_after_an_impact(fj.limit_cycles(scene)[0])
    run = cycle.trajectory(64)
    before, after = run.velocity[-1], run.velocity[0]
    # It jumps from below zero to above it.
    assert before[0] < -0.03 and after[0] > 0.03
    mass = np.asarray(structure.matrices.mass)
    at_section = 0.5 * (before @ mass @ before - after @ mass @ after)
    energy, others = cycle.energy, float(cycle.trajectory(64, energy=True).energy.impact[-1])
    gained = energy["stick_work"] + energy["slide_work"] + energy["load_work"]
    assert gained == pytest.approx(energy["damping_work"] + energy["impact_loss"], rel=1e-9)
    assert energy["impact_loss"] == pytest.approx(others + at_section, rel=1e-9) and at_section > 0.1


def _begun_after_an_impact(cycle: fj.LimitCycle) -> fj.LimitCycle:
    """Any of a cycle's points on the section may be the first: here the first to which an impact leads."""
    with jax.enable_x64(True):
        maps, at = ReturnMaps.of(cycle.scene), Section.of(Point(cycle.deviation, cycle.contact))
        points = [at, *(at := maps.returns(np.zeros(1, int), at, 1).at for _ in range(1, cycle.crossings))]
        at = next(point for point in points if maps.jumped(point.y)[0])
        return limit_cycle_of(maps, cycle.scene, closed_at(maps, at.point(0), cycle.crossings))


def test_a_flight_beyond_all_measure_is_no_cycle():
    """Nothing holds it back along one direction: 1e14 m away the motion seemed to return, to 1e-16 of that."""
    structure = fj.belt_oscillator(theta=0.39, k2=123e3, c1=3.97, c2=2.26)
    scene = fj.Scene(structure, fj.Coulomb(0.703), 1.41, fj.ConstantLoad(99.2))
    start = [0.0077, 0.0126, 0.0098, -0.7825, -3.553, -4.0105], fj.Status.DETACH
    with pytest.raises(fj.NoLimitCycle, match="did not close a cycle near it"):
        fj.limit_cycle(scene, start=start)


def test_multipliers_are_those_of_differences(cycle):
    """A trajectory beside the cycle approaches it at the rate of the largest multiplier but one, return by return."""
    apart = cycle.deviation * 1e-6
    state = cycle.state + apart * np.array([1, 1, 0, 0, 1, 0])
    # As many rows as `cycle.trajectory` above has: compiled already.
    run = fj.simulate(cycle.scene, t1=30 * cycle.period, dt_save=cycle.period / 50, y0=state)
    away = np.linalg.norm(run.velocity - run.velocity[-1], axis=1)[::50][4:16]
    rate = np.exp(np.polyfit(np.arange(len(away)), np.log(away), 1)[0])
    assert rate == pytest.approx(abs(cycle.multipliers[1]), rel=0.05)


def test_the_saddle_has_one_direction_outside_and_lies_between_sliding_and_the_cycle(cycle, saddle):
    outside = np.abs(saddle.multipliers) > 1 + 1e-9
    assert outside.sum() == 1 and not saddle.stable and saddle.residual < 1e-12
    assert saddle.amplitude < cycle.amplitude
    # Beside it, trajectories leave to either side.
    weights = np.asarray(saddle.scene.structure.weights)
    for share, stays in ((1.02, True), (0.98, False)):
        equilibrium = saddle.state - saddle.deviation
        run = fj.simulate(saddle.scene, t1=3.0, dt_save=2e-3, y0=equilibrium + share * saddle.deviation)
        sizes = np.linalg.norm(
            weights * (np.concatenate([run.displacement, run.velocity], axis=1) - equilibrium), axis=1
        )
        assert (sizes[-300:].max() > np.linalg.norm(weights * saddle.deviation)) == stays


@pytest.mark.slow
def test_from_a_start_newton_finds_the_unstable_cycle_too(saddle):
    """`test_branches` begins at a cycle that is given, and goes on along unstable ones."""
    again = fj.limit_cycle(paper(1.0), start=(saddle.state, saddle.contact.status))
    assert again.period == pytest.approx(saddle.period, rel=1e-12) and not again.stable
    nearby = fj.limit_cycle(paper(1.01), start=saddle)
    assert abs(nearby.period - saddle.period) < 1e-3 * saddle.period and not nearby.stable


def test_above_the_speed_where_it_loses_stability_the_cycle_is_a_torus():
    """At 3 m/s the motion beats for ever, some 14 returns to a beat; its peak is the reference's over a long run."""
    scene = paper(3.0)
    torus = fj.limit_cycle(scene)
    assert torus.kind == "torus" and torus.stable and torus.unstable_directions == 0
    peaks = {case["belt_speed"]: case["peak_speed"] for case in REFERENCE["paper"]["peaks"]}
    assert torus.amplitude == pytest.approx(peaks[3.0], rel=1e-4)
    assert 1 / torus.rotation_number == pytest.approx(14, abs=0.5)
    # No return balances by itself; the mean of many does.
    energy = torus.energy
    gained = energy["stick_work"] + energy["slide_work"] + energy["load_work"]
    assert gained == pytest.approx(energy["damping_work"] + energy["impact_loss"], rel=0.01)
    # A mean over whole beats: with equal weights for all returns it was 2e-3.
    assert abs(abs(torus.multipliers[0]) - 1) < 1e-3 and abs(torus.multipliers[1]) < 0.99
    # On some of the returns the contact sticks, which takes a direction away.
    assert np.all(torus.multipliers[2:] == 0) and "-∞, -∞ (the first is zero" in str(torus)
    # The curve's points, on cubics through their neighbours: half as many lie farther off, by the fourth power or so.
    path = np.asarray(scene.structure.weights) * torus.points
    size = np.mean(np.linalg.norm(path, axis=1))
    coarse = np.median(off_the_curve(path[::2])) / size
    assert torus.residual == pytest.approx(np.median(off_the_curve(path)) / size, rel=1e-6)
    assert torus.residual < 1e-8 and coarse > 8 * torus.residual
    # Its state is one of them, about equilibrium; they are so far apart.
    equilibrium = np.append(reference.linear(reference.of_scene(scene)).q_eq, np.zeros(3))
    away = np.linalg.norm(np.asarray(scene.structure.weights) * (torus.state - equilibrium) - path, axis=1).min()
    assert away < 1e-3 * size
    # It winds around the cycle that it came from, which is found from its middle; from one of its points, if need be.
    amid = np.mean(path, axis=0)
    for start in (torus, dataclasses.replace(torus, points=1e15 * torus.points)):
        inner = fj.limit_cycle(scene, start)
        assert inner.kind == "periodic" and inner.unstable_directions == 2
        beside = np.asarray(scene.structure.weights) * inner.points - amid
        assert np.linalg.norm(beside) < 0.7 * np.linalg.norm(np.std(path, axis=0))


@pytest.mark.parametrize("harmonic", [1, 2, 3])
def test_turns_per_return_are_those_of_the_curve_however_often_it_goes_around_its_mean(harmonic):
    turns = 0.0717092
    phase = 2 * np.pi * turns * np.arange(1024)
    curve = [np.cos(phase), np.sin(phase), 3 * np.cos(harmonic * phase), 2 * np.sin(harmonic * phase + 0.3)]
    assert _rotation(np.stack(curve, axis=1)) == pytest.approx(turns, abs=1e-6)


def test_points_of_an_ellipse_lie_on_cubics_to_the_fourth_power_of_their_distance():
    """As on a torus they are not evenly spread, and the curve has jumps, where nothing is said."""
    errors = []
    for count in (200, 400):
        angle = 2 * np.pi * (np.arange(count) + 0.3 * np.sin(np.arange(count))) / count
        path = np.stack([2 * np.cos(angle), np.sin(angle), np.where(angle < np.pi, 0.0, 5.0)], axis=-1)
        distance = off_the_curve(path)
        assert np.sum(distance > 1e-3) <= 8
        errors.append(np.median(distance))
    assert errors[0] / errors[1] == pytest.approx(16, rel=0.1)


@pytest.mark.slow
@pytest.mark.parametrize("speed", [0.2, 0.24, 0.27])
def test_a_stick_slip_cycle_beside_stable_sliding_is_met_without_a_start(speed):
    """Verasztó and Stépán's rig above its Hopf point: sliding attracts, and so does stick-slip, with an unstable cycle between.
    Kicks by the load alone are too small there: 1 N moves the mass by less than the unstable cycle.
    """
    mass, stiffness, damping, high, low, decay = 0.538, 6957.0, 5.946, 6.0, 2.0, 10.0
    structure = fj.Structure(
        np.diag([mass, 1.0]), np.diag([damping, 1.0]), np.diag([stiffness, 1.0]), [0.0, -1.0], tangential=0, normal=1
    )
    cycle = fj.limit_cycle(fj.Scene(structure, fj.ExponentialDecay(high, low, decay), speed, fj.ConstantLoad(1.0)))

    def force(slip):
        return low + (high - low) * np.exp(-decay * slip)

    def motion(t, y):
        return [y[1], (force(speed - y[1]) - stiffness * y[0] - damping * y[1]) / mass]

    def sticks(t, y):
        return speed - y[1]

    sticks.direction, sticks.terminal = -1, True
    # Sticking ends where spring and damper reach the static force; it begins where the mass is as fast as the belt again.
    begin = [(high - damping * speed) / stiffness, speed]
    slip = solve_ivp(motion, (0.0, 0.2), begin, "DOP853", events=sticks, rtol=1e-12, atol=1e-15)
    times = [t for t in slip.t_events[0] if t > 1e-4]
    assert len(times) == 1
    durations = {phase.status: phase.duration for phase in cycle.word}
    assert durations[fj.Status.SLIDE] == pytest.approx(times[0], abs=1e-9)
    assert durations[fj.Status.STICK] == pytest.approx((begin[0] - slip.y_events[0][-1][0]) / speed, abs=1e-9)
    assert cycle.stable


@pytest.mark.slow
def test_a_cycle_that_only_a_slower_belt_s_leads_to_is_met(monkeypatch):
    """Where motions released about sliding all come to rest, the cycle of a slower belt is followed to this one."""
    monkeypatch.setattr(search, "SPEEDS", ())
    monkeypatch.setattr(search, "FURTHER_SPEEDS", ())
    monkeypatch.setattr(search, "LOADS", (1.0, 1.01))
    monkeypatch.setattr(search, "FURTHER_LOADS", (1.02,))
    # At 0.4 of 1.8 m/s sliding is unstable, so that every motion comes to the cycle.
    found = fj.limit_cycle(benchmark_a(1.8))
    reference = REFERENCE["benchmark_a"]["stick_slip"]["1.8"]
    assert found.period == pytest.approx(reference["slip_time"] + reference["stick_time"], abs=1e-8)


@pytest.mark.slow
@pytest.mark.parametrize("belt_speed", [0.3, 1.0])
def test_below_the_fold_there_is_none(belt_speed):
    """Just below its fold the cycle's ghost holds trajectories for hundreds of periods; it is no cycle."""
    fold = {0.3: 0.1156, 1.0: 0.1679}[belt_speed]
    searched = (
        r"from rest under 0 to 20 times the final load, nor by 6 from sticking .* at 0\.7 and 0\.4 of the belt speed"
    )
    with pytest.raises(fj.NoLimitCycle, match=searched):
        fj.limit_cycle(paper(belt_speed, mu=0.99 * fold))


@pytest.mark.parametrize(
    ("start", "fragment"),
    [
        (np.zeros(5), "shape"),
        ("here", "must"),
        ((np.full(6, np.nan), 1), "`start` must be finite, but holds nan"),
        ((np.zeros(6), 7), r"a status for each contact, 0 \(stick\), 1 \(slide\) or 2 \(detach\), but has \[7\] for 1"),
        ((np.zeros(6), [1, 1]), r"a status for each contact.* but has \[1, 1\] for 1"),
    ],
)
def test_starts_of_the_wrong_kind_are_refused(start, fragment):
    with pytest.raises((TypeError, ValueError), match=fragment):
        fj.limit_cycle(paper(1.0), start=start)


@pytest.mark.slow
@pytest.mark.parametrize("multipliers", [False, True])
def test_derivatives_are_those_of_differences(cycle, multipliers):
    """In every kind of parameter, period, peak, state and multipliers move as two neighbouring cycles say."""
    steps = {"mu": 1e-5, "belt_speed": 1e-4, "k1": 1.0, "theta": 1e-6, "c1": 1e-3}
    slopes = fj.cycle_derivatives(cycle, list(steps), multipliers=multipliers)
    for name, step in steps.items():
        value = float(cycle.scene.parameters[name])
        above, below = (fj.limit_cycle(cycle.scene.replace(**{name: value + s * step}), start=cycle) for s in (1, -1))
        assert slopes.amplitude[name] == pytest.approx((above.amplitude - below.amplitude) / (2 * step), rel=1e-6)
        # The times of events are rounded to some 1e-15 s.
        assert slopes.period[name] == pytest.approx(
            (above.period - below.period) / (2 * step), rel=1e-6, abs=1e-15 / step
        )
        np.testing.assert_allclose(slopes.state[name], (above.state - below.state) / (2 * step), rtol=1e-5, atol=1e-7)
        if multipliers:
            expected = (above.multipliers[1:3] - below.multipliers[1:3]) / (2 * step)
            np.testing.assert_allclose(slopes.multipliers[name][:2], expected, rtol=1e-5)


@pytest.mark.parametrize("seed", range(2))
def test_derivatives_do_not_depend_on_coordinates(cycle, seed):
    """A change of coordinates rounds the point on the section to just before it in half of these."""
    turn, _ = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))
    structure = in_general_coordinates(cycle.scene.structure, turn)
    turned = fj.limit_cycle(fj.Scene(structure, fj.Coulomb(0.227), 1.0, fj.ConstantLoad(100.0)))
    expected, found = (fj.cycle_derivatives(one, ["mu", "belt_speed"]) for one in (cycle, turned))
    assert found.period == pytest.approx(expected.period, rel=1e-9)
    assert found.amplitude == pytest.approx(expected.amplitude, rel=1e-9)


@pytest.mark.slow
def test_the_paper_s_cycle_loses_its_stability_in_a_neimark_sacker_bifurcation():
    """A complex pair leaves the unit circle between 1.6 and 3 m/s: below that speed it is inside, above outside."""
    before = fj.limit_cycle(paper(1.8))
    at, beyond = (fj.limit_cycle(paper(speed), start=before) for speed in (1.8378941586942, 1.85))
    pair = at.multipliers[np.abs(at.multipliers.imag) > 0.1]
    np.testing.assert_allclose(np.abs(pair), 1.0, atol=1e-9)
    assert before.stable and not beyond.stable and beyond.unstable_directions == 2


@pytest.mark.slow
@pytest.mark.parametrize("belt_speed", [1.2, 1.4, 1.6, 1.8])
def test_benchmark_a_against_another_kind_of_solver(belt_speed):
    """The unstable cycle of pure sliding and the stick-slip cycle, against DOP853 with its variational equation."""
    sliding = REFERENCE["benchmark_a"]["sliding"][str(belt_speed)]
    stick_slip = REFERENCE["benchmark_a"]["stick_slip"][str(belt_speed)]
    cycle = fj.limit_cycle(benchmark_a(belt_speed))
    durations = {phase.status: phase.duration for phase in cycle.word}
    assert durations[fj.Status.SLIDE] == pytest.approx(stick_slip["slip_time"], abs=1e-9)
    assert durations[fj.Status.STICK] == pytest.approx(stick_slip["stick_time"], abs=1e-9)
    saddle = fj.saddle_cycle(benchmark_a(belt_speed), cycle)
    assert saddle.period == pytest.approx(sliding["period"], abs=1e-9)
    np.testing.assert_allclose(saddle.multipliers, [sliding["multiplier"], 1.0], atol=1e-8)
    run = saddle.trajectory(4000)
    assert run.displacement[:, 0].max() == pytest.approx(sliding["peak_displacement"], abs=2e-6)


@pytest.mark.parametrize("contacts", [1, 2, 3])
@pytest.mark.parametrize("ends", [True, False])
def test_a_phase_that_an_event_ends_where_the_section_is_counts_twice(contacts, ends):
    """Sliding, sticking, sliding, 1, 2 and 3 s: the first and the last are one phase that the section cuts, unless it ended there."""
    shape = () if contacts == 1 else (contacts,)
    status, direction = np.full((4, *shape), fj.Status.SLIDE), np.ones((4, *shape))
    # Of several contacts only the last one sticks.
    status.reshape(4, contacts)[1, -1] = fj.Status.STICK
    ended = np.zeros((4, *shape, 2), bool)
    ended[:2, ..., 0] = True
    ended[2] = ends
    times = np.array([1.0, 2.0, 3.0])
    contact = Contact(status[:3], direction[:3])  # type: ignore[arg-type]
    states, series = np.zeros((3, 4)), np.zeros((3, 17, 4))
    segments = PeriodSegments(np.cumsum(times) - times, times, states, contact, ended[:3], series, np.ones(3))
    found = word(segments)
    assert [phase.duration for phase in found] == ([1.0, 2.0, 3.0] if ends else [4.0, 2.0])
    sticking = (fj.Status.SLIDE,) * (contacts - 1) + (fj.Status.STICK,)
    assert found[1].status == (sticking if contacts > 1 else fj.Status.STICK)
    assert found[0].status == ((fj.Status.SLIDE,) * contacts if contacts > 1 else fj.Status.SLIDE)


@pytest.mark.parametrize("fast", [2e4, 5e4])
def test_a_contact_that_is_coupled_stiffly_to_a_slow_body(fast):
    """A period has tens of thousands of the fast mode's, and hundreds of those of each coordinate with all others held."""
    node, body, soft, rate = 0.01, 1.0, 1e3, 2 * np.pi * fast
    between = np.array([[1.0, 0.0, -1.0], [0.0, 0.0, 0.0], [-1.0, 0.0, 1.0]])
    stiffness = node * rate**2 * between + np.diag([0.0, 1e6, soft])
    damping = 0.1 * node * rate * between + np.diag([0.0, 10.0, 0.0])
    structure = fj.Structure(np.diag([node, 0.01, body]), damping, stiffness, [0.0, -1.0, 0.0], tangential=0, normal=1)
    scene = fj.Scene(structure, fj.Coulomb(0.3, 0.6), 0.05, fj.ConstantLoad(20.0))
    run = fj.simulate(scene, 3.0, 1e-3, y0=np.array([7.2e-3, 0.0, 7.2e-3, 0.05, 0.0, 0.05]))
    tangential = run.velocity[:, 0]
    rises = run.t[1:][(tangential[:-1] < 0) & (tangential[1:] >= 0)]
    cycle = fj.limit_cycle(scene, start=run)
    assert cycle.crossings == 1 and cycle.period == pytest.approx(np.diff(rises)[-4:].mean(), rel=3e-3)


@pytest.mark.slow
def test_a_coordinate_that_no_spring_holds_may_be_beside_a_cycle():
    """A block on a spring, pressed on by the load alone, under friction that falls: it sticks and slips, at the reference's speed."""
    structure = fj.Structure(
        np.diag([0.538, 0.538]), np.diag([5.946, 0.0]), np.diag([6957.0, 0.0]), [0.02, -1.0], tangential=0, normal=1
    )
    scene = fj.Scene(structure, fj.ExponentialDecay(6.0, 2.0, 10.0), belt_speed=0.1, load=fj.ConstantLoad(1.0))
    cycle = fj.limit_cycle(scene)
    assert cycle.stable and cycle.period == pytest.approx(0.0577091504, rel=1e-7)
    assert {phase.status.name for phase in cycle.word} == {"STICK", "SLIDE"}


def test_a_locked_torus_is_named_as_the_cycle_that_it_is():
    """It repeats after thirteen crossings, by the independent solver to rounding."""
    parts = dict(m1=0.3325985968, m2=0.0447402462, c1=0.5867675516, c2=1.9590233554, k1=100434.07558, k2=105775.09184)
    structure = fj.belt_oscillator(**parts, theta=0.028758738967)
    scene = fj.Scene(structure, fj.Coulomb(0.2779970970), 1.9522014875, load=fj.Pulse(100.0, 2.3516, 0.1))
    cycle = fj.limit_cycle(scene)
    assert cycle.kind == "periodic" and cycle.crossings == 13
    y = cycle.points[0]
    start = {**reference.of_scene(scene), "p": 1.0, "deviation": (y[:3], y[3:])}
    later = reference.trajectory(start, 1.01 * cycle.period, times=[cycle.period])
    back = np.concatenate([later.q[0] - later.q_eq, later.v[0]])
    np.testing.assert_allclose(back, y, atol=1e-9 * np.max(np.abs(y)))
    # A point for each crossing, none of them twice.
    path = np.asarray(structure.weights) * cycle.points
    apart = np.linalg.norm(path[:, None] - path, axis=-1)[np.triu_indices(len(path), 1)]
    assert len(path) == 13 and apart.min() > 0.01 * apart.max()
    # It may be started from, however many returns it has.
    again = fj.limit_cycle(scene, start=cycle)
    assert again.crossings == 13 and again.period == pytest.approx(cycle.period, rel=1e-12)


@pytest.mark.slow
def test_newton_s_points_lie_on_the_section_in_spite_of_rounding():
    """A tangential velocity of -1e-22 m/s would rise through zero at once: a "cycle" that closes after no time."""
    scene = full_matrices()
    cycle = fj.limit_cycle(scene)
    slope = fj.cycle_derivatives(cycle, ["mu"]).period["mu"]
    for change in np.random.default_rng(0).uniform(-2e-5, 2e-5, 12):
        period = fj.limit_cycle(scene.replace(mu=0.6766 + change), start=cycle).period
        assert period == pytest.approx(cycle.period + slope * change, rel=1e-8)


@pytest.mark.parametrize("patient", [False, True])
def test_a_step_that_leads_where_there_is_no_return_is_halved(patient):
    """Newton's method for arctan(5 (x - 2)) = 0 overshoots from 2.5, to where nothing returns: half the step does better."""
    asked = []

    def derived(group, at, crossings):
        x = at.y[:, 0]
        asked.append(x.tolist())
        returns = np.abs(x - 2) < 0.9
        y, slope = at.y.copy(), 1 - 5 / (1 + 25 * (x - 2) ** 2)
        y[:, 0] = np.where(returns, x - np.arctan(5 * (x - 2)), np.nan)
        jacobian = np.zeros((len(x), 2, 2))
        jacobian[:, 0, 0] = slope
        return at._replace(y=y), np.ones(len(x)), jacobian

    maps = SimpleNamespace(
        jumped=lambda y: np.zeros(len(y), bool),
        weights=np.ones(2),
        structure=SimpleNamespace(contacts=[None]),
        derived=derived,
        # It is at rest, as far as velocities go.
        returns=lambda group, at, crossings, peaks: SimpleNamespace(at=at, peak=np.zeros(len(group))),
        tangential=0,
        normal=0,
    )
    starts = np.array([[2.5, 0.0], [0.5, 0.0]])
    guess = Section(starts, np.full(2, fj.Status.DETACH, np.int32), np.ones(2))
    closed = close(maps, np.zeros(2, int), guess, 1, patient)  # type: ignore[arg-type]
    assert closed.found.tolist() == [True, False]
    assert closed.at.y[0, 0] == pytest.approx(2.0, abs=1e-10)
    # One step too far, and none from where nothing returns.
    assert abs(asked[1][0] - 2) > 0.9 and asked[2][0] == pytest.approx(0.5 * (2.5 + asked[1][0]))
    assert [len(x) for x in asked[:2]] == [2, 1]


@pytest.mark.parametrize(
    ("masses", "stiffness", "damping", "force", "friction", "belt_speed", "restitution"),
    [
        pytest.param(
            [1.183, 1.192, 1.081, 1.362],
            [[2.398, 0.166, 0.335, 0.155], [0.166, 1.924, -0.268, 0.234], [0.335, -0.268, 3.24, 0.582], [0.155, 0.234, 0.582, 2.792]],
            0.007939, 0.71, fj.Coulomb(0.632, 0.821), 0.215, 0.0, id="a cycle where sliding is stable",
        ),
        pytest.param(
            [1.026, 0.835, 0.591, 0.506],
            [[3.07, 0.34, 0.292, -0.034], [0.34, 1.822, -0.258, 0.206], [0.292, -0.258, 2.085, 0.165], [-0.034, 0.206, 0.165, 2.615]],
            0.001812, 0.988, fj.Coulomb(0.718, 1.437), 0.26, 0.4, id="two cycles",
        ),
    ],
)  # fmt: skip
def test_cycles_that_many_initial_states_come_to_are_found(
    masses, stiffness, damping, force, friction, belt_speed, restitution
):
    """Neither was met by kicks of the load and from sticking alone, which move all modes at once."""
    mass, stiffness = np.diag(masses), np.array(stiffness)
    structure = fj.Structure(
        mass, damping * (mass + stiffness), stiffness, [0, -force, 0, 0], contacts=[fj.ContactPoint(0, 1)]
    )
    scene = fj.Scene(structure, friction, belt_speed, fj.ConstantLoad(1.0), restitution=restitution)
    grid = fj.basins(scene, dq0=np.linspace(-1.0, 1.0, 9), q2=np.linspace(-1.0, 1.0, 9), progress=False)
    often = grid["attractor_amplitude"].values[grid["share"].values > 0.05]
    assert often.size
    amplitudes = np.array([cycle.amplitude for cycle in fj.limit_cycles(scene, progress=False)])
    for amplitude in often:
        assert np.min(np.abs(amplitudes / amplitude - 1)) < 1e-4


def test_derivatives_by_what_each_contact_has_for_itself_are_refused(cycle):
    own = dataclasses.replace(cycle, scene=fj.Scene(copies(2), fj.Coulomb(0.2), [1.0, 1.2], fj.ConstantLoad(100.0)))
    with pytest.raises(ValueError, match="`belt_speed` holds one for each contact"):
        fj.cycle_derivatives(own, ["belt_speed"])


def test_a_cycle_to_which_no_load_and_no_mode_leads_is_found_from_random_states():
    """Of a structure drawn at random; that it is one, the independent solver says. Motions from it stay for fifty periods."""
    mass = [[0.284449326878, 0.0, -0.008988922786], [0.0, 0.251338564417, 0.0], [-0.008988922786, 0.0, 0.033754550244]]
    damping = np.array(
        [[838.107552659, -15.689252516, -14.313375332], [0, 438.404951459, -438.124124900], [0, 0, 438.917514331]]
    )
    stiffness = np.array(
        [[30830.650989, -1984.638298, 881.862847], [0, 55456.769266, -55421.245639], [0, 0, 55425.189702]]
    )
    damping, stiffness = (upper + np.triu(upper, 1).T for upper in (1e-3 * damping, stiffness))
    structure = fj.Structure(mass, damping, stiffness, [0.0, -1.0, 0.0], tangential=0, normal=2)
    scene = fj.Scene(structure, fj.Coulomb(0.526886111638), 9.535090538582, fj.ConstantLoad(100.0))
    (cycle,) = fj.limit_cycles(scene)
    assert cycle.kind == "periodic" and cycle.stable
    times = cycle.period * np.array([1.0, 2.0, 50.0])
    run = reference.trajectory(reference.of_scene(scene, y0=np.split(cycle.state, 2)), times[-1], times)
    np.testing.assert_allclose(run.v, np.tile(cycle.state[3:], (3, 1)), atol=1e-6 * cycle.amplitude)
