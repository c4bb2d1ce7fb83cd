"""Polynomials by Horner's rule, from their coefficients in rising order: a list, or an array's first axis."""

import math
from collections.abc import Sequence

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float


def value_and_slope(c: Sequence[Array] | Array, x: Array) -> tuple[Array, Array]:
    """A polynomial and its first derivative; a value that is not used costs nothing once compiled."""
    value, slope = _with_derivatives(c, x, 1)
    return value, slope


def value_slope_and_bend(c: Sequence[Array] | Array, x: Array) -> tuple[Array, Array, Array]:
    """A polynomial and its first two derivatives."""
    value, slope, bend = _with_derivatives(c, x, 2)
    return value, slope, bend


def value_and_rate(c: Sequence[Array] | Array, unit: Array, time: Array) -> tuple[Array, Array]:
    """A series at a time that its coefficients measure in a unit (s), and its derivative by time."""
    value, slope = value_and_slope(c, time / unit)
    return value, slope / unit


def in_shares(c: Array, unit: Array) -> Array:
    """The coefficients of the same polynomial where its argument is measured in another unit."""

    def one(power, own):
        return power * unit, own * power

    return jax.lax.scan(one, jnp.ones_like(unit), c, unroll=True)[1]


def ratio(above: Array, below: Array, otherwise: float) -> Array:
    """A ratio, or something else where the divisor is not positive."""
    return jnp.where(below > 0, above / jnp.where(below > 0, below, 1.0), otherwise)


def extremum(c: Sequence[Array] | Array, x: Array, low: Array | float, high: Array, steps: int) -> Array:
    """Where a polynomial's slope is zero, by `steps` steps of Newton's method from `x`, kept between `low` and `high`."""

    def nearer(_, x):
        _, slope, bend = value_slope_and_bend(c, x)
        return jnp.clip(x - slope / jnp.where(bend == 0, 1.0, bend), low, high)

    # A loop, because its body is compiled once.
    return jax.lax.fori_loop(0, steps, nearer, x)


@jax.custom_jvp
def moving_root(c: Float[Array, "k g"], x: Float[Array, ""], chosen: Bool[Array, " g"]) -> Float[Array, ""]:
    """x, which is a root of the chosen one of these polynomials, with the derivatives of an implicit function, of any order; if
    none is chosen, it stays.
    """
    del c, chosen
    return x


@moving_root.defjvp
def _(primals, tangents):
    c, _, chosen = primals
    # With its own derivative, so that further ones are right as well.
    x = moving_root(*primals)
    value, _ = value_and_slope(tangents[0], x)
    _, slope = value_and_slope(c, x)
    value, slope = (jnp.sum(jnp.where(chosen, part, 0.0)) for part in (value, slope))
    return x, -value / jnp.where(slope == 0, 1.0, slope)


def _with_derivatives(c: Sequence[Array] | Array, x: Array, count: int) -> list[Array]:
    c = c if hasattr(c, "shape") else jnp.stack(c)
    zeros = [jnp.zeros_like(c[-1] * x)] * count
    # A loop that XLA unrolls, and that kernels keep.
    found, _ = jax.lax.scan(
        lambda found, own: (_one_further(found, x, own), None),
        [c[-1] + zeros[0], *zeros],
        c[:-1],
        reverse=True,
        unroll=True,
    )
    return found[:2] + [math.factorial(j) * found[j] for j in range(2, count + 1)]


def _one_further(found: list[Array], x: Array, coefficient: Array) -> list[Array]:
    """Taylor coefficients at x, with one coefficient of the polynomial more."""
    further = [found[j] * x + found[j - 1] for j in range(1, len(found))]
    return [found[0] * x + coefficient, *further]
