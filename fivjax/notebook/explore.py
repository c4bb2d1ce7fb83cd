"""An explorer for notebooks: sliders for a scene's parameters, and its response at once, from code compiled once."""

import json
from collections.abc import Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any, final

import numpy as np
import xarray as xr

from ..foundation import arguments
from ..foundation.precision import in_double_precision
from ..linear.critical import critical_friction
from ..maps.bistability import bistability_map
from ..model.scene import Scene, refuse_vector_contacts
from ..simulation.trajectory import Trajectory, simulate
from ..verdicts.verdict import Verdict
from .map_picture import MapPicture
from .panels import drawing_panels
from .sliders import BESIDE, PICTURE, parameters_shown, slider


def explorer(
    scene: Scene,
    dataset: xr.Dataset | None = None,
    *,
    t1: float = 1.5,
    ranges: Mapping[str, tuple[float, float]] | None = None,
) -> "Explorer":
    """Sliders for a scene, and its response, status, energy, phase plane and verdict, in a notebook.

        fj.explorer(scene)
        fj.explorer(scene, fj.bistability_map(scene, mu=…, p=…))  # a click on the map opens that trajectory

    A map belongs to the parameters for which it was computed: when other sliders change, it is greyed out, and a button
    computes it anew, event by event. With several contacts, each has its colour and its row of statuses; parameters that hold
    a value for each contact have no slider.

    **Arguments:** `scene`, which gives the first values of the sliders; `dataset`, a map over two of the scene's parameters;
    `t1`, the time to simulate, in s; `ranges`, the ends of sliders by name of parameter.

    **Returns:** an `Explorer`, which notebooks display.

    **Raises:** `ImportError` where ipywidgets or anywidget is missing, `ValueError` for unknown parameters or a map without
    two axes that are parameters of the scene.

    **Example:**

        >>> explorer = fj.explorer(scene, t1=0.5)  # doctest: +SLOW
    """
    arguments.instance("scene", scene, Scene, "a Scene")
    arguments.known("scene", scene)
    refuse_vector_contacts(scene.structure, "`explorer`")
    arguments.real_number("t1", t1, above=0)
    if dataset is not None:
        arguments.instance("dataset", dataset, xr.Dataset, "a map, such as `bistability_map` returns")
    ranges = arguments.by_name("ranges", ranges, '"mu": (0.1, 0.4)')
    for name, pair in ranges.items():
        ends = arguments.numeric_array(f"ranges[{name!r}]", pair)
        if ends.shape != (2,) or not ends[0] < ends[1] or not np.all(np.isfinite(ends)):
            raise ValueError(
                f"Argument `ranges` must hold the two ends of each slider, the lower one first, but `{name}` has {pair!r}."
            )
    return Explorer(scene, dataset, float(t1), ranges)


@final
class Explorer:
    """The result of `explorer`: `sliders` by name, `picture`, `map` and `anew` (or None), `said`; `widget` contains them
    all.
    """

    def __init__(self, scene: Scene, dataset: xr.Dataset | None, t1: float, ranges: dict):
        widgets, picture = _widgets()
        self.scene, self.t1 = scene, t1
        unknown = [name for name in ranges if name not in scene.parameters]
        if unknown:
            raise ValueError(
                f"Argument `ranges` must name parameters of the scene, but `{unknown[0]}` is none; it has: "
                f"{', '.join(sorted(scene.parameters))}."
            )
        self._map = None if dataset is None else MapPicture(dataset, scene)
        axes = {} if self._map is None else self._map.values
        arguments.single_numbers("ranges", ranges, scene.parameters)
        self._exact = {name: float(scene.parameters[name]) for name in parameters_shown(scene, {**ranges, **axes})}
        self.sliders = {name: slider(widgets, name, value, ranges, axes) for name, value in self._exact.items()}
        self._panels = drawing_panels(t1, len(scene.structure.contacts))
        self.picture = picture(name="response", layout=PICTURE)
        self.said = widgets.HTML()
        self.map = self.anew = None
        self._shown: Scene | None = scene
        # Verdicts are computed one at a time beside the pictures; only the last one requested is shown.
        self._worker = ThreadPoolExecutor(max_workers=1)
        self._pending: Future | None = None
        self._quiet = False
        rows = [widgets.HBox([widgets.VBox([*self.sliders.values(), self.said]), self.picture], layout=BESIDE)]
        if self._map is not None:
            self.map = picture(name="map", answers_clicks=True)
            self.map.observe(lambda change: self.open_trajectory(*change["new"]), "clicked")
            self.anew = widgets.Button(description="compute the map anew", layout={"width": "auto"})
            self.anew.on_click(lambda _: self.compute_map())
            rows += [self.map, self.anew]
        self.widget = widgets.VBox(rows)
        for each in self.sliders.values():
            each.observe(lambda change: self.update(), "value")
        self.update()

    def _repr_mimebundle_(self, **options) -> Any:
        return self.widget._repr_mimebundle_(**options)

    @in_double_precision
    def update(self) -> None:
        """Simulate with the values of the sliders, and draw; the verdict follows when it is known."""
        # Rows per second: 22 per cycle at 68 Hz are enough for a smooth phase plane, and few enough for an immediate response.
        rate = 1500
        if self._quiet:
            return
        try:
            scene = self.scene.replace(**{name: self._value(name) for name in self.sliders})
            run = simulate(scene, self.t1, 1 / rate, energy=True)
        except ValueError as error:
            # A verdict that is still to come is of other values.
            self._shown = None
            self.said.value = f"<i>{error}</i>"
            return
        self._shown = scene
        self.picture.png = self._panels(run)
        lines = _said(run)
        known = None if self._map is None else self._map.verdict(scene)
        self.said.value = "<br>".join([_in_words(known), *lines])
        if self._map is not None:
            self.map.png = self._map.marked(scene)
            self.anew.layout.display = "" if self._map.differences(scene) else "none"
        if self._pending is not None:
            self._pending.cancel()
            self._pending = None
        if known is None:
            self._pending = self._worker.submit(self._judge, scene, lines)

    def wait(self) -> None:
        """Wait until no computation is running."""
        if self._pending is not None and not self._pending.cancelled():
            self._pending.result()

    def open_trajectory(self, right: float, down: float) -> None:
        """Show the trajectory of the map nearest to a point, given as shares of the picture's width and height.

        All other sliders return to the values of the map's scene, so that exactly this trajectory is shown. A point outside of
        the map has no effect.
        """
        found = self._map.nearest(right, down)
        if found is None:
            return
        self._quiet = True
        try:
            self._exact = {name: float(self._map.scene.parameters[name]) for name in self.sliders} | found
            for name, value in self._exact.items():
                self.sliders[name].value = value
        finally:
            self._quiet = False
        self.update()

    def compute_map(self) -> None:
        """Compute the map for the values of the sliders, over the same axes; where these are refused, nothing is computed."""
        if self._shown is None:
            return
        self.anew.disabled, self.anew.description = True, "computing the map …"
        try:
            settings = json.loads(self._map.dataset.attrs.get("settings", "{}"))
            limit = {"t_max": settings["t_max"]} if "t_max" in settings else {}
            dataset = bistability_map(self._shown, progress=False, **limit, **self._map.values)
            self._map = MapPicture(dataset, self._shown)
        finally:
            self.anew.disabled, self.anew.description = False, "compute the map anew"
        self.update()

    def _judge(self, scene: Scene, lines: list[str]) -> None:
        name = next(iter(self.sliders))
        try:
            found = bistability_map(scene, progress=False, **{name: [float(scene.parameters[name])]})
            first = _in_words((Verdict(int(found["verdict"][0])), float(found["decided_at"][0])))
        except ValueError as error:
            first = f"<i>{error}</i>"
        if scene is self._shown:
            self.said.value = "<br>".join([first, *lines])

    def _value(self, name: str) -> float:
        # A browser rounds values to the steps of a slider; a trajectory of the map needs its exact values.
        value, exact = self.sliders[name].value, self._exact.get(name, np.inf)
        return exact if abs(value - exact) <= 0.5001 * self.sliders[name].step else value


def _widgets():
    try:
        import ipywidgets

        from .picture_widget import Picture
    except ImportError as error:
        raise ImportError(
            f"The explorer needs {error.name}, which is not installed: `pip install ipywidgets anywidget`, or, in a "
            f'checkout of fivjax, `pip install ".[notebook]"` for all that notebooks need.'
        ) from error
    return ipywidgets, Picture


def _in_words(known: tuple[Verdict, float] | None) -> str:
    if known is None:
        return "<b>verdict …</b>"
    verdict, when = known
    proved = verdict >= 0 and np.isfinite(when)
    return f"<b>verdict: {verdict.words}</b>{f', known after {when:.3g} s' if proved else ''}"


def _said(run: Trajectory) -> list[str]:
    assert run.energy is not None
    ledger = run.energy.ledger
    structure, count = run.scene.structure, len(run.scene.structure.contacts)
    if count == 1:
        durations = [f"sticks {1e3 * ledger.stick_time[-1]:.1f} ms, detached {1e3 * ledger.detach_time[-1]:.1f} ms"]
    else:
        stick, detach = (1e3 * np.asarray(ledger.by_contact[name][-1]) for name in ("stick_time", "detach_time"))
        durations = [f"contact {i} sticks {stick[i]:.1f} ms, detached {detach[i]:.1f} ms" for i in range(count)]
    ways = np.unique(np.sign(np.asarray(run.scene.belt_speed)))
    # Linear theory has one friction for all contacts, on belts that move the same way.
    limits = [f"{float(critical_friction(structure, direction=int(way))):.4f}" for way in ways]
    return [
        *(f"μ_crit = {limit} (linear theory, this structure)" for limit in limits if len(limits) == 1),
        f"{int(ledger.events[-1])} contact events in {run.t[-1]:g} s",
        *durations,
        f"mechanical energy at the end {run.energy.mechanical[-1]:.4g} J",
    ]
