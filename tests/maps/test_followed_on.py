"""When a verdict holds: of trajectories that are followed on after their time, and of those whose steps are used up."""

import dataclasses
import types

import jax.numpy as jnp
import numpy as np
import pytest
from jaxtyping import Array, Float
from scipy.integrate import solve_ivp

import fivjax as fj
from fivjax.attractors import long_run
from fivjax.attractors.catalogue import Attractors, Catalogue
from fivjax.attractors.long_run import Fates, fates
from fivjax.attractors.motions import Motions
from fivjax.attractors.neighbourhood import LARGEST
from fivjax.attractors.search import _continue_from_seeds
from fivjax.attractors.tori import Torus
from fivjax.attractors.tube import Tube
from fivjax.maps import jobs
from fivjax.maps.capture import later
from fivjax.maps.one_trajectory import Progress
from fivjax.section.return_maps import Images, Section

GROWTH, RETURN = 2e-3, 0.1


def law(x):
    """x → x + r (x - 1)(4 - x): away from an unstable cycle at 1, and slowly to a stable one at 4."""
    return x + GROWTH * (x - 1) * (4 - x)


class Line:
    """A return map of which one coordinate is free, in place of `ReturnMaps`; one event per return beyond 2, none before."""

    weights, known_to, tangential, normal = np.ones(4), 1e-6, 0, 1
    resolution = np.zeros(2)
    structure, section = types.SimpleNamespace(size=2, contacts=[None]), np.array([1.0, 0.0])

    def returns(self, group, at, crossings, kept=1, peaks=False):
        crossings = np.broadcast_to(crossings, len(group))
        x, events, path = at.y[:, 0].copy(), np.zeros(len(group), np.int32), np.full((len(group), kept, 4), np.nan)
        for k in range(int(np.max(crossings, initial=0))):
            going = k < crossings
            events += going & (x > 2)
            x = np.where(going, law(x), x)
            y = np.stack([x, *np.zeros((3, len(x)))], axis=1)
            path[going] = np.concatenate([path[going, 1:], y[going, None]], axis=1)
        y = np.stack([x, *np.zeros((3, len(x)))], axis=1)
        return Images(Section(y, at.status, at.direction), events, events, RETURN * crossings, path, x)

    def with_modes(self, group, y):
        return Section(y, np.ones(len(y), np.int32), np.ones(len(y)))

    def moves(self, group, y):
        return y[:, 0] != 0

    def path(self, group, at, count):
        found = self.returns(group, at, count, count)
        return found.at, found.path

    def derived(self, group, at, crossings):
        found, derivative = self.returns(group, at, crossings), np.zeros((len(group), 4, 4))
        for row, (x, count) in enumerate(zip(at.y[:, 0], np.broadcast_to(crossings, len(group)), strict=True)):
            derivative[row, 0, 0] = 1.0
            for _ in range(count):
                derivative[row, 0, 0] *= 1 + GROWTH * (5 - 2 * x)
                x = law(x)
        return found.at, found.time, derivative

    def peaks(self, group, at, crossings):
        return self.returns(group, at, crossings).at.y[:, 0]

    def jumped(self, y):
        return np.zeros(len(y), bool)

    def free_directions(self, status, y):
        return [np.eye(4)[:, :1]] * len(y)


def test_what_is_proved_after_the_time_is_over_has_its_own_time_and_events():
    """State, time and events when a motion is captured belong together, by the law alone; one that is there at once is soon.
    Where it has crept, time and events are known to some per cent.
    """
    x0 = np.array([1.01, 1.2, 3.9999])
    y = np.stack([x0, *np.zeros((3, 3))], axis=1)
    known = {0: Attractors.none(), 1: Attractors.none()}
    at = Section(y, np.ones(3, np.int32), np.ones(3))
    catalogue = Catalogue(Line(), known, lambda _: None)  # type: ignore[arg-type]
    found = fates(catalogue, Motions(np.array([0, 1, 1]), at))
    assert set(found.attractor) == {0, 1, 2}
    for row, x in enumerate(x0):
        returns, events, there = round(found.time[row] / RETURN), 0, found.at.y[row, 0]
        assert found.time[row] == pytest.approx(returns * RETURN, rel=1e-3)
        # One that has crept would be there a few returns sooner or later.
        crept = 0 if row == 2 else returns // 20
        path = [x]
        for _ in range(returns + crept):
            path.append(law(path[-1]))
        nearest = returns - crept + int(np.argmin(np.abs(np.array(path[returns - crept :]) - there)))
        assert path[nearest] == pytest.approx(there, abs=1e-12 if row == 2 else 1e-9)
        events, x = int(np.sum(np.array(path[:nearest]) > 2)), path[nearest]
        assert found.changes[row] == pytest.approx(events, abs=crept)
        cycle = found.attractor[row]
        assert cycle.amplitude == pytest.approx(4.0) and abs(x - 4) <= cycle.neighbourhood.radius
    assert np.all(found.time[:2] > 300 * RETURN), "the others begin far from where they are captured"


def test_the_result_is_that_of_the_instant_of_the_proof():
    """Only of those that were followed on: their time, all their events, and no time of the last one if there were more."""
    parts = dict.fromkeys(field.name for field in dataclasses.fields(Progress))
    parts |= {"t": np.array([5.0, 6.0, 7.0]), "events": np.array([2, 3, 4]), "last_event": np.array([1.0, 2.0, 3.0])}
    now = Progress(**parts)  # type: ignore[arg-type]
    after = later(now, np.array([2, 0]), np.array([10.0, 20.0]), np.array([0, 9]))
    assert after.t.tolist() == [25.0, 6.0, 17.0] and after.events.tolist() == [11, 3, 4]
    assert np.array_equal(after.last_event, [np.nan, 2.0, 3.0], equal_nan=True)
    assert now.t.tolist() == [5.0, 6.0, 7.0], "what is followed by others stays"


def test_who_reaches_a_cycle_with_the_last_step_is_captured(monkeypatch):
    """As many steps as the last trajectory took to its verdict are enough for it."""
    scene = fj.Scene(fj.belt_oscillator(), fj.Coulomb(0.2), 1.0, fj.Pulse(100.0, 1.2))
    taken, real = [], jobs.advance_all

    def counted(*args):
        taken.append(args[-1])
        real(*args)

    monkeypatch.setattr(jobs, "advance_all", counted)
    axes = {"mu": [0.2], "p": [1.02, 1.2, 1.5, 2.0]}
    expected = fj.bistability_map(scene, progress=False, **axes)
    assert fj.Verdict.LIMIT_CYCLE in expected["verdict"]
    found = fj.bistability_map(scene, progress=False, max_steps=sum(taken), **axes)
    for name in ("verdict", "decided_at", "amplitude"):
        np.testing.assert_array_equal(found[name], expected[name])


class Humped(fj.AbstractFriction):
    """Friction that falls fastest at some slip speed: sliding loses stability to a small cycle that slides all the time."""

    mu_static: Float[Array, ""]
    mu_dynamic: Float[Array, ""]
    constant = False

    @property
    def static(self):
        return self.mu_static

    def __call__(self, slip_speed):
        return self.mu_dynamic + (self.mu_static - self.mu_dynamic) * jnp.exp(-(slip_speed**2))

    def variation(self, slip_speed):
        drop = (self.mu_static - self.mu_dynamic) * jnp.ones_like(slip_speed)
        return 0.86 * drop, 2.0 * drop


@pytest.mark.slow
def test_a_cycle_that_slides_all_the_time_captures_whoever_comes_to_it():
    """A mass on a belt just below its upper Hopf point, against SciPy: one kick never has an event, one has two in the beginning.
    At the time of the verdict the motion is nearer to the cycle than to sliding: no neighbourhood is larger.
    """
    speed, damping = 1.12, 0.3
    structure = fj.Structure(np.eye(2), np.diag([damping, 1.0]), np.eye(2), [0.0, -1.0], tangential=0, normal=1)
    scene = fj.Scene(structure, Humped(1.0, 0.5), speed, fj.Pulse(1.0, p=1.2, duration=1.0))
    m = fj.bistability_map(scene, belt_speed=[speed], p=[1.02, 3.0], progress=False).isel(belt_speed=0)
    assert m["verdict"].values.tolist() == [1, 1] and m["attractor"].values.tolist() == [0, 0]
    assert m["contact_events"].values.tolist() == [0, 2]
    assert np.array_equal(m["last_event"], [np.nan, 1.0], equal_nan=True)

    def pushed(x, v, load):
        return load * (0.5 + 0.5 * np.exp(-((speed - v) ** 2))) - damping * v - x

    y, t, decided = [0.5 + 0.5 * np.exp(-(speed**2)), 0.0], 0.0, m["decided_at"].values[0]
    for end, load in ((1.0, 1.02), (decided, 1.0), (decided + 10.0, 1.0), (4000.0, 1.0), (4010.0, 1.0)):
        run = solve_ivp(
            lambda _, y, load=load: [y[1], pushed(*y, load)],
            (t, end),
            y,
            "DOP853",
            rtol=1e-10,
            atol=1e-12,
            max_step=0.05,
        )
        assert np.all(run.y[1] < speed)
        y, t, peak = run.y[:, -1], end, np.max(np.abs(run.y[1]))
        if end == decided + 10.0:
            assert peak == pytest.approx(m["amplitude"].values[0], rel=LARGEST)
    np.testing.assert_allclose(m["amplitude"], peak, rtol=1e-3)


def test_where_the_first_come_to_nothing_the_others_are_not_followed_onward(monkeypatch):
    """Of two groups: in one the first motions are chaotic, so it is worthwhile; in the other they are still undecided."""
    asked = []

    def long_fates(catalogue, motions, onward, slides):
        asked.append((motions.group.tolist(), onward.tolist()))
        nothing = np.zeros(len(motions.group), int)
        return Fates(motions.group == 0, {}, nothing > 0, motions.at, 0.0 * nothing, nothing)

    monkeypatch.setattr(long_run, "_long_fates", long_fates)
    y = np.stack([np.tile([1.1, 1.3, 1.5, 1.7], 2), *np.zeros((3, 8))], axis=1)
    catalogue = Catalogue(Line(), {g: Attractors.none() for g in range(2)}, lambda _: None)  # type: ignore[arg-type]
    at = Section(y, np.ones(8, np.int32), np.ones(8))
    found = fates(catalogue, Motions(np.repeat([0, 1], 4), at))
    assert asked == [([0, 0, 1, 1], [True] * 4), ([0, 0, 1, 1], [True] * 2 + [False] * 2)]
    assert found.chaotic.tolist() == [True] * 4 + [False] * 4


def test_where_the_first_are_captured_at_once_the_others_are_followed_onward_whoever_is_in_the_job(monkeypatch):
    """In one group the first motions are where something captures them; in the other they are still undecided."""
    asked = []

    def slow_fates(catalogue, motions, onward, slides):
        asked.append((motions.group.tolist(), onward.tolist()))
        nothing = np.zeros(len(motions.group), int)
        return Fates(nothing > 0, {}, nothing > 0, motions.at, 0.0 * nothing, nothing)

    def captures(self, motions, rows, latest=None):
        return {int(row): "something" for row in np.flatnonzero(rows & (np.abs(motions.at.y[:, 0] - 1.5) > 0.15))}

    monkeypatch.setattr(long_run, "_slow_fates", slow_fates)
    monkeypatch.setattr(Catalogue, "captures", captures)
    y = np.stack([[1.1, 1.5, 1.9, 1.4, 1.5, 1.6], *np.zeros((3, 6))], axis=1)
    at = Section(y, np.ones(6, np.int32), np.ones(6))
    catalogue = Catalogue(Line(), {g: Attractors.none() for g in range(2)}, lambda _: None)  # type: ignore[arg-type]
    for group, calls in (
        ([0, 0, 0], [([0], [True])]),
        ([0, 0, 0, 1, 1, 1], [([1, 1], [True, True]), ([0, 1], [True, False])]),
    ):
        asked.clear()
        fates(catalogue, Motions(np.array(group), at.rows(slice(len(group)))))
        assert asked == calls
    # One of the first is captured.
    asked.clear()
    fates(catalogue, Motions(np.zeros(4, int), at.rows(np.array([4, 0, 5, 3]))))
    assert asked == [([0], [True]), ([0, 0], [True, True])]


def test_what_comes_from_a_torus_nearby_to_a_known_cycle_is_not_asked_for_a_torus(monkeypatch):
    """A group whose neighbour has the cycle and a torus: the motion from the torus ends on the cycle."""
    known = {g: Attractors.none() for g in range(2)}
    catalogue = Catalogue(Line(), known, lambda _: None)  # type: ignore[arg-type]
    near = Section(np.array([[3.9999, 0.0, 0.0, 0.0]]), np.ones(1, np.int32), np.ones(1))
    assert set(fates(catalogue, Motions(np.zeros(1, int), near)).attractor) == {0}
    known[0].tori.append(Torus(Tube(np.array([[3.5, 0.0, 0.0, 0.0], [3.999, 0.0, 0.0, 0.0]]), 0.04), 1.0, 1.0))
    asked = []
    monkeypatch.setattr(Catalogue, "add_tori", lambda self, motions, tubes=(): asked.append(motions))
    _continue_from_seeds(catalogue, {1: 0})
    assert [cycle.points[0, 0] for cycle in known[1].cycles] == pytest.approx([4.0])
    assert not asked


def test_a_stable_cycle_next_to_its_fold_is_not_leapt_over():
    """Its saddle is a thousandth of its size away, and beyond that everything comes to slide. By another integrator the amplitude
    at 1 + 1e-5 times the fold's friction is 0.8145719154 m/s, after 500 s.
    """
    parts = dict(m1=0.5819, m2=0.05487, c1=2.4129, c2=1.06628, k1=99608.33811, k2=98503.67916, theta=0.0155)
    scene = fj.Scene(fj.belt_oscillator(**parts), fj.Coulomb(0.06), 0.8, fj.Pulse(100.0, p=2.2))
    fold = 0.057433905559
    m = fj.bistability_map(scene, mu=fold * (1 + np.array([-1e-5, 1e-6, 1e-5])), p=[2.2], progress=False)
    assert m["verdict"].values.ravel().tolist() == [0, 1, 1]
    assert m["amplitude"].values[2, 0] == pytest.approx(0.8145719154, rel=1e-6)


def test_what_passes_by_where_a_cycle_was_slides_once_it_has_faded():
    """Just past the fold of the paper's cycles at 1 m/s, which a branch has at μ = 0.1679666157: motions go about its ghost for
    thousands of returns, and have faded to nothing thousands of returns later.
    """
    scene = fj.Scene(fj.belt_oscillator(), fj.Coulomb(0.2), 1.0, fj.Pulse(100.0, p=1.2))
    m = fj.bistability_map(scene, mu=0.1679666157 + np.array([-1e-5, 1e-5]), p=[2.0, 2.4, 4.0], progress=False)
    assert m["verdict"].values.tolist() == [[0, 0, 0], [0, 1, 1]]
    assert np.all(np.isfinite(m["decided_at"]))
    with pytest.raises(fj.NoLimitCycle) as error:
        fj.limit_cycle(scene.replace(mu=0.16795))
    assert "stayed in motion" not in str(error.value)


@pytest.mark.slow
def test_next_to_the_unstable_cycle_of_a_locked_torus_motions_are_captured_for_the_stable_one(paper_scene):
    """A single kick comes so near to the unstable cycle that it is next to it for longer than it is followed."""
    scene = paper_scene.replace(mu=0.20017391304347826, p=1.7826086956521738, belt_speed=3.0)
    m = fj.bistability_map(scene, p=[1.7826086956521738], progress=False)
    assert m["verdict"].values.tolist() == [fj.Verdict.LIMIT_CYCLE] and m["proof"].values.tolist() == [
        fj.Proof.APPROACH
    ]
    found = m["attractor_period"].item(), m["amplitude"].item()
    # Another cycle attracts others.
    assert any(found == pytest.approx((cycle.period, cycle.amplitude), rel=1e-7) for cycle in fj.limit_cycles(scene))
