"""Functions that are made anew are the same as long as all that they read is."""

import functools
import math
from collections import namedtuple

import jax.numpy as jnp
import numpy as np

from fivjax.foundation.same_functions import first_like

SIZE, ARRAY = 2.0, np.ones(2)


def _doubled(x):
    return SIZE * x


def reads_a_number(_):
    return lambda x: jnp.sin(x) * SIZE


def reads_what_is_around_it(k):
    return lambda x: jnp.sin(x) * k


def reads_an_array(_):
    return lambda x: jnp.sin(x) * ARRAY


def calls_another(_):
    return lambda x: _doubled(x) + math.pi


def calls_itself(_):
    def function(x):
        return function(x - 1) if x > 0 else x

    return function


def test_one_that_is_made_anew_is_the_first_unless_what_it_reads_may_change():
    for make in (reads_a_number, reads_what_is_around_it, calls_another, calls_itself):
        assert make(1) is not make(1) and first_like(make(1)) is first_like(make(1))
    assert first_like(reads_an_array(1)) is not first_like(reads_an_array(1))
    for number, other in ((1, 2), (1, 1.0), (0.0, -0.0), (1, True)):
        assert first_like(reads_what_is_around_it(number)) is not first_like(reads_what_is_around_it(other))


def test_what_its_module_has_by_then_counts(monkeypatch):
    """Rejects code alone: a notebook's next cell may have another number, for the function or for what it calls."""
    before = [first_like(make(1)) for make in (reads_a_number, calls_another)]
    monkeypatch.setitem(globals(), "SIZE", 3.0)
    after = [first_like(make(1)) for make in (reads_a_number, calls_another)]
    assert all(one is not other for one, other in zip(before, after, strict=True))


def in_a_loop(factors):
    """Functions that share what they read, which is another number when the next one is made."""
    for factor in factors:
        yield first_like(lambda x: factor * x)  # noqa: B023


def test_functions_that_share_what_they_read_are_told_by_what_it_is_now():
    assert [function(1.0) for function in in_a_loop((1.0, 2.0))] == [1.0, 2.0]
    assert [function(1.0) for function in in_a_loop((1.0, 2.0))] == [1.0, 2.0]


def test_what_may_change_unseen_is_never_the_same():
    def of(value):
        return lambda x: x * value

    def with_a_number_of_its_own():
        function = of(1.0)
        function.scale = 2.0
        return function

    def importing():
        def function(x):
            import math as own

            return own.pi * x

        return function

    kinds = [namedtuple("Pair", names)(1.0, 2.0) for names in ("a b", "b a")]
    for make in (with_a_number_of_its_own, importing, lambda: of(np.poly1d([1.0])), lambda: of(functools.partial(abs))):
        assert first_like(make()) is not first_like(make())
    assert first_like(of(kinds[0])) is not first_like(of(kinds[1]))


def test_what_is_no_function_of_python_is_itself():
    for one in (print, jnp.sin, math.sin, np.add):
        assert first_like(one) is one
