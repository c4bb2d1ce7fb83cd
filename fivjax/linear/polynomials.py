"""Determinants of matrices of polynomials."""

from jaxtyping import Array, Float


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
