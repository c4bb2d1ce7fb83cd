"""A digest of what JAX traces of a function: it tells whether code from outside still computes the same.

The name of a class or a function does not tell what it does. What it is traced to does: the operations, their order and their
constants. Neither names nor addresses nor lines of source enter the digest, so it is the same in every process and under every
version of Python; another version of JAX may trace the same code to other operations.
"""

import dataclasses
import enum
import functools
import hashlib
import re
import sys
import types
from collections.abc import Callable, Mapping

import equinox as eqx
import jax
import numpy as np
from jax.extend import core

from .kept_programs import KNOWN_PACKAGES

# Parameters of operations that name things, or that make derivatives of a function only when these are asked for.
NAMES = ("name", "jvp_jaxpr_thunk", "jvp_jaxpr_fun", "fwd_jaxpr_thunk", "fwd", "bwd", "debug_info", "debug")


def digest(function: Callable, *args) -> str:
    """A digest of what `function(*args)` is traced to. Arrays stand for their shapes and types, everything else for itself.

    A function that cannot be traced is told by its byte code, which depends on the version of Python.
    """
    told = hashlib.sha256()
    arrays, rest = eqx.partition(args, eqx.is_array)
    try:
        traced = jax.make_jaxpr(lambda arrays: jax.tree.leaves(function(*eqx.combine(arrays, rest))))(arrays)
    except Exception:  # of any kind, because the code is somebody else's
        _tell(told, (function, args), [])
    else:
        _tell(told, traced, [])
    return told.hexdigest()[:40]


def is_from_outside(what) -> bool:
    """Whether an object, or a part of it, has a class or is a function that no version of a known package fixes."""
    kind = what if isinstance(what, type | types.FunctionType) else type(what)
    if (kind.__module__ or "").partition(".")[0] not in KNOWN_PACKAGES:
        return True
    if isinstance(what, tuple | list):
        return any(map(is_from_outside, what))
    if isinstance(what, functools.partial):
        return any(map(is_from_outside, (what.func, *what.args, *what.keywords.values())))
    if dataclasses.is_dataclass(what) and not isinstance(what, type):
        return any(is_from_outside(getattr(what, field.name, None)) for field in dataclasses.fields(what))
    return False


def _tell(told, what, inside: list) -> None:
    """Add an object to the digest: its value, never its address. `inside` are the objects that contain it."""
    told.update(f"<{type(what).__name__}".encode())
    if any(what is one for one in inside):
        return
    inside = [*inside, what]

    def tell(*parts) -> None:
        for part in parts:
            _tell(told, part, inside)

    if isinstance(what, core.Jaxpr):
        _tell_operations(told, what, inside)
        # In newer versions of JAX it holds its constants itself.
        tell(list(getattr(what, "consts", ())))
    elif isinstance(what, core.ClosedJaxpr):
        tell(what.jaxpr, list(what.consts))
    elif isinstance(what, str | bytes | bool | int | float | complex | type(None) | np.dtype | enum.Enum):
        told.update(repr(what).encode())
    elif isinstance(what, np.ndarray | np.generic | jax.Array):
        array = np.asarray(what)
        told.update(f"{array.dtype}{array.shape}".encode() + array.tobytes())
    elif isinstance(what, Mapping):
        for name in sorted(what, key=str):
            tell(str(name), what[name])
    elif isinstance(what, tuple | list):
        tell(*what)
    elif isinstance(what, set | frozenset):
        told.update(repr(sorted(map(str, what))).encode())
    elif isinstance(what, types.CodeType):
        told.update(f"{sys.version_info[:2]}".encode() + what.co_code)
        tell(what.co_names, what.co_consts)
    elif isinstance(what, type):
        _tell_class(told, what, inside)
    elif isinstance(what, types.FunctionType):
        told.update(what.__qualname__.encode())
        if is_from_outside(what):
            cells = [_content(cell) for cell in what.__closure__ or ()]
            tell(what.__code__, what.__defaults__, what.__kwdefaults__, cells)
    elif isinstance(what, types.MethodType | functools.partial):
        tell(what.__func__, what.__self__) if isinstance(what, types.MethodType) else tell(
            what.func, what.args, what.keywords
        )
    elif dataclasses.is_dataclass(what):
        tell(type(what), *(getattr(what, field.name, None) for field in dataclasses.fields(what)))
    else:
        told.update(re.sub(r" at 0x[0-9a-f]+", "", repr(what)).encode())


def _tell_operations(told, jaxpr, inside: list) -> None:
    numbers: dict = {}

    def variable(one) -> None:
        if isinstance(one, core.Literal):
            _tell(told, one.val, inside)
            told.update(str(one.aval).encode())
        else:
            told.update(f"v{numbers.setdefault(one, len(numbers))}:{one.aval}".encode())

    for one in (*jaxpr.constvars, *jaxpr.invars):
        variable(one)
    for operation in jaxpr.eqns:
        told.update(f";{operation.primitive.name}".encode())
        for one in (*operation.invars, *operation.outvars):
            variable(one)
        _tell(told, {name: value for name, value in operation.params.items() if name not in NAMES}, inside)
    told.update(b"->")
    for one in jaxpr.outvars:
        variable(one)


def _tell_class(told, kind: type, inside: list) -> None:
    told.update(kind.__qualname__.encode())
    if is_from_outside(kind):
        for base in kind.__mro__:
            if is_from_outside(base):
                for name, value in sorted(vars(base).items()):
                    if isinstance(value, types.FunctionType | property | staticmethod | classmethod):
                        inner = value.fget if isinstance(value, property) else getattr(value, "__func__", value)
                        _tell(told, (name, inner), inside)


def _content(cell):
    try:
        return cell.cell_contents
    except ValueError:  # not assigned yet
        return None
