"""Attractors continued from group to group: which groups seed which, and that what is found is what releases find."""

import numpy as np
import pytest

import fivjax as fj
from fivjax.attractors import search
from fivjax.maps import plan
from fivjax.maps.plan import Grid, TrajectoryList

MUS = np.linspace(0.2, 0.227, 7)


def test_every_fourth_value_seeds_those_that_follow():
    grid = Grid({"mu": MUS, "p": np.array([1.0, 2.0]), "k1": np.array([1e5, 2e5])})
    seeding = grid.seeding(np.arange(grid.total)).reshape(7, 2, 2, 2)
    np.testing.assert_array_equal(seeding[:, 0, 0, 0], MUS[[0, 0, 0, 0, 4, 4, 4]])
    # The other spring is twice as stiff, so nothing is continued to it.
    np.testing.assert_array_equal(seeding[:, 0, 1], np.stack([MUS, np.full(7, 2e5)], axis=1))
    np.testing.assert_array_equal(seeding[:, 0], seeding[:, 1])
    np.testing.assert_array_equal(grid.seeding(np.array([27, 3])), seeding.reshape(-1, 2)[[27, 3]])


def test_lists_are_seeded_as_grids_are_where_they_have_the_group():
    listed = TrajectoryList(
        {"mu": np.array([0.22, 0.2, 0.2, 0.21]), "c1": np.array([1.0, 1.0, 1.05, 1.05]), "p": np.ones(4)}
    )
    np.testing.assert_array_equal(listed.seeding(np.arange(4)), [[0.2, 1.0], [0.2, 1.0], [0.2, 1.0], [0.2, 1.0]])
    alone = TrajectoryList({"mu": np.array([0.22, 0.2]), "c1": np.array([1.0, 1.05])})
    np.testing.assert_array_equal(alone.seeding(np.arange(2)), [[0.22, 1.0], [0.2, 1.05]])
    assert TrajectoryList({"p": np.ones(3)}).seeding(np.arange(3)).shape == (3, 0)


@pytest.mark.parametrize(("speed", "agreeing"), [(1.0, 1e-9), (3.0, 1e-3)])
def test_what_is_continued_is_what_releases_find(paper_scene, monkeypatch, speed, agreeing):
    """Cycles at 1 m/s, to rounding; tori at 3 m/s, as far as a torus' amplitude is known."""
    searched = []
    by_releases = search._by_releases

    def counting(catalogue, equilibrium, groups):
        searched.extend(MUS[np.searchsorted(MUS, catalogue.maps.shared[0].friction.mu[groups])])
        by_releases(catalogue, equilibrium, groups)

    monkeypatch.setattr(search, "_by_releases", counting)
    axes = {"mu": MUS, "p": [1.0, 1.25, 2.0]}
    found = []
    for seeding in (1, 4):
        searched.clear()
        monkeypatch.setattr(plan, "SEEDING", seeding)
        found.append(fj.bistability_map(paper_scene.replace(belt_speed=speed), progress=False, **axes))
        assert sorted(searched) == MUS[::seeding].tolist()
    each, continued = found
    np.testing.assert_array_equal(continued["verdict"], each["verdict"])
    assert {0, 1} <= set(np.unique(each["verdict"]).tolist())
    np.testing.assert_allclose(continued["amplitude"], each["amplitude"], rtol=agreeing)


def test_where_nothing_can_be_continued_motions_are_released(paper_scene, monkeypatch):
    monkeypatch.setattr(search, "_continue_from_seeds", lambda *_: None)
    m = fj.bistability_map(paper_scene.replace(belt_speed=1.0), mu=MUS[:2], p=[2.0], progress=False)
    assert m["verdict"].values.tolist() == [[1], [1]] and len(m["attractor_period"]) == 2
