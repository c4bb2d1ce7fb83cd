"""Motions that creep along a line of states: no cycle is leapt over, and what is found is what a long run shows."""

from types import SimpleNamespace

import numpy as np
import pytest
from scipy.optimize import brentq

import fivjax as fj
from fivjax.attractors.creeping import creep
from fivjax.attractors.divergence import long_divergence
from fivjax.attractors.motions import Motions
from fivjax.section.return_maps import Images, ReturnMaps, Section


class Line(SimpleNamespace):
    """The return map of a state (x, z): x drifts by `drift(x, group)` a return, and z decays to a curve, like other deviations."""

    weights = np.ones(2)
    resolution = np.zeros(1000)  # of groups: nothing is rounded away

    def moves(self, group, y):
        return np.ones(len(group), bool)

    def returns(self, group, at, crossings, kept=0):
        y, crossings = at.y.copy(), np.broadcast_to(crossings, len(at.y))
        for count in range(int(np.max(crossings))):
            moving = crossings > count
            x, z = y[moving].T
            y[moving] = np.stack(
                [x + self.drift(x, group[moving]) + self.coupling * (z - 0.1 * x**2), 0.98 * z + 0.002 * x**2], axis=1
            )
        none = np.zeros(len(y), int)
        return Images(at._replace(y=y), none, none, 1.0 * crossings, np.zeros((len(y), 1, 2)), np.zeros(len(y)))


def on_line(drift, starts, arrived, most=3.0, coupling=0.01):
    """Where motions from these x, each of a group of its own, creep to; and after how many returns."""
    y = np.stack([starts, 0.1 * starts**2], axis=1)
    at = Section(y, np.ones(len(y), np.int32), np.ones(len(y)))

    def done(rows, at):
        del rows
        return arrived(at.y[:, 0]) | (at.y[:, 0] > most)

    creeps, last, time, _ = creep(Line(drift=drift, coupling=coupling), Motions(np.arange(len(y)), at), done)
    return creeps, last.y[:, 0], time


@pytest.mark.slow
def test_pairs_of_cycles_are_not_leapt_over():
    """Two cycles, born in a fold, lie closer to each other than a leap is long: what comes from below stays at the lower one."""
    pairs = np.meshgrid(np.linspace(0.5, 0.9, 5), np.linspace(1.0, 1.06, 7), [0.03, 0.01, 1e-3])
    starts, at, apart = map(np.ravel, pairs)

    def drift(x, k):
        return 1e-5 * ((x - at[k]) ** 2 - apart[k] ** 2)

    creeps, x, _ = on_line(drift, starts, lambda x: np.zeros(len(x), bool))
    assert np.all(creeps) and np.all(x < at)
    assert np.all(at - apart - x < 0.5 * (at - starts))


def test_a_pair_next_to_where_a_motion_begins_to_creep_is_not_leapt_over():
    """Beyond the pair, as far from its middle, the drift is the same again."""
    distances, parts = np.meshgrid(np.geomspace(2e-4, 5e-3, 15), [0.2, 0.5, 0.8])
    distance, apart = distances.ravel(), (distances * parts).ravel()

    def drift(x, k):
        return 0.2 * ((x - 1.0) ** 2 - apart[k] ** 2)

    _, x, _ = on_line(drift, 1.0 - distance, lambda x: np.zeros(len(x), bool), coupling=0.0)
    assert np.all(x < 1.0)


def test_what_the_fold_has_left_behind_is_passed():
    """Just past the fold the motion is slow, and goes on."""
    creeps, x, _ = on_line(lambda x, k: 1e-5 * ((x - 1.0) ** 2 + 0.05**2), np.array([0.5, 0.8]), lambda x: x > 1.5)
    assert np.all(creeps) and np.all(x > 1.5)


@pytest.mark.parametrize("rate", [1e-5, -1e-5])
def test_how_long_a_slow_growth_takes(rate):
    """A deviation that grows or decays by the same factor in each return, to the tenfold or a tenth: ln 10 / |rate| returns."""
    creeps, x, time = on_line(
        lambda x, k: rate * x, np.ones(1), lambda x: np.abs(np.log(x)) >= np.log(10.0), np.inf, 0.0
    )
    assert creeps[0] and time[0] == pytest.approx(np.abs(np.log(x[0])) / abs(rate), rel=0.03)


def test_growth_from_rounding_takes_few_returns():
    """Ten decades at a rate of 1e-5: 2.3 million returns, of which some thousands are computed."""
    line = Line(drift=lambda x, k: 1e-5 * x, coupling=0.0)
    counted, returns = [], line.returns
    line.returns = lambda group, at, crossings: (counted.append(np.max(crossings)), returns(group, at, crossings))[1]
    at = Section(np.array([[1e-10, 0.0]]), np.ones(1, np.int32), np.ones(1))
    creeps, last, time, _ = creep(line, Motions(np.zeros(1, int), at), lambda rows, at: at.y[:, 0] > 1.0)
    assert creeps[0] and last.y[0, 0] > 1.0
    assert time[0] == pytest.approx(np.log(last.y[0, 0] / 1e-10) / 1e-5, rel=1e-3)
    assert sum(counted) < 10_000


def test_growth_stays_below_a_cycle_that_attracts():
    """That of a supercritical Hopf point, or of a pair of cycles born in a fold: what grows from below comes to it, not beyond."""
    starts, apart = map(np.ravel, np.meshgrid([1e-9, 1e-4, 0.3], [np.inf, 0.1, 0.01]))

    def drift(x, k):
        return 1e-5 * x * (1 - x**2) * (1 - (x / (1 + apart[k])) ** 2)

    creeps, x, _ = on_line(drift, starts, lambda x: np.zeros(len(x), bool), coupling=0.0)
    assert np.all(creeps) and np.all((x > 0.9) & (x < 1.0))


def test_neighbours_of_a_motion_that_grows_are_not_chaotic():
    """From rounding to a cycle the distance of neighbours grows by thirty e-folds, and so does their size."""
    line = Line(drift=lambda x, k: 0.02 * x * (1 - x), coupling=0.0)
    at = Section(np.array([[1e-14, 0.0]]), np.ones(1, np.int32), np.ones(1))
    found = long_divergence(line, Motions(np.zeros(1, int), at))
    assert not found.chaotic[0] and found.closing_in[0] and found.at.y[0, 0] == pytest.approx(1.0, abs=1e-3)


def test_what_rounding_does_to_neighbours_of_a_tiny_motion_is_no_chaos():
    """Where friction falls, slip speeds that differ by 1e-16 of the belt's are the same. These motions grow by 1e-5 a second."""
    mass, stiffness = np.diag([1.1, 1.1, 1.0]), np.array([[1.5, 0.9, 1.4], [0.9, 3.1, 0.9], [1.4, 0.9, 2.8]])
    damping = np.array([[0.10, 0.05, 0.07], [0.05, 0.18, 0.04], [0.07, 0.04, 0.17]])
    structure = fj.Structure(mass, damping, stiffness, [-0.4, -1.0, -1.0])
    scene = fj.Scene(structure, fj.ExponentialDecay(0.48, 0.23, 2.4), 0.77, fj.ConstantLoad(1.0))

    def growth(mu_static):
        return float(np.max(np.real(fj.cea.eigenvalues(scene.replace(mu_static=mu_static)))))

    maps = ReturnMaps.of(scene.replace(mu_static=brentq(lambda mu: growth(mu) - 1e-5, 0.3, 1.0, xtol=1e-14)))
    y = np.random.default_rng(1).normal(size=(8, 6)) * np.repeat([1e-13, 1e-11], 4)[:, None]
    y[:, [2, 5]] = 0.0
    group = np.zeros(len(y), int)
    found = long_divergence(maps, Motions(group, maps.in_contact(group, y)))
    assert np.all(found.changes == 0) and not np.any(found.chaotic)


def test_without_a_kick_what_grows_comes_to_what_kicks_come_to():
    """Steady sliding is unstable under this friction; at the equilibrium itself only rounding is left, which grows."""
    scene = fj.Scene(fj.belt_oscillator(), fj.ExponentialDecay(0.1738, 0.14, 0.5), 1.0, fj.Pulse(100.0, p=1.2))
    m = fj.bistability_map(scene, p=[1.0, 1 + 1e-9, 1.5], progress=False)
    assert np.all(m.verdict == fj.Verdict.LIMIT_CYCLE)
    np.testing.assert_allclose(m.amplitude, m.amplitude[-1], rtol=1e-9)
    growth = float(np.max(np.real(fj.cea.eigenvalues(scene))))
    assert m.decided_at[0] > np.log(1e8) / growth


def test_what_grows_bursts_and_grows_again_is_not_leapt_over():
    """Without events for hundreds of periods at a time: by leaps the motion comes to its cycle when it does step by step."""
    scene = fj.Scene(fj.belt_oscillator(), fj.ExponentialDecay(0.1875, 0.05, 0.05), 1.0, fj.Pulse(100.0, p=1.2))
    p = [1.0645, 1.5806]
    found = fj.bistability_map(scene, p=p, progress=False)
    followed = fj.bistability_map(scene, p=p, progress=False, t_max=2e4, max_steps=10**9)
    assert np.all(found.verdict == fj.Verdict.LIMIT_CYCLE)
    np.testing.assert_allclose(found.amplitude, followed.amplitude, rtol=1e-9)
    assert np.all(found.decided_at < 2 * followed.decided_at)


@pytest.fixture(scope="module")
def near_hopf():
    """A scene on a belt at a given share more than the speed at which sliding becomes stable under falling friction."""
    structure, law = fj.belt_oscillator(), fj.ExponentialDecay(0.15, 0.1, 1.5)

    def scene(v):
        return fj.Scene(structure, law, float(v), load=fj.Pulse(100.0, 1.2))

    hopf = brentq(lambda v: float(np.max(np.real(fj.cea.eigenvalues(scene(v))))), 0.2, 3.0, xtol=1e-13)
    return lambda share: scene((1 + share) * hopf)


@pytest.mark.parametrize("share", [-1e-3, 3e-3])
def test_near_a_hopf_point_verdicts_are_those_of_long_runs(near_hopf, share):
    """Multipliers there are 1 ± 5e-5: a thousand seconds, which kernels follow step by step if they are told to."""
    scene, p = near_hopf(share), [0.97, 1.01, 1.2, 1.6]
    found = fj.bistability_map(scene, p=p, progress=False)
    followed = fj.bistability_map(scene, p=p, progress=False, t_max=1e5, max_steps=10**9)
    assert not np.any(found["verdict"] == fj.Verdict.UNDECIDED)
    np.testing.assert_array_equal(found["verdict"], followed["verdict"])
    late = followed["decided_at"].values > 500.0
    assert np.any(late)
    np.testing.assert_allclose(found["decided_at"].values[late], followed["decided_at"].values[late], rtol=0.3)


@pytest.mark.slow
def test_kicks_that_are_hardly_any_are_decided_where_sliding_grows_slowly():
    """Below the size at which a motion counts as faded: it grows by 0.099 1/s, for a hundred seconds and more."""
    friction = fj.ExponentialDecay(0.17, 0.14760887, 1.0)
    scene = fj.Scene(fj.belt_oscillator(), friction, 1.0, fj.Pulse(100.0, p=1.2))
    kicks = 1 + np.array([1e-9, 1e-8, 1e-7, 0.5])
    m = fj.bistability_map(scene, p=kicks, progress=False)
    assert np.all(m.verdict == fj.Verdict.LIMIT_CYCLE)
    np.testing.assert_allclose(m.amplitude, m.amplitude[-1], rtol=1e-9)
    growth = float(np.max(np.real(fj.cea.eigenvalues(scene))))
    # No sooner than such a kick has grown to a ten-thousandth of one that doubles the load.
    assert np.all(m.decided_at > np.log(1e-4 / (kicks - 1)) / growth)
