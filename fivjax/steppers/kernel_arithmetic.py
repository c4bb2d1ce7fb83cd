"""Products with matrices and values of polynomials for kernels, in C++: loops of fixed length, which compilers make fast."""

from typing import Any, NamedTuple

from ..foundation.warp_library import warp
from .kernel_matrices import BLOCK, blocks_of, padded
from .kernel_types import Types
from .propagation import ORDER
from .window_roots import ROOT_STEPS


class Arithmetic(NamedTuple):
    """Warp functions for structures of one size.

    Products are of so many blocks of a matrix, from the block `first` on, and a row.
    """

    block: Any
    sample: Any
    hull: Any
    guard_series: Any
    series: Any
    value_at: Any  # value and slope of a polynomial
    value_of_few: Any  # the same of its first terms
    bent_at: Any  # value, slope and second derivative
    state_at: Any  # displacements and velocities from their series, at a share of an interval


def arithmetic(n: int, t: Types) -> Arithmetic:
    """The functions for structures with `n` degrees of freedom."""
    wp = warp()
    columns = 2 * n + 2

    def product(size):
        # Every fourth matrix is that of detachment; in contact the last two columns are zero.
        return f"""
            wp::vec_t<{size}, wp::float64> found;
            const wp::float64* column = m.data + {BLOCK * columns} * ({blocks_of(n).total} * matrix + first);
            const int columns = matrix % 4 == 3 ? {columns} : {columns - 2};
            for (int b = 0; b < {size}; b += {BLOCK}) {{
                wp::float64 sums[{BLOCK}];
                for (int r = 0; r < {BLOCK}; ++r) sums[r] = column[r] * here[0];
                for (int k = 1; k < columns; ++k)
                    for (int r = 0; r < {BLOCK}; ++r) sums[r] += column[{BLOCK} * k + r] * here[k];
                for (int r = 0; r < {BLOCK}; ++r) found[b + r] = sums[r];
                column += {BLOCK * columns};
            }}
            return found;"""

    def horner(terms):
        return f"""
            wp::float64 value = c[{terms - 1}], slope = 0.0;
            for (int k = {terms - 2}; k >= 0; --k) {{
                slope = slope * x + value;
                value = value * x + c[k];
            }}
            return wp::vec_t<2, wp::float64>(value, slope);"""

    bent = f"""
        wp::float64 value = c[{ORDER}], slope = 0.0, bend = 0.0;
        for (int k = {ORDER - 1}; k >= 0; --k) {{
            bend = bend * x + slope;
            slope = slope * x + value;
            value = value * x + c[k];
        }}
        return wp::vec_t<3, wp::float64>(value, slope, 2.0 * bend);"""

    of_state = f"""
        wp::vec_t<{2 * n}, wp::float64> found;
        for (int j = 0; j < {n}; ++j) {{
            wp::float64 value = c[{ORDER + 2} * j + {ORDER + 1}], slope = 0.0;
            for (int k = {ORDER}; k >= 0; --k) {{
                slope = slope * x + value;
                value = value * x + c[{ORDER + 2} * j + k];
            }}
            found[j] = value;
            found[{n} + j] = slope / interval;
        }}
        return found;"""

    @wp.func_native(product(BLOCK))
    def block(m: t.matrices, matrix: int, first: int, here: t.row) -> t.block: ...

    @wp.func_native(product(padded(2 * n)))
    def sample(m: t.matrices, matrix: int, first: int, here: t.row) -> t.sample: ...

    @wp.func_native(product(padded(2 * ORDER)))
    def hull(m: t.matrices, matrix: int, first: int, here: t.row) -> t.hull: ...

    @wp.func_native(product(padded(2 * (ORDER + 2))))
    def guard_series(m: t.matrices, matrix: int, first: int, here: t.row) -> t.guards: ...

    @wp.func_native(product(padded(n * (ORDER + 2))))
    def series(m: t.matrices, matrix: int, first: int, here: t.row) -> t.series: ...

    @wp.func_native(horner(ORDER + 1))
    def value_at(c: t.polynomial, x: wp.float64) -> t.pair: ...

    @wp.func_native(horner(ROOT_STEPS[0] + 1))
    def value_of_few(c: t.polynomial, x: wp.float64) -> t.pair: ...

    @wp.func_native(bent)
    def bent_at(c: t.polynomial, x: wp.float64) -> t.triple: ...

    @wp.func_native(of_state)
    def state_at(c: t.series, x: wp.float64, interval: wp.float64) -> t.state: ...

    return Arithmetic(block, sample, hull, guard_series, series, value_at, value_of_few, bent_at, state_at)
