"""JAX functions written out as C++ and computed by kernels: against JAX itself, with loops, branches, tables and tangents."""

import functools
import itertools
import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from fivjax.foundation.argument_forms import Form
from fivjax.foundation.jaxprs import with_code_once
from fivjax.foundation.linear_solve import solve
from fivjax.foundation.numpy_evaluation import by_numpy
from fivjax.kernels.functions import KernelFunction
from fivjax.kernels.kernel import kernel_of


def with_loops(x, matrix, count):
    """Loops of known and unknown length, branches, places that are unknown, arrays that are gone through by loops."""
    size = x.shape[0]

    def turn(carry):
        k, y, far = carry
        y = jax.lax.cond(k % 2 == 0, lambda y: jnp.sin(matrix @ y), lambda y: y[::-1] + 0.1 * y, y)
        far = jax.lax.dynamic_update_index_in_dim(far, y[k % size], k % 3, 0)
        return k + 1, y, far.at[k % 3].add(jnp.max(y))

    _, y, far = jax.lax.while_loop(lambda carry: carry[0] < count, turn, (jnp.zeros((), jnp.int32), x, jnp.zeros(3)))
    rows = jax.lax.scan(lambda a, b: (a + b, a * b), jnp.zeros(size), jnp.outer(x, y))[1]
    batch = jnp.einsum("bij,bj->bi", jnp.stack([matrix, matrix.T, 2 * matrix]), rows[:3])
    large = jnp.where(rows > 0, rows, matrix[:, :1] * rows)
    first, *_, last = jnp.unstack(rows, axis=1)
    taken = jnp.take_along_axis(rows, jnp.argmax(rows, axis=1)[:, None], axis=1)
    return {
        "y": y,
        "far": jnp.concatenate([far, jnp.cumsum(y)]),
        "batch": batch.sum(axis=0),
        "large": jnp.max(large, axis=1) + jnp.sum(large.T, axis=1),
        "taken": taken[:, 0],
        "unstacked": first - 2 * last,
        "sorted": jnp.sort(jnp.stack([far[0], y[0], y[1], far[1]])),
        "count": count + jnp.sum(rows > 0),
    }


def function(args, instants):
    x, matrix, count = args

    def row(total, t):
        total = total + t * x
        return total, {"total": total, "square": jnp.sum(total**2), "sign": total[0] > 0}

    total, rows = jax.lax.scan(row, jnp.zeros_like(x), instants)
    return {"total": total, **with_loops(x, matrix, count)}, rows


KERNEL = KernelFunction(function)


def given(size):
    random = np.random.default_rng(size)
    return random.normal(size=size), random.normal(size=(size, size)), np.int32(7)


@pytest.mark.parametrize("size", [4, 9])
def test_what_a_kernel_computes_is_what_jax_does(size):
    args, instants = given(size), np.linspace(-1, 1, 6)
    with jax.enable_x64(True):
        expected = jax.jit(function)(args, instants)
    found = KERNEL(args, instants)
    assert jax.tree.structure(found) == jax.tree.structure(expected)
    for own, other in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
        assert own.dtype == other.dtype
        np.testing.assert_allclose(own, other, rtol=1e-12, atol=1e-12)


def rows_of(size, lanes):
    """Lanes of different numbers and lengths of loops."""
    random = np.random.default_rng(size)
    _, matrix, _ = given(size)
    numbers = [random.normal(size=(lanes, size)), np.broadcast_to(matrix.ravel(), (lanes, size * size))]
    return np.concatenate([*numbers, random.integers(0, 12, (lanes, 1))], axis=1)


@pytest.mark.parametrize("size", [4, 9])
def test_lanes_side_by_side_are_what_they_are_alone(size):
    """They go through loops of different lengths, other branches and other places; and none depends on its neighbours."""
    rows, instants = rows_of(size, 21), np.random.default_rng(0).normal(size=(21, 6))
    form = Form.of(given(size))[0]
    alone, found = (KERNEL.of_many(form, rows, instants, side_by_side=side) for side in (False, True))
    assert kernel_of(KERNEL, form.kept, side_by_side=True).of_lanes.side_by_side > 1
    for own, other in zip(jax.tree.leaves(found), jax.tree.leaves(alone), strict=True):
        np.testing.assert_allclose(own, other, rtol=1e-12, atol=1e-12)
    some = np.random.default_rng(1).permutation(21)[:10]
    again = KERNEL.of_many(form, rows[some], instants[some], side_by_side=True)
    for own, other in zip(jax.tree.leaves(again), jax.tree.leaves(found), strict=True):
        np.testing.assert_array_equal(own, other[some])


def by_numbers(args, instants):
    x, y = args
    bits = functools.partial(jax.lax.bitcast_convert_type, new_dtype=jnp.int64)
    whole, true = jnp.round(jnp.where(jnp.isfinite(x), 3 * jnp.tanh(x), 0.0)).astype(jnp.int32), x > y
    return {
        "smooth": [
            jnp.exp(x),
            jnp.log(jnp.abs(x)),
            jnp.log1p(jnp.abs(x)),
            jnp.expm1(x),
            jnp.arcsinh(x),
            jnp.arccosh(jnp.maximum(jnp.abs(x), 1.0)),
            jnp.arctanh(jnp.sin(x)),
            jnp.tanh(x),
            jnp.cbrt(x),
            2.0**x,
        ],
        "rounded": [
            jnp.sign(x),
            jnp.floor(x),
            jnp.ceil(x),
            jnp.round(x),
            jnp.fmod(x, y),
            jnp.clip(x, -0.5, y),
            x**3,
            x**-2,
        ],
        "powers": [jnp.abs(x) ** y, jnp.arctan2(x, y), jnp.hypot(x, y), jax.nn.sigmoid(x), jax.lax.rsqrt(jnp.abs(x))],
        "whole": [
            whole,
            whole % 2,
            jnp.maximum(whole, 1),
            whole.astype(x.dtype),
            true.astype(jnp.int32),
            -whole,
            ~whole,
            jnp.sign(whole),
            whole * whole,
        ],
        "true": [
            true,
            ~true,
            true & (x > 0),
            true | (y > 0),
            true ^ (x > 0),
            jnp.isfinite(x),
            whole == 1,
            jnp.isnan(x / y),
        ],
        "extreme": [
            jnp.maximum(x, y),
            jnp.minimum(x, y),
            jnp.argmax(x),
            jnp.argmin(x),
            jnp.argmax(true),
            jnp.max(x),
            jnp.any(true),
        ],
        "power of two": jax.lax.bitcast_convert_type(bits(x) & bits(jnp.array(jnp.inf)), x.dtype),
    }, ()


def test_functions_of_lanes_side_by_side_are_those_of_jax():
    """With numbers that are none, infinite or zero, too."""
    random, kernel = np.random.default_rng(3), KernelFunction(by_numbers)
    rows = random.normal(size=(40, 6)) * np.exp(random.uniform(-3, 3, (40, 1)))
    rows[:, 0] = [
        *np.geomspace(1e-300, 1e300, 20),
        *-np.geomspace(1e-300, 1e300, 14),
        0.0,
        np.inf,
        -np.inf,
        np.nan,
        709.7,
        -745.1,
    ]
    form = Form.of((rows[0, :3], rows[0, 3:]))[0]
    found, _ = kernel.of_many(form, rows, side_by_side=True)
    assert kernel_of(kernel, form.kept, side_by_side=True).of_lanes.side_by_side > 1
    with jax.enable_x64(True):
        expected, _ = jax.jit(jax.vmap(lambda row: by_numbers((row[:3], row[3:]), None)))(rows)
    for own, other in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
        if own.dtype == float:
            # The cube root of very large and small numbers is the one with such an error: that of XLA.
            np.testing.assert_allclose(own, other, rtol=2e-14, atol=1e-307)
        else:
            np.testing.assert_array_equal(own, other)


@pytest.mark.parametrize("size", [3, 6])
def test_systems_of_lanes_side_by_side_are_solved(size):
    """Whose largest entries are in other rows from lane to lane."""
    random = np.random.default_rng(size)
    matrices, rights = random.normal(size=(11, size, size)), random.normal(size=(11, size, 2))
    kernel, form = KernelFunction(lambda args, instants: (solve(*args), ())), Form.of((matrices[0], rights[0]))[0]
    rows = np.concatenate([matrices.reshape(11, -1), rights.reshape(11, -1)], axis=1)
    found, _ = kernel.of_many(form, rows, side_by_side=True)
    np.testing.assert_allclose(found, np.linalg.solve(matrices, rights), rtol=1e-9)


def loss(of, x, matrix, instants):
    ends, rows = of((x, matrix, jnp.int32(5)), instants)
    return jnp.sum(ends["y"] ** 2) + jnp.sum(ends["large"]) + jnp.sum(rows["square"]) + jnp.sum(ends["batch"])


def test_its_derivatives_are_those_of_jax():
    x, matrix, _ = given(4)
    instants = np.linspace(-1, 1, 6)

    # Bounded loops, so that JAX differentiates its own function in both modes.
    def of_jax(x, matrix):
        return loss(function, x, matrix, instants)

    def of_kernel(x, matrix):
        return loss(KERNEL, x, matrix, instants)

    with jax.enable_x64(True):
        expected = jax.jit(jax.jacfwd(of_jax, (0, 1)))(x, matrix)
        for derivative in (jax.grad, jax.jacfwd):
            for found in (derivative(of_kernel, (0, 1)), jax.jit(derivative(of_kernel, (0, 1)))):
                for own, other in zip(found(x, matrix), expected, strict=True):
                    np.testing.assert_allclose(own, other, rtol=1e-11, atol=1e-11)
        # Only what is perturbed has a direction.
        np.testing.assert_allclose(jax.grad(of_kernel)(x, matrix), expected[0], rtol=1e-11, atol=1e-11)


def test_a_tangent_may_be_a_number_of_pythons():
    kernel = KernelFunction(lambda args, instants: (args[0] ** 2, ()))
    with jax.enable_x64(True):
        square = jax.jit(lambda x: jax.jvp(lambda x: kernel((x,), np.zeros(1))[0], (x,), (1.0,)))
        assert square(3.0) == (9.0, 6.0)


def test_a_batch_is_what_single_calls_are():
    _, matrix, count = given(4)
    x, instants = np.random.default_rng(1).normal(size=(3, 2, 4)), np.linspace(0, 1, 3)

    def of(x):
        ends, rows = KERNEL((x, matrix, count), instants)
        return ends["y"], rows["square"]

    with jax.enable_x64(True):
        found = jax.jit(jax.vmap(jax.vmap(of)))(x)
        slopes = jax.vmap(jax.jacfwd(lambda x: of(x)[0]))(x[0])
    for place in itertools.product(range(3), range(2)):
        for own, other in zip(found, of(x[place]), strict=True):
            np.testing.assert_array_equal(own[place], other)
    with jax.enable_x64(True):
        expected = jax.jacfwd(lambda x: of(x)[0])(x[0, 1])
    np.testing.assert_array_equal(slopes[1], expected)
    form, _ = Form.of((x[0, 0], matrix, count))
    rows = np.array([np.concatenate([one.ravel(), matrix.ravel(), [count]]) for one in x.reshape(-1, 4)])
    ends, _ = KERNEL.of_many(form, rows, instants)
    np.testing.assert_array_equal(ends["y"].reshape(3, 2, 4), found[0])
    # A batch may be of none.
    with jax.enable_x64(True):
        for way in (jax.vmap, lambda of: jax.jit(jax.vmap(of))):
            nothing, slopes = way(of)(x[:0, 0]), way(jax.jacfwd(lambda x: of(x)[0]))(x[:0, 0])
            assert [part.shape for part in (*nothing, slopes)] == [(0, 4), (0, *found[1].shape[2:]), (0, 4, 4)]


@pytest.mark.parametrize("size", [3, 7])
def test_solutions_of_systems_have_tangents(size):
    """Small systems are written out, larger ones are a function's; their largest entries are not on the diagonal."""
    random = np.random.default_rng(size)
    matrix, right = (random.normal(size=(size, size)) + 3 * np.eye(size))[::-1].copy(), random.normal(size=(size, 2))
    kernel = KernelFunction(lambda args, instants: (solve(*args), ()))

    def of_kernel(matrix, right):
        return jnp.sum(kernel((matrix, right), np.zeros(1))[0] ** 2)

    def of_jax(matrix, right):
        return jnp.sum(jnp.linalg.solve(matrix, right) ** 2)

    with jax.enable_x64(True):
        expected, found = (jax.grad(of, (0, 1))(matrix, right) for of in (of_jax, of_kernel))
    for own, other in zip(found, expected, strict=True):
        np.testing.assert_allclose(own, other, rtol=1e-11, atol=1e-12)


def test_what_a_kernel_cannot_do_is_said():
    with pytest.raises(NotImplementedError, match=r"one `scan`"):
        KernelFunction(lambda args, instants: (jnp.sum(instants), ()))((np.zeros(1),), np.zeros(3))
    with pytest.raises(NotImplementedError, match="primitive `digamma`"):
        KernelFunction(lambda args, instants: (jax.scipy.special.digamma(args[0]), ()))((np.ones(1),), np.zeros(3))
    with pytest.raises(NotImplementedError, match="Numbers of type `float32`"):
        KernelFunction(lambda args, instants: (args[0].astype(jnp.float32), ()))((np.ones(1),), np.zeros(3))


def test_numpy_computes_what_jax_does():
    args = given(4)
    with jax.enable_x64(True):
        expected = with_loops(*args)
    found = by_numpy(with_loops)(*args)
    for own, other in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
        assert isinstance(own, np.ndarray | np.generic)
        np.testing.assert_allclose(own, other, rtol=1e-13, atol=1e-13)


def test_numpy_reads_and_writes_the_places_of_arrays_that_jax_does():
    """Against JAX's own `gather` and `scatter`, by the forms of indexing that it writes them for."""
    from fivjax.foundation.numpy_evaluation import by_numpy

    a, where = np.arange(24.0).reshape(4, 6), np.array([2, 0, 3])
    forms = [
        lambda a, at: a[at],
        lambda a, at: a[:, at],
        lambda a, at: a[at, at],
        lambda a, at: a[jnp.ix_(at, at)],
        lambda a, at: jax.vmap(lambda row, i: row[i])(a[:3], at),
        lambda a, at: jax.vmap(lambda row, i: jax.lax.dynamic_slice(row, (i,), (2,)))(a[:3], at),
        lambda a, at: a.at[at].set(-1.0),
        lambda a, at: a.at[:, at].set(jnp.arange(3.0)),
        lambda a, at: a.at[at, 1].add(jnp.arange(3.0)),
        lambda a, at: a.at[jnp.array([1, 1]), 1].add(2.0),
        lambda a, at: a.at[at + 2, 0].set(-1.0),  # one of them outside
        lambda a, at: jnp.argmax(a, axis=1) + jnp.max(a[:, ::-1], axis=1),
        lambda a, at: jnp.take(a, at, axis=1, mode="clip"),
    ]
    for form in forms:
        np.testing.assert_array_equal(by_numpy(form)(a, where), form(jnp.asarray(a), jnp.asarray(where)))


def test_second_derivatives_of_a_kernel_are_those_of_its_function():
    """The derivative of a derivative, under `vmap` and `jit`."""
    x, matrix, count = given(3)
    instants = np.linspace(0.1, 1.0, 4)

    def of(run):
        def loss(x):
            ends, rows = run((x, matrix, count), instants)
            return jnp.sum(ends["batch"]) + jnp.sum(rows["square"]) + jnp.sum(ends["total"] ** 2)

        return loss

    with jax.enable_x64(True):
        many = x + 0.1 * np.arange(3.0)[:, None]
        # In one program: without `jit` every operation would be compiled by itself.
        expected = jax.jit(jax.vmap(jax.jacfwd(jax.jacfwd(of(function)))))(many)
        found = jax.jit(jax.jacfwd(jax.jacfwd(of(KERNEL))))
        np.testing.assert_allclose(jax.vmap(found)(many), expected, rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(found(x), expected[0], rtol=1e-9, atol=1e-9)


def test_second_derivatives_of_a_kernel_need_no_jit():
    """Of a short function: without `jit` each of its operations is a program of its own."""
    cubes = KernelFunction(lambda args, instants: (args[0] ** 3 * args[1], ()))

    def of(x):
        return jnp.sum(cubes((x, jnp.asarray([2.0, -1.0])), np.zeros(1))[0])

    with jax.enable_x64(True):
        many = np.array([[1.0, 2.0], [-0.5, 3.0]])
        expected = np.einsum("bi,ij->bij", 6.0 * many * [2.0, -1.0], np.eye(2))
        np.testing.assert_allclose(jax.vmap(jax.hessian(of))(many), expected, rtol=1e-12, atol=1e-12)
        np.testing.assert_allclose(jax.hessian(of)(many[0]), expected[0], rtol=1e-12, atol=1e-12)


def test_what_follows_from_what_is_given_is_computed_once_before_all_loops():
    """As the sizes of a large matrix: neither in each turn of a loop, nor again for each that needs it."""

    def repeated(args, instants):
        matrix, x, count = args

        def turn(carry):
            k, y = carry
            sizes = jnp.abs(matrix)
            return k + 1, jnp.sin(matrix @ y) / jnp.max(sizes) + jnp.abs(matrix) @ x

        _, y = jax.lax.while_loop(lambda carry: carry[0] < count, turn, (jnp.zeros((), jnp.int32), x))
        return y, ()

    random, kernels = np.random.default_rng(5), KernelFunction(repeated)
    args = random.normal(size=(9, 9)), random.normal(size=9), np.int32(3)
    found, _ = kernels(args)
    with jax.enable_x64(True):
        np.testing.assert_allclose(found, repeated(tuple(map(jnp.asarray, args)), None)[0], rtol=1e-13)
    form, _ = Form.of(args)
    source = kernel_of(kernels, form.kept).text.source
    before, _, after = source.partition("for (;;)")
    assert before.count("wp::abs(given[") == 1 and "wp::abs(" not in after
    # Rows of the matrix become columns, whose numbers a loop over results reads side by side.
    assert not re.search(r"given\[\w+ \* 9", after)


@with_code_once
def _nearest(points, at, allowed, first):
    """A whole number, a choice, a matrix across its rows and one that is known."""
    distances = jnp.sum(jnp.abs(points - at), axis=1) + jnp.where(allowed, 0.0, 10.0) + jnp.arange(len(points)) * 1e-3
    place = jax.lax.while_loop(lambda k: jnp.any(distances < distances[k]), lambda k: k + 1, first)
    return place, points[place], distances


@with_code_once
def _nearest_of_half(points, at):
    return _nearest(points[::2] - 0.1, at, jnp.ones(len(points[::2]), bool), jnp.int32(0))[0]


def test_a_function_with_its_code_once_is_called():
    """Twice, of which it has one text, and by another such function for another shape; of tangents it is written out."""

    def calls(args, instants):
        points, at, scale = args
        allowed = points[:, 0] > 0
        one, near, sizes = _nearest(points, at, allowed, jnp.int32(0))
        other, far, more = _nearest(points.T[::-1].T * scale, jnp.ones_like(at), ~allowed, one * 0)
        return {
            "places": jnp.stack([one, other, _nearest_of_half(points, at)]),
            "near": near,
            "far": far,
            "sizes": sizes + more,
        }, ()

    random, kernels = np.random.default_rng(8), KernelFunction(calls)
    args = random.normal(size=(17, 3)), random.normal(size=3), np.array(1.3)
    found, _ = kernels(args)
    with jax.enable_x64(True):
        like = jax.tree.map(jnp.asarray, args)
        expected, _ = calls(like, None)
        assert np.array_equal(found["places"], expected["places"])
        for name in ("near", "far", "sizes"):
            np.testing.assert_allclose(found[name], expected[name], rtol=1e-14)
        slopes = jax.jacfwd(lambda scale: kernels((like[0], like[1], scale))[0]["far"])(like[2])
        np.testing.assert_allclose(slopes, expected["far"] / 1.3, rtol=1e-13)
    source = kernel_of(kernels, Form.of(args)[0].kept).text.source
    assert source.count("noinline") == 3 and source.count("_nearest_0(") == 2


def test_what_differs_by_the_sign_of_a_zero_is_not_the_same():
    def signs(args, instants):
        (matrix,) = args
        return (1.0 / (jnp.abs(matrix) * jnp.array(0.0))[0, 0], 1.0 / (jnp.abs(matrix) * jnp.array(-0.0))[0, 0]), ()

    found, _ = KernelFunction(signs)((np.ones((9, 9)),))
    assert tuple(map(float, found)) == (np.inf, -np.inf)


def at_the_edges(args, instants):
    table, i, n = args
    places = jnp.stack([i, i + 1])
    return {
        "filled": [jnp.take(table, i), table.at[places].get(mode="fill", fill_value=0.5), jnp.take(table, places)],
        "clamped": [table[i], table.at[places].get(mode="clip")],
        "whole": [n // i, n % i, jnp.where(i == 0, n, n // i)],
        "put": [table.at[i].set(7.0), table.at[i].add(2.0), table.at[i].set(7.0, mode="clip")],
        "rows": [jnp.outer(table, table).at[i].set(table), jnp.outer(table, table).at[1, i].set(-1.0)],
        "signs": 1.0 / jnp.where(i > 2, 0.0, -0.0),
        # Of numbers that are known when the kernel is written.
        "neither": jax.lax.div(jnp.zeros(()), jnp.zeros(())) + table,
    }, ()


def of_any_numbers(args, instants):
    x, y = args
    row = jnp.concatenate([x, y * jnp.ones(2)])
    return {
        "whole": [x.astype(jnp.int32), jnp.ceil(y).astype(jnp.int64), jnp.clip(x.astype(int), 0, 7)],
        "best": [jnp.argmax(row), jnp.argmin(row), jnp.argmax(x), jnp.argmin(x)],
        "sorted": [jnp.sort(row), jnp.argsort(row)],
    }, ()


def test_what_is_no_number_or_beyond_all_whole_ones_is_as_in_jax():
    """C++ has nothing for the conversion of such numbers, and comparisons with them never hold."""
    strange = np.array([1.0, -2.5, 3e9, -3e9, 1e300, -1e300, np.inf, -np.inf, np.nan])
    rows = np.array([[a, b, c, d] for a in strange for b in strange for c, d in ((0.5, -7.0), (np.nan, 1.0))])
    rows = np.concatenate([rows, rows[:, ::-1]])
    kernel, form = KernelFunction(of_any_numbers), Form.of((rows[0, :3], rows[0, 3]))[0]
    with jax.enable_x64(True):
        expected = jax.vmap(lambda row: of_any_numbers((row[:3], row[3]), None)[0])(jnp.asarray(rows))
    for side_by_side in (False, True):
        found, _ = kernel.of_many(form, rows, side_by_side=side_by_side)
        for own, other in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
            # The largest whole number is no real one.
            np.testing.assert_allclose(own, np.asarray(other, float), rtol=1e-15)


def of_whole_numbers(args, instants):
    x, y = args
    few, many = (jnp.floor(8 * own).astype(jnp.int32) for own in (y, jnp.outer(y, jnp.ones(40)).ravel()))
    return {
        "sizes": [jnp.abs(few), jnp.sign(few), jnp.sum(few)],
        "bits": [~few, ~many, ~(few > 0), few & 5, few | 9, few ^ 3],
        "all bits": [jax.lax.reduce_and(own, (0,)) for own in (few, many)],
        "any bits": [jax.lax.reduce_or(own, (0,)) for own in (few, many)],
        "between": jax.lax.clamp(y[0], x, y[1]),
        "cases": jnp.select([y > 1, y > 0, y > -1], [y**2, jnp.sin(y), x[0] + y], 7.0),
    }, ()


def of_large_numbers(args, instants):
    x, y = (jnp.floor(own).astype(jnp.int64) for own in args)
    most, few = 3_000_000_000, [(100 * own).astype(jnp.int8) for own in (x, y)]
    return {
        "beyond 31 bits": [x < most, jnp.minimum(x, most), x // most, jnp.remainder(x, most), x * most],
        "beyond 53 bits": jnp.abs(x - 2**53) - 2**53,
        "of equal ones": [(x - x) & y, jax.lax.rem(x - x, y)],
        "of 8 bits": [*few, few[0] + few[1], few[0] * few[1], -few[0], args[0].astype(jnp.int8)],
        "of many": [
            jnp.sum(jnp.outer(few[0], jnp.ones(60, jnp.int8)), dtype=jnp.int8),
            jnp.sum((x * jnp.arange(1, 90)).astype(jnp.int32) * 40_000_003, dtype=jnp.int32),
            jnp.prod((y + jnp.arange(50)).astype(jnp.int32), dtype=jnp.int32),
            jnp.full((8, 8), 90_000_001, jnp.int32) @ (x + jnp.arange(8)).astype(jnp.int32),
            jnp.zeros(3, jnp.int32).at[y % 3].add(2_000_000_000).at[y % 3].add(2_000_000_000),
        ],
        "true": [jnp.maximum(x > 0, y > 0), jnp.minimum(x > 0, y > 0), jnp.max(jnp.stack([x > 0, y > 0]))],
        "from tables": [jnp.asarray(np.arange(60) % 7 > 2, kind)[y % 50] for kind in (jnp.int8, jnp.int64, bool)],
        "of 32 bits": [(x * most).astype(jnp.int32), x.astype(jnp.int32) * 1_000_003 + y.astype(jnp.int32) * 10**9],
    }, ()


def test_a_general_reduction_is_left_to_xla():
    """It holds a function of two numbers, which was called for all of them at once: what it wrote had no room."""

    def summed(args, instants):
        return [jax.lax.reduce(args[0] * jnp.arange(3.0), args[0], jax.lax.add, (0,))], ()

    with pytest.raises(NotImplementedError, match="`reduce` has no C"):
        KernelFunction(summed)((np.float64(2.0),), np.zeros(1))


def without_sign(args, instants):
    x, y = (own.astype(jnp.uint32) for own in args)
    return [x * jnp.uint32(2_654_435_761) + y, x < y - 1, args[0].astype(jnp.uint64)], ()


@pytest.mark.parametrize(("function", "as_vectors"), [(of_large_numbers, True), (without_sign, False)])
def test_whole_numbers_of_any_size_are_as_in_jax(function, as_vectors):
    """Also where they begin again at the other end. Without a sign they have no code side by side."""
    rows = np.array([[-5.0, 3.0], [70_000.0, -2.0], [300.0, 5.0], [-1.5, 1.0], [4e9, -3.0], [0.0, 1e6]])
    kernel, form = KernelFunction(function), Form.of((rows[0, 0], rows[0, 1]))[0]
    with jax.enable_x64(True):
        expected = jax.vmap(lambda row: function((row[0], row[1]), None)[0])(jnp.asarray(rows))
    for side_by_side in (False, True):
        found, _ = kernel.of_many(form, rows, side_by_side=side_by_side)
        for own, other in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
            np.testing.assert_array_equal(own, other)
    assert (kernel_of(kernel, form.kept, side_by_side=True).of_lanes.side_by_side > 1) == as_vectors


def test_whole_numbers_and_bounds_of_which_the_lower_is_above_the_upper_are_as_in_jax():
    rows = 3 * np.random.default_rng(0).normal(size=(40, 5))
    kernel, form = KernelFunction(of_whole_numbers), Form.of((rows[0, :2], rows[0, 2:]))[0]
    with jax.enable_x64(True):
        expected = jax.vmap(lambda row: of_whole_numbers((row[:2], row[2:]), None)[0])(jnp.asarray(rows))
    for side_by_side in (False, True):
        found, _ = kernel.of_many(form, rows, side_by_side=side_by_side)
        for own, other in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
            np.testing.assert_array_equal(own, other)


def test_places_outside_of_a_table_and_division_by_zero_are_as_in_jax():
    """Neither of them is anything for C++; a division would end the process."""
    table, places = np.array([10.0, 20.0, 30.0]), np.array([0, 1, 2, 3, 7, -1, -3, -9, 5])
    kernel, form = KernelFunction(at_the_edges), Form.of((table, places[0], places[0]))[0]
    rows = np.concatenate([np.tile(table, (9, 1)), places[:, None], np.full((9, 1), -7)], axis=1).astype(float)
    with jax.enable_x64(True):
        own = jnp.asarray(table)
        expected = jax.vmap(lambda i: at_the_edges((own, i, jnp.asarray(-7)), None)[0])(places)
    for side_by_side in (False, True):
        found, _ = kernel.of_many(form, rows, side_by_side=side_by_side)
        for own, other in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
            np.testing.assert_array_equal(own, other)
