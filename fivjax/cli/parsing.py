"""Parsing of options of the form `NAME=…`; each error shows the right form."""

import math
from collections.abc import Iterable
from pathlib import Path
from typing import TypeVar

import numpy as np
import tyro

from ..foundation.digits import apart, counted

T = TypeVar("T")


def axis(text: str, *, least: int = 1) -> tuple[str, np.ndarray]:
    """The name and values of an axis from `NAME=FROM:TO:COUNT`.

    **Raises:** `ValueError` for anything else, ends that are not finite or not increasing, and fewer than `least` values or
    more than ten million.
    """
    try:
        name, values = text.split("=")
        start, stop, count = values.split(":")
        low, high, points = float(start), float(stop), int(count)
    except ValueError:
        raise ValueError(
            f"An axis must read NAME=FROM:TO:COUNT, such as mu=0.05:0.228:64, but reads {text!r}."
        ) from None
    if points < least:
        raise ValueError(f"Axis `{name}` must have at least {counted(least, 'value')}, but its COUNT is {points}.")
    most_values = 10**7
    if points > most_values:
        raise ValueError(
            f"Axis `{name}` must have at most {most_values:,} values, but asks for {points:,}: {8 * points:,} bytes, before "
            f"anything is computed for them."
        )
    if not (math.isfinite(low) and math.isfinite(high)):
        raise ValueError(f"Axis `{name}` must be finite, but goes from {low:g} to {high:g}.")
    if points > 1 and not high > low:
        raise ValueError(f"Axis `{name}` must go up, but goes from {' to '.join(apart(low, high))}.")
    if name == "theta":
        for end in (low, high):
            check_angle(f"Axis `{name}`", end)
    return name, np.linspace(low, high, points)


def options() -> tyro.constructors.ConstructorRegistry:
    """How options are read: a word in place of a number is answered by a sentence, and what need not be given is named as what
    it is.
    """
    registry = tyro.constructors.ConstructorRegistry()

    def shown(value) -> list[str]:
        return ["none" if value is None else str(value)]

    @registry.primitive_rule
    def optional(info: tyro.constructors.PrimitiveTypeInfo) -> tyro.constructors.PrimitiveConstructorSpec | None:
        kind = {str | None: str, Path | None: Path}.get(info.type)
        if kind is None:
            return None
        return tyro.constructors.PrimitiveConstructorSpec(
            nargs=1,
            metavar="PATH" if kind is Path else "TEXT",
            instance_from_str=lambda words: kind(words[0]),
            is_instance=lambda value: value is None or isinstance(value, kind),
            str_from_instance=shown,
        )

    @registry.primitive_rule
    def rule(info: tyro.constructors.PrimitiveTypeInfo) -> tyro.constructors.PrimitiveConstructorSpec | None:
        kind = {float: float, float | None: float, int: int}.get(info.type)
        if kind is None:
            return None
        example, what = ("0.2", "a number") if kind is float else ("8", "a whole number")

        def read(words: list[str]) -> float | int:
            try:
                return kind(words[0])
            except ValueError:
                raise ValueError(f"it must be {what}, such as {example}, but is {words[0]!r}.") from None

        return tyro.constructors.PrimitiveConstructorSpec(
            nargs=1,
            metavar=kind.__name__.upper(),
            instance_from_str=read,
            is_instance=lambda value: value is None or isinstance(value, int | float),
            str_from_instance=shown,
        )

    return registry


def pairs(option: str, texts: Iterable[str], form: str = "COLUMN=…, such as `t=ms`") -> dict[str, str]:
    """The two sides of each text, such as `COLUMN=…`.

    **Raises:** `ValueError` for a text of another form, and for a name that comes twice.
    """

    def sides(text: str) -> tuple[str, str]:
        name, equals, meaning = text.partition("=")
        if not (name and equals and meaning):
            raise ValueError(f"Option `{option}` must read {form}, but reads {text!r}.")
        return name, meaning

    return by_name(option, map(sides, texts))


def by_name(option: str, named: Iterable[tuple[str, T]]) -> dict[str, T]:
    """What an option gives each name.

    **Raises:** `ValueError` for a name that comes twice.
    """
    found: dict[str, T] = {}
    for name, own in named:
        if name in found:
            raise ValueError(f"Option `{option}` must give each name once, but gives `{name}` twice.")
        found[name] = own
    return found


def refuse_repeated(arguments: Iterable[str]) -> None:
    """Refuse an option that is given twice: only the last of them would count.

    **Raises:** `ValueError` for it.
    """
    given = [text.partition("=")[0].replace("_", "-") for text in arguments if text.startswith("--")]
    given = [option.replace("--no-", "--", 1) for option in given]
    for option in given:
        if given.count(option) > 1:
            raise ValueError(
                f"Option `{option}` is there twice. Give it once; if it takes several values, write them one after the other."
            )


def bound(text: str) -> tuple[str, tuple[float, float]]:
    """The name and the two ends of `NAME=LOW:HIGH`."""
    try:
        name, values = text.split("=")
        low, high = map(float, values.split(":"))
    except ValueError:
        raise ValueError(f"A bound must read NAME=LOW:HIGH, such as mu=0.05:0.5, but reads {text!r}.") from None
    return name, (low, high)


def low_pass(text: str) -> tuple[float, int]:
    """The cut-off (Hz) and the order of `CUTOFF:ORDER`."""
    try:
        cutoff, order = text.split(":")
        return float(cutoff), int(order)
    except ValueError:
        raise ValueError(f"A filter must read CUTOFF:ORDER, such as 400:4, but reads {text!r}.") from None


def check_angle(what: str, angle: float) -> None:
    """Refuse an inclination of a right angle or more, which was probably meant in degrees."""
    if math.isfinite(angle) and abs(angle) >= 0.5 * math.pi:
        raise ValueError(
            f"{what} is in rad and must be less than a right angle, {0.5 * math.pi:.4f}, but is {angle:g}; "
            f"{angle:g} degrees are {math.radians(angle):.4g} rad."
        )
