"""The section's return map by kernels, side by side: the one that the series stepper has by XLA."""

import copy
from concurrent.futures import ThreadPoolExecutor

import jax
import numpy as np
import pytest

import fivjax as fj
from fivjax.maps.groups import Task, constants_of
from fivjax.section.about_sliding import sliding_state
from fivjax.section.by_kernel import section_kernels
from fivjax.section.free_directions import directions_of_several, zero_on_section
from fivjax.section.return_maps import KEPT, Images, ReturnMaps, Section

CROSSINGS = 6


@pytest.fixture(scope="module")
def maps():
    scene = fj.Scene(fj.belt_oscillator(), fj.Coulomb(mu=0.2), belt_speed=2.0)
    with jax.enable_x64(True), ThreadPoolExecutor(2) as pool:
        tree = constants_of(Task(scene, fj.EventExact(), ("mu",), (), {}), np.array([[0.12], [0.2], [0.227]])).tree
        kernels = section_kernels(scene, tree.mechanics, tree.longest_return, pool, side_by_side=True)
        yield ReturnMaps(scene.structure, tree.mechanics, tree.longest_return, kernels, pool)


@pytest.fixture(scope="module")
def exactly(maps):
    """The same return maps by the series stepper, which the oracle agrees with."""
    same = copy.copy(maps)
    same.kernels = None
    return same


@pytest.fixture(scope="module")
def starts(maps, exactly) -> tuple[np.ndarray, Section]:
    """Groups and states on the section, from small ones, which slide, to large ones, which stick and lift off."""
    group = np.arange(24) % 3
    states = np.random.default_rng(3).normal(size=(24, 6)) * np.geomspace(0.1, 8.0, 24)[:, None]
    at = maps.with_modes(group, np.where(np.arange(6) == 3, 0.0, states) / maps.weights)
    closed = at.status[:, None] != fj.Status.DETACH
    at = at._replace(y=np.where(closed & np.isin(np.arange(6), (2, 5)), 0.0, at.y))
    # Where the velocity rises, as it does on the section, and not only is zero.
    return group, exactly.returns(group, at, 1).at


def test_crossings_are_the_series_stepper_s(maps, exactly, starts):
    """Also the events on the way, the time that it takes, and the crossings before the last."""
    group, at = starts
    found, expected = (one.returns(group, at, CROSSINGS, kept=CROSSINGS + 1) for one in (maps, exactly))
    size = np.linalg.norm(maps.weights * at.y, axis=1)
    assert np.sum(expected.events > 5) > 6
    assert np.any(expected.events == 0)
    for ours, theirs in ((found.at.y, expected.at.y), (found.path[:, -CROSSINGS], expected.path[:, -CROSSINGS])):
        assert np.all(np.isfinite(theirs))
        assert np.max(np.linalg.norm(maps.weights * (ours - theirs), axis=1) / size) < 1e-9
    np.testing.assert_array_equal(found.events, expected.events)
    np.testing.assert_array_equal(found.at.status, expected.at.status)
    np.testing.assert_allclose(found.time, expected.time, rtol=1e-10)
    assert np.all(np.isnan(found.path[:, 0]))


def test_a_motion_has_as_many_segments_as_its_returns_need():
    """Between two returns their number is limited, but not over all: 60,000 returns to a cycle of five events."""
    scene = fj.Scene(fj.belt_oscillator(), fj.Coulomb(mu=0.227), belt_speed=1.0)
    group, maps = np.zeros(1, int), ReturnMaps.of(scene)
    at = maps.in_contact(group, fj.limit_cycle(scene).points[:1])
    found = maps.returns(group, at, 60_000)
    assert found.events.tolist() == [300_000]
    np.testing.assert_allclose(found.at.y, at.y, rtol=1e-9, atol=1e-15)


def test_of_no_states_there_are_no_images(maps, exactly, starts):
    group, at = starts
    for one in (maps, exactly):
        found = one.returns(group[:0], at.rows(slice(0)), CROSSINGS, kept=CROSSINGS)
        assert found.path.shape == (0, CROSSINGS, 6)
        assert all(len(part) == 0 for part in (*found.at, found.events, found.time, found.peak))


@pytest.mark.slow
def test_the_peak_on_the_way_is_known_to_rounding(maps, exactly, starts):
    """By the series stepper, which is compiled for it; `test_attractor` compares amplitudes with an independent solver."""
    np.testing.assert_allclose(maps.peaks(*starts, CROSSINGS), exactly.peaks(*starts, CROSSINGS), rtol=1e-9)


def test_differences_are_the_derivative_through_events(maps, exactly, starts):
    """In the coordinates that the section and the contact leave free: the others nobody can change."""
    group, at = (starts[0][:12], starts[1].rows(slice(12)))
    _, time, ours = maps.derived(group, at, np.full(12, 2))
    _, expected_time, theirs = exactly.derived(group, at, np.full(12, 2))
    np.testing.assert_allclose(time, expected_time, rtol=1e-10)
    scale = maps.weights[:, None] / maps.weights
    free = np.array([0, 1, 4])
    difference = (scale * (ours - theirs))[:, :, free]
    assert np.max(np.abs(difference)) < 1e-6 * np.max(np.abs((scale * theirs)[:, :, free]))


def test_each_rise_of_the_velocity_is_a_crossing():
    """A light mass in flight vibrates so fast that the velocity falls and rises again within a step: that counts, too."""
    parts = dict(m1=0.45, m2=0.0092, c1=1.65, c2=0.483, k1=32851.0, k2=48414.0, theta=0.19)
    scene = fj.Scene(fj.belt_oscillator(**parts), fj.Coulomb(0.3076), belt_speed=32.26, load=fj.Pulse(100.0, 6.0, 0.1))
    run = fj.simulate(scene, 3.0, 1e-5)
    after = run.t >= 0.1
    speed = run.velocity[after, scene.structure.tangential]
    expected = int(np.sum((speed[:-1] < 0) & (speed[1:] >= 0)))
    start = np.concatenate([run.displacement[after][0], run.velocity[after][0]])
    maps, only = ReturnMaps.of(scene), np.zeros(1, int)
    at = maps.in_contact(only, (start - np.asarray(sliding_state(scene, scene.load.final)))[None])
    count, time = 0, 0.0
    while True:
        image = maps.returns(only, at, 1)
        time, at = time + float(image.time[0]), image.at
        if time > run.t[-1] - 0.1:
            break
        count += 1
    assert count == expected and count > 100


def test_what_is_zero_on_the_section():
    """With one contact its tangential velocity, with several none; and gaps that are closed, with their rates."""
    slide, detach = fj.Status.SLIDE, fj.Status.DETACH
    one = zero_on_section(3, 0, 2, np.array([slide, detach]))
    assert [np.flatnonzero(row).tolist() for row in one] == [[2, 3, 5], [3]]
    assert zero_on_section(3, 0, 2, np.zeros(0, int)).shape == (0, 6)
    places, status = (np.array([0, 2]), np.array([1, 3])), np.array([[slide, detach], [slide, slide], [detach, detach]])
    several = zero_on_section(4, *places, status)
    assert [np.flatnonzero(row).tolist() for row in several] == [[1, 5], [1, 3, 5, 7], []]


def test_free_directions_of_several_contacts_are_those_that_nothing_holds():
    """Of three contacts one slides, one sticks and one is open; the velocities' weighted sum is zero on the section."""
    rng, n = np.random.default_rng(1), 7
    weights, section = rng.uniform(0.5, 2.0, 2 * n), np.zeros(n)
    tangential, normal = np.array([4, 0, 6]), np.array([2, 5, 1])
    section[tangential] = 1.0, 0.7, 0.4
    status = np.array([fj.Status.SLIDE, fj.Status.STICK, fj.Status.DETACH])
    free = directions_of_several(weights, section, tangential, normal, status)
    held = [*normal[:2], *(n + normal[:2]), n + tangential[1]]
    assert free.shape == (2 * n, 2 * n - len(held) - 1)
    np.testing.assert_allclose(free.T @ free, np.eye(free.shape[1]), atol=1e-14)
    np.testing.assert_allclose(free[held], 0.0, atol=1e-14)
    np.testing.assert_allclose(section @ (free / weights[:, None])[n:], 0.0, atol=1e-14)


@pytest.mark.parametrize(("crossings", "kept"), [(5, 3), (96, 48), (20, 20), (40, 17)])
def test_without_kernels_the_last_of_many_states_are_kept(crossings, kept, monkeypatch):
    """By a law that adds one to a state at each crossing, which takes a second and has two events."""

    def returned(self, group, at, count, kept, peaks):
        assert kept <= KEPT
        path = at.y[:, None] + np.arange(count - kept + 1, count + 1)[:, None]
        number = np.full(len(group), count)
        return Images(at._replace(y=at.y + count), 2 * number, number, 1.0 * number, path, at.y[:, 0] + count)

    monkeypatch.setattr(ReturnMaps, "_returns", returned)
    maps = object.__new__(ReturnMaps)
    maps.kernels = None
    at = Section(np.array([[0.0, 0.0], [100.0, 100.0]]), np.zeros(2, int), np.zeros(2))
    found = maps.returns(np.zeros(2, int), at, crossings, kept)
    assert found.at.y[:, 0].tolist() == [crossings, 100 + crossings] and found.time.tolist() == [crossings] * 2
    assert found.events.tolist() == [2 * crossings] * 2
    np.testing.assert_array_equal(found.path[1, :, 0], 100 + np.arange(crossings - kept + 1, crossings + 1))


def test_of_several_contacts_the_one_that_sticks_goes_on_to_stick():
    """Static friction is larger: one that was taken to slide, at the belt's speed, was another motion. So were the parts of which
    derivatives over many crossings are made.
    """
    rng, n = np.random.default_rng(3), 5
    a, b = rng.standard_normal((2, n, n)) / np.sqrt(n)
    matrices = np.eye(n) + 0.06 * a @ a.T, 0.02 * np.eye(n), 2 * (np.eye(n) + b @ b.T)
    structure = fj.Structure(*matrices, [0, 0, -1, -1, 0], contacts=[fj.ContactPoint(0, 2), fj.ContactPoint(1, 3)])
    scene = fj.Scene(structure, fj.Coulomb(0.2, 0.5), 0.2, fj.ConstantLoad(10.0))
    with jax.enable_x64(True):
        maps, one = ReturnMaps.of(scene), np.zeros(1, int)
        at = maps.in_contact(one, 0.3 * rng.standard_normal((1, 10)) * np.array([1, 1, 0, 0, 1] * 2))
        start = at = maps.returns(one, at, 60).at
        seen, product = set(), np.eye(10)
        for _ in range(17):
            seen.add(tuple(at.status[0].tolist()))
            told = maps.with_modes(one, maps.weights * at.y / maps.weights)
            for own, other in zip(at, told, strict=True):
                np.testing.assert_allclose(other, own, rtol=1e-15)
            at, _, slope = maps.derived(one, at, 1)
            product = slope[0] @ product
        end, _, derived = maps.derived(one, start, 17)
    assert seen == {(0, 1), (1, 0)}
    np.testing.assert_allclose(end.y, at.y, atol=1e-12 * np.abs(at.y).max())
    np.testing.assert_allclose(derived[0], product, atol=1e-6 * np.abs(product).max())
