"""Pictures of the linear analysis, from datasets that `cea` has computed.

Each function takes a dataset and returns a matplotlib figure, a new one unless given. Colour-blind readers can distinguish the
colours, and they differ in grey; lines differ in style as well.
"""

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from .style import (
    BLACK,
    BLUE,
    COLOURS,
    DASHES,
    ORANGE,
    VERMILION,
    cell_edges,
    check_dataset,
    new_figure,
    variable_label,
)


def eigenvalues(dataset: xr.Dataset, *, figure: Figure | None = None) -> Figure:
    """Frequencies and growth rates of the modes over one parameter (Fig. 3), with the critical friction marked.

    `dataset` is from `cea.modes`. With a single value on the axis, points are drawn.

    **Raises:** `TypeError` for anything but modes.
    """
    check_dataset(dataset, ("frequency", "growth_rate"), "fj.cea.modes(structure, mu=np.linspace(0, 0.5, 501))")
    if dataset["frequency"].ndim != 2 or "mode" not in dataset["frequency"].dims:
        raise ValueError("This picture needs modes over a parameter, as `fj.cea.modes` returns them; select by slices.")
    figure = new_figure(figure, 6.4, 5.6)
    upper, lower = figure.subplots(2, 1, sharex=True)
    (name,) = (str(dim) for dim in dataset["frequency"].dims if dim != "mode")
    # A line through a single point cannot be seen.
    marker = "o" if dataset.sizes[name] == 1 else None
    for k, mode in enumerate(dataset["mode"].values):
        style = {
            "color": COLOURS[k % len(COLOURS)],
            "linestyle": DASHES[k % len(DASHES)],
            "label": f"mode {mode + 1}",
            "marker": marker,
        }
        upper.plot(dataset[name], dataset["frequency"].sel(mode=mode), **style)
        lower.plot(dataset[name], dataset["growth_rate"].sel(mode=mode), **style)
    lower.axhline(0, color="0.4", linewidth=0.8)
    if name == "mu" and "mu_crit" in dataset and np.isfinite(dataset["mu_crit"]):
        mu_crit = float(dataset["mu_crit"])
        for axes in (upper, lower):
            axes.axvline(mu_crit, color="0.4", linestyle=(0, (1, 2)), linewidth=1.2)
        # At the top, where no curve comes near the limit, and on the side with more room.
        on_the_left = mu_crit > np.mean(lower.get_xlim())
        lower.annotate(
            f"$\\mu_{{crit}}$ = {mu_crit:.5g}, {float(dataset['frequency_crit']):.3f} Hz",
            (mu_crit, 1),
            xycoords=lower.get_xaxis_transform(),
            xytext=(-6 if on_the_left else 6, -6),
            textcoords="offset points",
            ha="right" if on_the_left else "left",
            va="top",
            fontsize="small",
        )
    upper.set_ylabel(variable_label(dataset["frequency"]))
    lower.set_ylabel(variable_label(dataset["growth_rate"]))
    lower.set_xlabel(variable_label(dataset[name]))
    upper.legend(frameon=False)
    return figure


def sensitivity(dataset: xr.Dataset, *, figure: Figure | None = None) -> Figure:
    """How each parameter changes the critical friction, in percent per percent, the largest on top (a tornado diagram).

    `dataset` is from `cea.sensitivity(structure).dataset`. The plain derivative is written beside each bar. Bars to the
    left (μ_crit falls) are hatched.

    **Raises:** `TypeError` for anything but the dataset of a sensitivity.
    """
    check_dataset(dataset, ("normalised", "sensitivity"), "fj.cea.sensitivity(structure).dataset")
    shown = dataset.isel(parameter=np.argsort(np.nan_to_num(np.abs(dataset["normalised"].values)), kind="stable"))
    figure = new_figure(figure, 6.4, 1.4 + 0.36 * shown.sizes["parameter"])
    axes = figure.subplots()
    names = [str(name) for name in shown["parameter"].values]
    falling, rising = BLUE, ORANGE
    for row, value in enumerate(shown["normalised"].values):
        falls = value < 0
        axes.barh(
            row,
            np.nan_to_num(value),
            color=falling if falls else rising,
            edgecolor="black",
            linewidth=0.6,
            hatch="///" if falls else None,
        )
        plain, unit = float(shown["sensitivity"][row]), str(shown["unit"].values[row])
        text = f"{plain:+.3g} per {unit}" if np.isfinite(plain) else "no derivative (undamped)"
        axes.annotate(
            text,
            (np.nan_to_num(value), row),
            xytext=(-4 if falls else 4, 0),
            textcoords="offset points",
            ha="right" if falls else "left",
            va="center",
            fontsize="small",
        )
    axes.set_yticks(range(len(names)), names)
    axes.axvline(0, color="black", linewidth=0.8)
    # Space for the numbers beside the longest bars.
    axes.margins(x=0.6)
    axes.set_xlabel(f"percent of $\\mu_{{crit}}$ = {float(dataset['mu_crit']):.5g} per percent of the parameter")
    return figure


def chart(dataset: xr.Dataset, *, figure: Figure | None = None) -> Figure:
    """Growth rate over two parameters, with the stability limit.

    `dataset` is from `cea.chart`. Points without steady sliding are left white.

    **Raises:** `TypeError` for anything but a chart.
    """
    check_dataset(dataset, ("growth_rate", "frequency"), "fj.cea.chart(structure, mu=..., k1=...)")
    if dataset["growth_rate"].ndim != 2 or "mode" in dataset.dims:
        raise TypeError(
            "Argument `dataset` must be a chart over two parameters; modes are drawn by `fj.plot_linear.eigenvalues`."
        )
    figure = new_figure(figure, 6.4, 4.8)
    axes = figure.subplots()
    across, up = (str(name) for name in dataset["growth_rate"].dims)
    growth = dataset["growth_rate"].transpose(up, across)
    edges = (cell_edges(dataset[name].values) for name in (across, up))
    picture = axes.pcolormesh(*edges, growth, cmap="cividis", rasterized=True)
    figure.colorbar(picture, ax=axes, label=variable_label(dataset["growth_rate"]))
    _limit(axes, dataset[across], dataset[up], growth)
    axes.set_xlabel(variable_label(dataset[across]))
    axes.set_ylabel(variable_label(dataset[up]))
    return figure


def design(dataset: xr.Dataset, *, figure: Figure | None = None) -> Figure:
    """The course of a design: the quantity it improves, and the parameters, over the steps (`Design.history`).

    The design that was returned is marked, with its value; the target is a dashed line.

    **Raises:** `TypeError` for anything but the history of a design.
    """
    check_dataset(dataset, (), "fj.design.raise_critical_friction(structure, bounds).history")
    if "step" not in dataset.dims or "chosen_step" not in dataset.attrs:
        raise TypeError(
            "Argument `dataset` must be the `history` of a design, such as `raise_critical_friction` returns."
        )
    names = [str(name) for name in dataset.data_vars]
    figure = new_figure(figure, 6.4, 1.2 + 1.5 * len(names))
    step, target = int(dataset.attrs["chosen_step"]), dataset.attrs.get("target")
    rows = np.atleast_1d(figure.subplots(len(names), 1, sharex=True))
    for axes, name in zip(rows, names, strict=True):
        axes.plot(dataset["step"], dataset[name], color=BLACK, marker="o" if dataset.sizes["step"] == 1 else None)
        value = float(dataset[name].sel(step=step))
        axes.plot(step, value, "o", color=VERMILION, label=f"returned: {value:.6g}")
        axes.set_ylabel(variable_label(dataset[name]))
        if name == names[0] and target is not None:
            axes.axhline(target, color=BLUE, ls="--", lw=1.0, label=f"target: {target:g}")
        axes.margins(x=0.03, y=0.12)
        axes.legend(frameon=False, fontsize="small")
    rows[-1].set_xlabel("step")
    return figure


def _limit(axes: Axes, x, y, growth) -> None:
    values = growth.values[np.isfinite(growth.values)]
    if values.size == 0 or values.min() >= 0 or values.max() <= 0:
        side = "unstable" if values.size and values.min() >= 0 else "stable"
        axes.set_title(
            f"{side} everywhere shown" if values.size else "no steady sliding anywhere shown", fontsize="medium"
        )
        return
    if min(growth.shape) < 2:
        return
    # A white line under a black one is visible on any colour.
    axes.contour(x, y, growth, levels=[0.0], colors="white", linewidths=3.0)
    axes.contour(x, y, growth, levels=[0.0], colors="black", linewidths=1.4)
    axes.set_title("line: limit of stability", fontsize="medium")
