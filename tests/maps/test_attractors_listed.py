"""The table of a map's attractors, told apart a few groups at a time."""

import numpy as np
import pytest

import fivjax as fj
from fivjax.maps import datasets
from fivjax.maps.datasets import attractor_table
from fivjax.maps.results import not_run

GROUPS, EACH = 40, 3


def results(count: int):
    """Trajectories of forty groups with three attractors each, in any order; their groups; and the attractor of each."""
    rng = np.random.default_rng(0)
    verdicts = not_run(count, energy=False)
    verdicts.verdict[:] = rng.integers(-1, 2, count)
    group, which = rng.integers(0, GROUPS, count), rng.integers(0, EACH, count)
    amplitude = np.sort(rng.uniform(1.0, 2.0, (GROUPS, EACH)), axis=1)
    # Computed from different guesses.
    verdicts.amplitude[:] = amplitude[group, which] * (1 + 1e-9 * rng.normal(size=count))
    verdicts.attractor_period[:] = amplitude[group, which] ** 2
    verdicts.attractor_kind[:] = 0
    return verdicts, group, EACH * group + which, amplitude


@pytest.mark.parametrize("at_a_time", [1, 100, 10**6])
def test_each_attractor_of_a_group_is_listed_once_however_many_are_looked_at(at_a_time, monkeypatch):
    monkeypatch.setattr(datasets, "AT_A_TIME", at_a_time)
    verdicts, group, attractor, amplitude = results(5000)
    place, table = attractor_table(lambda rows: group[rows], verdicts)
    on_one = verdicts.verdict == fj.Verdict.LIMIT_CYCLE
    np.testing.assert_array_equal(place, np.where(on_one, attractor, -1))
    np.testing.assert_allclose(table["attractor_amplitude"], amplitude.ravel(), rtol=1e-8)
    assert set(table["attractor_kind"]) == {"periodic"}


def test_without_limit_cycles_the_table_is_empty():
    place, table = attractor_table(lambda rows: np.zeros(len(rows), int), not_run(3, energy=False))
    assert np.all(place == -1) and all(len(column) == 0 for column in table.values())
