"""Approaches to cycles: what they capture comes to the cycle, and nothing beyond an unstable one is captured."""

from types import SimpleNamespace

import numpy as np
import pytest

import fivjax as fj
from fivjax.attractors import catalogue
from fivjax.attractors.approach import approaches
from fivjax.attractors.catalogue import Attractors, Catalogue
from fivjax.attractors.cycles import StableCycle
from fivjax.attractors.motions import Motions
from fivjax.attractors.neighbourhood import Neighbourhood
from fivjax.attractors.tori import contains_cycle
from fivjax.attractors.tube import Tube
from fivjax.section.return_maps import Images, Section

STABLE, GROWTH = 4.0, 0.01


class Line:
    """A return map of which one coordinate is free, in place of `ReturnMaps`: away from an unstable cycle, to a stable one."""

    weights, known_to, normal = np.ones(4), 1e-6, 1
    structure, section = SimpleNamespace(size=2, contacts=[None]), np.array([1.0, 0.0])

    def __init__(self, unstable):
        self.unstable = unstable

    def returns(self, group, at, crossings, kept=1, peaks=False):
        crossings = np.broadcast_to(crossings, len(group))
        y, path = at.y.copy(), np.full((len(group), kept, 4), np.nan)
        for k in range(int(np.max(crossings, initial=0))):
            going = k < crossings
            # What has left is far away, and stays there.
            x = np.maximum(y[going, 0], -1.0)
            y[going, 0] = x + GROWTH * (x - self.unstable) * (STABLE - x)
            path[going] = np.concatenate([path[going, 1:], y[going, None]], axis=1)
        nothing = np.zeros(len(group))
        none = nothing.astype(np.int32)
        return Images(at._replace(y=y), none, none, nothing, path, nothing)

    def with_modes(self, group, y):
        return Section(y, np.ones(len(y), np.int32), np.ones(len(y)))

    def path(self, group, at, count):
        found = self.returns(group, at, count, count)
        return found.at, found.path


def cycle_of(unstable: float) -> StableCycle:
    """The stable cycle, with a neighbourhood that is much smaller than what it attracts."""
    y, multiplier = np.array([STABLE, 0.0, 0.0, 0.0]), 1 - GROWTH * (STABLE - unstable)
    return StableCycle(y[None], 0.1, multiplier, STABLE, Neighbourhood(y, 1, 1.0, np.eye(4), 1e-4, multiplier, 1))


@pytest.mark.parametrize(("unstable", "nearest"), [(0.5, 3.6), (3.2, 3.6), (3.5, None), (3.95, None)])
def test_an_approach_ends_before_an_unstable_cycle(unstable, nearest):
    """A tube is drawn in only where its edge is, too: next to an unstable cycle there is none."""
    maps, cycle = Line(unstable), cycle_of(unstable)
    (found,) = approaches(maps, np.zeros(1, int), [cycle], lambda count: None)  # type: ignore[arg-type]
    assert (found is None) == (nearest is None)
    known = Attractors([cycle], [], [] if found is None else [found])
    x = np.concatenate([np.linspace(0.0, 8.0, 801), unstable + 1e-6 * np.arange(-5, 6)])
    y = np.stack([x, *np.zeros((3, len(x)))], axis=1)
    motions = Motions(np.zeros(len(x), int), Section(y, np.ones(len(x), np.int32), np.ones(len(x))))
    catalogue = Catalogue(maps, {0: known}, lambda count: None)  # type: ignore[arg-type]
    rows = np.array(list(catalogue.captures(motions, np.ones(len(x), bool))), int)
    np.testing.assert_array_equal(np.flatnonzero(catalogue.has_captured(motions)), np.sort(rows))
    assert np.all(x[rows] > unstable)
    if found is not None:
        assert found.cycle is cycle and np.min(found.tube.states[:, 0]) >= nearest
        # The cycle's neighbourhood alone has nobody but who starts in it.
        assert len(rows) > 20 * np.sum(np.abs(x - STABLE) <= 1e-4)


def test_an_approach_with_another_cycle_in_it_is_left_out():
    maps, cycle = Line(0.5), cycle_of(0.5)
    (found,) = approaches(maps, np.zeros(1, int), [cycle], lambda count: None)  # type: ignore[arg-type]
    assert found is not None
    other = cycle._replace(points=cycle.points - np.array([0.05, 0.0, 0.0, 0.0]))
    far = cycle._replace(points=cycle.points - np.array([3.9, 0.0, 0.0, 0.0]))
    for cycles, kept in (([cycle, far], 1), ([cycle, far, other], 0)):
        known = Attractors(cycles, [], [found])
        known.keep_apart(maps)  # type: ignore[arg-type]
        assert len(known.approaches) == kept


def test_a_cycle_found_later_in_the_tube_of_a_locked_torus_ends_what_that_captures(monkeypatch):
    maps, cycle = Line(0.5), cycle_of(0.5)
    (found,) = approaches(maps, np.zeros(1, int), [cycle], lambda count: None)  # type: ignore[arg-type]
    assert found is not None
    known = Attractors.none()
    of_group, motions = Catalogue(maps, {0: known}, lambda count: None), Motions(np.zeros(1, int), None)  # type: ignore
    # A torus about which everything comes back, and that is locked to the cycle.
    monkeypatch.setattr(catalogue, "tori_from", lambda *_: ({}, [(0, cycle, found.tube)]))
    of_group.add_tori(motions)
    assert [one.cycle for one in known.approaches] == [cycle]
    other = cycle._replace(points=cycle.points - np.array([0.05, 0.0, 0.0, 0.0]))
    monkeypatch.setattr(catalogue, "stable_cycles", lambda *_: [(0, np.zeros(1, int), other)])
    of_group.add_cycles(motions)
    assert known.cycles == [cycle, other] and not known.approaches


def test_a_map_by_approaches_says_what_it_says_by_neighbourhoods_alone(monkeypatch):
    """Every verdict and every amplitude, of cycles on locked tori; in less time of the motion."""
    axes = {"mu": np.array([0.165, 0.28]), "p": np.linspace(1.5, 3.0, 32)}
    scene = fj.Scene(fj.belt_oscillator(), fj.Coulomb(0.2), belt_speed=3.0, load=fj.Pulse(100.0, 1.2))
    fast = fj.bistability_map(scene, progress=False, **axes)
    monkeypatch.setattr(catalogue, "approaches", lambda maps, group, cycles, report: [None] * len(cycles))
    slow = fj.bistability_map(scene, progress=False, **axes)
    for name in ("verdict", "amplitude"):
        np.testing.assert_array_equal(fast[name], slow[name])
    by_approach = fast["proof"] == fj.Proof.APPROACH
    assert not np.any(slow["proof"] == fj.Proof.APPROACH) and np.sum(by_approach) >= 40
    assert np.all(slow["proof"].values[by_approach.values] == fj.Proof.ELLIPSOID)
    earlier = (fast["decided_at"] / slow["decided_at"]).values[by_approach.values]
    assert np.all(earlier <= 1) and np.median(earlier) < 0.7


@pytest.mark.parametrize(("away", "near"), [(0.3, True), (0.65, True), (1.4, True), (1.6, False)])
def test_no_tube_captures_next_to_another_cycle(away, near):
    """The other's motions come into the inner half of the tube, too, where it lies in the outer half, or just beyond."""
    angle = np.linspace(0.0, 2 * np.pi, 200, endpoint=False)
    circle = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    tube, maps = Tube(circle, 0.04), SimpleNamespace(weights=np.ones(2))
    other = SimpleNamespace(points=np.array([[1 + 0.04 * away, 0.0]]))
    assert contains_cycle(maps, tube, [other]) == near


@pytest.mark.slow
def test_a_cycle_in_the_outer_half_of_a_tube_keeps_its_trajectories():
    """About a locked torus of 170 crossings: kicks above 3.6 lead to a cycle at 0.65 of the tube's radius from it."""
    structure = fj.belt_oscillator(
        m1=0.64721312749121,
        m2=0.04723687388072624,
        c1=1.0430509200919393,
        c2=0.8665937714484849,
        k1=109296.84124616739,
        k2=114669.78585037433,
    )
    law = fj.ExponentialDecay(0.2711712562306021, 0.1813332863063123, 2.332806860325404)
    scene = fj.Scene(structure, law, 3.64331263806095, fj.Pulse(100.0, 1.2))
    late = [3.630091963292237, 3.844553540562549, 3.890253694613819, 3.9485377412757874, 3.9898535356477463]
    p = np.concatenate([np.linspace(1.66, 3.47, 30), late])
    m = fj.bistability_map(scene, p=p, progress=False)
    assert np.all(m["verdict"] == fj.Verdict.LIMIT_CYCLE)
    for kick, amplitude in list(zip(p, m["amplitude"].values, strict=True))[::6]:
        run = fj.simulate(scene.replace(p=float(kick)), 150.0, 1e-3)
        assert np.abs(run.velocity[-20_000:, 0]).max() == pytest.approx(amplitude, rel=2e-3)
    np.testing.assert_allclose(m["amplitude"].values[-len(late) :], 2.2456459, rtol=1e-6)
