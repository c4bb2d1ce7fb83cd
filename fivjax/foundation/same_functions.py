"""Functions that are made anew by each call of the function around them, and told apart by JAX although they are the same."""

import dis
import sys
import threading
import types
from collections.abc import Callable

import numpy as np

from .kept_programs import KNOWN_PACKAGES

# The latest ones, by what is told of them.
_seen: dict[tuple, Callable] = {}
MOST = 1000
# The instruction of an import inside a function.
IMPORTS = dis.opmap["IMPORT_NAME"]
_lock = threading.Lock()


def first_like(function: Callable[..., tuple]) -> Callable[..., tuple]:
    """The first function seen with the same code that reads the same values; the function itself where that cannot be told.

    JAX knows functions by their identity. What is traced of one would be traced again for each that is made anew, and data that
    hold different ones do not go together.
    """
    told = _told_now(function)
    if told is None:
        return function
    with _lock:
        found = _seen.get(told)
        # What functions of one loop read may change after they are made.
        if found is None or _told_now(found) != told:
            found = _seen[told] = function
        if len(_seen) > MOST:
            del _seen[next(iter(_seen))]
    return found


def _told_now(function: Callable) -> tuple | None:
    """What tells a function from others at this moment; None where that cannot be told."""
    if type(function) is not types.FunctionType:
        return None
    try:
        return _told(function, {})
    except _CannotTell:
        return None


class _CannotTell(Exception):
    pass


def _told(function: types.FunctionType, before: dict) -> tuple:
    """The code of a function, and all that it reads from elsewhere; functions `before` it, with their numbers, are told."""
    if function in before:
        return "again", before[function]
    before[function] = len(before)
    if function.__dict__:
        raise _CannotTell
    try:
        closed_over = tuple(cell.cell_contents for cell in function.__closure__ or ())
    except ValueError:  # not there yet
        raise _CannotTell from None
    known = function.__globals__
    read = tuple((name, known[name]) for name in sorted(_names(function.__code__)) if name in known)
    defaults = function.__defaults__, tuple(sorted((function.__kwdefaults__ or {}).items()))
    return function.__module__, function.__code__, _value((defaults, closed_over, read), before)


def _names(code: types.CodeType) -> set[str]:
    """The names that code may read from its module, and code within it."""
    if IMPORTS in code.co_code[::2]:
        raise _CannotTell
    inner = [one for one in code.co_consts if isinstance(one, types.CodeType)]
    return set(code.co_names).union(*map(_names, inner))


def _value(one, before: dict) -> tuple:
    """A value that never changes, told apart from others that are equal to it."""
    if one is None or type(one) in (bool, int, float, complex, str, bytes):
        return type(one), repr(one)
    if type(one) is tuple:
        return tuple, *(_value(part, before) for part in one)
    name = one.__name__ if type(one) is types.ModuleType else getattr(one, "__module__", None) or ""
    package, is_jitted = name.partition(".")[0], type(one).__name__ == "PjitFunction"
    fixed = isinstance(one, types.ModuleType | types.FunctionType | types.BuiltinFunctionType | type | np.ufunc)
    if (fixed or is_jitted) and (package in KNOWN_PACKAGES or package in sys.stdlib_module_names):
        return type(one), one
    if type(one) is types.FunctionType:
        return _told(one, before)
    raise _CannotTell
