"""The same oscillator in other units of mass, length and time: verdicts and critical kicks are the same numbers."""

import numpy as np
import pytest

import fivjax as fj
from tests.helpers.several_contacts import coupled

# kg, m and s become so many units: tonnes and millimetres; a system of ever higher, one of ever lower frequencies.
UNITS = {"tonne-mm": (1e-3, 1e3, 1.0), "fast": (1e-18, 1e-6, 1e-9), "slow": (1e12, 1e-6, 1e5)}


def scene_in(mass, length, time):
    scales = {"m": mass, "c": mass / time, "k": mass / time**2}
    own = {k: float(v) * scales.get(k[0], 1.0) for k, v in fj.belt_oscillator().parameters.items()}
    load = fj.Pulse(100.0 * mass * length / time**2, p=1.2, duration=0.1 * time)
    return fj.Scene(fj.belt_oscillator(**own), fj.Coulomb(0.22), length / time, load)


@pytest.mark.parametrize("units", UNITS)
def test_a_map_has_the_same_verdicts_and_amplitudes(units):
    axes = {"mu": [0.15, 0.2], "p": [1.0, 1.8, 2.6], "progress": False}
    here = fj.bistability_map(scene_in(1.0, 1.0, 1.0), **axes)
    there = fj.bistability_map(scene_in(*UNITS[units]), **axes)
    assert set(here["verdict"].values.ravel()) == {0, 1}
    np.testing.assert_array_equal(there["verdict"], here["verdict"])
    _, length, time = UNITS[units]
    np.testing.assert_allclose(there["amplitude"] * time / length, here["amplitude"], rtol=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("units", UNITS)
def test_the_smallest_perturbations_are_the_same(units):
    mass, length, time = UNITS[units]
    (kick, state), (kick_there, state_there) = (
        (fj.smallest_kick(scene, progress=False), fj.smallest_kick(scene, "state", progress=False))
        for scene in (scene_in(1.0, 1.0, 1.0), scene_in(mass, length, time))
    )
    assert abs(kick_there.p - kick.p) < 1e-10 and abs(kick_there.certified - kick.certified) < 1e-10
    # At the minimum p hardly depends on the duration.
    assert abs(kick_there.duration / time - kick.duration) < 1e-6 * kick.duration
    root_energy = np.sqrt(mass) * length / time
    np.testing.assert_allclose(
        np.array([state_there.size, state_there.certified]) / root_energy, [state.size, state.certified], rtol=1e-7
    )


@pytest.mark.slow
def test_a_cycle_of_two_contacts_closes_at_any_frequency():
    """Next to it, by Newton's method. Rejects steps that are cut off by the ratio of displacements to velocities."""
    structure, time = coupled(2), 1e-9

    def scene_in(mass, length, time):
        units = (mass, mass / time, mass / time**2, mass * length / time**2)
        parts = [np.asarray(part) * unit for part, unit in zip(structure.matrices, units, strict=True)]
        return fj.Scene(
            fj.Structure(*parts, contacts=structure.contacts), fj.Coulomb(0.24), length / time, fj.ConstantLoad(100.0)
        )

    cycle = fj.limit_cycle(scene_in(1.0, 1.0, 1.0))
    start = np.asarray(cycle.state) + np.concatenate([np.full(6, 1e-6), np.full(6, 1e-4)])
    start = np.concatenate([start[:6] * 1e-6, start[6:] * 1e-6 / time])
    found = fj.limit_cycle(scene_in(1e-18, 1e-6, time), start=(start, cycle.contact.status))
    assert found.period / time == pytest.approx(cycle.period, rel=1e-12)
    assert found.amplitude * time / 1e-6 == pytest.approx(cycle.amplitude, rel=1e-10)
