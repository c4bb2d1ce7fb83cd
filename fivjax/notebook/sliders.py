"""The explorer's sliders: which parameters have one, their ranges and steps, and their layout."""

import re
from collections.abc import Mapping

import numpy as np

from ..foundation.quantities import quantity_of
from ..model.scene import Scene

FIRST = ("mu", "mu_static", "mu_dynamic", "p", "belt_speed")
RANGES = {
    "mu": (0.0, 0.6),
    "mu_static": (0.0, 0.8),
    "mu_dynamic": (0.0, 0.8),
    "p": (1.0, 3.0),
    "belt_speed": (0.1, 10.0),
}
# Sliders keep their width; in a narrow notebook the picture moves below them.
SLIDER = {"width": "330px", "min_width": "330px", "flex": "0 0 auto"}
BESIDE = {"flex_flow": "row wrap", "align_items": "flex-start"}
PICTURE = {"flex": "1 1 480px", "max_width": "680px"}


def parameters_shown(scene: Scene, also: Mapping) -> list[str]:
    """The names of the parameters that have a slider, in order."""
    # A parameter with a value for each contact has none.
    single = [name for name, value in scene.parameters.items() if np.ndim(value) == 0]
    first = [name for kind in FIRST for name in single if name == kind or _kind(name) == kind]
    return list(dict.fromkeys([*first, *scene.structure.parameters, *also]))


def _kind(name: str) -> str:
    """The name without the contact's number: `mu` of `mu_1`."""
    return re.sub(r"_\d+$", "", name)


def slider(widgets, name: str, value: float, ranges: Mapping, axes: Mapping):
    """A slider for one parameter; its range includes the scene's value and both ends of the map's axis of that name."""
    # The range of a structure's parameters, relative to their values.
    shares = (0.5, 1.5)
    usual = RANGES.get(_kind(name)) or tuple(share * abs(value) for share in shares)
    low, high = ranges[name] if name in ranges else (usual if value >= 0 else (-usual[1], -usual[0]))
    reached = [value, *([axes[name][0], axes[name][-1]] if name in axes else [])]
    low, high = float(min(low, *reached)), float(max(high, *reached))
    if low == high:
        high = low + 1.0
    # Steps of 1, 2 or 5 times a power of ten, at least five hundred of them, so that typed values are multiples of a step.
    finest = (high - low) / 500
    power = 10.0 ** np.floor(np.log10(finest))
    step = float(power * max(k for k in (1, 2, 5) if k <= finest / power * (1 + 1e-9)))
    # A browser rounds to steps from the lower end, so the scene's value must be a whole number of steps from it.
    low = max(low, float(np.round(value - step * np.floor((value - low) / step + 1e-9), 12)))
    _, unit = quantity_of(name) or (name, "1")
    return widgets.FloatSlider(
        value,
        min=low,
        max=high,
        step=step,
        description=name if unit == "1" else f"{name} ({unit})",
        readout_format=f".{max(0, -int(np.floor(np.log10(step) + 1e-9)))}f",
        style={"description_width": "9em"},
        layout=SLIDER,
    )
