"""The critical perturbation over one parameter (Fig. 10, Table 2): a line where it is known, a bar where only its range is."""

import json

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from .style import BLUE, VERMILION, axis_label, check_dataset, new_figure


def critical(dataset: xr.Dataset, *, figure: Figure | None = None) -> Figure:
    """The critical perturbation over one parameter (Fig. 10, Table 2).

    A line with dots where it is known; dots are hollow if there are more crossings above. Where undecided trajectories leave
    only a range, from the last kick proved to slide to the first proved to end on a limit cycle, that range is drawn as a bar.

    **Raises:** `TypeError` for anything but a critical perturbation, `ValueError` for one over several parameters.
    """
    check_dataset(dataset, ("p_crit", "only_crossing"), "fj.critical_perturbation(scene, mu=...)")
    names = tuple(map(str, dataset["p_crit"].dims))
    if len(names) != 1:
        chosen = ", ".join(f"{name}=0" for name in names[1:])
        raise ValueError(
            f"This picture needs p_crit over one parameter, but it is over {len(names)}: {', '.join(names) or 'none'}. "
            + (
                f"Select a slice, here the first: `fj.plot.critical(found.isel({chosen}))`."
                if names
                else "Give `fj.critical_perturbation` an axis, such as `mu=np.linspace(0.1, 0.228, 17)`."
            )
        )
    figure = new_figure(figure, 6.4, 4.2)
    axes = figure.add_subplot()
    x, p = dataset[names[0]].values, dataset["p_crit"].values
    only = dataset["only_crossing"].values.astype(bool)
    limit = dataset.attrs.get("mu_crit", np.inf) if names[0] == "mu" else np.inf
    handles = draw_threshold(axes, dataset, names[0], BLUE, limit=limit)[1:]
    axes.plot(x[only], p[only], "o", color=BLUE, ms=4)
    handles.insert(0, Line2D([], [], color=BLUE, lw=1.2, marker="o", ms=4, label="only crossing seen"))
    if (~only & np.isfinite(p)).any():
        axes.plot(x[~only], p[~only], "o", color=BLUE, mfc="white", ms=5)
        handles.insert(1, Line2D([], [], color=BLUE, ls="", marker="o", mfc="white", ms=5, label="islands seen above"))
    if len(handles) > 1:
        axes.legend(handles=handles, frameon=False)
    if names[0] == "belt_speed" and len(x) > 1 and x[0] > 0 and x[-1] / x[0] > 30:
        axes.set_xscale("log")
    low, high = json.loads(dataset.attrs.get("range", "[null, null]"))
    if np.isfinite(limit):
        axes.axvline(limit, color=VERMILION, ls="--", lw=1.2)
        axes.annotate(
            rf"$\mu_\mathrm{{crit}}$ = {limit:.4f}" "\n(linear theory)",
            (limit, 0.97),
            (-6, 0),
            xycoords=("data", "axes fraction"),
            textcoords="offset points",
            ha="right",
            va="top",
        )
    axes.set(
        xlabel=axis_label(names[0]),
        ylabel=r"critical perturbation $p_\mathrm{crit}$",
        title=f"Smallest kick to the limit cycle (sought in {low:g}–{high:g})" if low is not None else "",
    )
    return figure


def draw_threshold(axes: Axes, dataset: xr.Dataset, name: str, colour: str, limit: float = np.inf) -> list[Line2D]:
    """Draw p_crit over one axis: a line where it is known, bars where only a range is. Returns the legend entries.

    A line joins neighbours that are both known; it is broken at the `limit` of linear theory, because beyond it sliding is
    unstable without a kick.
    """
    x, p = dataset[name].values, dataset["p_crit"].values
    handles = [Line2D([], [], color=colour, lw=1.6, label=r"critical perturbation $p_\mathrm{crit}$")]
    for part in (x < limit, x >= limit):
        axes.plot(x[part], p[part], color=colour, lw=1.6)
    # A single known point between unknown ones has no line.
    known = np.concatenate([[False], np.isfinite(p), [False]])
    alone = known[1:-1] & ~known[:-2] & ~known[2:]
    axes.plot(x[alone], p[alone], "o", color=colour, ms=3)
    if "p_crit_low" in dataset and "p_crit_high" in dataset:
        low, high = dataset["p_crit_low"].values, dataset["p_crit_high"].values
        open_ = ~np.isfinite(p) & np.isfinite(low) & np.isfinite(high)
        if open_.any():
            axes.vlines(x[open_], low[open_], high[open_], color=colour, lw=5, alpha=0.45)
            handles.append(
                Line2D(
                    [], [], color=colour, lw=5, alpha=0.45, label=r"$p_\mathrm{crit}$ lies in this range (undecided)"
                )
            )
    return handles
