"""Bi-stability maps: where sliding returns, and how large the limit cycle is elsewhere."""

import numpy as np
import xarray as xr
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from ..verdicts.verdict import Verdict
from .style import BLACK, BLUE, VERMILION, axis_label, cell_edges, check_dataset, fill_cells, new_figure
from .thresholds import draw_threshold

SLIDING_SHADE = "#f2f2f2"


def bistability(
    dataset: xr.Dataset, *, critical: xr.Dataset | None = None, value: str = "amplitude", figure: Figure | None = None
) -> Figure:
    """A bi-stability map: where sliding returns, and how large the limit cycle is elsewhere.

    **Arguments:** `dataset` from `bistability_map` with two axes (the first is drawn to the right), or with one, over which the
    value is a curve; `critical`, from `critical_perturbation`, drawn over two axes instead of the map's own, coarser boundary;
    `value`, the variable that colours limit cycles: "amplitude", "decided_at", "contact_events" or "last_event".

    **Raises:** `TypeError` for anything but a map, `ValueError` for a map with no axis or more than two.
    """
    check_dataset(dataset, ("verdict", value), "fj.bistability_map(scene, mu=..., p=...)")
    names = tuple(map(str, dataset["verdict"].dims))
    _check_axes(dataset, names)
    if set(dataset[value].dims) != set(names):
        raise ValueError(
            f"Argument `value` must be over {' and '.join(names)}, as the verdicts are, but `{value}` is not."
        )
    if critical is not None:
        check_dataset(critical, ("p_crit",), "fj.critical_perturbation(scene, mu=...)", "critical")
    figure = new_figure(figure, 7.2, 4.8)
    if len(names) == 1:
        return _over_one_axis(figure, dataset, value)
    axes = figure.add_subplot()
    x, y = (cell_edges(dataset[name].values) for name in names)
    verdict = dataset["verdict"].values.T
    fill_cells(axes, (x, y), verdict == Verdict.SLIDING, SLIDING_SHADE, "")
    cycle = np.ma.masked_where(verdict != Verdict.LIMIT_CYCLE, dataset[value].values.T)
    mesh = axes.pcolormesh(x, y, cycle, cmap="viridis", rasterized=True)
    if cycle.count():
        figure.colorbar(mesh, ax=axes, label=axis_label(value))
    open_ = verdict < 0
    handles = [Patch(facecolor=SLIDING_SHADE, edgecolor="0.6", label="returns to sliding")]
    handles += fill_cells(axes, (x, y), open_, VERMILION, f"no verdict ({int(open_.sum())} of {open_.size})")
    boundary = dataset if critical is None else critical
    if names[1] == "p" and "p_crit" in boundary and boundary["p_crit"].dims == (names[0],):
        handles += draw_threshold(axes, boundary, names[0], BLACK)
    limit = dataset.attrs.get("mu_crit")
    for axis, name in ((axes.axvline, names[0]), (axes.axhline, names[1])):
        if name == "mu" and limit is not None:
            axis(limit, color=VERMILION, ls="--", lw=1.4)
            handles.append(Line2D([], [], color=VERMILION, ls="--", label=_limit_label(limit)))
    for set_limits, edges, name in ((axes.set_xlim, x, names[0]), (axes.set_ylim, y, names[1])):
        _fit(set_limits, edges, limit if name == "mu" else None)
    axes.set(xlabel=axis_label(names[0]), ylabel=axis_label(names[1]))
    axes.legend(handles=handles, loc="upper center", bbox_to_anchor=(0.5, -0.14), ncols=2, frameon=False)
    axes.set_title("Bi-stability: colour where a kick leads to a limit cycle")
    return figure


def _over_one_axis(figure: Figure, dataset: xr.Dataset, value: str) -> Figure:
    """The value of limit cycles over the only axis; what returns to sliding, and what has no verdict, on the line at zero."""
    (name,) = map(str, dataset["verdict"].dims)
    axes, x, verdict = figure.add_subplot(), dataset[name].values, dataset["verdict"].values
    at_rest = np.zeros_like(x)
    for where, y, style, colour, label in (
        (verdict == Verdict.LIMIT_CYCLE, dataset[value].values, "o", BLUE, "limit cycle"),
        (verdict == Verdict.SLIDING, at_rest, "o", "0.6", "returns to sliding"),
        (verdict < 0, at_rest, "x", VERMILION, f"no verdict ({int((verdict < 0).sum())} of {verdict.size})"),
    ):
        if where.any():
            axes.plot(x[where], y[where], style, color=colour, ms=4, label=label)
    limit = dataset.attrs.get("mu_crit")
    if name == "mu" and limit is not None:
        axes.axvline(limit, color=VERMILION, ls="--", lw=1.4, label=_limit_label(limit))
        _fit(axes.set_xlim, cell_edges(x), limit)
    axes.set(xlabel=axis_label(name), ylabel=axis_label(value))
    axes.legend(loc="upper center", bbox_to_anchor=(0.5, -0.14), ncols=2, frameon=False)
    return figure


def _limit_label(limit: float) -> str:
    return rf"$\mu_\mathrm{{crit}}$ = {limit:.4f} (linear theory)"


def _check_axes(dataset: xr.Dataset, names: tuple[str, ...]) -> None:
    if "place" in dataset:
        raise ValueError(
            "A map picture needs a grid, but this is a sparse map. Draw a part of its grid, or a coarse picture of all: "
            "`fj.plot.bistability(fj.window(m))`."
        )
    if not names:
        raise ValueError(
            "A map picture needs an axis or two, but this map has none. Give `fj.bistability_map` one, such as "
            "`p=np.linspace(1, 4, 64)`."
        )
    for name in names:
        if name not in dataset.coords or dataset[name].dtype == object:
            raise ValueError(
                f"A map picture needs numbers along its axes, but `{name}` has none. A map that was stacked is drawn as it was "
                f"before: `m.unstack()`."
            )
    if len(names) > 2:
        chosen = ", ".join(f"{name}=0" for name in names[2:])
        raise ValueError(
            f"A map picture has two axes at most, but this map has {len(names)}: {', '.join(names)}. Select a slice, here the "
            f'first: `fj.plot.bistability(m.isel({chosen}))`; `m.sel(..., method="nearest")` selects by value.'
        )


def _fit(set_limits, edges: np.ndarray, also: float | None) -> None:
    low, high = edges[0], edges[-1]
    if also is not None and high < also < high + 0.1 * (high - low):
        high = also + 0.02 * (high - low)
    set_limits(low, high)
