"""The table of a map's attractors, told apart a few groups at a time."""

import numpy as np
import pytest

import fivjax as fj
from fivjax.maps import datasets
from fivjax.maps.datasets import attractor_table
from fivjax.maps.results import not_run
from tests.helpers.several_contacts import copies

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


def test_a_pair_of_cycles_that_a_symmetric_structure_exchanges_is_two_attractors():
    structure = copies(2)
    mass, damping, stiffness, load = (np.array(matrix) for matrix in structure.matrices)
    stiffness[np.ix_([0, 3], [0, 3])] += 200.0 * np.array([[1.0, -1.0], [-1.0, 1.0]])
    structure = fj.Structure(mass, damping, stiffness, load, contacts=structure.contacts)
    scene = fj.Scene(structure, fj.Coulomb(0.2), 1.0, fj.ConstantLoad(100.0))
    # Where one oscillator starts at a speed, and where the other does.
    found = fj.basins(scene, dq0=[0.0, 2.0], dq3=[0.0, 2.0], progress=False)
    one, other = found.isel(dq0=1, dq3=0), found.isel(dq0=0, dq3=1)
    assert one["verdict"] == other["verdict"] == fj.Verdict.LIMIT_CYCLE
    np.testing.assert_allclose(one["amplitude"], other["amplitude"], rtol=1e-9)
    assert one["attractor"] != other["attractor"]


def test_cycles_of_one_amplitude_and_several_periods_are_listed_once_each():
    verdicts = not_run(1000, energy=False)
    which, rng = np.arange(1000) % 3, np.random.default_rng(1)
    verdicts.verdict[:], verdicts.attractor_kind[:] = fj.Verdict.LIMIT_CYCLE, 0
    verdicts.amplitude[:] = 1.0 + 1e-9 * rng.normal(size=1000)
    verdicts.attractor_period[:] = np.array([0.01, 0.02, 0.03])[which]
    place, table = attractor_table(lambda rows: np.zeros(len(rows), int), verdicts)
    np.testing.assert_array_equal(place, which)
    assert table["attractor_period"].tolist() == [0.01, 0.02, 0.03]
