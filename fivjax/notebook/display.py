"""How results show themselves in a notebook.

Formatters are handed to IPython when fivjax is imported in it; nothing happens elsewhere, and IPython is no dependency.
A scene shows as a table with units, a trajectory and fivjax's own datasets as their picture with the numbers below,
a matplotlib figure as itself. Other libraries' datasets show as ever.
"""

import base64
import html
import io
import sys

import numpy as np
import xarray as xr
from matplotlib.figure import Figure

from ..calibration.fit import Calibration
from ..foundation import arguments
from ..io.datasets import QUANTITIES, describe
from ..linear.cea import Sensitivity
from ..model.scene import Scene
from ..plot import calibration as plot_calibration
from ..plot import energy as plot_energy
from ..plot import linear as plot_linear
from ..plot import results as plot
from ..simulation.ending import Ending
from ..simulation.trajectory import Trajectory

DPI = 100


def show(result) -> Figure:
    """The picture of a result: what a notebook shows for it.

    **Arguments:** `result`, a `Trajectory`, a map, a critical perturbation, modes, a stability chart, energies per cycle,
    sensitivities, a `tradeoff` or a `Calibration`.

    **Returns:** a matplotlib figure.

    **Raises:** `TypeError` for anything that has no picture.
    """
    figure = _picture(result)
    if figure is None:
        raise TypeError(
            f"Argument `result` must be something that fivjax computed and can draw, but is {arguments.describe(result)}. "
            f"The modules `fj.plot`, `fj.plot_energy` and `fj.plot_linear` have pictures of parts."
        )
    return figure


def _picture(result) -> Figure | None:
    if isinstance(result, Trajectory):
        return _of_trajectory(result)
    if isinstance(result, Sensitivity):
        return plot_linear.sensitivity(result.dataset)
    if isinstance(result, Calibration):
        return plot_calibration.calibration(result)
    if not isinstance(result, xr.Dataset) or "fivjax" not in result.attrs:
        return None
    # What a dataset is drawn as, by what it holds.
    for has, draw in (
        (lambda d: "verdict" in d and d["verdict"].ndim == 2, plot.bistability),
        (lambda d: "crossings" in d and d["p_crit"].ndim == 1 and d["p_crit"].size > 1, plot.critical),
        (lambda d: "damping_ratio" in d and d["frequency"].shape[0] > 1, plot_linear.eigenvalues),
        (lambda d: "growth_rate" in d and "mode" not in d.dims and d["growth_rate"].ndim == 2, plot_linear.chart),
        (lambda d: "state_error" in d and "stepper" in d.dims, plot.tradeoff),
        (lambda d: "energy_gain" in d and "cycle" in d.dims and d.sizes["cycle"] > 0, plot_energy.per_cycle),
    ):
        if has(result):
            return draw(result)
    return None


def _of_trajectory(run: Trajectory) -> Figure:
    figure = Figure(figsize=(10.0, 3.4), layout="constrained")
    left, right = np.asarray(figure.subfigures(1, 2, width_ratios=(5, 3)), object)
    # A part of a figure has all that a picture function asks of a figure.
    plot.response(run, figure=left)  # pyright: ignore[reportArgumentType]
    plot.phase_plane(run, last=0.25 * float(run.t[-1]), figure=right)  # pyright: ignore[reportArgumentType]
    return figure


def png(figure: Figure) -> bytes:
    """A figure as PNG."""
    written = io.BytesIO()
    figure.savefig(written, format="png", dpi=DPI)
    return written.getvalue()


def scene_table(scene: Scene) -> str:
    """A scene as an HTML table: each parameter with its meaning, value and unit."""
    about = describe(scene)
    rows = []
    for name, value in about["parameters"].items():
        meaning, unit = QUANTITIES.get(name, (name, ""))
        cells = (name, meaning, f"{value:g}", "" if unit == "1" else unit)
        rows.append(
            "<tr>" + "".join(f"<td style='text-align:left'>{html.escape(cell)}</td>" for cell in cells) + "</tr>"
        )
    head = "".join(f"<th style='text-align:left'>{title}</th>" for title in ("parameter", "meaning", "value", "unit"))
    parts = f"{about['structure']}, {about['friction']}, {about['load']}; impact law “{about['impact_law']}”"
    return (
        f"<b>Scene</b>: {html.escape(parts)}<table><thead><tr>{head}</tr></thead><tbody>{''.join(rows)}</tbody></table>"
    )


def trajectory_summary(run: Trajectory) -> str:
    """A trajectory as HTML: its picture, and in one line how long, how often and how much."""
    counts = {name: int(np.sum(np.asarray(run.status) == status)) for status, name in plot.STATUS_NAMES.items()}
    shares = ", ".join(f"{name} {count / len(run.t):.1%}" for name, count in counts.items() if count)
    peak = float(np.nanmax(np.abs(np.asarray(run.velocity)[:, run.scene.structure.tangential])))
    said = f"{run.t[-1]:g} s in {len(run.t)} rows; {shares}; tangential speed up to {peak:.3g} m/s"
    if run.energy is not None:
        said += (
            f"; {int(run.energy.ledger.events[-1])} contact events, energy residual {run.energy.ledger.worst[-1]:.1e} J"
        )
    if int(run.outcome) != Ending.FINISHED:
        said += f"; {run.meaning}"
    return f"{_image(_of_trajectory(run))}<div><b>Trajectory</b>: {html.escape(said)}</div>"


def dataset_summary(dataset: xr.Dataset) -> str:
    """A dataset as HTML: fivjax's own with their picture first, others as xarray shows them."""
    figure = _picture(dataset)
    table = dataset._repr_html_()
    return table if figure is None else f"{_image(figure)}<details><summary>data</summary>{table}</details>"


def _image(figure: Figure) -> str:
    return f"<img style='max-width:100%' src='data:image/png;base64,{base64.b64encode(png(figure)).decode()}'/>"


def _with_image(result) -> str:
    return f"{_image(show(result))}<pre>{html.escape(str(result))}</pre>"


def register() -> bool:
    """Hand the formatters to the running IPython, if there is one; returns whether there was."""
    shell = sys.modules["IPython"].get_ipython() if "IPython" in sys.modules else None
    if shell is None:
        return False
    formatters = shell.display_formatter.formatters
    for kind, formatter in (
        (Scene, scene_table),
        (Trajectory, trajectory_summary),
        (xr.Dataset, dataset_summary),
        (Sensitivity, _with_image),
        (Calibration, _with_image),
    ):
        formatters["text/html"].for_type(kind, formatter)
    if Figure not in formatters["image/png"]:
        formatters["image/png"].for_type(Figure, png)
    return True
