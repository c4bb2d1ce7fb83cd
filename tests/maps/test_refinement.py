"""Adaptive maps: where they compute, what they assume elsewhere, and how they say how often that is wrong."""

import numpy as np
import pytest
from scipy.stats import hypergeom

import fivjax as fj
from fivjax.maps.datasets import from_rows
from fivjax.maps.refinement import finer_axis, refine_grid
from fivjax.maps.results import not_run


def test_an_axis_is_halved_in_each_of_its_intervals():
    np.testing.assert_array_equal(
        finer_axis(np.array([0.0, 1.0, 4.0]), 2), [0.0, 0.25, 0.5, 0.75, 1.0, 1.75, 2.5, 3.25, 4.0]
    )
    np.testing.assert_array_equal(finer_axis(np.array([2.0]), 3), [2.0])


def fill(truth, halvings, audit=0.01, interrupt=None):
    """A known picture in place of trajectories: what is computed, what is filled in, what the audit counts."""
    calls = []

    def run(places, what):
        calls.append((what, len(places)))
        assert np.all(np.diff(places) > 0)
        verdicts = not_run(len(places), energy=False)
        done = slice(len(places) // 2 if what == interrupt else len(places))
        verdicts.verdict[done] = truth.ravel()[places[done]]
        verdicts.amplitude[done] = truth.ravel()[places[done]]
        return verdicts

    refined, verdicts, checked = refine_grid(truth.shape, halvings, audit, run)
    computed = np.zeros(truth.size, bool)
    computed[refined.places] = ~verdicts.pending()
    found = from_rows("verdict", verdicts.verdict, refined.every_row())
    return found.reshape(truth.shape), computed.reshape(truth.shape), checked, calls


@pytest.mark.parametrize("count", [(17, 9), (9, 33)])
def test_a_smooth_boundary_is_found_whole_with_a_part_of_the_work(count):
    """A circle on grids halved four times: every place is right, and few were computed."""
    x, y = (np.linspace(-1, 1, (n - 1) * 16 + 1) for n in count)
    truth = (x[:, None] ** 2 + y**2 < 0.5).astype(int)
    found, computed, checked, _ = fill(truth, 4)
    np.testing.assert_array_equal(found, truth)
    assert computed.mean() < 0.3
    assert checked.wrong == 0 and checked.cells > 100


def test_three_axes_and_an_axis_of_one_value_are_refined_alike():
    x = np.linspace(-1, 1, 33)
    truth = (x[:, None, None] + 0.5 * x[None, None, :] > 0.1).astype(int)
    found, computed, _, _ = fill(truth, 2)
    np.testing.assert_array_equal(found, truth)
    assert computed.mean() < 0.7


def test_the_audit_finds_islands_that_the_coarse_grid_missed():
    """An island between the places of the coarse grid is missed; the audit's rate tells of it."""
    truth = np.zeros((129, 129), int)
    truth[33:47, 33:47] = 1
    found, computed, checked, _ = fill(truth, 4, audit=0.5)
    # All of the island was assumed to be sea; what the audit came across is right now, and counted.
    assert checked.wrong == np.sum(computed & (truth == 1))
    assert checked.wrong + np.sum(found != truth) == 196
    # It drew half of the assumed cells, each as likely as any other: so much it may be off by chance, once in ten thousand draws.
    assumed = truth.size - (computed.sum() - checked.cells)
    low, high = hypergeom.interval(1 - 1e-4, assumed, 196, checked.cells)
    assert low <= checked.wrong <= high
    assert checked.cells == assumed // 2


def test_after_an_interrupt_the_finer_places_are_not_run():
    """So that the map is gone on with, and nothing assumed is taken for a result."""
    truth = (np.add.outer(np.arange(33), np.arange(33)) > 30).astype(int)
    found, computed, checked, calls = fill(truth, 3, interrupt="halving 1 of 3")
    assert [what for what, _ in calls] == ["coarse grid", "halving 1 of 3"]
    assert np.any(found == fj.Verdict.NOT_RUN)
    assert checked.cells == 0
    np.testing.assert_array_equal(found[computed], truth[computed])


def test_an_axis_of_one_value_is_never_too_fine():
    np.testing.assert_array_equal(finer_axis(np.array([0.2]), 100), [0.2])
    refined, *_ = refine_grid((1, 1), 100, 0.0, lambda places, what: not_run(len(places), False))
    assert refined.places.tolist() == [0]


def test_a_refined_map_equals_the_full_one(tmp_path):
    """The paper's map: the computed cells have the full map's numbers, the others its verdicts; also when resumed."""
    scene = fj.Scene(fj.belt_oscillator(), fj.Coulomb(0.2), 3.0, fj.Pulse(100.0, 1.2))
    mu, p = np.linspace(0.15, 0.225, 4), np.linspace(1.0, 3.0, 5)
    m = fj.bistability_map(scene, mu=mu, p=p, refine=2, audit=0.1, progress=False, resume=tmp_path / "map.part")
    assert m["verdict"].shape == (13, 17)
    full = fj.bistability_map(scene, mu=m["mu"].values, p=m["p"].values, progress=False)
    np.testing.assert_array_equal(m["verdict"], full["verdict"])
    assert 0.1 < float(m["computed"].mean()) < 0.9
    ours, theirs = (one["amplitude"].where(m["computed"]).values for one in (m, full))
    np.testing.assert_allclose(ours, theirs, rtol=1e-3)
    assert m.attrs["audit_wrong"] == 0 and m.attrs["audit_cells"] > 0 and m.attrs["audit_rate_high"] < 0.5
    again = fj.bistability_map(scene, mu=mu, p=p, refine=2, audit=0.1, progress=False, resume=tmp_path / "map.part")
    np.testing.assert_array_equal(again["verdict"], m["verdict"])
    np.testing.assert_array_equal(again["computed"], m["computed"])
    assert again.attrs["audit_cells"] == m.attrs["audit_cells"]


def test_refinements_that_make_no_sense_are_refused():
    scene = fj.Scene(fj.belt_oscillator(), fj.Coulomb(0.2), 3.0, fj.Pulse(100.0, 1.2))
    with pytest.raises(ValueError, match="`refine` must be a whole number of at least 0"):
        fj.bistability_map(scene, p=[1.0, 2.0], refine=-1)
    with pytest.raises(ValueError, match="`audit` must be at most 1"):
        fj.bistability_map(scene, p=[1.0, 2.0], refine=1, audit=2.0)


def test_more_halvings_than_a_map_has_trajectories_are_refused(paper_scene):
    for refine in (27, 20_000):
        with pytest.raises(ValueError, match=f"Argument `refine` is {refine}: each interval"):
            fj.bistability_map(paper_scene, mu=[0.1, 0.2], p=[1.0, 2.0], refine=refine)
