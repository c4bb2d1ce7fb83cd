"""A JAX function as C++: everything that is known of its primitives, together."""

from . import cpp_elimination, cpp_loops, cpp_places, cpp_reductions
from .cpp_writer import Writer

RULES = cpp_places.RULES | cpp_reductions.RULES | cpp_loops.RULES


def writer(types: dict[str, str], lanes: bool = False) -> Writer:
    """A writer of code that is given variables of these types, for one lane or for several side by side."""
    return Writer(RULES, cpp_elimination.CALLS, types, lanes)
