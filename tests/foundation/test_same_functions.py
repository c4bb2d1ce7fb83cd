"""Functions that are made anew are the same as long as all that they read is."""

import math

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
    first = reads_what_is_around_it(1)
    assert first_like(first) is first or first_like(first)(0.5) == first(0.5)
    for number, other in ((1, 2), (1, 1.0), (0.0, -0.0), (1, True)):
        assert first_like(reads_what_is_around_it(number)) is not first_like(reads_what_is_around_it(other))


def test_what_its_module_has_by_then_counts(monkeypatch):
    """Rejects code alone: a notebook's next cell may have another number, for the function or for what it calls."""
    before = [first_like(make(1)) for make in (reads_a_number, calls_another)]
    monkeypatch.setitem(globals(), "SIZE", 3.0)
    after = [first_like(make(1)) for make in (reads_a_number, calls_another)]
    assert all(one is not other for one, other in zip(before, after, strict=True))


def test_what_is_no_function_of_python_is_itself():
    for one in (print, jnp.sin, math.sin, np.add):
        assert first_like(one) is one
