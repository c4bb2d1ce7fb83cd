"""Values and the structure of trees as text (JSON), which carries no code: reading it calls nothing that it names.

It has tuples, lists, dictionaries, named tuples and modules of this package, and in them numbers, strings and structures.
Classes are written by name, and only names of this package are read.
"""

import dataclasses
import json
import sys
from typing import Any

import equinox as eqx
import jax

PACKAGE = __name__.partition(".")[0]


class NotPlain(Exception):
    """Something that has no such text."""


def to_text(value) -> str:
    """A value as text.

    **Raises:** `NotPlain` if it could not be read back the same.
    """
    text = json.dumps(_written(value))
    if repr(from_text(text)) != repr(value):
        raise NotPlain(repr(value))
    return text


def from_text(text: str | bytes) -> Any:
    """The value again.

    **Raises:** `NotPlain` or `ValueError` if the text is none of `to_text`.
    """
    return _read(json.loads(text))


def structure_to_text(structure: jax.tree_util.PyTreeDef) -> str:
    """The structure of a tree as text.

    **Raises:** `NotPlain` if it could not be read back the same.
    """
    text = json.dumps(_written(structure))
    if _read(json.loads(text)) != structure:
        raise NotPlain(repr(structure))
    return text


def with_zeros(structure: jax.tree_util.PyTreeDef) -> Any:
    """A tree of this structure."""
    return jax.tree.unflatten(structure, [0.0] * structure.num_leaves)


def _written(value) -> Any:
    if value is None or type(value) in (bool, int, float, str):
        return value
    if isinstance(value, jax.tree_util.PyTreeDef):
        return {"structure": _written(with_zeros(value))}
    if type(value) in (tuple, list):
        return {type(value).__name__: [_written(part) for part in value]}
    if type(value) is dict:
        return {"dict": [[_written(key), _written(part)] for key, part in value.items()]}
    if _is_own(type(value)):
        return {"class": f"{type(value).__module__}:{type(value).__qualname__}", "fields": _written(_fields(value))}
    raise NotPlain(repr(value))


def _read(plain) -> Any:
    match plain:
        case None | bool() | int() | float() | str():
            return plain
        case {"structure": tree}:
            return jax.tree.structure(_read(tree))
        case {"tuple": [*parts]}:
            return tuple(map(_read, parts))
        case {"list": [*parts]}:
            return list(map(_read, parts))
        case {"dict": [*pairs]}:
            return {_read(key): _read(part) for key, part in pairs}
        case {"class": str(name), "fields": fields}:
            return _with_fields(_class_of(name), _read(fields))
    raise NotPlain(repr(plain))


def _is_own(kind: type) -> bool:
    """Whether it is a named tuple or a module of this package."""
    return kind.__module__.partition(".")[0] == PACKAGE and (
        issubclass(kind, eqx.Module) or (issubclass(kind, tuple) and hasattr(kind, "_fields"))
    )


def _class_of(name: str) -> type:
    module, _, path = name.partition(":")
    if module.partition(".")[0] != PACKAGE:
        raise NotPlain(name)
    # Who makes such a value has imported its class; nothing is imported for the sake of a text.
    found: Any = sys.modules.get(module)
    for part in path.split("."):
        found = getattr(found, part, None)
    if not (isinstance(found, type) and _is_own(found)):
        raise NotPlain(name)
    return found


def _fields(value) -> dict[str, Any]:
    if isinstance(value, tuple):
        return value._asdict()
    # Fields that were not set have no value.
    names = [field.name for field in dataclasses.fields(value)]
    return {name: getattr(value, name) for name in names if name in vars(value)}


def _with_fields(kind: type, fields) -> Any:
    """An object with these fields, as JAX makes them: without the class' own `__init__`."""
    if not isinstance(fields, dict):
        raise NotPlain(repr(fields))
    if issubclass(kind, tuple):
        if list(fields) != list(kind._fields):
            raise NotPlain(repr(fields))
        return tuple.__new__(kind, fields.values())
    if not set(fields) <= {field.name for field in dataclasses.fields(kind)}:
        raise NotPlain(repr(fields))
    found = object.__new__(kind)
    for name, part in fields.items():
        object.__setattr__(found, name, part)
    return found
