"""The boundary between sliding and squeal in a plane of the Poincaré section."""

import xarray as xr
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from ..verdicts.verdict import Verdict
from .maps import SLIDING_SHADE
from .style import BLACK, BLUE, ORANGE, VERMILION, cell_edges, check_dataset, fill_cells, new_figure


def boundary_section(dataset: xr.Dataset, *, figure: Figure | None = None) -> Figure:
    """The stable manifold, the saddle and the motions after two nearly critical kicks, over the verdicts in a plane of the
    section.

    **Arguments:** `dataset` from `boundary_section`.

    **Returns:** a matplotlib figure.

    **Raises:** `TypeError` for anything but such a dataset.
    """
    check_dataset(dataset, ("verdict", "manifold", "path"), "fj.boundary_section(scene)")
    figure = new_figure(figure, 7.2, 5.4)
    axes = figure.add_subplot()
    x, y = edges = [cell_edges(dataset[name].values) for name in ("unstable", "stable")]
    verdict = dataset["verdict"].values
    handles: list[Patch | Line2D] = []
    for where, colour, label in (
        (verdict == Verdict.SLIDING, SLIDING_SHADE, "slides"),
        (verdict == Verdict.LIMIT_CYCLE, ORANGE, "squeals"),
        (verdict < 0, "0.6", "no verdict"),
    ):
        handles += fill_cells(axes, edges, where, colour, label, 0.6)
    axes.plot(dataset["manifold"], dataset["stable"], color=BLACK, lw=1.6)
    handles.append(Line2D([], [], color=BLACK, lw=1.6, label="stable manifold"))
    for side, colour, marker in (("slides", BLUE, "v"), ("squeals", VERMILION, "^")):
        path = dataset["path"].sel(side=side)
        axes.plot(
            path.sel(direction="unstable"), path.sel(direction="stable"), color=colour, marker=marker, ms=2.5, lw=0.4
        )
        sign = "below" if side == "slides" else "above"
        handles.append(Line2D([], [], color=colour, marker=marker, ms=4, lw=0.6, label=f"kick just {sign} critical"))
    axes.plot(0, 0, "o", ms=8, mfc="white", mec=BLACK, mew=1.5, zorder=4)
    handles.append(Line2D([], [], ls="none", marker="o", mfc="white", mec=BLACK, ms=8, label="saddle cycle"))
    axes.set(
        xlim=(x[0], x[-1]),
        ylim=(y[0], y[-1]),
        xlabel="along the unstable direction (sizes of the saddle)",
        ylabel="along the slowest stable direction",
    )
    axes.legend(handles=handles, loc="upper center", bbox_to_anchor=(0.5, -0.14), ncols=3, frameon=False)
    return figure
