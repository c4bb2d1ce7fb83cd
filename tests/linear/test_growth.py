"""Linear theory against the simulator: growth rate and frequency read off small transients of Sections 3.1 and 3.2."""

import numpy as np
import pytest

import fivjax as fj
from tests.helpers.catalogue import steady

SCENES = {
    "mode coupling": fj.Scene(fj.belt_oscillator(), fj.Coulomb(0.5), 3.0, steady()),
    "negative slope": fj.Scene(fj.belt_oscillator(), fj.ExponentialDecay(0.2, 0.1, 0.5), 0.5, steady()),
}


@pytest.mark.parametrize("name", SCENES)
def test_growth_and_frequency_of_small_transients_are_the_eigenvalues(name):
    """Prony's method on the tangential displacement knows nothing of the matrices; a wrong slope of friction shows at once."""
    scene = SCENES[name]
    q = fj.sliding_equilibrium(scene)
    # Small enough that speed-dependent friction is linear to 1e-5, large enough to stand clear of rounding.
    run = fj.simulate(scene, 0.2, 1e-3, y0=(q + np.array([1e-8, 2e-8, 0.0]), np.zeros(3)))
    assert set(run.status) == {1}
    x = run.displacement[:, 0] - q[0]
    # Four samples predict the fifth; the roots of that recurrence are exp(λ dt).
    rows = np.stack([x[k : len(x) - 4 + k] for k in range(4)], axis=1)
    recurrence = np.linalg.lstsq(rows, x[4:], rcond=None)[0]
    measured = np.log(np.roots([1.0, *-recurrence[::-1]]).astype(complex)) / 1e-3
    growing = measured[np.argmax(measured.real)]
    found = np.asarray(fj.cea.eigenvalues(scene))
    expected = found[np.argmax(found.real)]
    assert expected.real > 0
    assert growing.real == pytest.approx(expected.real, rel=1e-4)
    assert abs(growing.imag) == pytest.approx(abs(expected.imag), rel=1e-4)
