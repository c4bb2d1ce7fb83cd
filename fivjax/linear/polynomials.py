"""Determinants of matrices of polynomials, and all roots of many polynomials at once, in real arithmetic."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float


def determinant(rows) -> tuple[list, list[list]]:
    """Determinant and leading principal minors of a matrix of polynomials, by expansion along its rows.

    `rows[i][j]` is a list of coefficients, highest power first; all are scalars, or all arrays of one shape.
    """
    size = len(rows)
    minors = {(): [1.0]}
    leading = []
    for i in range(size):
        larger: dict[tuple[int, ...], list] = {}
        for columns, minor in minors.items():
            for j in range(size):
                if j not in columns:
                    sign = (-1) ** sum(column > j for column in columns)
                    key = tuple(sorted((*columns, j)))
                    larger[key] = _sum(larger.get(key, []), _product([sign * c for c in rows[i][j]], minor))
        minors = larger
        leading.append(minors[tuple(range(i + 1))])
    return leading[-1], leading


def _product(a, b) -> list:
    result = [0.0] * (len(a) + len(b) - 1)
    for i, x in enumerate(a):
        for j, y in enumerate(b):
            result[i + j] = result[i + j] + x * y
    return result


def _sum(a, b) -> list:
    width = max(len(a), len(b))
    a, b = [0.0] * (width - len(a)) + a, [0.0] * (width - len(b)) + b
    return [x + y for x, y in zip(a, b, strict=True)]


def characteristic_polynomial(mass, damping, stiffness, scale) -> list[Float[Array, ""]]:
    """Coefficients of det(s²M + sC + K) in units of `scale` (rad/s), highest power first, the first one 1.

    They are not finite where the sliding mass matrix is singular (Painlevé's paradox).
    """
    m = mass.shape[0]
    rows = [[[mass[i, j] * scale**2, damping[i, j] * scale, stiffness[i, j]] for j in range(m)] for i in range(m)]
    coefficients, _ = determinant(rows)
    return [c / coefficients[0] for c in coefficients]


def polynomial_roots(coefficients) -> Complex[Array, "n ..."]:
    """All roots of polynomials with leading coefficient 1 and coefficients of order one, by Ehrlich–Aberth iteration.

    `coefficients` is a list of real arrays of one shape, highest power first. All operations are elementwise over that shape
    and in real arithmetic, so a million polynomials take little time. NaN where the iteration has not converged.
    """
    degree = len(coefficients) - 1
    coefficients = [jnp.broadcast_to(c, coefficients[-1].shape) for c in coefficients]
    # First guesses on the unit circle, not symmetric about the real axis: from symmetric ones, pairs of real roots are not
    # found.
    angles = 2 * np.pi * (np.arange(degree) + 0.35) / degree
    start = [
        (jnp.full_like(coefficients[-1], np.cos(angle)), jnp.full_like(coefficients[-1], np.sin(angle)))
        for angle in angles
    ]
    finite = jnp.isfinite(sum(coefficients))
    coefficients = [jnp.where(finite, c, 0.0) for c in coefficients]

    # Simple roots need some fifteen iterations; at a double root each iteration at least triples the precision.
    iterations = 60

    def not_converged(carry):
        iteration, _, change = carry
        return (iteration < iterations) & (jnp.max(change, initial=0.0) > 1e-26)

    def iterate(carry):
        iteration, roots, _ = carry
        roots, change = _aberth(coefficients, roots)
        return iteration + 1, roots, change

    change = jnp.full_like(coefficients[-1], jnp.inf)
    _, roots, change = jax.lax.while_loop(not_converged, iterate, (0, start, change))
    settled = finite & (change < 1e-8)
    return jnp.stack([jax.lax.complex(jnp.where(settled, x, jnp.nan), y) for x, y in roots])


def _aberth(coefficients, roots):
    reciprocals = {}
    for i in range(len(roots)):
        for j in range(i):
            reciprocals[i, j] = _reciprocal((roots[i][0] - roots[j][0], roots[i][1] - roots[j][1]))
    improved, change = [], 0.0
    for i, root in enumerate(roots):
        value, slope = (coefficients[0], 0.0), (0.0, 0.0)
        for coefficient in coefficients[1:]:
            slope = _times(slope, root)
            slope = (slope[0] + value[0], slope[1] + value[1])
            value = _times(value, root)
            value = (value[0] + coefficient, value[1])
        others = (0.0, 0.0)
        for j in range(len(roots)):
            if j != i:
                sign = 1.0 if j < i else -1.0
                reciprocal = reciprocals[max(i, j), min(i, j)]
                others = (others[0] + sign * reciprocal[0], others[1] + sign * reciprocal[1])
        deflated = _times(value, others)
        step = _times(value, _reciprocal((slope[0] - deflated[0], slope[1] - deflated[1])))
        usable = jnp.isfinite(step[0] + step[1])
        step = (jnp.where(usable, step[0], 0.0), jnp.where(usable, step[1], 0.0))
        improved.append((root[0] - step[0], root[1] - step[1]))
        size = 1.0 + root[0] ** 2 + root[1] ** 2
        change = jnp.maximum(change, (step[0] ** 2 + step[1] ** 2) / size)
    return improved, change


def _times(a, b):
    return a[0] * b[0] - a[1] * b[1], a[0] * b[1] + a[1] * b[0]


def _reciprocal(a):
    square = a[0] ** 2 + a[1] ** 2
    return a[0] / square, -a[1] / square
