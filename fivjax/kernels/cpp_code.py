"""A JAX function as C++: everything that is known of its primitives, together."""

from . import cpp_elimination, cpp_loops, cpp_places
from .cpp_writer import Writer

RULES = cpp_places.RULES | cpp_loops.RULES


def writer(types: dict[str, str]) -> Writer:
    """A writer of code that is given variables of these types."""
    return Writer(RULES, cpp_elimination.CALLS, types)
