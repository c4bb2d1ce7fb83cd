"""Horner's rule against NumPy, and zeros at the start of a guard."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from fivjax.contact.rounding import zero_at_start
from fivjax.foundation.polynomial import value_and_slope, value_slope_and_bend


@pytest.mark.parametrize("form", [list, jnp.asarray])
def test_value_slope_and_bend(form):
    """Rejects a coefficient in the wrong place, for a list of coefficients and for an array of them."""
    c = np.random.default_rng(0).normal(size=(6, 4))
    x = np.linspace(-1.0, 1.5, 4)
    with jax.enable_x64(True):
        found = jax.jit(value_slope_and_bend)(form(c), x)
        shorter = jax.jit(value_and_slope)(form(c), x)
    for i in range(4):
        p = np.polynomial.Polynomial(c[:, i])
        expected = [p(x[i]), p.deriv()(x[i]), p.deriv(2)(x[i])]
        np.testing.assert_allclose([f[i] for f in found], expected, rtol=1e-13, atol=1e-13)
        np.testing.assert_array_equal([f[i] for f in shorter], [f[i] for f in found[:2]])


def test_zeros_at_the_start():
    """Shows which starts are zero: small beside the whole, or within rounding; one that is exact is not, however small."""
    c = np.array([[1e-13, 1e-13, 1e-13, 1e-5], [1.0, 1e-10, 1.0, 1.0], [1.0, 1.0, 1.0, 1.0]])
    rounding = np.array([[0.0, 0.0, 0.0, 1e-4], [0.0] * 4, [0.0] * 4])
    exact = np.array([False, False, True, False])
    with jax.enable_x64(True):
        found = np.array(jax.jit(zero_at_start)(c, np.abs(c).sum(axis=0), rounding, exact))
    np.testing.assert_array_equal(found.sum(axis=0), [1, 2, 0, 1])
