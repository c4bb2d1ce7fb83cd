# pyright: reportOptionalSubscript=false, reportOptionalMemberAccess=false
"""An explorer for notebooks: sliders for a scene's parameters, and its answer at once, from code compiled once."""

import io
from collections.abc import Mapping
from typing import Any, final

import numpy as np
import xarray as xr
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from PIL import Image

from ..contact import Status
from ..foundation import arguments
from ..foundation.precision import in_double_precision
from ..io.datasets import QUANTITIES
from ..linear.critical import critical_friction
from ..model.scene import Scene
from ..plot import results as plot
from ..plot.results import BLACK, BLUE, GREEN, STATUS_NAMES, VERMILION
from ..simulation.trajectory import Trajectory, simulate

# Rows a second: 22 a cycle at 68 Hz draw a round phase plane, and few enough to answer at once.
RATE = 1500
FIRST = ("mu", "mu_static", "mu_dynamic", "p", "belt_speed")
RANGES = {
    "mu": (0.0, 0.6),
    "mu_static": (0.0, 0.8),
    "mu_dynamic": (0.0, 0.8),
    "p": (1.0, 3.0),
    "belt_speed": (0.1, 10.0),
}
# What a structure's parameters range over, as shares of their own values.
SHARES = (0.5, 1.5)


def explorer(
    scene: Scene,
    dataset: xr.Dataset | None = None,
    *,
    t1: float = 1.5,
    ranges: Mapping[str, tuple[float, float]] | None = None,
) -> "Explorer":
    """Sliders for a scene, and its response, status, energy and phase plane, in a notebook.

        fj.explorer(scene)
        fj.explorer(scene, fj.bistability_map(scene, mu=…, p=…))  # a click on the map opens that lane

    **Arguments:** `scene`, where the sliders start; `dataset`, a map over two of the scene's parameters; `t1`, how much to
    simulate, in s; `ranges`, the ends of sliders by name of parameter.

    **Returns:** an `Explorer`, which shows itself.

    **Raises:** `ImportError` where ipywidgets or anywidget is missing, `ValueError` for unknown parameters or a map without
    two axes.
    """
    arguments.instance("scene", scene, Scene, "a Scene")
    arguments.real_number("t1", t1, above=0)
    if dataset is not None:
        arguments.instance("dataset", dataset, xr.Dataset, "a map, such as `bistability_map` returns")
    return Explorer(scene, dataset, float(t1), dict(ranges or {}))


@final
class Explorer:
    """What `explorer` returns: `sliders` by name, `picture`, `map` (or None), `said`, and `widget`, which holds them all."""

    def __init__(self, scene: Scene, dataset: xr.Dataset | None, t1: float, ranges: dict):
        widgets, picture = _widgets()
        self.scene, self.dataset, self.t1 = scene, dataset, t1
        unknown = [name for name in ranges if name not in scene.parameters]
        if unknown:
            raise ValueError(
                f"Argument `ranges` must name parameters of the scene, but `{unknown[0]}` is none; it has: "
                f"{', '.join(sorted(scene.parameters))}."
            )
        axes = {} if dataset is None else {str(name): dataset[name].values for name in dataset["verdict"].dims}
        self.sliders = {
            name: _slider(widgets, name, float(scene.parameters[name]), ranges, axes)
            for name in _shown(scene, {**ranges, **axes})
        }
        self._panels = _panels(t1)
        self.picture = picture(name="response")
        self.said = widgets.HTML()
        self.map = None
        if dataset is not None:
            self._map_axes, self._marked = _markable(plot.bistability(dataset))
            self.map = picture(name="map", clickable=True)
            self.map.observe(lambda change: self.open_lane(*change["new"]), "clicked")
        self._quiet = False
        self._lane = {name: float(scene.parameters[name]) for name in self.sliders}
        self._axes = axes
        for slider in self.sliders.values():
            slider.observe(lambda change: self.update(), "value")
        self.update()
        controls = widgets.VBox([*self.sliders.values(), self.said])
        rows = [widgets.HBox([controls, self.picture])]
        self.widget = widgets.VBox(rows if self.map is None else [*rows, self.map])

    def _repr_mimebundle_(self, **options) -> Any:
        return self.widget._repr_mimebundle_(**options)

    @in_double_precision
    def update(self) -> None:
        """Simulate with what the sliders say, and draw."""
        if self._quiet:
            return
        try:
            scene = self.scene.replace(**{name: self._value(name) for name in self.sliders})
            run = simulate(scene, self.t1, 1 / RATE, energy=True)
        except ValueError as error:
            self.said.value = f"<i>{error}</i>"
            return
        self.picture.png = self._panels(run)
        self.said.value = _said(run)
        if self.map is not None:
            self.map.png = self._marked(*(self._value(name) for name in self._axes))

    def _value(self, name: str) -> float:
        # A browser rounds what it is given to the slider's steps; the lane of a map is meant exactly.
        value, exact = self.sliders[name].value, self._lane.get(name, np.inf)
        return exact if abs(value - exact) <= 0.5001 * self.sliders[name].step else value

    def open_lane(self, right: float, down: float) -> None:
        """Show the lane of the map nearest to a place, given as shares of the picture's width and height.

        The other sliders go back to the map's scene: what is shown is that lane, and not one like it.
        """
        width, height = self._map_axes.figure.canvas.get_width_height()
        at = self._map_axes.transData.inverted().transform((right * width, (1 - down) * height))
        self._quiet = True
        try:
            self._lane = {name: float(self.scene.parameters[name]) for name in self.sliders}
            for (name, values), value in zip(self._axes.items(), at, strict=True):
                self._lane[name] = float(values[np.argmin(np.abs(values - value))])
            for name, value in self._lane.items():
                self.sliders[name].value = value
        finally:
            self._quiet = False
        self.update()


def _widgets():
    try:
        import ipywidgets

        from .clickable import Picture
    except ImportError as error:
        raise ImportError(
            f"The explorer needs {error.name}, which is not installed; install what notebooks need: "
            f'`pip install "fivjax[notebook]"`.'
        ) from error
    return ipywidgets, Picture


def _shown(scene: Scene, also: Mapping) -> list[str]:
    names = [name for name in FIRST if name in scene.parameters] + list(scene.structure.parameters)
    return list(dict.fromkeys([*names, *also]))


def _slider(widgets, name: str, value: float, ranges: Mapping, axes: Mapping):
    low, high = ranges.get(name) or RANGES.get(name) or tuple(share * value for share in SHARES)
    reached = [value, *([axes[name][0], axes[name][-1]] if name in axes else [])]
    low, high = float(min(low, *reached)), float(max(high, *reached))
    if low == high:
        high = low + 1.0
    # Steps of 1, 2 or 5 times a power of ten, at least five hundred of them: a value that was typed lies on one.
    finest = (high - low) / 500
    power = 10.0 ** np.floor(np.log10(finest))
    step = float(power * max(k for k in (1, 2, 5) if k <= finest / power * (1 + 1e-9)))
    # A browser rounds to steps from the lower end; the scene's own value has to be one of them.
    low = max(low, float(np.round(value - step * np.floor((value - low) / step + 1e-9), 12)))
    unit = QUANTITIES[name][1] if name in QUANTITIES else "1"
    return widgets.FloatSlider(
        value,
        min=low,
        max=high,
        step=step,
        description=name if unit == "1" else f"{name} ({unit})",
        readout_format=f".{max(0, -int(np.floor(np.log10(step) + 1e-9)))}f",
        style={"description_width": "9em"},
        layout={"width": "330px"},
    )


def _said(run: Trajectory) -> str:
    assert run.energy is not None
    ledger = run.energy.ledger
    limit = float(critical_friction(run.scene.structure, direction=1 if run.scene.belt_speed > 0 else -1))
    lines = [
        f"μ_crit = {limit:.4f} (linear theory)",
        f"{int(ledger.events[-1])} contact events",
        f"sticks {1e3 * ledger.stick_time[-1]:.1f} ms, detached {1e3 * ledger.detach_time[-1]:.1f} ms",
        f"mechanical energy at the end {run.energy.mechanical[-1]:.4g} J",
    ]
    return "<br>".join(lines)


def _panels(t1: float):
    """A function that draws a run into four panels whose artists are made once; returns PNG."""
    figure = Figure(figsize=(8.4, 4.8), dpi=80)
    canvas = FigureCanvasAgg(figure)
    grid = figure.add_gridspec(
        3,
        2,
        width_ratios=(5, 3),
        height_ratios=(4, 1, 3),
        left=0.1,
        right=0.98,
        top=0.97,
        bottom=0.1,
        hspace=0.35,
        wspace=0.28,
    )
    response, status, energy = (figure.add_subplot(grid[k, 0]) for k in range(3))
    phase = figure.add_subplot(grid[:, 1])
    (wave,) = response.plot([], [], color=BLUE, lw=0.7)
    (steps,) = status.plot([], [], ".", color=VERMILION, ms=2)
    (mechanical,) = energy.plot([], [], color=BLACK, lw=1.0, label="mechanical energy")
    (contact,) = energy.plot([], [], color=GREEN, lw=1.0, ls="--", label="from the contact, less damping")
    (orbit,) = phase.plot([], [], color=BLUE, lw=0.8)
    belt = phase.axhline(0, color=BLACK, ls=":", lw=0.8)
    response.set(ylabel="acceleration (m/s²)", xlim=(0, t1))
    status.set(ylim=(-0.5, 2.5), xlim=(0, t1))
    status.set_yticks([int(s) for s in Status], [STATUS_NAMES[s] for s in Status])
    energy.set(xlabel="time (s)", ylabel="energy (J)", xlim=(0, t1))
    # Between two panels, where no curve can run behind it.
    energy.legend(
        loc="lower right",
        bbox_to_anchor=(1, 0.97),
        ncols=2,
        fontsize="small",
        frameon=False,
        borderaxespad=0,
        borderpad=0.3,
    )
    phase.set(xlabel="tangential displacement (mm)", ylabel="tangential velocity (m/s)")
    for axes in (response, status):
        axes.tick_params(labelbottom=False)
    # What places labels, and how many ticks there are, is what drawing waits for.
    for axes, left in ((response, -0.13), (energy, -0.13), (phase, -0.21)):
        axes.yaxis.set_label_coords(left, 0.5)
        axes.yaxis.set_major_locator(MaxNLocator(5))
        axes.xaxis.set_major_locator(MaxNLocator(5))
    energy.xaxis.set_label_coords(0.5, -0.25)
    phase.xaxis.set_label_coords(0.5, -0.075)

    def draw(run: Trajectory) -> bytes:
        tangential = run.scene.structure.tangential
        late = np.asarray(run.t) > 0.7 * t1
        assert run.energy is not None
        work = run.energy.work
        wave.set_data(run.t, run.acceleration[:, tangential])
        steps.set_data(run.t, run.status)
        mechanical.set_data(run.t, run.energy.mechanical)
        contact.set_data(run.t, work.contact - work.damping)
        orbit.set_data(1e3 * run.displacement[late, tangential], run.velocity[late, tangential])
        belt.set_ydata([float(run.scene.belt_speed)] * 2)
        for axes in (response, energy, phase):
            axes.relim()
            axes.autoscale_view(scalex=axes is phase)
        # A belt far beyond the motion is left out of the picture rather than shrinking it.
        low, high = np.min(run.velocity[late, tangential]), np.max(run.velocity[late, tangential])
        room = 0.05 * (high - low) + 1e-9
        phase.set_ylim(low - room, high + room)
        canvas.draw()
        return _png(canvas)

    return draw


def _markable(figure: Figure):
    """The axes of a map's picture, and a function that returns it as PNG with a place marked; the map is drawn only once."""
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    axes = figure.axes[0]
    whole = canvas.copy_from_bbox(figure.bbox)
    (mark,) = axes.plot([], [], "o", ms=10, mfc="none", mec=VERMILION, mew=2.5, animated=True)

    def marked(x: float, y: float) -> bytes:
        canvas.restore_region(whole)
        mark.set_data([x], [y])
        axes.draw_artist(mark)
        return _png(canvas)

    return axes, marked


def _png(canvas: FigureCanvasAgg) -> bytes:
    written = io.BytesIO()
    # Little compression: what counts is that it comes at once.
    Image.fromarray(np.asarray(canvas.buffer_rgba())[..., :3]).save(written, format="png", compress_level=1)
    return written.getvalue()
