"""Basins of attraction: which attractor each initial state leads to."""

import numpy as np
import xarray as xr
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from ..cycles.cycle import LimitCycle
from ..verdicts.verdict import Verdict
from .maps import SLIDING_SHADE
from .style import (
    BLACK,
    BLUE,
    GREEN,
    ORANGE,
    PURPLE,
    SKY,
    VERMILION,
    cell_edges,
    check_dataset,
    fill_cells,
    new_figure,
    variable_label,
)


def basins(dataset: xr.Dataset, *, saddle: LimitCycle | None = None, figure: Figure | None = None) -> Figure:
    """A picture of basins: each attractor has its colour, and its share is in the legend.

    **Arguments:** `dataset` from `basins` with two axes (the first is drawn to the right); `saddle`, the unstable cycle from
    `saddle_cycle`, drawn over it if both axes belong to the same coordinate, such as x2 and dx2.

    **Raises:** `TypeError` for anything but basins, `ValueError` for those that do not have two axes.
    """
    check_dataset(dataset, ("verdict", "attractor", "share"), "fj.basins(scene, x2=..., dx2=...)")
    names = tuple(map(str, dataset["verdict"].dims))
    if len(names) != 2:
        raise ValueError(
            f"A picture of basins needs two axes, but these have {len(names)}: {', '.join(names)}."
            f"{' Select with `.isel`.' if len(names) > 2 else ''}"
        )
    figure = new_figure(figure, 7.2, 4.8)
    axes = figure.add_subplot()
    edges = [cell_edges(dataset[name].values) for name in names]
    verdict, attractor = dataset["verdict"].values.T, dataset["attractor"].values.T
    handles: list[Patch | Line2D] = []
    # Of what is shown, which may be a part of what was computed.
    slides = verdict == Verdict.SLIDING
    handles += fill_cells(axes, edges, slides, SLIDING_SHADE, f"slides: {100 * np.mean(slides):.1f} %")
    # Colours of attractors, in the order of the table; readers who do not see red and green can distinguish them.
    colours = (BLUE, ORANGE, GREEN, PURPLE, SKY, "#F0E442")
    for place in range(dataset.sizes["attractors"]):
        one = dataset.isel(attractors=place)
        there = (verdict == Verdict.LIMIT_CYCLE) & (attractor == place)
        label = f"{one['attractor_kind'].values!s}, {float(one['attractor_amplitude']):.4g} m/s: {100 * np.mean(there):.1f} %"
        handles += fill_cells(axes, edges, there, colours[place % len(colours)], label)
    handles += fill_cells(
        axes, edges, verdict < 0, VERMILION, f"no verdict ({int((verdict < 0).sum())} of {verdict.size})"
    )
    if saddle is not None and names[1] == f"d{names[0]}":
        path = saddle.trajectory(points=2000)
        k = saddle.scene.structure.coordinates.index(names[0])
        axes.plot(path.displacement[:, k], path.velocity[:, k], color=BLACK, lw=1.2)
        handles.append(Line2D([], [], color=BLACK, lw=1.2, label="saddle cycle"))
    labels = [variable_label(dataset[name]) for name in names]
    axes.set(xlim=edges[0][[0, -1]], ylim=edges[1][[0, -1]], xlabel=labels[0], ylabel=labels[1])
    axes.legend(handles=handles, loc="upper center", bbox_to_anchor=(0.5, -0.14), ncols=2, frameon=False)
    axes.set_title("Basins: where initial states lead")
    return figure
