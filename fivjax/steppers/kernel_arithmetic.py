"""Products with matrices and values of polynomials for kernels, in C++: loops of fixed length, which compilers make fast."""

from typing import Any, NamedTuple

from ..foundation.warp_library import warp
from .kernel_matrices import BLOCK, abreast, blocks_of, padded, places_of
from .kernel_types import Types
from .propagation import INTERVALS, ORDER

# Terms of the series in each of the first steps of Newton's method, which are enough for nearly all roots: few at first.
ROOT_STEPS = (5, 5, ORDER)


# Numbers side by side: a vector of a processor, or what is computed like one by a GPU.
VECTOR = f"""
#if defined(__CUDACC__) || defined(__CUDACC_RTC__)
        struct block_ {{
            wp::float64 of[{BLOCK}];
            CUDA_CALLABLE wp::float64& operator[](int r) {{ return of[r]; }}
            CUDA_CALLABLE block_ operator*(wp::float64 factor) const {{
                block_ found;
                for (int r = 0; r < {BLOCK}; ++r) found.of[r] = of[r] * factor;
                return found;
            }}
            CUDA_CALLABLE void operator+=(const block_& other) {{
                for (int r = 0; r < {BLOCK}; ++r) of[r] += other.of[r];
            }}
        }};
        auto all_above = [](const block_& numbers, const block_& limits) {{
            bool found = true;
            for (int r = 0; r < {BLOCK}; ++r) found = found && numbers.of[r] > limits.of[r];
            return found;
        }};
#else
        typedef double block_ __attribute__((ext_vector_type({BLOCK}), aligned(8)));
        auto all_above = [](block_ numbers, block_ limits) {{ return __builtin_reduce_and(numbers > limits) != 0; }};
#endif
        auto rows_at = [](const wp::float64* column) {{ return *(const block_*)column; }};
"""


class Arithmetic(NamedTuple):
    """Warp functions for structures of one size.

    Products are of so many blocks of a matrix, from the block `first` on, and a row.
    """

    row_of: Any  # the row of a state and a load
    sizes: Any  # what a product gives of the sizes of a row's entries
    block: Any
    sample: Any
    hull: Any
    guard_series: Any
    series: Any
    scan: Any  # the first interval of a window that has to be looked at
    speeds: Any  # the tangential velocity at each sample
    speed_and_bend: Any  # the largest of them, and the largest second difference
    guard: Any  # the series of a guard; its first coefficients, which are zero up to rounding, are exactly zero
    speed_series: Any  # the series of the tangential velocity, in m per interval
    value_at: Any  # value and slope of a polynomial
    value_of_few: Any  # the same of its first terms
    bent_at: Any  # value, slope and second derivative
    state_at: Any  # displacements and velocities from their series, at a share of an interval


def arithmetic(n: int, tangential: int, normal: int, t: Types) -> Arithmetic:
    """The functions for structures with `n` degrees of freedom and a contact at these coordinates."""
    wp = warp()
    columns, side, places = 2 * n + 2, abreast(n), places_of(n, normal)
    speed_at = places.index(n + tangential)
    entries = [f"y[{place}]" if place < 2 * n else ("load", "1.0")[place - 2 * n] for place in places]
    filled = "".join(f"found[{k}] = {entry};\n" for k, entry in enumerate(entries))
    row_source = f"wp::vec_t<{columns}, wp::float64> found;\n{filled}return found;"

    def product(size, kept=None, of="here[{}]"):
        # Every fourth matrix is that of detachment; in contact the last two columns are zero.
        return f"""{VECTOR}
            wp::vec_t<{kept or size}, wp::float64> found;
            const wp::float64* column = m.data + {BLOCK * columns} * ({blocks_of(n).total} * matrix + first);
            const int columns = matrix % 4 == 3 ? {columns} : {columns - 2};
            for (int b = 0; b < {size}; b += {BLOCK}) {{
                block_ sums = rows_at(column) * {of.format(0)};
                for (int k = 1; k < columns; ++k) sums += rows_at(column + {BLOCK} * k) * {of.format("k")};
                for (int r = 0; r < {BLOCK} && b + r < {kept or size}; ++r) found[b + r] = sums[r];
                column += {BLOCK * columns};
            }}
            return found;"""

    def scan_of(used):
        return f"""
            for (; i < whole; ++i) {{
                block_ sums = rows_at(column) * here[0];
                for (int k = 1; k < {used}; ++k) sums += rows_at(column + {BLOCK} * k) * here[k];
                if ((i >= proved && !all_above(sums, limits)) || (speed < 0.0 && sums[6] >= 0.0)) break;
                speed = sums[6];
                column += {BLOCK * columns};
            }}"""

    # Numbers of columns that compilers know make this loop, in which trajectories spend most of their time, faster.
    scan_source = f"""{VECTOR}
        block_ limits;
        for (int r = 0; r < {BLOCK}; ++r) limits[r] = r < 6 ? sizes[6 + r % 2] : -INFINITY;
        const wp::float64* column = m.data + {BLOCK * columns * blocks_of(n).total} * matrix;
        wp::float64 speed = here[{speed_at}];
        int i = 0;
        if (matrix % 4 == 3) {{ {scan_of(columns)} }} else {{ {scan_of(columns - 2)} }}
        return i;"""

    speeds_source = f"""
        wp::vec_t<{INTERVALS + 1}, wp::float64> found;
        const wp::float64* column = m.data + {BLOCK * columns * blocks_of(n).total} * matrix + 6;
        found[0] = here[{speed_at}];
        for (int i = 0; i < {INTERVALS}; ++i) {{
            wp::float64 sum = 0.0;
            for (int k = 0; k < {columns}; ++k) sum += column[{BLOCK} * k] * here[k];
            found[i + 1] = sum;
            column += {BLOCK * columns};
        }}
        return found;"""

    of_speeds = """
        wp::float64 speed = wp::max(wp::abs(speeds[0]), wp::abs(speeds[last])), bend = 0.0;
        for (int k = 1; k < last; ++k) {
            speed = wp::max(speed, wp::abs(speeds[k]));
            bend = wp::max(bend, wp::abs(speeds[k + 1] - 2.0 * speeds[k] + speeds[k - 1]));
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

    # Coordinates side by side, and even and odd powers apart.
    of_state = f"""
        const wp::float64 u = x * x;
        wp::float64 even[{side}], even_slope[{side}], odd[{side}], odd_slope[{side}];
        for (int j = 0; j < {side}; ++j) {{
            even[j] = c[{side * (ORDER + 1)} + j];
            odd[j] = c[{side * ORDER} + j];
            even_slope[j] = odd_slope[j] = 0.0;
        }}
        for (int k = {ORDER - 1}; k > 0; k -= 2)
            for (int j = 0; j < {side}; ++j) {{
                even_slope[j] = even_slope[j] * u + even[j];
                even[j] = even[j] * u + c[{side} * k + j];
                odd_slope[j] = odd_slope[j] * u + odd[j];
                odd[j] = odd[j] * u + c[{side} * (k - 1) + j];
            }}
        wp::vec_t<{2 * n}, wp::float64> found;
        for (int j = 0; j < {n}; ++j) {{
            even_slope[j] = even_slope[j] * u + even[j];
            even[j] = even[j] * u + c[j];
            found[j] = even[j] + x * odd[j];
            found[{n} + j] = (odd[j] + 2.0 * (x * even_slope[j] + u * odd_slope[j])) / interval;
        }}
        return found;"""

    guard_source = f"""
        wp::vec_t<{ORDER + 1}, wp::float64> found;
        for (int k = 0; k < {ORDER + 1}; ++k) found[k] = k < zeros ? 0.0 : c[2 * k + which];
        return found;"""

    speed_source = f"""
        wp::vec_t<{ORDER + 1}, wp::float64> found;
        for (int k = 0; k < {ORDER + 1}; ++k) found[k] = (k + 1) * c[{side} * (k + 1) + {tangential}];
        return found;"""

    @wp.func_native(row_source)
    def row_of(y: t.state, load: wp.float64) -> t.row: ...

    @wp.func_native(product(BLOCK, of="wp::abs(here[{}])"))
    def sizes(m: t.matrices, matrix: int, first: int, here: t.row) -> t.block: ...

    @wp.func_native(product(BLOCK))
    def block(m: t.matrices, matrix: int, first: int, here: t.row) -> t.block: ...

    @wp.func_native(product(padded(2 * n), 2 * n))
    def sample(m: t.matrices, matrix: int, first: int, here: t.row) -> t.state: ...

    @wp.func_native(product(padded(2 * ORDER)))
    def hull(m: t.matrices, matrix: int, first: int, here: t.row) -> t.hull: ...

    @wp.func_native(product(padded(2 * (ORDER + 2))))
    def guard_series(m: t.matrices, matrix: int, first: int, here: t.row) -> t.guards: ...

    @wp.func_native(product(padded(side * (ORDER + 2))))
    def series(m: t.matrices, matrix: int, first: int, here: t.row) -> t.series: ...

    @wp.func_native(scan_source)
    def scan(m: t.matrices, matrix: int, here: t.row, sizes: t.block, proved: int, whole: int) -> int: ...

    @wp.func_native(speeds_source)
    def speeds(m: t.matrices, matrix: int, here: t.row) -> t.speeds: ...

    @wp.func_native(of_speeds)
    def speed_and_bend(speeds: t.speeds, last: int) -> t.pair: ...

    @wp.func_native(guard_source)
    def guard(c: t.guards, which: int, zeros: int) -> t.polynomial: ...

    @wp.func_native(speed_source)
    def speed_series(c: t.series) -> t.polynomial: ...

    @wp.func_native(value_and_slope(ORDER + 1))
    def value_at(c: t.polynomial, x: wp.float64) -> t.pair: ...

    @wp.func_native(value_and_slope(ROOT_STEPS[0] + 1))
    def value_of_few(c: t.polynomial, x: wp.float64) -> t.pair: ...

    @wp.func_native(bent)
    def bent_at(c: t.polynomial, x: wp.float64) -> t.triple: ...

    @wp.func_native(of_state)
    def state_at(c: t.series, x: wp.float64, interval: wp.float64) -> t.state: ...

    products = row_of, sizes, block, sample, hull, guard_series, series
    series_of_one = guard, speed_series, value_at, value_of_few, bent_at
    return Arithmetic(*products, scan, speeds, speed_and_bend, *series_of_one, state_at)
