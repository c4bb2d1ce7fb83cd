"""Products with matrices and values of polynomials for kernels, in C++: loops of fixed length, which compilers make fast."""

from typing import Any, NamedTuple

from ..foundation.warp_library import warp
from .kernel_matrices import BLOCK, blocks_of, padded
from .kernel_types import Types
from .propagation import INTERVALS, ORDER
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
    scan: Any  # the intervals of a window up to the first that has to be looked at
    speed_and_bend: Any  # the largest speed in a scan, and the largest second difference
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

    def scan_of(used):
        return f"""
            for (; i < whole; ++i) {{
                wp::float64 sums[{BLOCK}];
                for (int r = 0; r < {BLOCK}; ++r) sums[r] = column[r] * here[0];
                for (int k = 1; k < {used}; ++k)
                    for (int r = 0; r < {BLOCK}; ++r) sums[r] += column[{BLOCK} * k + r] * here[k];
                int clear = 0;
                for (int r = 0; r < {BLOCK}; ++r) clear += sums[r] > limits[r];
                found[i + 1] = sums[6];
                if ((i >= proved && clear < {BLOCK}) || (found[i] < 0.0 && sums[6] >= 0.0)) break;
                column += {BLOCK * columns};
            }}"""

    # Numbers of columns that compilers know make this loop, in which trajectories spend most of their time, faster.
    scan_source = f"""
        wp::vec_t<{t.scan._length_}, wp::float64> found;
        wp::float64 limits[{BLOCK}];
        for (int r = 0; r < {BLOCK}; ++r) limits[r] = r < 6 ? sizes[6 + r % 2] : -INFINITY;
        const wp::float64* column = m.data + {BLOCK * columns * blocks_of(n).total} * matrix;
        int i = 0;
        found[0] = here[speed_at];
        if (matrix % 4 == 3) {{ {scan_of(columns)} }} else {{ {scan_of(columns - 2)} }}
        if (i == whole && i < {INTERVALS}) {{
            wp::float64 behind = 0.0;
            for (int k = 0; k < {columns}; ++k) behind += column[{BLOCK} * k + 6] * here[k];
            found[i + 1] = behind;
        }}
        found[{INTERVALS + 1}] = i;
        return found;"""

    of_speeds = """
        wp::float64 speed = wp::max(wp::abs(scan[0]), wp::abs(scan[last])), bend = 0.0;
        for (int k = 1; k < last; ++k) {
            speed = wp::max(speed, wp::abs(scan[k]));
            bend = wp::max(bend, wp::abs(scan[k + 1] - 2.0 * scan[k] + scan[k - 1]));
        }
        return wp::vec_t<2, wp::float64>(speed, bend);"""

    def value_and_slope(terms):
        # Even and odd powers apart: two short chains of operations that wait for each other instead of a long one.
        even, odd = (terms - 1) // 2, terms // 2 - 1
        return f"""
            const wp::float64 u = x * x;
            wp::float64 even = c[{2 * even}], even_slope = 0.0, odd = c[{2 * odd + 1}], odd_slope = 0.0;
            for (int k = {even - 1}; k >= 0; --k) {{
                even_slope = even_slope * u + even;
                even = even * u + c[2 * k];
            }}
            for (int k = {odd - 1}; k >= 0; --k) {{
                odd_slope = odd_slope * u + odd;
                odd = odd * u + c[2 * k + 1];
            }}
            return wp::vec_t<2, wp::float64>(even + x * odd, odd + 2.0 * (x * even_slope + u * odd_slope));"""

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

    @wp.func_native(scan_source)
    def scan(
        m: t.matrices, matrix: int, here: t.row, speed_at: int, sizes: t.block, proved: int, whole: int
    ) -> t.scan: ...

    @wp.func_native(of_speeds)
    def speed_and_bend(scan: t.scan, last: int) -> t.pair: ...

    @wp.func_native(value_and_slope(ORDER + 1))
    def value_at(c: t.polynomial, x: wp.float64) -> t.pair: ...

    @wp.func_native(value_and_slope(ROOT_STEPS[0] + 1))
    def value_of_few(c: t.polynomial, x: wp.float64) -> t.pair: ...

    @wp.func_native(bent)
    def bent_at(c: t.polynomial, x: wp.float64) -> t.triple: ...

    @wp.func_native(of_state)
    def state_at(c: t.series, x: wp.float64, interval: wp.float64) -> t.state: ...

    products = block, sample, hull, guard_series, series
    return Arithmetic(*products, scan, speed_and_bend, value_at, value_of_few, bent_at, state_at)
