"""The explorer's picture of a trajectory: four panels whose artists are made once, so that drawing is fast."""

import io
from collections.abc import Callable

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator, ScalarFormatter
from PIL import Image

from ..contact import Status
from ..plot import STATUS_NAMES
from ..plot.style import BLACK, BLUE, GREEN, VERMILION
from ..simulation.trajectory import Trajectory

# The smallest range of a panel's axis, as a share of the load over the mass, the belt speed, the displacement or the energy of
# steady sliding. Far below it there is only rounding.
LEAST = 1e-2


def drawing_panels(t1: float) -> Callable[[Trajectory], bytes]:
    """A function that draws a trajectory up to `t1` (s) and returns PNG."""
    figure = Figure(figsize=(8.4, 4.8), dpi=80)
    canvas = FigureCanvasAgg(figure)
    response, status, energy, phase = _axes(figure, t1)
    (wave,) = response.plot([], [], color=BLUE, lw=0.7)
    (steps,) = status.plot([], [], ".", color=VERMILION, ms=2)
    (mechanical,) = energy.plot([], [], color=BLACK, lw=1.0, label="mechanical energy")
    (contact,) = energy.plot([], [], color=GREEN, lw=1.0, ls="--", label="from the contact, less damping")
    # The last point is marked, so that a motion at rest is visible.
    (orbit,) = phase.plot([], [], color=BLUE, lw=0.8, marker="o", ms=3, markevery=[-1])
    belt = phase.axhline(0, color=BLACK, ls=":", lw=0.8)
    # Between two panels, where it covers no curve.
    place = {"loc": "lower right", "bbox_to_anchor": (1, 0.97), "borderaxespad": 0, "borderpad": 0.3}
    energy.legend(**place, ncols=2, fontsize="small", frameon=False)

    def draw(run: Trajectory) -> bytes:
        tangential = run.scene.structure.tangential
        late = np.asarray(run.t) > 0.7 * t1
        assert run.energy is not None
        lines = (
            (wave, run.t, run.acceleration[:, tangential]),
            (steps, run.t, run.status),
            (mechanical, run.t, run.energy.mechanical),
            (contact, run.t, run.energy.work.contact - run.energy.work.damping),
            (orbit, 1e3 * run.displacement[late, tangential], run.velocity[late, tangential]),
        )
        for line, x, y in lines:
            line.set_data(x, y)
        belt.set_ydata([float(run.scene.belt_speed)] * 2)
        force, mass = float(run.scene.load.force), float(run.scene.structure.mass[tangential, tangential])
        response.set_ylim(limits(wave.get_ydata(), LEAST * force / mass))
        stored = np.concatenate([mechanical.get_ydata(), contact.get_ydata()])
        energy.set_ylim(limits(stored, LEAST * np.nanmax(np.abs(stored))))
        phase.set_xlim(limits(orbit.get_xdata(), LEAST * np.nanmax(np.abs(orbit.get_xdata()))))
        # A belt speed far from the motion's is left out, because it would shrink the motion in the picture.
        phase.set_ylim(limits(orbit.get_ydata(), LEAST * abs(float(run.scene.belt_speed))))
        canvas.draw()
        return png(canvas)

    return draw


def limits(values, least: float) -> tuple[float, float]:
    """The ends of an axis for these values: with a margin, and at least `least` apart, so that rounding is not magnified."""
    known = np.asarray(values)[np.isfinite(values)]
    low, high = (known.min(), known.max()) if known.size else (0.0, 0.0)
    half = 0.5 * max(1.1 * (high - low), least, 1e-30)
    return float(0.5 * (low + high) - half), float(0.5 * (low + high) + half)


def png(canvas: FigureCanvasAgg) -> bytes:
    """The picture on a canvas, as PNG."""
    written = io.BytesIO()
    # Little compression, because speed matters.
    Image.fromarray(np.asarray(canvas.buffer_rgba())[..., :3]).save(written, format="png", compress_level=1)
    return written.getvalue()


def _axes(figure: Figure, t1: float):
    around = {"left": 0.1, "right": 0.98, "top": 0.95, "bottom": 0.1, "hspace": 0.35, "wspace": 0.28}
    grid = figure.add_gridspec(3, 2, width_ratios=(5, 3), height_ratios=(4, 1, 3), **around)
    response, status, energy = (figure.add_subplot(grid[k, 0]) for k in range(3))
    phase = figure.add_subplot(grid[:, 1])
    response.set(ylabel="acceleration (m/s²)", xlim=(0, t1))
    status.set(ylim=(-0.5, 2.5), xlim=(0, t1))
    status.set_yticks([int(s) for s in Status], [STATUS_NAMES[s] for s in Status])
    energy.set(xlabel="time (s)", ylabel="energy (J)", xlim=(0, t1))
    phase.set(xlabel="tangential displacement (mm)", ylabel="tangential velocity (m/s)")
    for axes in (response, status):
        axes.tick_params(labelbottom=False)
    # Fixed positions of labels and few ticks, because these take most of the time of drawing.
    for axes, left in ((response, -0.13), (energy, -0.13), (phase, -0.21)):
        axes.yaxis.set_label_coords(left, 0.5)
        for axis, ticks in ((axes.xaxis, 4 if axes is phase else 5), (axes.yaxis, 5)):
            axis.set_major_locator(MaxNLocator(ticks))
            # Without an offset, which would be printed over the name of the axis.
            written = ScalarFormatter(useOffset=False)
            written.set_powerlimits((-1, 4) if axis is phase.yaxis else (-5, 6))
            axis.set_major_formatter(written)
    energy.xaxis.set_label_coords(0.5, -0.25)
    phase.xaxis.set_label_coords(0.5, -0.075)
    return response, status, energy, phase
