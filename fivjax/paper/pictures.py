"""Pictures in the layout of the paper's Figs. 2, 4–6 and 9 and its tables: matplotlib figures from computed results.

Colours are those of Okabe and Ito that are similar to the paper's, which everyone can distinguish; in grey they differ in
lightness, and lines also in style.
"""

import textwrap
from collections.abc import Mapping, Sequence

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.legend import Legend

import fivjax as fj

BLACK, BLUE, GREEN, ORANGE, VERMILION = "#000000", "#0072B2", "#009E73", "#E69F00", "#D55E00"
Window = tuple[float, float]

# The range of a spectrogram below its strongest line, in dB. The paper does not state its range; with this one its two
# spectrograms look as it describes them.
DEPTH = 40.0


def friction_laws(dataset: xr.Dataset) -> Figure:
    """Friction coefficient over slip speed, one line for each `law` (Fig. 2)."""
    figure = _new_figure(5.6, 3.8)
    axes = figure.add_subplot()
    styles = [(VERMILION, "-"), (BLUE, "--"), (BLACK, "-.")]
    for law, (colour, line) in zip(dataset["law"].values, styles, strict=False):
        axes.plot(dataset["slip_speed"], dataset["friction"].sel(law=law), color=colour, ls=line, lw=1.6, label=law)
    axes.set(xlabel="slip speed (m/s)", ylabel=r"friction coefficient $\mu$", xlim=(0, dataset["slip_speed"].max()))
    axes.set_ylim(0, None)
    axes.legend(frameon=False)
    return figure


def onset(run: fj.Trajectory, spectrum: xr.Dataset, window: Window) -> Figure:
    """Accelerations along the belt and across it, a window of them, and the spectrogram (Figs. 4 and 5).

    `spectrum` is from `spectra.spectrogram`; across the belt is the paper's y1, coordinate 1.
    """
    figure = _new_figure(8.4, 6.0)
    panels = figure.subplot_mosaic("aa;bc")
    accelerations(panels["a"], run, (float(run.t[0]), float(run.t[-1])))
    panels["a"].axvspan(*window, color="0.8", zorder=0)
    _thick(_legend_above(panels["a"], columns=2))
    accelerations(panels["b"], run, window)
    level = spectrum["level"]
    shown = level.sel(frequency=slice(0, 500))
    mesh = panels["c"].pcolormesh(
        shown["t"], shown["frequency"], shown, cmap="viridis", vmin=-DEPTH, vmax=0, shading="nearest", rasterized=True
    )
    figure.colorbar(mesh, ax=panels["c"], label="power relative to the strongest (dB)")
    panels["c"].set(xlabel="time (s)", ylabel="frequency (Hz)")
    return lettered(figure, list(panels.values()))


def coexistence(
    runs: Mapping[str, fj.Trajectory], zoomed: fj.Trajectory, zoom: Window, marks: Mapping[str, Window]
) -> Figure:
    """Tangential accelerations of several runs; below, a window of one of them with its normal acceleration (Fig. 6).

    `marks` are windows to point at by name, those of Fig. 7.
    """
    figure = _new_figure(8.4, 6.4)
    panels = figure.subplot_mosaic("a;b", height_ratios=(3, 2))
    _overlay(panels["a"], runs)
    for name, (start, end) in marks.items():
        panels["a"].axvline(0.5 * (start + end), color=BLACK, lw=0.8, ls=":")
        panels["a"].annotate(
            name, (0.5 * (start + end), 0.92), (3, 0), xycoords=("data", "axes fraction"), textcoords="offset points"
        )
    # Space above the curves for these names.
    low, high = panels["a"].get_ylim()
    panels["a"].set_ylim(low, high + 0.12 * (high - low))
    accelerations(panels["b"], zoomed, zoom)
    _legend_above(panels["b"], columns=2)
    return lettered(figure, list(panels.values()))


def overlaid(runs: Mapping[str, fj.Trajectory]) -> Figure:
    """The tangential accelerations of several runs (Fig. 9)."""
    figure = _new_figure(8.4, 3.8)
    _overlay(figure.add_subplot(), runs)
    return figure


def _overlay(axes: Axes, runs: Mapping[str, fj.Trajectory]) -> None:
    """The tangential accelerations of several runs on one pair of axes, in the order given."""
    # Of different lightness, so that they can be distinguished in grey.
    shades = [(BLUE, ORANGE), (ORANGE, GREEN, BLACK)][len(runs) > 2]
    for (name, run), colour in zip(runs.items(), shades, strict=False):
        axes.plot(run.t, run.acceleration[:, run.scene.structure.tangential], color=colour, lw=0.5, label=name)
    axes.set(xlabel="time (s)", ylabel="tangential\nacceleration (m/s²)", xlim=(0, max(r.t[-1] for r in runs.values())))
    _thick(_legend_above(axes, columns=len(runs)))


def accelerations(axes: Axes, run: fj.Trajectory, window: Window) -> None:
    """Tangential and normal (y1) acceleration in a window, status shaded where the window is short enough to see it."""
    inside = (np.asarray(run.t) >= window[0]) & (np.asarray(run.t) <= window[1])
    t, values = np.asarray(run.t)[inside], np.asarray(run.acceleration)[inside]
    short = len(t) < 5000
    lines = [
        (values[:, run.scene.structure.tangential], "tangential ($x_2$)", VERMILION, "-", 1.3 if short else 0.5),
        (values[:, 1], "normal ($y_1$)", BLUE, "--" if short else "-", 1.3 if short else 0.5),
    ]
    # The larger one first, so that it does not hide the smaller.
    for line, label, colour, style, width in sorted(lines, key=lambda item: -np.nanmax(np.abs(item[0]))):
        axes.plot(t, line, color=colour, ls=style, lw=width, label=label)
    if short:
        fj.plot.shade_status(axes, fj.Trajectory(**{**vars(run), "t": t, "status": run.status[inside], "energy": None}))
    axes.set(xlabel="time (s)", ylabel="acceleration (m/s²)", xlim=window)


def table(columns: Sequence[str], rows: Sequence[Sequence[str]]) -> Figure:
    """A table of text (Tables 1 and 2)."""
    figure = _new_figure(1.8 * len(columns), 0.5 + 0.32 * (len(rows) + 1))
    axes = figure.add_subplot()
    axes.set_axis_off()
    drawn = axes.table(
        cellText=[list(row) for row in rows], colLabels=list(columns), loc="center", cellLoc="left", colLoc="left"
    )
    drawn.auto_set_font_size(False)
    drawn.set_fontsize(10)
    drawn.auto_set_column_width(list(range(len(columns))))
    drawn.scale(1, 1.4)
    for (row, _), cell in drawn.get_celld().items():
        cell.set_edgecolor("0.7")
        cell.visible_edges = "B"
        if row == 0:
            cell.set_text_props(weight="bold")
    return figure


def captioned(figure: Figure, caption: str) -> Figure:
    """The figure with a caption below it."""
    width = int(figure.get_size_inches()[0] * 17)
    figure.supxlabel(textwrap.fill(caption, width), x=0.01, ha="left", fontsize="small")
    return figure


def lettered(figure: Figure, panels: Sequence[Axes] | None = None, names: Sequence[str] = ()) -> Figure:
    """The figure with (a), (b) … above its panels (all, unless some are given), followed by a name if given."""
    panels = figure.axes if panels is None else panels
    for letter, axes, name in zip("abcdefgh", panels, names or [""] * len(panels), strict=False):
        axes.set_title(f"({letter}) {name}".rstrip(), loc="left", fontsize="medium")
    return figure


def _new_figure(width: float, height: float) -> Figure:
    """A figure of this size in inches."""
    return Figure(figsize=(width, height), layout="constrained")


def _legend_above(axes: Axes, columns: int = 3) -> Legend:
    """A legend above the right end of a panel, where it covers no curve."""
    return axes.legend(loc="lower right", bbox_to_anchor=(1, 1), ncols=columns, frameon=False)


def _thick(legend: Legend) -> None:
    # The thin lines of a long run would not show their colour in the legend.
    for line in legend.get_lines():
        line.set_linewidth(3)
