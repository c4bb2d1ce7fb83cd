"""Structures by functions of one's own that this process has made: datasets hold none of their code, and find it here."""

from collections.abc import Callable, Hashable
from typing import Any

# A function of a structure's parameters by name.
Maker = Callable[..., Any]

# The most functions that are remembered, the newest: a notebook may define one again and again.
MOST = 64
_MADE: dict[Hashable, tuple[Callable, Maker]] = {}


def remember(function: Callable, settings: Hashable, maker: Maker) -> None:
    """Remember how a structure is made of its parameters, by name; the `function` and its `settings` tell it from others."""
    key = id(function), settings
    _MADE.pop(key, None)
    _MADE[key] = function, maker
    if len(_MADE) > MOST:
        del _MADE[next(iter(_MADE))]


def remembered() -> list[Maker]:
    """How structures of this process were made, the newest first."""
    return [maker for _, maker in _MADE.values()][::-1]
