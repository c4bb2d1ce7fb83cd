"""Functions of known values by NumPy: the same as by XLA, bit for bit where linear systems are solved."""

import json
import threading
import time
from concurrent.futures import ThreadPoolExecutor

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from fivjax.foundation import numpy_evaluation
from fivjax.foundation.blocks import in_threads
from fivjax.foundation.linear_solve import solve
from fivjax.foundation.matrix_routines import eigenvalues
from fivjax.foundation.numpy_evaluation import by_numpy
from fivjax.foundation.numpy_plans import NumpyPlan, numpy_plan_of
from fivjax.section.about_sliding import sliding_state

RANDOM = np.random.default_rng(3)


@pytest.mark.parametrize("size", [1, 3, 6])
def test_linear_systems_are_solved_as_by_elimination(size):
    """Small ones are written out, larger ones eliminated in a loop; one right side, or several."""
    with jax.enable_x64(True):
        matrix = RANDOM.normal(size=(size, size))
        for right in (RANDOM.normal(size=size), RANDOM.normal(size=(size, 2))):
            found = by_numpy(solve)(matrix, right)
            assert np.allclose(found, np.linalg.solve(matrix, right), rtol=1e-10)
            assert np.allclose(matrix @ found, right, rtol=1e-9)


def test_as_many_systems_as_unknowns_are_not_taken_for_one():
    with jax.enable_x64(True):
        matrix, right = RANDOM.normal(size=(3, 3)), RANDOM.normal(size=(3, 3))
        found = by_numpy(jax.vmap(solve, in_axes=(None, 0)))(matrix, right)
        assert np.allclose(found, np.linalg.solve(matrix, right.T).T, rtol=1e-10)


def test_the_hundred_and_first_call_gives_what_the_first_gives():
    """Then XLA computes it. Its arrays do not take a list as an index, so a derivative of several contacts failed in a long study."""
    doubled = by_numpy(lambda x: (2.0 * x, 2.0 * x[0]))
    with jax.enable_x64(True):
        for k in range(numpy_evaluation.REPAID + 2):
            array, number = doubled(np.array([1.0, float(k)]))
            assert type(array) is np.ndarray and type(number) is np.float64
            assert array.tolist() == [2.0, 2.0 * k] and number == 2.0


def test_what_is_kept_of_a_call_is_no_view_of_its_arguments():
    turned, x = by_numpy(lambda x: (x.T, x)), np.arange(4.0).reshape(2, 2)
    turned(x)
    x[:] = 99.0
    again, same = turned(np.arange(4.0).reshape(2, 2))
    assert again.tolist() == [[0.0, 2.0], [1.0, 3.0]] and same.tolist() == [[0.0, 1.0], [2.0, 3.0]]


def test_the_hundred_and_first_call_is_in_double_precision_too():
    sine = by_numpy(jnp.sin)
    found = [sine(np.float64(k)) for k in range(numpy_evaluation.REPAID + 3)]
    assert not jax.config.jax_enable_x64 and {one.dtype for one in found} == {np.dtype(np.float64)}
    np.testing.assert_allclose(found, np.sin(np.arange(len(found))), rtol=1e-14, atol=1e-15)


def test_names_may_be_strings_of_numpy():
    known = by_numpy(lambda names, x: len(names) * x)
    assert known((np.str_("mu"), np.array(["k1"])[0]), 3.0) == known(("mu", "k1"), 3.0) == 6.0


def test_a_singular_system_has_no_finite_solution():
    with jax.enable_x64(True):
        assert not np.all(np.isfinite(by_numpy(solve)(np.ones((2, 2)), np.array([1.0, 2.0]))))


def test_in_a_batch_each_leaves_its_loop_by_itself():
    """A loop whose condition differs within a batch goes on for the others."""

    def halvings(x):
        return jax.lax.while_loop(lambda carry: carry[0] > 1, lambda carry: (carry[0] / 2, carry[1] + 1), (x, 0))

    with jax.enable_x64(True):
        left, count = by_numpy(jax.vmap(halvings))(np.array([0.5, 3.0, 40.0]))
    assert left.tolist() == [0.5, 0.75, 0.625] and count.tolist() == [0, 2, 6]


def of_many_kinds(x, k):
    """Loops of all kinds, a branch, indices, and a linear system."""
    table = jnp.arange(12.0).reshape(4, 3) + x
    total, rows = jax.lax.scan(lambda total, row: (total + row.sum(), row * total), x, table, reverse=True)
    count = jax.lax.while_loop(lambda n: n * n < 50 + k, lambda n: n + 1, k)
    chosen = jax.lax.cond(k > 2, lambda row: -row, lambda row: row / 2, table[k])
    solved = solve(jnp.eye(3) * 3 + table[:3] / 9, chosen)
    columns = jnp.unstack(table, axis=1)
    return total, rows.at[k, 1].add(x), count * 3, solved, jnp.max(table, axis=1), table[::2].astype(int), columns[2]


def test_a_plan_is_text_and_gives_the_same():
    with jax.enable_x64(True):
        traced = jax.make_jaxpr(of_many_kinds)(0.0, 0)
        plan = json.loads(json.dumps(numpy_plan_of(traced)))
        for x, k in ((0.5, 1), (-2.0, 3)):
            expected = jax.jit(of_many_kinds)(x, k)
            found = NumpyPlan(plan)([np.asarray(x), np.asarray(k)])
            for own, other in zip(found, expected, strict=True):
                assert own.dtype == other.dtype
                np.testing.assert_allclose(own, other, rtol=1e-14)


@pytest.mark.parametrize(
    "function",
    [
        lambda x: jax.lax.linalg.eig(x[:4, :4]),
        lambda x: jax.vmap(eigenvalues)(jnp.stack([x[:3, :3], x[1:4, 1:4], x[:3, :3] * jnp.nan])),
        lambda x: jax.lax.sort((x > 0, x, -x), dimension=0, num_keys=2),
        lambda x: jax.lax.sort(jnp.where(x > 1, jnp.nan, x), dimension=1),
        lambda x: [jnp.cumsum(x, 1), jax.lax.cumsum(x, 0, reverse=True), jnp.cumsum(x > 0)],
        lambda x: [jax.lax.div(k := (9 * x).astype(int), 3 + 0 * k), jax.lax.rem(k, -4 + 0 * k), jnp.fmod(x, 0.3)],
        lambda x: [z := jax.lax.complex(x, 1 / (x - x[0, 0])), z.conj(), z.imag, z.real, z / (1 + 2j)],
    ],
)
def test_all_of_it_is_numpy_s_and_agrees_with_jax(function):
    x = np.random.default_rng(8).normal(size=(4, 5))
    with jax.enable_x64(True):
        plan = json.loads(json.dumps(numpy_plan_of(jax.make_jaxpr(function)(x))))
        with np.errstate(divide="ignore"):
            found, expected = NumpyPlan(plan)([x]), jax.tree.leaves(jax.jit(function)(x))
        for own, other in zip(found, expected, strict=True):
            assert own.dtype == other.dtype
            np.testing.assert_allclose(own, other, rtol=1e-13, atol=1e-14)


def test_numbers_beyond_all_whole_ones_are_the_nearest_of_them_as_in_jax():
    """NumPy has the lowest for all of them."""
    strange = np.array([1.5, -2.5, 3e9, -3e9, 1e300, -1e300, np.inf, -np.inf, np.nan, 2.0**63, -(2.0**63)])

    def whole(x):
        return [x.astype(kind) for kind in (jnp.int32, jnp.int64, jnp.uint32, jnp.int8)]

    with jax.enable_x64(True):
        for own, other in zip(by_numpy(whole, always=True)(strange), jax.jit(whole)(strange), strict=True):
            assert own.dtype == other.dtype
            np.testing.assert_array_equal(own, other)


def test_what_numpy_does_not_have_is_left_to_jax():
    """As a part of the function, which is then no text; and for indices outside of their array."""
    with jax.enable_x64(True):
        plan = numpy_plan_of(jax.make_jaxpr(lambda x: jax.scipy.special.erf(x) + 1)(0.5))
        with pytest.raises(TypeError, match="serializable"):
            json.dumps(plan)
        assert NumpyPlan(plan)([np.asarray(0.5)])[0] == pytest.approx(1.5204998778)
        beyond = by_numpy(lambda x, k: x.at[k].get(mode="fill", fill_value=-1.0))
        assert (
            float(beyond(np.arange(3.0), np.asarray(5))) == -1.0 and float(beyond(np.arange(3.0), np.asarray(1))) == 1.0
        )


def test_a_function_is_kept_only_under_its_own_name(monkeypatch, paper_scene):
    """Functions that others make of it have its name, too."""
    kept = []
    monkeypatch.setattr(numpy_evaluation, "kept_value", lambda make, form: kept.append(make.__name__) or make(form))
    with jax.enable_x64(True):
        by_numpy(jax.vmap(solve, in_axes=(None, 0)))(np.eye(3), np.ones((2, 3)))
        by_numpy(solve)(np.eye(2), np.ones(2))
        assert kept == []
        by_numpy(sliding_state.__wrapped__)(paper_scene, np.asarray(100.0))
        assert kept == []
        itself = by_numpy(sliding_state.__wrapped__)
        monkeypatch.setattr("fivjax.section.about_sliding.sliding_state", itself)
        itself(paper_scene, np.asarray(100.0))
        assert kept == ["sliding_state"]


def test_what_is_known_is_not_changed_by_later_calls():
    """Parts that depend on nothing are computed once, and each call has its own copy."""

    def function(x):
        table = jnp.arange(3.0) @ jnp.ones((3, 3))
        return table, table + x, jnp.where(x > 0, table, -table)

    with jax.enable_x64(True):
        own = by_numpy(function)
        own(np.float64(1.0))[0][:] = 7.0
        table, moved, chosen = own(np.float64(-2.0))
    assert table.tolist() == [3.0, 3.0, 3.0] and moved.tolist() == [1.0, 1.0, 1.0] and chosen.tolist() == [-3.0] * 3


def test_parts_are_run_once_each_also_where_no_other_thread_is_free():
    done, busy = [], threading.Event()
    with ThreadPoolExecutor(1) as pool:
        pool.submit(busy.wait)
        in_threads(done.append, range(5), pool, 2)
        busy.set()
    assert sorted(done) == list(range(5))


def test_where_one_thread_is_interrupted_the_others_have_ended_before_it_goes_on():
    """They write into arrays of the thread that is interrupted."""
    begun, written, caller = threading.Event(), [], threading.get_ident()

    def run(part):
        if threading.get_ident() == caller:
            assert begun.wait(60)
            raise KeyboardInterrupt
        begun.set()
        time.sleep(0.1)
        written.append(part)

    with ThreadPoolExecutor(1) as pool:
        with pytest.raises(KeyboardInterrupt):
            in_threads(run, range(9), pool, 2)
        at_once = list(written)
    assert at_once == written and len(written) == 1
