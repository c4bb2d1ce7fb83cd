"""The cost of accuracy: the picture of `fj.tradeoff`."""

import numpy as np
import xarray as xr
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from .style import BLUE, check_dataset, new_figure


def tradeoff(dataset: xr.Dataset, *, figure: Figure | None = None) -> Figure:
    """A work–precision diagram of `fj.tradeoff`: the cost of a trajectory per period over the error of its state.

    Each method has its own marker, named in the legend; markers of single precision are hollow.

    **Raises:** `TypeError` for anything but the result of `fj.tradeoff`.
    """
    check_dataset(dataset, ("state_error", "cost"), "fj.tradeoff(scene)")
    figure = new_figure(figure, 8.4, 4.8)
    axes = figure.add_subplot(xscale="log", yscale="log")
    handles = []
    # One for each method, filled for double precision.
    markers = "os^Dv<>pPX*hd"
    for k, name in enumerate(dataset["stepper"].values):
        marker = markers[k % len(markers)]
        handles.append(Line2D([], [], color=BLUE, ls="", marker=marker, label=str(name)))
        for kind in dataset["precision"].values:
            point = dataset.sel(stepper=name, precision=kind)
            cost, error = 1e6 * float(point["cost"]), float(point["state_error"])
            if np.isfinite(error) and error > 0:
                fill = BLUE if kind == "float64" else "white"
                axes.plot(cost, error, ls="", marker=marker, ms=7, color=BLUE, mfc=fill, zorder=3)
    if "float32" in dataset["precision"].values:
        handles.append(Line2D([], [], color=BLUE, ls="", marker="o", mfc="white", label="hollow: float32"))
    axes.set_xlabel("time for one period of one trajectory (µs)")
    axes.set_ylabel("relative error of the state")
    axes.margins(x=0.1)
    axes.grid(alpha=0.3, which="major")
    figure.legend(handles=handles, loc="outside right upper", frameon=False)
    return figure
