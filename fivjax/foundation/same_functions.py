"""Functions that are made anew by each call of the function around them, and told apart by JAX although they are the same."""

import sys
import threading
import types
from collections.abc import Callable

from .kept_programs import KNOWN_PACKAGES

# The latest ones, by what is told of them.
_seen: dict[tuple, Callable] = {}
MOST = 1000
_lock = threading.Lock()


def first_like(function: Callable[..., tuple]) -> Callable[..., tuple]:
    """The first function seen with the same code that reads the same values; the function itself where that cannot be told.

    JAX knows functions by their identity. What is traced of one would be traced again for each that is made anew, and data that
    hold different ones do not go together.
    """
    if not isinstance(function, types.FunctionType):
        return function
    try:
        key = _told(function, ())
    except _CannotTell:
        return function
    with _lock:
        found = _seen.setdefault(key, function)
        if len(_seen) > MOST:
            del _seen[next(iter(_seen))]
    return found


class _CannotTell(Exception):
    pass


def _told(function: types.FunctionType, inside: tuple) -> tuple:
    """The code of a function, and all that it reads from elsewhere; `inside` are the functions that read it."""
    if function in inside:
        return ("itself", inside.index(function))
    try:
        closed_over = [cell.cell_contents for cell in function.__closure__ or ()]
    except ValueError:  # not there yet
        raise _CannotTell from None
    known = function.__globals__
    read = [(name, known[name]) for name in sorted(_names(function.__code__)) if name in known]
    defaults = function.__defaults__, tuple(sorted((function.__kwdefaults__ or {}).items()))
    values = _value((defaults, tuple(closed_over), tuple(read)), (*inside, function))
    return function.__module__, function.__code__, values


def _names(code: types.CodeType) -> set[str]:
    """The names that code may read from its module, and code within it."""
    inner = [one for one in code.co_consts if isinstance(one, types.CodeType)]
    return set(code.co_names).union(*map(_names, inner))


def _value(one, inside: tuple) -> tuple:
    """A value that never changes, told apart from others that are equal to it."""
    if one is None or isinstance(one, bool | int | float | complex | str | bytes):
        return type(one), repr(one)
    if isinstance(one, tuple):
        return tuple, *(_value(part, inside) for part in one)
    name = one.__name__ if isinstance(one, types.ModuleType) else getattr(one, "__module__", None) or ""
    package, fixed = name.partition(".")[0], isinstance(one, types.ModuleType) or callable(one)
    if fixed and (package in KNOWN_PACKAGES or package in sys.stdlib_module_names):
        return type(one), one
    if isinstance(one, types.FunctionType):
        return _told(one, inside)
    raise _CannotTell
