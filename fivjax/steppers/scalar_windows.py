"""`Windowed` for one trajectory at a time, as Warp functions that run on a CPU or a GPU.

The matrices are those of `propagation`, the laws of contact those of `contact` (`scalar_source` writes them out). A loop for one
trajectory looks at the intervals of the window one after the other and stops at the first that may have an event; arrays of
trajectories, which `Windowed` steps, have to look at all. The two agree to rounding.

Warp is an extra (`pip install fivjax[gpu]`), so it is imported only where it is used.
"""

import functools
import hashlib
import importlib.util
import math
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from .. import contact as physics
from ..contact import Contact, Mechanics, Status
from ..contact.rounding import RESTING
from ..foundation.scalar_source import scalar_source
from .propagation import INTERVALS, ORDER, Propagators
from .window import bracketed, fastest, first_is_safe, leading
from .window_roots import MOST_ROOT_STEPS, PEAK_STEPS, RISE_STEPS, ROOT_STEPS

# Structures with more degrees of freedom make kernels that take long to compile.
MOST_COORDINATES = 8


def is_installed() -> bool:
    """Whether Warp is there."""
    return importlib.util.find_spec("warp") is not None


def warp() -> Any:
    """The module `warp`, initialised without a word."""
    import warp as wp

    before = wp.config.log_level
    wp.config.log_level = max(before, wp.LOG_WARNING)
    try:
        wp.init()
    finally:
        wp.config.log_level = before
    return wp


# Rows of a block of a matrix: two vectors of a processor. A block is contiguous, column by column.
BLOCK = 8


class Blocks(NamedTuple):
    """Where the parts of a mode's matrices begin, in blocks; of a structure with `n` degrees of freedom."""

    intervals: int  # control points of both guards in each interval, and the tangential velocity at its end
    hull: int  # control points of the guards' series in the first interval
    samples: int
    guards: int  # their series, and their values at the end of the interval
    displacements: int  # their series, coordinate by coordinate
    sizes: int
    total: int


def blocks_of(n: int) -> Blocks:
    lengths = 2 * ORDER, (INTERVALS + 1) * padded(2 * n), 2 * (ORDER + 2), n * (ORDER + 2), BLOCK
    return Blocks(0, *np.cumsum([INTERVALS, *(padded(length) // BLOCK for length in lengths)]).tolist())


def padded(rows: int) -> int:
    """The next multiple of a block's length."""
    return -(-rows // BLOCK) * BLOCK


def places_of(n: int, normal: int) -> list[int]:
    """The places in (state, load, one) of the columns: first those that are not zero in contact."""
    closed = [place for place in range(2 * n + 2) if place not in (normal, n + normal)]
    return [*closed, normal, n + normal]


def matrices(prepared: Propagators, n: int, tangential: int, normal: int) -> Float[np.ndarray, "groups m"]:
    """The matrices of several scenes (leading axis), mode by mode: sticking, sliding in either direction, detached."""
    window, series, sizes = (np.asarray(part) for part in (prepared.window, prepared.series, prepared.sizes))
    count = len(window)
    hull, control, samples = np.split(window[:, 8:], np.cumsum((2 * ORDER, 6 * INTERVALS)), axis=1)
    guards, displacements = np.split(series, [2 * (ORDER + 2)], axis=1)
    control = control.reshape(count, 3, INTERVALS, 2, -1).transpose(0, 2, 1, 3, 4).reshape(count, INTERVALS, 6, -1)
    samples = samples.reshape(count, INTERVALS + 1, 2 * n, -1)
    displacements = displacements.reshape(count, ORDER + 2, n, -1).swapaxes(1, 2).reshape(count, n * (ORDER + 2), -1)
    intervals = np.concatenate([control, samples[:, 1:, n + tangential, None]], axis=2)
    parts = [_in_blocks(part) for part in (intervals, hull, samples, guards, displacements, sizes)]
    rows = np.concatenate([part.reshape(count, -1, BLOCK, part.shape[-1]) for part in parts], axis=1)
    found = np.zeros((count, 4, rows.shape[1], 2 * n + 2, BLOCK))
    for mode in range(3):
        found[:, mode, :, : 2 * n] = rows[..., 2 * n * mode : 2 * n * (mode + 1)].swapaxes(-1, -2)
    found[:, 3] = rows[..., 6 * n :][..., places_of(n, normal)].swapaxes(-1, -2)
    return found.reshape(count, -1)


def _in_blocks(rows: Float[np.ndarray, "*parts rows c"]) -> Float[np.ndarray, "*parts padded c"]:
    more = padded(rows.shape[-2]) - rows.shape[-2]
    return np.pad(rows, [(0, 0)] * (rows.ndim - 2) + [(0, more), (0, 0)])


class Form(NamedTuple):
    """What all scenes have in common that one kernel serves: everything but numbers."""

    structure: Any
    shapes: tuple[tuple[int, ...], ...]

    @classmethod
    def of(cls, mechanics: Mechanics, leading: int = 0) -> "Form":
        """That of mechanics whose numbers have so many leading axes."""
        leaves, structure = jax.tree.flatten(mechanics)
        return cls(structure, tuple(np.shape(leaf)[leading:] for leaf in leaves))

    @property
    def count(self) -> int:
        """How many numbers mechanics of this form have."""
        return sum(map(math.prod, self.shapes))

    def mechanics(self, numbers) -> Mechanics:
        """The mechanics with these numbers."""
        ends = np.cumsum([math.prod(shape) for shape in self.shapes]).tolist()
        parts = [
            numbers[end - math.prod(shape) : end].reshape(shape) for shape, end in zip(self.shapes, ends, strict=True)
        ]
        return jax.tree.unflatten(self.structure, parts)


class Functions(NamedTuple):
    """Warp functions and types for scenes of one form."""

    name: str  # a digest of the laws
    state: Any  # vector: displacements, velocities
    mode: Any  # vector: status, direction
    row: Any  # vector: state, load, one
    mechanics: Any  # vector
    advance: Any
    peak: Any


@functools.cache
def functions(form: Form) -> Functions:
    """The Warp functions for scenes of this form.

    `advance` goes to the next event, crossing of the section, end of the time or of the window, whichever comes first; `peak` is
    the largest tangential speed on the way.
    """
    wp = warp()
    real = wp.float64
    like = jax.tree.unflatten(form.structure, [np.zeros(shape) for shape in form.shapes])
    tangential, normal = like.tangential, like.normal
    n = like.free_load.shape[0]
    velocity = n + tangential
    at = blocks_of(n)
    intervals, hulls, samples, guards, displacements, bounds, total = at
    of_sample = padded(2 * n) // BLOCK
    state, row, numbers = (wp.types.vector(size, real) for size in (2 * n, 2 * n + 2, form.count))
    mode_type, pair = (wp.types.vector(2, real) for _ in range(2))
    how_type, block_type, polynomial = (wp.types.vector(size, real) for size in (4, BLOCK, ORDER + 1))
    few, bracket_type, one_type = (wp.types.vector(size, real) for size in (10, 12, 1))
    hull_type, sample_type, guards_type, series_type = (
        wp.types.vector(padded(size), real) for size in (2 * ORDER, 2 * n, 2 * (ORDER + 2), n * (ORDER + 2))
    )
    speeds_type, matrices_type = wp.types.vector(INTERVALS + 1, real), wp.array(dtype=real)
    # A row is (state, load, one) with what is zero in contact at its end.
    of_row = wp.types.vector(2 * n + 2, int)(*places_of(n, normal))
    speed_at = places_of(n, normal).index(velocity)

    def product(size):
        """What a Warp function does that multiplies so many rows, from the block `first` of a matrix on, by `here`."""
        return f"""
            wp::vec_t<{size}, wp::float64> found;
            const wp::float64* column = m.data + {BLOCK * (2 * n + 2)} * ({total} * matrix + first);
            const int columns = matrix % 4 == 3 ? {2 * n + 2} : {2 * n};
            for (int b = 0; b < {size}; b += {BLOCK}) {{
                wp::float64 sums[{BLOCK}];
                for (int r = 0; r < {BLOCK}; ++r) sums[r] = column[r] * here[0];
                for (int k = 1; k < columns; ++k)
                    for (int r = 0; r < {BLOCK}; ++r) sums[r] += column[{BLOCK} * k + r] * here[k];
                for (int r = 0; r < {BLOCK}; ++r) found[b + r] = sums[r];
                column += {BLOCK * (2 * n + 2)};
            }}
            return found;"""

    digest = hashlib.sha256(repr(at).encode())

    def body(function, **arguments):
        """What a Warp function does that computes what a JAX function of vectors says."""
        source, size = scalar_source(function, **{name: kind._length_ for name, kind in arguments.items()})
        digest.update(source.encode())
        return f"wp::vec_t<{size}, wp::float64> found;\n{source}\nreturn found;"

    def contact_of(mode):
        return Contact(mode[0].astype(jnp.int32), mode[1])

    def exact_of(mode):
        return physics.exactly_zero(contact_of(mode))[:, None]

    def held_of(mechanics, mode, y):
        return physics.on_constraint(form.mechanics(mechanics), contact_of(mode), y)

    def next_of(mechanics, mode, y, how):
        """`how`: the load, which guards have ended their mode, and the time within which a rebound counts as rest."""
        own, contact = form.mechanics(mechanics), contact_of(mode)
        y = physics.on_constraint(own, contact, y)
        contact, y = physics.transition(own, contact, how[0], y, how[1:3] != 0, how[3])
        return jnp.concatenate([y, jnp.stack([contact.status.astype(y.dtype), contact.direction])])

    def limits_of(sizes):
        return sizes[:6].reshape(3, 2, 1)

    def begun_of(mode, start, sizes):
        zeros, _ = leading(start.reshape(4, 2, 1), limits_of(sizes), exact_of(mode))
        return jnp.any(zeros > 0)[None]

    def safe_of(mode, start, hull, sizes):
        hull = hull[: 2 * ORDER].reshape(ORDER, 2, 1)
        return first_is_safe(start.reshape(4, 2, 1), hull, limits_of(sizes), exact_of(mode))

    def bracket_of(mode, start, end, sizes):
        inside = jnp.ones(1, bool)
        found = bracketed(start.reshape(5, 2, 1), end.reshape(2, 1), limits_of(sizes), exact_of(mode), inside)
        return jnp.concatenate([jnp.ravel(part).astype(start.dtype) for part in jax.tree.leaves(found)])

    def fastest_of(speeds, steps):
        return fastest(speeds[:, None], steps)

    @wp.func_native(body(held_of, mechanics=numbers, mode=mode_type, y=state))
    def held(mechanics: numbers, mode: mode_type, y: state) -> state: ...

    @wp.func_native(body(next_of, mechanics=numbers, mode=mode_type, y=state, how=how_type))
    def next_mode(mechanics: numbers, mode: mode_type, y: state, how: how_type) -> row: ...

    @wp.func_native(body(begun_of, mode=mode_type, start=block_type, sizes=block_type))
    def has_begun(mode: mode_type, start: block_type, sizes: block_type) -> one_type: ...

    @wp.func_native(body(safe_of, mode=mode_type, start=block_type, hull=hull_type, sizes=block_type))
    def is_safe(mode: mode_type, start: block_type, hull: hull_type, sizes: block_type) -> one_type: ...

    @wp.func_native(body(bracket_of, mode=mode_type, start=few, end=pair, sizes=block_type))
    def brackets(mode: mode_type, start: few, end: pair, sizes: block_type) -> bracket_type: ...

    @wp.func_native(body(fastest_of, speeds=speeds_type, steps=one_type))
    def fastest_sample(speeds: speeds_type, steps: one_type) -> one_type: ...

    @wp.func_native(product(BLOCK))
    def block(m: matrices_type, matrix: int, first: int, here: row) -> block_type: ...

    @wp.func_native(product(padded(2 * n)))
    def sample(m: matrices_type, matrix: int, first: int, here: row) -> sample_type: ...

    @wp.func_native(product(padded(2 * ORDER)))
    def hull(m: matrices_type, matrix: int, first: int, here: row) -> hull_type: ...

    @wp.func_native(product(padded(2 * (ORDER + 2))))
    def guard_series(m: matrices_type, matrix: int, first: int, here: row) -> guards_type: ...

    @wp.func_native(product(padded(n * (ORDER + 2))))
    def series(m: matrices_type, matrix: int, first: int, here: row) -> series_type: ...

    def horner(terms):
        """What a Warp function does that gives value and slope of a polynomial, of its first terms."""
        return f"""
            wp::float64 value = c[{terms - 1}], slope = 0.0;
            for (int k = {terms - 2}; k >= 0; --k) {{
                slope = slope * x + value;
                value = value * x + c[k];
            }}
            return wp::vec_t<2, wp::float64>(value, slope);"""

    @wp.func_native(horner(ORDER + 1))
    def value_at(c: polynomial, x: real) -> pair: ...

    @wp.func_native(horner(ROOT_STEPS[0] + 1))
    def value_of_few(c: polynomial, x: real) -> pair: ...

    within = f"""
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

    @wp.func_native(within)
    def state_within(c: series_type, x: real, interval: real) -> state: ...

    # Numbers in double precision: Warp takes Python's for single.
    zero, half, one, two, most = real(0.0), real(0.5), real(1.0), real(2.0), real(float(INTERVALS))
    settled, settled_rise = real(1e-7), real(1e-8)
    rounding, infinite = real(8.0 * np.finfo(float).eps), real(math.inf)
    resting = real(RESTING["float64"])
    stick, slide, detach = (real(float(status)) for status in (Status.STICK, Status.SLIDE, Status.DETACH))
    order, short_steps = ORDER, len(ROOT_STEPS) - 1

    @wp.struct
    class Step:
        """An advance: the state and mode after it, the state before what happened at its end, its duration (s), whether the
        section was crossed, and whether the mode has ended.
        """

        y: state
        mode: mode_type
        end: state
        h: real
        crossed: int
        ended: int

    @wp.func
    def matrix_of(g: int, mode: mode_type) -> int:
        """The place of a mode's matrix among those of all groups."""
        if mode[0] == stick:
            return 4 * g
        if mode[0] == detach:
            return 4 * g + 3
        if mode[1] > zero:
            return 4 * g + 1
        return 4 * g + 2

    @wp.func
    def stacked(y: state, load: real) -> row:
        found = row()
        for k in range(2 * n + 2):
            place = of_row[k]
            if place < 2 * n:
                found[k] = y[place]
            elif place == 2 * n:
                found[k] = load
            else:
                found[k] = one
        return found

    @wp.func
    def sample_at(m: matrices_type, w: int, here: row, i: int) -> state:
        """The state at the beginning of an interval."""
        there = sample(m, w, samples + of_sample * i, here)
        found = state()
        for k in range(2 * n):
            found[k] = there[k]
        return found

    @wp.func
    def sizes_at(m: matrices_type, w: int, here: row) -> block_type:
        size = row()
        for k in range(2 * n + 2):
            size[k] = wp.abs(here[k])
        return block(m, w, bounds, size)

    @wp.func
    def lowest_of(c: polynomial, guess: real) -> real:
        """Where a guard that dips is lowest, in [0, 1]."""
        x = guess
        for _ in range(6):
            value = c[order]
            slope = zero
            bend = zero
            for k in range(order):
                bend = bend * x + slope
                slope = slope * x + value
                value = value * x + c[order - 1 - k]
            if bend > zero:
                x = x - slope / (two * bend)
            else:
                x = x - slope
            x = wp.clamp(x, zero, one)
        return x

    @wp.func
    def root_of(c: polynomial, zeros: real, guess: real, end: real) -> pair:
        """The root in the bracket from 0 to `end`, and the slope there: Newton's method, with bisection where it leads away."""
        low = zero
        high = end
        x = wp.min(guess, end)
        slope = zero
        done = int(0)
        count = int(0)
        while done == 0 and count < MOST_ROOT_STEPS:
            few_terms = count < short_steps
            there = pair()
            if few_terms:
                there = value_of_few(c, x)
            else:
                there = value_at(c, x)
            value = there[0]
            slope = there[1]
            # The slope of the polynomial with its roots at zero divided out, up to the common factor of value and slope.
            if x > zero:
                slope = slope - zeros * value / x
            nearer = x - value
            if slope != zero:
                nearer = x - value / slope
            if few_terms:
                x = wp.clamp(nearer, zero, end)
            else:
                if slope != zero and wp.abs(nearer - x) <= settled:
                    done = 1
                if value > zero:
                    low = x
                else:
                    high = x
                if done == 0 and not (nearer > low and nearer < high):
                    nearer = half * (low + high)
                x = wp.clamp(nearer, zero, one)
            count += 1
        return pair(x, slope)

    @wp.func
    def speed_series(c: series_type) -> polynomial:
        """The series of the tangential velocity, in m per interval."""
        found = polynomial()
        for k in range(order + 1):
            found[k] = real(k + 1) * c[(order + 2) * tangential + k + 1]
        return found

    @wp.func
    def rise_of(c: polynomial, end: real, last: real) -> real:
        """Where the tangential velocity rises through zero before `end`, where it is `last`."""
        low = zero
        high = end
        x = end * c[0] / (c[0] - last)
        done = int(0)
        count = int(0)
        while done == 0 and count < RISE_STEPS:
            there = value_at(c, x)
            if there[0] < zero:
                low = x
            else:
                high = x
            slope = there[1]
            if slope == zero:
                slope = one
            nearer = x - there[0] / slope
            if nearer >= low and nearer <= high:
                if wp.abs(nearer - x) <= settled_rise * end:
                    done = 1
                x = nearer
            else:
                x = half * (low + high)
            count += 1
        return x

    @wp.func
    def guard(c: guards_type, which: int, zeros: real) -> polynomial:
        """The series of a guard; its first coefficients, which are zero up to rounding, are exactly zero."""
        found = polynomial()
        for k in range(order + 1):
            if real(k) >= zeros:
                found[k] = c[2 * k + which]
        return found

    @wp.func
    def first_interval(m: matrices_type, w: int, mode: mode_type, here: row, steps: real) -> int:
        """The first interval that may have an event, in which the section is crossed, or in which the time ends."""
        sizes = sizes_at(m, w, here)
        whole = int(wp.floor(steps))
        before = here[speed_at]
        i = int(0)
        searching = int(1)
        while searching == 1 and i < whole:
            c = block(m, w, intervals + i, here)
            begins = zero
            start = block_type()
            if i == 0:
                start = block(m, w, guards, here)
                begins = has_begun(mode, start, sizes)[0]
            if before < zero and c[6] >= zero:
                searching = 0
            elif begins > zero:
                if is_safe(mode, start, hull(m, w, hulls, here), sizes)[0] == zero:
                    searching = 0
            elif not (
                wp.min(wp.min(c[0], c[2]), c[4]) > sizes[6] and wp.min(wp.min(c[1], c[3]), c[5]) > sizes[7]
            ):
                searching = 0
            if searching == 1:
                before = c[6]
                i += 1
        return i

    @wp.func
    def advance(
        m: matrices_type, mechanics: numbers, interval: real, g: int, y: state, mode: mode_type, load: real, h: real
    ) -> Step:
        w = matrix_of(g, mode)
        steps = wp.min(h / interval, most)
        here = stacked(y, load)
        i = first_interval(m, w, mode, here, steps)
        began = y
        if i > 0:
            began = sample_at(m, w, here, i)
        share = zero
        fires_0 = int(0)
        fires_1 = int(0)
        crossed = int(0)
        reached = began
        if i < INTERVALS:
            there = stacked(began, load)
            both = guard_series(m, w, guards, there)
            start = few()
            for k in range(10):
                start[k] = both[k]
            last = pair(both[2 * order + 2], both[2 * order + 3])
            b = brackets(mode, start, last, sizes_at(m, w, there))
            share = wp.min(steps - real(i), one)
            root = pair(infinite, infinite)
            slope = pair()
            same = pair()
            for q in range(2):
                crosses = b[6 + q]
                end = b[4 + q]
                guess = b[q]
                if crosses > zero or b[10 + q] > zero:
                    c = guard(both, q, b[2 + q])
                    if b[10 + q] > zero:
                        low = lowest_of(c, guess)
                        if value_at(c, low)[0] <= zero:
                            crosses = one
                            end = low
                            guess = half * low
                    if crosses > zero:
                        found = root_of(c, b[2 + q], guess, end)
                        root[q] = found[0]
                        slope[q] = found[1]
                        same[q] = rounding * (wp.abs(c[0]) + wp.abs(c[1]) + wp.abs(c[2]) + wp.abs(c[3]))
            first = wp.min(root[0], root[1])
            # Roots that differ by rounding are one event; the two guards of an open gap always are.
            if root[0] < infinite and (root[0] == first or (root[0] - first) * wp.abs(slope[0]) <= same[0]):
                fires_0 = 1
            if root[1] < infinite and (root[1] == first or (root[1] - first) * wp.abs(slope[1]) <= same[1]):
                fires_1 = 1
            if b[8] > zero or b[9] > zero:  # used up from the start
                first = zero
                fires_0 = int(b[8])
                fires_1 = int(b[9])
            if first <= share:
                if fires_0 + fires_1 > 0:
                    share = first
            else:
                fires_0 = 0
                fires_1 = 0
            if share != zero:
                ahead = series(m, w, displacements, there)
                reached = state_within(ahead, share, interval)
                if began[velocity] < zero and reached[velocity] >= zero:
                    crossed = 1
                    share = rise_of(speed_series(ahead), share, reached[velocity] * interval)
                    reached = state_within(ahead, share, interval)
                    reached[velocity] = zero
                    fires_0 = 0
                    fires_1 = 0
        result = Step()
        result.end = reached
        result.ended = wp.max(fires_0, fires_1)
        if result.ended > 0:
            after = next_mode(
                mechanics, mode, reached, how_type(load, real(fires_0), real(fires_1), resting * interval)
            )
            for k in range(2 * n):
                result.y[k] = after[k]
            result.mode = mode_type(after[2 * n], after[2 * n + 1])
        else:
            result.y = held(mechanics, mode, reached)
            result.mode = mode
        if reached[velocity] < zero and result.y[velocity] >= zero:
            crossed = 1
        result.crossed = crossed
        result.h = (real(i) + share) * interval
        return result

    @wp.func
    def highest_near(
        m: matrices_type, w: int, here: row, load: real, i: int, steps: real, interval: real
    ) -> real:
        """The largest tangential speed next to a sample of the window."""
        c = speed_series(series(m, w, displacements, stacked(sample_at(m, w, here, i), load)))
        low = wp.max(-real(i), -one)
        high = wp.min(steps - real(i), one)
        x = zero
        for _ in range(PEAK_STEPS):
            value = c[order]
            slope = zero
            bend = zero
            for k in range(order):
                bend = bend * x + slope
                slope = slope * x + value
                value = value * x + c[order - 1 - k]
            bend = two * bend
            if bend == zero:
                bend = one
            x = wp.clamp(x - slope / bend, low, high)
        return wp.max(wp.abs(c[0]), wp.abs(value_at(c, x)[0])) / interval

    @wp.func
    def peak(
        m: matrices_type, interval: real, g: int, y: state, mode: mode_type, load: real, h: real, end: state
    ) -> real:
        w = matrix_of(g, mode)
        here = stacked(y, load)
        steps = h / interval
        highest = wp.abs(end[velocity])
        speeds = speeds_type()
        turned = speeds_type()
        for k in range(INTERVALS + 1):
            speeds[k] = sample(m, w, samples + of_sample * k, here)[velocity]
            turned[k] = -speeds[k]
            if real(k) <= steps:
                highest = wp.max(highest, wp.abs(speeds[k]))
        upper = int(fastest_sample(speeds, one_type(steps))[0])
        lower = int(fastest_sample(turned, one_type(steps))[0])
        highest = wp.max(highest, highest_near(m, w, here, load, upper, steps, interval))
        return wp.max(highest, highest_near(m, w, here, load, lower, steps, interval))

    return Functions(digest.hexdigest()[:16], state, mode_type, row, numbers, advance, peak)
