"""The picture of a result, and results as HTML for notebooks (`registration` hands these functions to IPython)."""

import base64
import html
import inspect
import io
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.figure import Figure

from .. import plot
from ..calibration.result import Calibration
from ..cycles.cycle import LimitCycle
from ..foundation import arguments
from ..linear.cea import Sensitivity
from ..plot import energy as plot_energy
from ..plot import linear as plot_linear
from ..simulation.ending import Ending
from ..simulation.trajectory import Trajectory

if TYPE_CHECKING:
    import xarray as xr


def show(result, **options) -> Figure:
    """The picture of a result.

    **Arguments:** `result`, a `Trajectory`, a `LimitCycle` (one period), a map, basins, a critical perturbation, a branch, a
    boundary section, modes, a stability chart, energies per cycle, sensitivities, a `tradeoff`, a `Calibration` or the dataset
    of one; `options` are those of the function of `fj.plot` that draws it.

    **Returns:** a matplotlib figure.

    **Raises:** `TypeError` for anything that fivjax did not compute, and for an option that its picture does not have;
    `ValueError` for a dataset without a picture, or with more axes than one has.

    **Example:**

        >>> figure = fj.show(run)
    """
    draw, drawn = _picture_of(result)
    of_picture = plot.response if draw in (_of_trajectory, _of_cycle) else draw
    # The first is what is drawn.
    known = list(inspect.signature(of_picture).parameters)[1:]
    for name in options:
        if name not in known:
            raise TypeError(
                f"Argument `{name}` is no option of this picture, which is `{of_picture.__name__}` of `fj.plot`; it has: "
                f"{', '.join(known)}.{arguments.did_you_mean(name, known)}"
            )
    return draw(drawn, **options)


def _picture_of(result) -> tuple[Callable[..., Figure], Any]:
    """The function that draws a result, and what it draws."""
    import xarray as xr

    if isinstance(result, Trajectory):
        return _of_trajectory, result
    if isinstance(result, LimitCycle):
        return _of_cycle, result
    if isinstance(result, Sensitivity):
        return plot_linear.sensitivity, result.dataset
    if isinstance(result, Calibration):
        return plot.calibration, result
    if isinstance(result, xr.Dataset) and "fivjax" in result.attrs:
        _refuse_more_axes(result)
        for is_one, draw in _PICTURES:
            if is_one(result):
                return draw, result
        if "displacement" in result and "status" in result:
            return _of_trajectory, Trajectory.from_dataset(result)
        raise ValueError(
            f"Argument `result` is a dataset of fivjax's with {', '.join(map(str, result.data_vars))} over "
            f"{', '.join(f'{name} ({size})' for name, size in result.sizes.items()) or 'no axis'}, of which there is no "
            "picture. Read its numbers, or compute it for more values of an axis."
        )
    raise TypeError(
        f"Argument `result` must be something that fivjax computed and can draw, but is {arguments.describe(result)}. "
        f"The modules `fj.plot`, `fj.plot.energy` and `fj.plot.linear` have pictures of parts."
    )


# The function that draws a dataset, by the variables that it has.
_PICTURES = (
    (lambda d: "manifold" in d and "path" in d, plot.boundary_section),
    (lambda d: "verdict" in d and "share" in d, plot.basins),
    (lambda d: "verdict" in d, plot.bistability),
    (lambda d: "special" in d and "word" in d, plot.branch),
    (lambda d: "crossings" in d and d["p_crit"].ndim == 1 and d["p_crit"].size > 1, plot.critical),
    (lambda d: "damping_ratio" in d and d["frequency"].ndim == 2 and d["frequency"].size, plot_linear.eigenvalues),
    (lambda d: "growth_rate" in d and "mode" not in d.dims and d["growth_rate"].ndim == 2, plot_linear.chart),
    (lambda d: "state_error" in d and "stepper" in d.dims, plot.tradeoff),
    (lambda d: "value_text" in d, plot.calibration),
    (lambda d: "energy_gain" in d and "cycle" in d.dims and d.sizes["cycle"] > 0, plot_energy.per_cycle),
)


def _refuse_more_axes(dataset: "xr.Dataset") -> None:
    for name, most in (("verdict", 2), ("crossings", 1)):
        axes = [] if name not in dataset else [str(axis) for axis in dataset[name].dims]
        if len(axes) > most:
            choice = ", ".join(f"{axis}=0" for axis in axes[most:])
            raise ValueError(
                f"A picture of this dataset needs {most} {'axes' if most > 1 else 'axis'}, but it has {len(axes)}: "
                f"{', '.join(axes)}. Choose a value of the others, for instance `fj.show(m.isel({choice}))`."
            )


def _of_trajectory(run: Trajectory, of_phase_plane: float = 0.25, figure: Figure | None = None, **options) -> Figure:
    """Its response, and the last share of it in the phase plane."""
    if len(run.t) < 2:
        raise ValueError(f"A picture of a run needs at least two rows, but it has {len(run.t)}. Show more of it.")
    if len(run.scene.structure.contacts) > 1:
        return plot.response(run, **options, figure=figure)
    figure = Figure(figsize=(10.0, 3.4), layout="constrained") if figure is None else figure
    left, right = np.asarray(figure.subfigures(1, 2, width_ratios=(5, 3)), object)
    # A subfigure has all methods that these functions need.
    plot.response(run, **options, figure=left)
    plot.phase_plane(run, last=of_phase_plane * float(run.t[-1]), figure=right)
    return figure


def _of_cycle(cycle: LimitCycle, **options) -> Figure:
    """One period of it."""
    return _of_trajectory(cycle.trajectory(), of_phase_plane=1.0, **options)


def png(figure: Figure) -> bytes:
    """A figure as PNG."""
    dpi = 100
    written = io.BytesIO()
    figure.savefig(written, format="png", dpi=dpi)
    return written.getvalue()


def trajectory_summary(run: Trajectory) -> str:
    """A trajectory as HTML: its picture, and a line with its duration, number of events and peak. A batch, as it prints."""
    if np.ndim(run.t) != 1:
        return f"<pre>{html.escape(repr(run))}</pre>"
    counts = {name: int(np.sum(np.asarray(run.status) == status)) for status, name in plot.STATUS_NAMES.items()}
    shares = ", ".join(f"{name} {count / np.size(run.status):.1%}" for name, count in counts.items() if count)
    along = np.asarray(run.slip_velocity) + np.asarray(run.scene.belt_speed)
    peak = float(np.nanmax(np.abs(along)))
    said = f"{run.t[-1]:g} s in {len(run.t)} rows; {shares}; tangential speed up to {peak:.3g} m/s"
    if run.energy is not None:
        said += (
            f"; {int(run.energy.ledger.events[-1])} contact events, energy residual {run.energy.ledger.worst[-1]:.1e} J"
        )
    if int(run.outcome) != Ending.FINISHED:
        said += f"; {run.meaning}"
    return f"{_image(_of_trajectory(run))}<div><b>Trajectory</b>: {html.escape(said)}</div>"


def with_picture(result) -> str:
    """A result as HTML: its picture, and below it what it prints."""
    return f"{_image(show(result))}<pre>{html.escape(str(result))}</pre>"


def _image(figure: Figure) -> str:
    return f"<img style='max-width:100%' src='data:image/png;base64,{base64.b64encode(png(figure)).decode()}'/>"
