"""Checks on what users pass in: each failure is a sentence that names the argument, the rule and the value.

Values that are not known yet (inside `jit`, `grad` or `vmap`) cannot be checked and pass. A trajectory of a map whose values
are bad ends in a named status instead.
"""

import difflib
from collections.abc import Collection, Iterable, Mapping
from pathlib import Path

import jax
import numpy as np

from .digits import apart
from .precision import is_known

# Energies are products of two or three numbers that users give; they must be finite, too.
LARGEST = 1e100
# What JAX raises where the number of something traced is asked for.
NEEDS_NUMBERS = (
    jax.errors.TracerArrayConversionError,
    jax.errors.TracerIntegerConversionError,
    jax.errors.ConcretizationTypeError,
)


def real_number(
    name: str, value, *, minimum: float | None = None, above: float | None = None, maximum: float | None = None
) -> None:
    """Refuse anything but one finite real number within the stated bound."""
    if not is_known(value):
        return
    array = numeric_array(name, value)
    if array.shape != ():
        raise ValueError(
            f"Argument `{name}` must be one number, but has shape {array.shape}. For several values, pass them as an "
            f"axis of `bistability_map` or use `jax.vmap`."
        )
    number = array.item()
    if not np.isfinite(number):
        raise ValueError(f"Argument `{name}` must be finite, but is {number}.")
    if abs(number) > LARGEST:
        raise ValueError(
            f"Argument `{name}` must be at most {LARGEST:g} in size, because products of such numbers are computed, but is "
            f"{number:g}."
        )
    if minimum is not None and number < minimum:
        shown, bound = apart(number, minimum)
        rule = "non-negative" if minimum == 0 else f"at least {bound}"
        raise ValueError(f"Argument `{name}` must be {rule}, but is {shown}.")
    if above is not None and number <= above:
        shown, bound = apart(number, above)
        rule = "positive" if above == 0 else f"above {bound}"
        raise ValueError(f"Argument `{name}` must be {rule}, but is {shown}.")
    if maximum is not None and number > maximum:
        shown, bound = apart(number, maximum)
        raise ValueError(f"Argument `{name}` must be at most {bound}, but is {shown}.")


def each_number(name: str, value, count: int, **bounds):
    """One number, or one for each of `count` contacts; refuse anything else. A list for one contact is its number."""
    if not is_known(value):
        return value
    array = numeric_array(name, value)
    if array.shape == (1,) == (count,):
        value = array = array[0]
    if array.ndim == 0 or count == 1:
        real_number(name, value, **bounds)
        return value
    if array.shape != (count,):
        raise ValueError(
            f"Argument `{name}` must be one number or hold one for each of the {count} contacts, but has shape {array.shape}."
        )
    for one in array:
        real_number(name, one, **bounds)
    return value


def is_whole(value) -> bool:
    """Whether it is one whole number, of Python's or NumPy's; spans of time are made of those."""
    return isinstance(value, int | np.integer) and not isinstance(value, bool | np.timedelta64)


def whole_number(name: str, value, *, minimum: int) -> int:
    """`value` as an `int`, if it is one whole number of at least `minimum`; one of NumPy's can overflow."""
    if not is_whole(value) or value < minimum:
        raise ValueError(f"Argument `{name}` must be a whole number of at least {minimum}, but is {value!r}.")
    return int(value)


def numeric_array(name: str, value) -> np.ndarray:
    """`value` as a NumPy array of real numbers, or a sentence about what it is instead."""
    known(name, value)
    if hasattr(value, "toarray"):
        raise TypeError(f"Argument `{name}` must be an array, but is {describe(value)}: give it as `.toarray()`.")
    try:
        array = np.asarray(value)
    except (ValueError, TypeError):
        raise TypeError(f"Argument `{name}` must be numeric, but is {describe(value)}.") from None
    if np.ma.is_masked(value):
        raise ValueError(
            f"Argument `{name}` must have all its values, but some are masked. Drop them with `.compressed()`, or fill them."
        )
    if array.dtype.kind not in "iuf":
        # What makes an array one of objects is not always its first.
        others = (one for one in array.ravel().tolist() if isinstance(one, bool) or not isinstance(one, int | float))
        holds = f" that holds {describe(next(others, None))}" if array.ndim and array.size else ""
        raise TypeError(f"Argument `{name}` must be numeric, but is {describe(value)}{holds}.")
    return array


def pair(name: str, value, example: str, *, minimum: float | None = None) -> tuple[float, float]:
    """`value` as two numbers of Python's, if it holds two finite ones, the lower one first."""
    known(name, value)
    if np.shape(value) != (2,):
        raise ValueError(
            f"Argument `{name}` must be two numbers, the lower one first, such as {example}, but is {value!r}."
        )
    low, high = value
    real_number(f"{name}[0]", low, minimum=minimum)
    real_number(f"{name}[1]", high, above=float(low))
    return float(low), float(high)


def bounds_about(name: str, pair, own: float) -> np.ndarray:
    """The lowest and the highest value that the parameter `name` may take, between which its `own` value lies."""
    pair = numeric_array(f"bounds[{name!r}]", pair)
    if pair.shape != (2,) or not np.all(np.isfinite(pair)) or pair[0] >= pair[1] or not pair[0] <= own <= pair[1]:
        raise ValueError(
            f"The bounds of `{name}` must be two numbers that hold its own value {own:g}, the lower one first, but are "
            f"{pair.tolist()}."
        )
    return pair


def axis(name: str, values) -> np.ndarray:
    """The values of one axis of a batch: one-dimensional, not empty, finite, strictly increasing."""
    array = numeric_array(name, values).astype(np.float64)
    if array.ndim == 0:
        array = array[None]
    if array.ndim != 1:
        raise ValueError(f"Axis `{name}` must be one-dimensional, but has shape {array.shape}.")
    if array.size == 0:
        raise ValueError(f"Axis `{name}` must hold at least one value, but is empty.")
    if not np.all(np.isfinite(array)):
        raise ValueError(f"Axis `{name}` must be finite, but holds {array[~np.isfinite(array)][0]}.")
    steps = np.diff(array)
    if np.any(steps <= 0):
        at = int(np.argmax(steps <= 0))
        before, after = apart(*array[at : at + 2])
        raise ValueError(
            f"Axis `{name}` must be strictly increasing, but goes from {before} to {after} "
            f"(values {at} and {at + 1}). Sort it and drop repeats, for instance with `numpy.unique`."
        )
    return array


def known(name: str, value) -> None:
    """Refuse numbers that a JAX transformation traces, in functions whose course depends on the numbers themselves."""
    if not is_known(jax.tree.leaves(value)):
        raise TypeError(
            f"Argument `{name}` must hold known numbers, but is traced by `jax.jit`, `jax.vmap` or a derivative around this "
            "call. Call this function outside of them. Many parameters go on the axes of `bistability_map`; derivatives are "
            "given by `cycle_derivatives` and by `critical_perturbation(..., derivatives=True)`, and in linear theory "
            "`cea.critical_friction` and `cea.growth_rate` have them."
        )


def instance(name: str, value, kinds: type | tuple[type, ...], example: str) -> None:
    """Refuse a value of the wrong type, with an example of the right one."""
    if not isinstance(value, kinds):
        raise TypeError(f"Argument `{name}` must be {example}, but is {describe(value)}.")


def one_of(name: str, value, choices: Iterable[str]) -> None:
    """Refuse a word that is not among the choices."""
    choices = list(choices)
    # An array compares as one.
    is_array = hasattr(value, "shape") and not isinstance(value, str)
    if is_array or value not in choices:
        listed = ", ".join(f'"{choice}"' for choice in choices)
        said = describe(value) if is_array else repr(value)
        raise ValueError(
            f"Argument `{name}` must be one of {listed}, but is {said}.{did_you_mean(str(value), choices)}"
        )


def is_listed(value) -> bool:
    """Whether it holds values one after the other: no text, no dictionary, and no single one."""
    # An array without axes is iterable by its type alone.
    return isinstance(value, Iterable) and not isinstance(value, str | Mapping) and getattr(value, "ndim", 1) > 0


def listed_names(name: str, value, example: str) -> tuple[str, ...]:
    """The names in a list; one name may stand for itself."""
    if isinstance(value, str):
        return (str(value),)
    names = tuple(value) if is_listed(value) else ()
    if not is_listed(value) or not all(isinstance(one, str) for one in names):
        raise TypeError(f'Argument `{name}` must be a list of names, such as ["{example}"], but is {describe(value)}.')
    # Those of an array are NumPy's own, which JAX takes for arrays.
    return tuple(map(str, names))


def by_name(name: str, value, example: str) -> dict:
    """A dictionary, whose values are still to be checked; empty where none is given."""
    if value is None:
        return {}
    if not isinstance(value, Mapping):
        raise TypeError(f"Argument `{name}` must be a dictionary, such as {{{example}}}, but is {describe(value)}.")
    return dict(value)


def path(name: str, value) -> Path:
    """A path, from a string or a path."""
    if not isinstance(value, str | Path):
        raise TypeError(f"Argument `{name}` must be a path, as a string or a `pathlib.Path`, but is {describe(value)}.")
    if "\0" in str(value):
        raise ValueError(
            f"Argument `{name}` must not hold the character NUL, but is {str(value)!r}. Give another path."
        )
    return Path(value)


def did_you_mean(name: str, known: Iterable[str]) -> str:
    """ " Did you mean `k1`?", for a name that is none of those known but close to one; else nothing."""
    near = difflib.get_close_matches(str(name), known, n=1)
    return f" Did you mean `{near[0]}`?" if near else ""


def names_of_parameters(name: str, names: Collection[str], known: Iterable[str]) -> None:
    """Refuse an empty list of names, and any that is not a parameter of the scene."""
    known = sorted(known)
    unknown = next((one for one in names if one not in known), None)
    if unknown is not None or not names:
        said = "is empty" if unknown is None else f"has {unknown!r}"
        near = "" if unknown is None else did_you_mean(unknown, known)
        raise ValueError(
            f"Argument `{name}` must name parameters of the scene, but {said}; they are: {', '.join(known)}.{near}"
        )


def single_numbers(name: str, names: Iterable[str], values: Mapping) -> None:
    """Refuse names of parameters whose values hold a number for each contact."""
    for one in names:
        if np.ndim(values[one]):
            raise ValueError(
                f"Argument `{name}` must name parameters that are single numbers, but `{one}` holds one for each contact. "
                f"Give the scene one number for all contacts."
            )


def describe(value) -> str:
    """A short description of a value for an error message."""
    if isinstance(value, str | bool | int | float | complex | type(None)):
        return f"{value!r} ({type(value).__name__})"
    if isinstance(value, np.ndarray | jax.Array):
        return f"an array of {value.dtype} with shape {value.shape}"
    if isinstance(value, list | tuple) and not value:
        return f"an empty {type(value).__name__}"
    return f"of type {type(value).__name__}"


def truth(name: str, value) -> None:
    """Refuse what is not True or False."""
    if not isinstance(value, bool | np.bool_):
        raise TypeError(f"Argument `{name}` must be True or False, but is {describe(value)}.")
