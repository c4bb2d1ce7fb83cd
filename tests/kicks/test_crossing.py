"""Critical kicks say what is proved: brackets with both ends confirmed, and no number across undecided trajectories."""

import io
from types import SimpleNamespace

import numpy as np
import pytest

import fivjax as fj
from fivjax.foundation import progress
from fivjax.kicks import narrowing
from fivjax.maps import bistability, engine, jobs
from fivjax.maps.crossing import first_crossings
from fivjax.maps.engine import RunOptions
from fivjax.maps.results import not_run

KICKS = np.array([1.0, 1.1, 1.2, 1.3, 1.4, 1.5])


@pytest.mark.parametrize(
    ("p_range", "p_step", "kicks"),
    [
        ((1.0, 1.149), 0.1, 3),
        ((1.0, 1.2), 0.1, 3),
        ((1.0, 5.0), 0.01, 401),
        ((1.2 - 1e-4, 1.2 + 1e-4), 1e-4, 3),
        ((1, 2), 1, 2),
    ],
)
def test_the_steps_of_a_scan_are_no_longer_than_asked(p_range, p_step, kicks):
    low, high, _, count = narrowing.checked_range(p_range, p_step)
    assert count == kicks and (high - low) / (count - 1) <= p_step * (1 + 1e-6)


@pytest.mark.parametrize(
    ("row", "low", "high", "middle", "changes"),
    [
        ([0, 0, 0, 1, 1, 1], 1.2, 1.3, 1.25, 1),
        ([0, -1, -1, -1, 1, 1], 1.0, 1.4, np.nan, 1),  # found at v = 5 m/s with falling friction: once called 1.2
        ([0, 0, -8, 1, 1, 1], 1.1, 1.3, np.nan, 1),  # a failure between is as little known
        ([0, 0, 1, 0, 1, 1], 1.1, 1.2, 1.15, 3),  # an island
        ([0, 0, 0, 0, 0, 0], np.nan, np.nan, np.nan, 0),
        ([1, 1, 1, 1, 1, 1], np.nan, 1.0, 1.0, 0),
        ([-1, 1, 1, 1, 1, 1], np.nan, 1.1, np.nan, 0),  # without a kick it may slide: once called 1.0
        ([-1, -1, 1, 1, 1, 1], np.nan, 1.2, np.nan, 0),
        ([-1] * 6, np.nan, np.nan, np.nan, 0),
    ],
)
def test_a_crossing_is_the_bracket_that_is_proved(row, low, high, middle, changes):
    found = first_crossings(KICKS, np.array([row]))
    np.testing.assert_allclose([found.low[0], found.high[0], found.middle[0]], [low, high, middle])
    assert found.changes[0] == changes


def test_what_was_not_computed_proves_nothing():
    """A refined map whose points beside the crossing have their verdicts from neighbours."""
    row, computed = np.array([0, 0, 0, 1, 1, 1]), np.array([True, True, False, False, True, False])
    found = first_crossings(KICKS, row[None], computed[None])
    assert [found.low[0], found.high[0]] == [1.1, 1.4] and found.middle[0] == pytest.approx(1.25)
    found = first_crossings(KICKS, 0 * row[None] + 1, computed[None] & (KICKS > 1.0))
    assert np.isnan(found.low[0]) and found.high[0] == 1.1


def told(verdict_of, by_method=False):
    """In place of `run_to_verdict`: verdicts as a function of the kick and of the label of the batch, and of the method."""

    def run(scene, trajectories, method, limits, means, **_):
        kicks, of_method = trajectories.columns()["p"], {"method": method} if by_method else {}
        verdicts = not_run(len(kicks), limits.energy)
        verdicts.verdict[:] = [verdict_of(p, means.label, **of_method) for p in kicks]
        return verdicts

    return run


def test_a_map_draws_no_boundary_across_undecided_trajectories(paper_scene, monkeypatch):
    """The bracket is given, and p_crit is NaN: the middle of the two ends would be invented."""
    verdicts = dict(zip(KICKS, [0, -1, -1, -1, 1, 1], strict=True))
    monkeypatch.setattr(bistability, "run_to_verdict", told(lambda p, _: verdicts[p]))
    m = fj.bistability_map(paper_scene, p=KICKS)
    assert np.isnan(m["p_crit"]) and (m["p_crit_low"], m["p_crit_high"]) == (1.0, 1.4)


def found_by(monkeypatch, paper_scene, verdict_of, **options):
    monkeypatch.setattr(narrowing, "run_to_verdict", told(verdict_of))
    return fj.critical_perturbation(paper_scene, p_range=(1.0, 3.0), p_step=0.1, **options).isel(belt_speed=0)


def test_a_crossing_is_narrowed_to_the_tolerance(paper_scene, monkeypatch):
    found = found_by(monkeypatch, paper_scene, lambda p, _: int(p > 1.23456789), tolerance=1e-7)
    assert found["p_crit_low"] <= 1.23456789 < found["p_crit_high"]
    assert float(found["p_crit"]) == pytest.approx(1.23456789, abs=1e-7) and found["p_crit_error"] <= 5e-8
    assert found["only_crossing"]


def test_a_tolerance_below_rounding_still_gives_a_number(paper_scene, monkeypatch):
    """Two neighbouring numbers cannot come closer; their middle used to be NaN as if something were undecided between."""
    found = found_by(monkeypatch, paper_scene, lambda p, _: int(p > 1.23456789), tolerance=1e-17)
    assert float(found["p_crit"]) == pytest.approx(1.23456789, abs=1e-15)


def test_undecided_trajectories_stop_the_narrowing_and_leave_no_number(paper_scene, monkeypatch):
    def verdict_of(p, _):
        return -1 if 1.33 < p < 1.57 else int(p >= 1.57)

    found = found_by(monkeypatch, paper_scene, verdict_of)
    assert np.isnan(found["p_crit"]) and np.isnan(found["p_crit_error"])
    assert 1.3 <= found["p_crit_low"] <= 1.33 and 1.57 <= found["p_crit_high"] <= 1.6


def test_a_part_of_a_scan_begins_at_a_kick_that_slides(paper_scene, monkeypatch):
    """It began at the last kick of the part before; where that was undecided, and the next one squealed, there was no bracket."""

    def verdict_of(p, label):
        return -1 if label == "scan" and 1.45 < p < 1.55 else int(p > 1.52)

    monkeypatch.setattr(narrowing, "run_to_verdict", told(verdict_of))
    options, limits = RunOptions("scan", progress=False), SimpleNamespace(energy=False)
    columns = {"duration": np.array([0.1, 0.2])}
    kicked = narrowing.Kicked(paper_scene, columns, None, limits, options, {})  # type: ignore[arg-type]
    kicks = np.linspace(1.0, 5.0, 41)
    assert kicks[kicks.size // 8] == 1.5  # the last kick of the first part
    np.testing.assert_allclose(narrowing.least_crossings(kicked, kicks, 1e-5, 2).middle, 1.52, atol=1e-5)


@pytest.mark.parametrize("at_the_end", [0, -1])
def test_a_crossing_that_its_own_trajectories_do_not_confirm_is_none(paper_scene, monkeypatch, at_the_end):
    """Just past a fold the scan's batch once said limit cycle from 2.52 on and every later one sliding: p_crit was 2.52."""
    found = found_by(
        monkeypatch, paper_scene, lambda p, label: int(p > 2.51) if label == "scan" else at_the_end * (p > 2.51)
    )
    assert np.isnan(found["p_crit"]) and np.isnan(found["p_crit_high"])
    assert found["only_crossing"] == (at_the_end == -1)


def test_the_lower_end_is_the_critical_kick_where_all_of_them_squeal(paper_scene, monkeypatch):
    found = found_by(monkeypatch, paper_scene, lambda *_: 1)
    assert found["p_crit"] == 1.0 and np.isnan(found["p_crit_low"]) and found["p_crit_error"] == 0
    found = found_by(monkeypatch, paper_scene, lambda p, _: 1 if p > 1.0 else -1)
    assert np.isnan(found["p_crit"]) and np.isnan(found["p_crit_error"])


@pytest.mark.parametrize(("coarser", "error"), [(1.26, 0.0101), (1.05, 0.2001), (2.95, 1.7001), (np.inf, np.inf)])
def test_what_doubled_steps_change_is_sought_further_away_where_it_is_much(paper_scene, monkeypatch, coarser, error):
    """It was NaN, or the distance of the end to which it was sought."""

    def verdict_of(p, _, method):
        return int(p > (1.25 if method.dt == 1e-4 else coarser))

    monkeypatch.setattr(narrowing, "run_to_verdict", told(verdict_of, by_method=True))
    method = fj.WhereSwitched(dt=1e-4)
    found = fj.critical_perturbation(paper_scene, p_range=(1.0, 3.0), p_step=0.1, method=method, tolerance=2e-4)
    assert float(found["p_crit"].squeeze()) == pytest.approx(1.25, abs=1e-4)
    assert float(found["p_crit_error"].squeeze()) == pytest.approx(error, abs=3e-4)


def test_undecided_trajectories_elsewhere_might_hide_another_crossing(paper_scene, monkeypatch):
    found = found_by(monkeypatch, paper_scene, lambda p, _: -1 if p > 2.5 else int(p > 1.25))
    assert float(found["p_crit"]) == pytest.approx(1.25, abs=1e-5) and not found["only_crossing"]


def test_a_map_that_fails_as_a_whole_says_why(paper_scene, monkeypatch):
    """On a belt at rest nothing slides: the dataset has the reason, for whoever draws or prints it."""
    monkeypatch.setattr(bistability, "run_to_verdict", told(lambda *_: int(fj.Verdict.NO_EQUILIBRIUM)))
    m = fj.bistability_map(paper_scene, p=KICKS)
    assert m.attrs["failure"].startswith("no steady sliding to start from")
    monkeypatch.setattr(bistability, "run_to_verdict", told(lambda p, _: int(p > 1.2)))
    assert "failure" not in fj.bistability_map(paper_scene, p=KICKS).attrs


@pytest.mark.parametrize(("count", "said"), [(1, "1 trajectory"), (4096, "4,096 trajectories")])
def test_numbers_go_with_their_nouns(count, said):
    with pytest.warns(UserWarning, match=f"of {said}, {count} without a verdict"):
        engine.interrupted(not_run(count, energy=False))


def test_the_bar_says_that_it_compiles_before_anything_moves(paper_scene, monkeypatch):
    """Compiling takes longer than many a map; a bar at 0 % looks as if nothing happened."""
    shown = io.StringIO()
    monkeypatch.setattr(progress, "tqdm", lambda **options: REAL(**{**options, "file": shown, "mininterval": 0}))

    def two_rounds(job, pool, results, file, report):
        report(0)
        first = shown.getvalue()
        assert "map, compiling …" in first and "trajectories" in first
        results.verdicts.verdict[:] = 0
        report(len(results.verdicts.verdict))

    monkeypatch.setattr(jobs, "follow_all", two_rounds)
    fj.bistability_map(paper_scene, p=KICKS, progress=True)
    assert "compiling" not in shown.getvalue().split("\r")[-1]


REAL = progress.tqdm


@pytest.mark.slow
@pytest.mark.parametrize(("mu", "speed"), [(0.163, 1.0), (0.166, 1.0), (0.1235, 0.5), (0.114, 0.3)])
def test_no_critical_kick_is_invented_past_a_fold(mu, speed):
    """None of 401 kicks squeals there, so that there is no number to give."""
    scene = fj.Scene(fj.belt_oscillator(), fj.Coulomb(mu), speed, fj.Pulse(100.0, 1.2))
    assert np.isnan(fj.critical_perturbation(scene, progress=False)["p_crit"].item())
