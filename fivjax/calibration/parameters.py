"""Free parameters of a fit: their names, their bounds, and the unbounded numbers that an optimiser changes."""

from collections.abc import Iterable, Mapping

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..foundation import arguments
from ..foundation.digits import apart
from ..model.scene import Scene

# Parameters that may be negative; all others are positive, unless bounds say otherwise for one that the scene takes.
SIGNED = ("theta", "belt_speed")
HIGHEST = {"restitution": 1.0}


class FreeParameters(eqx.Module):
    r"""The free parameters and their bounds.

    Between two bounds $x = l + (h - l) / (1 + e^{-u})$, above one $x = l + e^u$, without any $x = s u$; so the optimiser
    never leaves the bounds. `size` is a large change of each parameter: its own size, or the width of its bounds.
    """

    names: tuple[str, ...] = eqx.field(static=True)
    kinds: tuple[str, ...] = eqx.field(static=True)
    lower: Float[np.ndarray, " k"]
    upper: Float[np.ndarray, " k"]
    size: Float[np.ndarray, " k"]

    def __init__(self, scene: Scene, free: Iterable[str], bounds: Mapping[str, tuple[float, float]] | None = None):
        if isinstance(free, str):
            raise TypeError(f'Argument `free` must be a list of names, such as ["{free}"], but is {free!r} (str).')
        names = arguments.listed_names("free", free, "mu")
        if not names:
            raise ValueError("Argument `free` must name at least one parameter, but is empty.")
        bounds = arguments.by_name("bounds", bounds, '"mu": (0.1, 0.5)')
        known = scene.parameters
        for name in (*names, *bounds):
            if name not in known:
                near = arguments.did_you_mean(name, known)
                raise ValueError(f"Scene has no parameter `{name}`; it has: {', '.join(sorted(known))}.{near}")
        if len(set(names)) != len(names):
            raise ValueError(f"Argument `free` names a parameter twice: {', '.join(names)}.")
        for name in bounds:
            if name not in names:
                raise ValueError(
                    f"Argument `bounds` names `{name}`, which is not among the free ones: {', '.join(names)}."
                )
        lower, upper, size, kinds = [], [], [], []
        for name in names:
            refuse_one_for_each_contact(scene, name, "free")
            value = float(known[name])
            low, high = _bound(scene, name, bounds.get(name))
            if not low < value < high:
                least, most, own = apart(low, high, value)
                raise ValueError(
                    f"Parameter `{name}` must start inside its bounds ({least}, {most}), but is {own} in the scene. "
                    f"Widen `bounds`, or start elsewhere with `scene.replace`."
                )
            lower.append(low)
            upper.append(high)
            kinds.append("both" if np.isfinite([low, high]).all() else "lower" if np.isfinite(low) else "none")
            size.append(abs(value) if value else min(1.0, high - low))
        self.names, self.kinds = names, tuple(kinds)
        self.lower, self.upper, self.size = np.array(lower), np.array(upper), np.array(size)

    def values(self, u: Float[Array | np.ndarray, " k"]) -> Float[Array | np.ndarray, " k"]:
        """The parameters, in their own units; known ones by NumPy."""
        by = np if isinstance(u, np.ndarray) else jnp
        found = []
        for k, kind in enumerate(self.kinds):
            if kind == "both":
                # tanh does not overflow, and its derivative is not NaN.
                share = 0.5 * (1.0 + by.tanh(0.5 * u[k]))
                found.append(self.lower[k] + (self.upper[k] - self.lower[k]) * share)
            elif kind == "lower":
                found.append(self.lower[k] + self.size[k] * by.exp(u[k]))
            else:
                found.append(self.size[k] * u[k])
        return by.stack(found)

    def unbounded(self, values) -> np.ndarray:
        """The inverse of `values`; numbers outside the bounds are first moved inside."""
        # So far inside, as a share; and so near to a bound that `values` still has eight digits.
        moved, nearest = 1e-3, 1e-8
        found = []
        for k, kind in enumerate(self.kinds):
            value, low = float(values[k]), self.lower[k]
            if kind == "both":
                width = self.upper[k] - low
                least = nearest if low < value < self.upper[k] else moved
                share = np.clip((value - low) / width, least, 1 - least)
                found.append(np.log(share / (1 - share)))
            elif kind == "lower":
                share = (value - low) / self.size[k]
                found.append(np.log(max(share, nearest if value > low else moved)))
            else:
                found.append(value / self.size[k])
        return np.array(found)

    def scene(self, scene: Scene, u: Float[Array | np.ndarray, " k"]) -> Scene:
        """The scene with these parameters."""
        values = self.values(u)
        return scene.replace(**{name: values[k] for k, name in enumerate(self.names)})


def refuse_one_for_each_contact(scene: Scene, name: str, what: str) -> None:
    """Refuse a parameter that holds a value for each contact, where a single number is needed."""
    shape = np.shape(scene.parameters[name])
    if shape:
        raise ValueError(
            f"Parameter `{name}` cannot be {what}: the scene has one value for each of {shape[0]} contacts. Give the scene one "
            f"number for all contacts, or leave it out."
        )


def _bound(scene: Scene, name: str, bound) -> tuple[float, float]:
    value, highest = float(scene.parameters[name]), HIGHEST.get(name, np.inf)
    if bound is None:
        return -np.inf if name in SIGNED or value < 0 else 0.0, highest
    array = arguments.numeric_array(f"bounds[{name!r}]", bound).astype(np.float64)
    if array.shape != (2,) or np.any(np.isnan(array)) or not array[0] < array[1]:
        raise ValueError(f"Argument `bounds[{name!r}]` must be a pair that goes up, but is {bound!r}.")
    least = float(array[0]) if np.isfinite(array[0]) else -abs(value) - 1.0
    lowest = -np.inf if least >= 0 or _takes(scene, name, least) else 0.0
    low, high = max(float(array[0]), lowest), min(float(array[1]), highest)
    if np.isfinite(high) and not np.isfinite(low):
        raise ValueError(f"Argument `bounds[{name!r}]` must also have a finite lower end, but is {bound!r}.")
    return low, high


def _takes(scene: Scene, name: str, value: float) -> bool:
    try:
        scene.replace(**{name: value})
    except ValueError:
        return False
    return True
