"""Bifurcation diagrams: amplitudes of limit cycles over a parameter, beside the map of the same parameter."""

from collections.abc import Mapping

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure, SubFigure
from matplotlib.lines import Line2D

from ..branches.tori_on_branches import turning
from .maps import bistability
from .style import BLACK, COLOURS, GREEN, axis_label, check_dataset, legend_above, new_figure

# Of cycles: stable, unstable, and unstable by a complex pair of multipliers.
STYLES, LABELS = ("-", "--", "-."), ("stable", "unstable", "unstable, beside a torus")
THIN, THICK = 1.3, 2.6


def branch(
    branches: xr.Dataset | Mapping[str, xr.Dataset],
    *,
    beside: xr.Dataset | None = None,
    tori: xr.Dataset | None = None,
    figure: Figure | None = None,
) -> Figure:
    """A bifurcation diagram: steady sliding and limit cycles over a parameter; stable ones solid, unstable ones dashed,
    and dash-dotted where a torus branches off (see `tori_along`).

    **Arguments:** `branches`, a dataset from `continue_cycle`, or several over the same parameter by label; `beside`, a map
    from `bistability_map` that is drawn to the right; `tori`, from `tori_along`, the attractors where cycles are unstable.

    **Returns:** a matplotlib figure.

    **Raises:** `TypeError` for anything but branches, `ValueError` for branches over different parameters.
    """
    several = {"": branches} if isinstance(branches, xr.Dataset) else branches
    call = "fj.continue_cycle(scene, 'mu', (0.02, 0.3))"
    if not isinstance(several, Mapping) or not several:
        check_dataset(branches, ("amplitude",), call, "branches")
    for one in several.values():
        check_dataset(one, ("parameter", "amplitude", "special", "sliding_stable"), call, "branches")
        if not one["amplitude"].ndim:
            raise ValueError(
                "A branch has an axis `point`, but of this one a single point was selected; select by slices."
            )
        if not one["amplitude"].size:
            raise ValueError("A branch has points, but of this one none was selected.")
    names = {str(one.attrs["parameter"]) for one in several.values()}
    if len(names) > 1:
        raise ValueError(
            f"Argument `branches` must be over one parameter, but they are over {', '.join(sorted(names))}."
        )
    figure = new_figure(figure, 7.2 if beside is None else 14.4, 4.8)
    left: Figure | SubFigure = figure
    if beside is not None:
        halves = figure.subfigures(1, 2, squeeze=False)[0]
        left = halves[0]
        bistability(beside, figure=halves[1])
    axes = left.add_subplot()
    handles = _special_points(axes, several)
    for colour, (label, one) in zip(np.resize(COLOURS, len(several)), several.items(), strict=True):
        _lines(axes, one, str(colour))
        if label:
            handles.append(Line2D([], [], color=str(colour), label=label))
    handles += _line_styles(several)
    if tori is not None:
        handles += _tori(axes, tori)
    axes.set(xlabel=axis_label(names.pop()), ylabel="peak tangential speed (m/s)")
    axes.set_ylim(bottom=-0.02 * axes.get_ylim()[1])
    legend_above(axes, handles, columns=2)
    return figure


def _kinds(one: xr.Dataset) -> np.ndarray:
    """For each point of a branch which of `STYLES` it is drawn in."""
    kinds = np.where(one["stable"].values, 0, 1)
    # At special points multipliers are those of a neighbour, or not known.
    kinds[turning(one["multipliers"].values)] = 2
    return kinds


def _line_styles(several: Mapping[str, xr.Dataset]) -> list[Line2D]:
    shown = {0, *np.concatenate([_kinds(one) for one in several.values()]).tolist()}
    if not all(np.all(one["sliding_stable"]) for one in several.values()):
        shown.add(1)
    cycles = [Line2D([], [], color=BLACK, ls=STYLES[kind], lw=THIN, label=LABELS[kind]) for kind in sorted(shown)]
    return [*cycles, Line2D([], [], color=BLACK, lw=THICK, label="steady sliding")]


def _lines(axes: Axes, one: xr.Dataset, colour: str) -> None:
    x, y, kinds = one["parameter"].values, one["amplitude"].values, _kinds(one)
    known = np.isfinite(y)
    x, y, kinds = x[known], y[known], kinds[known]
    # A line through a single point cannot be seen.
    marker = "o" if len(x) == 1 else None
    # The line from a point to the next has the style of the first of them.
    for kind, style in enumerate(STYLES):
        chosen = kinds == kind
        shown = chosen | np.append(False, chosen[:-1])
        found = np.where(shown, x, np.nan), np.where(shown, y, np.nan)
        axes.plot(*found, color=colour, ls=style, lw=THIN, marker=marker)
    order = np.argsort(one["parameter"].values, kind="stable")
    x, slides = one["parameter"].values[order], one["sliding_stable"].values[order]
    for is_stable, style in ((True, STYLES[0]), (False, STYLES[1])):
        found = np.where(slides == is_stable, x, np.nan), np.zeros(len(x))
        axes.plot(*found, color=colour, ls=style, lw=THICK, marker=marker)


def _tori(axes: Axes, tori: xr.Dataset) -> list[Line2D]:
    check_dataset(tori, ("kind", "amplitude", "place"), "fj.tori_along(branch)", "tori")
    handles = []
    for kind, marker in (("torus", "o"), ("locked", "s"), ("another cycle", "^")):
        here = tori["kind"].values == kind
        if here.any():
            style = {"ls": "none", "marker": marker, "ms": 4, "color": GREEN, "zorder": 4}
            axes.plot(tori["parameter"].values[here], tori["amplitude"].values[here], **style)
            handles.append(Line2D([], [], **style, label=kind))
    return handles


def _special_points(axes: Axes, several: Mapping[str, xr.Dataset]) -> list[Line2D]:
    kinds = sorted({str(name) for one in several.values() for name in one["special"].values if name})
    handles = []
    markers = ("o", "s", "^", "D", "v", "P", "X", "<", ">", "*")
    for kind, marker in zip(kinds, np.resize(markers, len(kinds)), strict=True):
        style = {"ls": "none", "marker": str(marker), "ms": 5, "mfc": "white", "mec": BLACK, "zorder": 3}
        for one in several.values():
            here = one["special"].values == kind
            axes.plot(one["parameter"].values[here], one["amplitude"].values[here], **style)
        handles.append(Line2D([], [], **style, label=kind))
    return handles
