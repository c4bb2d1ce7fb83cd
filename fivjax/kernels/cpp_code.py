"""A JAX function as C++: everything that is known of its primitives, together; and the body of a C++ function of vectors."""

from collections.abc import Callable

import jax
import numpy as np

from ..foundation.precision import own_settings
from . import cpp_elimination, cpp_loops, cpp_places, cpp_reductions
from .cpp_arrays import View
from .cpp_numbers import text_of
from .cpp_writer import Writer

RULES = cpp_places.RULES | cpp_reductions.RULES | cpp_loops.RULES


def writer(types: dict[str, str], lanes: bool = False) -> Writer:
    """A writer of code that is given variables of these types, for one lane or for several side by side."""
    return Writer(RULES, cpp_elimination.CALLS, types, lanes)


def scalar_source(function: Callable, **lengths: int) -> tuple[str, int]:
    """The body of a C++ function of vectors of these lengths, by name, with the length of the vector `found` that it fills.

    `function` takes the vectors in double precision, in this order, and gives one vector of numbers of any type.

    **Raises:** `NotImplementedError` for a primitive of JAX that has no C++.
    """
    with own_settings():
        like = [jax.ShapeDtypeStruct((length,), np.float64) for length in lengths.values()]
        closed = jax.make_jaxpr(function)(*like)
        code = writer(dict.fromkeys(lengths, "double"))
        given = [code.small(View(name, (0,), (length,), (1,), "double")) for name, length in lengths.items()]
        with jax.ensure_compile_time_eval():
            (found,) = code.run(closed.jaxpr, closed.consts, given)
    entries = code.entries(found).ravel()
    ends = [f"found[{place}] = (double)({text_of(entry)});" for place, entry in enumerate(entries)]
    return "\n".join([code.source, *ends]), len(entries)
