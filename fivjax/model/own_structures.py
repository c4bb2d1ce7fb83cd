"""Structures by functions of one's own: what their parameters may be called, and those that this process has made, because
datasets hold none of their code, and find it here.
"""

import threading
from collections.abc import Callable, Hashable
from typing import Any

# Arguments of functions that take parameters by their names beside these: maps and parts of them, critical kicks, charts and
# curves of modes.
ARGUMENTS = frozenset(
    {
        *("self", "scene", "system", "direction", "method", "t_max", "memory", "max_steps", "progress", "resume"),
        *("energy", "refine", "sparse", "audit", "executor", "kick", "p_range", "p_step", "tolerance", "derivatives"),
        *("points", "most"),
    }
)
# A function of a structure's parameters by name.
Maker = Callable[..., Any]

# The most functions that are remembered, the newest: a notebook may define one again and again.
MOST = 64
_MADE: dict[Hashable, tuple[Callable, Maker]] = {}
_remembering = threading.Lock()


def check_name(name: str) -> None:
    """**Raises:** `ValueError` for what no parameter may be called."""
    if name in ARGUMENTS:
        raise ValueError(
            f"Argument `parameters` must not name one `{name}`: that is an argument of functions that take parameters by their "
            f"names, such as `bistability_map`. Give it another name."
        )


def remember(function: Callable, settings: Hashable, maker: Maker) -> None:
    """Remember how a structure is made of its parameters, by name; the `function` and its `settings` tell it from others."""
    key = id(function), settings
    with _remembering:
        _MADE.pop(key, None)
        _MADE[key] = function, maker
        if len(_MADE) > MOST:
            del _MADE[next(iter(_MADE))]


def remembered() -> list[Maker]:
    """How structures of this process were made, the newest first."""
    with _remembering:
        return [maker for _, maker in _MADE.values()][::-1]
