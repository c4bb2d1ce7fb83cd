"""The explorer's picture of a trajectory: four panels whose artists are made once, so that drawing is fast."""

import io
from collections.abc import Callable
from typing import Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator, ScalarFormatter
from PIL import Image

from ..contact import Status
from ..model.sliding import contact_coordinates
from ..plot import STATUS_NAMES
from ..plot.style import BLACK, BLUE, COLOURS, GREEN, VERMILION
from ..simulation.trajectory import Trajectory

# The smallest range of a panel's axis, as a share of the load over the mass, the belt speed, the displacement or the energy of
# steady sliding. Far below it there is only rounding.
LEAST = 1e-2


def drawing_panels(t1: float, contacts: int = 1) -> Callable[[Trajectory], bytes]:
    """A function that draws a trajectory of so many contacts up to `t1` (s) and returns PNG.

    Each of several contacts has its colour, and its row of dots beside each status.
    """
    # The distance of the statuses of one contact from those of the next, in a panel where stick and slide are 1 apart.
    apart = 0.5
    figure = Figure(figsize=(8.4, 4.8), dpi=80)
    canvas = FigureCanvasAgg(figure)
    response, status, energy, phase = _axes(figure, t1)
    colours = [BLUE] if contacts == 1 else [COLOURS[1 + i % (len(COLOURS) - 1)] for i in range(contacts)]
    waves = [response.plot([], [], color=colour, lw=0.7, label=f"contact {i}")[0] for i, colour in enumerate(colours)]
    dots = [VERMILION] if contacts == 1 else colours
    steps = [status.plot([], [], ".", color=colour, ms=2)[0] for colour in dots]
    offsets = apart * (np.arange(contacts) - 0.5 * (contacts - 1)) / contacts
    (mechanical,) = energy.plot([], [], color=BLACK, lw=1.0, label="mechanical energy")
    (contact,) = energy.plot([], [], color=GREEN, lw=1.0, ls="--", label="from the contact, less damping")
    # The last point is marked, so that a motion at rest is visible.
    curves = [phase.plot([], [], color=colour, lw=0.8, marker="o", ms=3, markevery=[-1])[0] for colour in colours]
    belts = [phase.axhline(0, color=BLACK if contacts == 1 else colour, ls=":", lw=0.8) for colour in colours]
    # Between two panels, where it covers no curve.
    place: dict[str, Any] = {"loc": "lower right", "bbox_to_anchor": (1, 0.97), "borderaxespad": 0, "borderpad": 0.3}
    energy.legend(**place, ncols=2, fontsize="small", frameon=False)
    if contacts > 1:
        response.legend(**place, ncols=min(contacts, 5), fontsize="small", frameon=False)

    def draw(run: Trajectory) -> bytes:
        structure, late = run.scene.structure, np.asarray(run.t) > 0.7 * t1
        places = np.ravel(contact_coordinates(structure)[0])
        assert run.energy is not None
        mechanical.set_data(run.t, run.energy.mechanical)
        contact.set_data(run.t, run.energy.work.contact - run.energy.work.damping)
        statuses = np.reshape(run.status, (len(run.t), contacts))
        speeds = np.broadcast_to(np.asarray(run.scene.belt_speed), contacts)
        for i, place in enumerate(places):
            waves[i].set_data(run.t, run.acceleration[:, place])
            steps[i].set_data(run.t, statuses[:, i] + offsets[i])
            curves[i].set_data(1e3 * run.displacement[late, place], run.velocity[late, place])
            belts[i].set_ydata([float(speeds[i])] * 2)
        force, mass = float(run.scene.load.force), float(structure.mass[places[0], places[0]])
        response.set_ylim(limits(_every(waves), LEAST * force / mass))
        stored = _every([mechanical, contact])
        energy.set_ylim(limits(stored, LEAST * np.nanmax(np.abs(stored))))
        across = _every(curves, "get_xdata")
        phase.set_xlim(limits(across, LEAST * np.nanmax(np.abs(across))))
        # A belt speed far from the motion's is left out, because it would shrink the motion in the picture.
        phase.set_ylim(limits(_every(curves), LEAST * float(np.max(np.abs(speeds)))))
        canvas.draw()
        return png(canvas)

    return draw


def _every(lines, data: str = "get_ydata") -> np.ndarray:
    """The values of all lines."""
    return np.concatenate([getattr(line, data)() for line in lines])


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
