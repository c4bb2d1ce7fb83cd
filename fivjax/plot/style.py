"""Functions for all pictures: colours, labels with units, new figures, and errors for objects that cannot be drawn.

Figures are made without `pyplot`, so there is no global state. Colours are those of Okabe and Ito, and matplotlib's
perceptually uniform colour maps; lines differ in style as well, so that everyone can distinguish them, even in grey.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure
from matplotlib.legend import Legend
from matplotlib.patches import Patch

from ..foundation import arguments
from ..foundation.quantities import quantity_of
from ..model.structure import Structure
from ..simulation.trajectory import Trajectory

BLACK, ORANGE, SKY, GREEN, BLUE, VERMILION, PURPLE = (
    "#000000",
    "#E69F00",
    "#56B4E9",
    "#009E73",
    "#0072B2",
    "#D55E00",
    "#CC79A7",
)
# From dark to light; lines also differ in their dashes.
COLOURS = (BLACK, BLUE, VERMILION, GREEN, PURPLE, ORANGE, SKY)
DASHES = ("-", "--", "-.", ":")


def new_figure(figure: Figure | None, width: float, height: float) -> Figure:
    """The figure to draw into: the one given, or a new one of this size in inches."""
    return Figure(figsize=(width, height), layout="constrained") if figure is None else figure


def with_unit(text: str, unit: str) -> str:
    """A label with its unit; without one for pure numbers."""
    return text if unit == "1" else f"{text} ({unit.replace('2', '²')})"


def axis_label(name) -> str:
    """The label of a parameter or result, by its name in fivjax."""
    long_name, unit = quantity_of(str(name)) or (str(name), "1")
    symbols = {"mu": r" $\mu$", "p": " $p$"}
    return with_unit(long_name + symbols.get(str(name), ""), unit)


def variable_label(variable: xr.DataArray) -> str:
    """The label of a variable, from its own attributes."""
    long_name = variable.attrs.get("long_name", str(variable.name).replace("_", " "))
    return with_unit(str(long_name), variable.attrs.get("units", "1"))


def coordinate_label(structure: Structure, index: int) -> str:
    """The name of a coordinate with its direction at a contact, if any: "tangential x2", "normal y2", "y1"."""
    name = structure.coordinates[index]
    roles = {}
    for tangential, normal in structure.places:
        roles.update({tangential: "tangential", normal: "normal"})
    role = roles.get(index)
    return name if role is None else f"{role} {name}"


def cell_edges(values: np.ndarray) -> np.ndarray:
    """The edges of cells around the values of an axis; a single value has a cell, too."""
    values = np.asarray(values, float)
    if not len(values):
        raise ValueError("A picture needs values along its axes, but one has none. Select less narrowly.")
    if len(values) == 1:
        half = 0.5 * abs(values[0]) or 0.5
        return np.array([values[0] - half, values[0] + half])
    middle = 0.5 * (values[:-1] + values[1:])
    return np.concatenate([[2 * values[0] - middle[0]], middle, [2 * values[-1] - middle[-1]]])


def fill_cells(axes: Axes, edges, where: np.ndarray, colour: str, label: str, alpha: float = 1.0) -> list[Patch]:
    """Fill the cells between these `edges` (along x, along y) where something holds, and give their entry in a legend; none
    where it holds nowhere.
    """
    if not where.any():
        return []
    shown = np.ma.masked_where(~where, np.ones(where.shape))
    axes.pcolormesh(*edges, shown, cmap=ListedColormap([colour]), alpha=alpha, rasterized=True)
    return [Patch(facecolor=colour, edgecolor="0.6", alpha=alpha, label=label)]


def legend_above(axes: Axes, handles=None, columns: int = 3) -> Legend:
    """A legend without frame above the right end of a panel, where it covers no curve."""
    options: dict[str, Any] = {"loc": "lower right", "bbox_to_anchor": (1, 1), "ncols": columns, "frameon": False}
    return axes.legend(**({} if handles is None else {"handles": handles}), **options)


def check_run(run) -> None:
    """Refuse anything but a trajectory; the error names the call that makes one."""
    if isinstance(run, xr.Dataset):
        raise TypeError(
            "Argument `run` must be a trajectory, as `fj.simulate` returns it, but is a dataset. Pass the trajectory itself; "
            "of a dataset, maps, modes and the like are drawn by `fj.show(dataset)`."
        )
    arguments.instance("run", run, Trajectory, "a trajectory, such as `fj.simulate(scene, 2.0)` returns")
    run.refuse_batch("A picture")


def check_runs(runs, *beside) -> None:
    """Refuse anything but a mapping of trajectories by label, and what lacks one of these labels `beside` it."""
    if not isinstance(runs, dict) or not runs:
        raise TypeError(
            'Argument `runs` must be trajectories by label, such as {"3 m/s": run}, but is '
            f"{'empty' if isinstance(runs, dict) else arguments.describe(runs)}."
        )
    for run in runs.values():
        check_run(run)
    for other in beside:
        missing = [label for label in runs if not isinstance(other, Mapping) or label not in other]
        if missing:
            raise ValueError(f"Cycles and windows must be given by the labels of `runs`, but {missing[0]!r} has none.")


def check_dataset(dataset, variables: tuple[str, ...], call: str, name: str = "dataset") -> None:
    """Refuse anything but a dataset with the variables of a picture; the error names the call whose result has them."""
    if isinstance(dataset, xr.Dataset):
        missing = [variable for variable in variables if variable not in dataset]
        if not missing:
            return
        held = ", ".join(map(str, dataset.data_vars)) or "nothing"
        described = f"a dataset without `{missing[0]}` (it holds: {held})"
    else:
        described = arguments.describe(dataset)
    raise TypeError(f"Argument `{name}` must be what `{call}` returns, but is {described}.")
