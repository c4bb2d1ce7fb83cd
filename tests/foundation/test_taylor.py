"""Taylor coefficients of friction laws, and which laws are certain to be smooth."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from fivjax.foundation.smoothness import is_smooth
from fivjax.foundation.taylor import composed, taylor_coefficients

ORDER, AT, RADIUS = 16, 0.37, 0.3
LAWS = {
    "exponential": (lambda x: 0.1 + 0.2 * jnp.exp(-3 * x), True),
    "powers": (lambda x: (1 + x) ** -1.7 + x**7 + jnp.sqrt(1 + x) + jax.lax.rsqrt(1 + x) + jnp.cbrt(1 + x), True),
    "regularised": (lambda x: jnp.tanh(2 * x) + jnp.arctan(x) + jax.nn.sigmoid(x) + jax.lax.erf(x), True),
    "logarithms": (lambda x: jnp.log(1 + x) / (2 + jnp.log1p(x)) + jnp.expm1(x) * jnp.sin(x) - jnp.cosh(x), True),
    "roots of what is above zero": (
        lambda x: jnp.sqrt(x**2 + 1.0) + jnp.sqrt((x - 0.5) ** 2 + 1.0) + jnp.abs(3 * x),
        True,
    ),
    "a power of a ratio": (lambda x: jnp.exp(-((x / jnp.asarray(-0.2) / -1.0) ** 1.7)), True),
    "a size by a root": (lambda x: x + jnp.sqrt((x - 0.1) * (x - 0.1)), False),
    "a size by a power": (lambda x: x + ((x - 0.1) ** 2) ** 0.5, False),
    "a size by an angle": (lambda x: x + jnp.arccos(jnp.cos(x)), False),
    "a size by a logarithm": (lambda x: x + jnp.exp(0.5 * jnp.log((x - 0.1) ** 2)), False),
    "a jump by an inverse": (lambda x: jnp.tanh(1 / (x - 0.9)), False),
    "a jump by a negative power": (lambda x: jnp.arctan((x - 0.9) ** -1), False),
    "a jump by an angle": (lambda x: jnp.arctan(jnp.tan(x)), False),
    "a loop": (lambda x: jax.lax.fori_loop(0, 5, lambda i, y: y * x + 2.0, jnp.ones_like(x)), True),
    "a branch": (lambda x: jax.lax.cond(x > 2, jnp.sin, jnp.exp, x), False),
    "clipped": (lambda x: jnp.maximum(jnp.exp(x), 1) + jnp.abs(x) + jnp.clip(x, 0, 3), False),
    "a table": (lambda x: jnp.interp(x, jnp.array([0.0, 1.0, 2.0]), jnp.array([3.0, 2.0, 4.0])), False),
    "chosen": (lambda x: jnp.where(x > 2, x, jnp.exp(x)), False),
    "in pieces": (lambda x: jnp.piecewise(x, [x < 0.1, x > 2], [jnp.sin, jnp.cos, lambda y: jnp.exp(y)]), False),
    "one of several": (lambda x: jnp.select([x < 0.1, x < 2, x < 3], [x, jnp.exp(x), x * x], 7.0), False),
    "beyond a table": (lambda x: jnp.exp(x) + jnp.stack([x, x * x]).at[7].get(mode="fill", fill_value=3.0), False),
}


@pytest.mark.parametrize(("law", "smooth"), LAWS.values(), ids=LAWS)
def test_the_series_is_the_law_and_smoothness_is_read_from_its_code(law, smooth):
    """Rejects a wrong rule: beside the centre the polynomial is the law, up to the size of its last terms."""
    with jax.enable_x64(True):
        c = np.array(taylor_coefficients(law, jnp.asarray(AT), ORDER))
        beside = 0.25 * RADIUS
        assert np.polyval(c[::-1], beside) == pytest.approx(float(law(jnp.asarray(AT + beside))), rel=1e-14)
        assert bool(is_smooth(law, jnp.asarray(AT))) is smooth


def test_smoothness_may_depend_on_parameters_that_are_traced():
    """Rejects taking their signs for unknown: proofs were lost in compiled code only."""

    def smooth(scale, power):
        return is_smooth(lambda x: (1 + x / scale) ** power + 1 / (x + scale), jnp.asarray(AT))

    with jax.enable_x64(True):
        for scale, expected in ((2.0, True), (-2.0, False)):
            assert bool(smooth(jnp.asarray(scale), jnp.asarray(-1.3))) is expected
            assert bool(jax.jit(smooth)(scale, -1.3)) is expected


def test_complex_numbers_are_refused():
    """Their real parts alone were taken."""
    with jax.enable_x64(True), pytest.raises(NotImplementedError, match="Complex numbers"):
        taylor_coefficients(lambda x: jnp.abs(x + 1j * x * x), jnp.asarray(AT), ORDER)


@pytest.mark.parametrize(
    ("exponent", "exact"), [(0.0, [1, 0, 0, 0, 0]), (1.0, [0, 1, 1, 0, 0]), (3.0, [0, 0, 0, 1, 3])]
)
def test_a_power_of_nothing_has_the_series_of_a_whole_exponent_that_is_a_parameter(exponent, exact):
    """Rejects logarithms and divisions by the base: (x + x²)ⁿ about x = 0."""

    def series(exponent):
        return jnp.stack(taylor_coefficients(lambda x: (x + x * x) ** exponent, jnp.zeros(()), 4))

    with jax.enable_x64(True):
        np.testing.assert_allclose(jax.jit(series)(exponent), exact, atol=1e-15)
        # The derivative by the exponent has a logarithm.
        assert np.all(np.isnan(jax.jit(jax.jacfwd(series))(exponent)))


def test_a_power_of_nothing_has_no_series_between_whole_exponents():
    with jax.enable_x64(True):
        found = taylor_coefficients(lambda x: x**1.5, jnp.zeros(()), 4)
    np.testing.assert_array_equal(found, [0, 0, *[np.nan] * 3])


def test_a_loop_whose_length_depends_on_the_argument_may_have_kinks():
    """Rejects calling smooth what ends a loop by its argument."""
    halved = lambda x: jax.lax.while_loop(lambda y: y > 1.0, lambda y: 0.5 * y, x)  # noqa: E731
    assert not is_smooth(halved, jnp.asarray(3.0))


def test_a_composition_agrees_with_a_recurrence():
    """exp(-3 u(t)) by its derivatives in u, and by its own recurrence in t."""
    with jax.enable_x64(True):
        u = [jnp.asarray(0.4), *map(jnp.asarray, np.random.default_rng(0).normal(size=ORDER))]
        outer, powers = taylor_coefficients(lambda x: jnp.exp(-3 * x), u[0], ORDER), []
        mine = [outer[0], *(composed(outer, u[: k + 1], powers) for k in range(1, ORDER + 1))]
        right = [outer[0]]
        for k in range(1, ORDER + 1):
            right.append(-3 / k * sum(j * u[j] * right[k - j] for j in range(1, k + 1)))
    np.testing.assert_allclose(mine, right, rtol=1e-12)
