"""The explorer's map: drawn once, marked at the values of the sliders, greyed out if it belongs to another scene, clickable."""

import numpy as np
import xarray as xr
from matplotlib.backends.backend_agg import FigureCanvasAgg

from .. import plot
from ..model.scene import Scene
from ..plot.style import VERMILION
from ..verdicts.verdict import Verdict
from .panels import png


class MapPicture:
    """A map of two axes, with the scene for which it was computed: that of the dataset if it has one, else the one given."""

    def __init__(self, dataset: xr.Dataset, scene: Scene):
        if "verdict" not in dataset:
            raise ValueError(
                "Argument `dataset` must be a map, such as `bistability_map` returns: it has no `verdict`."
            )
        self.dataset = dataset
        self.scene = Scene.from_dataset(dataset) if "scene" in dataset.attrs else scene
        self.values = {str(name): dataset[name].values for name in dataset["verdict"].dims}
        unknown = [name for name in self.values if name not in scene.parameters]
        if unknown:
            raise ValueError(
                f"Argument `dataset` must be a map over parameters of the scene, but `{unknown[0]}` is none; it has: "
                f"{', '.join(sorted(scene.parameters))}."
            )
        figure = plot.bistability(dataset)
        if len(self.values) != 2:
            raise ValueError(
                f"Argument `dataset` must be a map over two axes, but has only {', '.join(self.values)}. Give "
                f"`fj.bistability_map` another one, such as `p=np.linspace(1, 4, 64)`."
            )
        self._canvas = FigureCanvasAgg(figure)
        self._canvas.draw()
        self.axes = figure.axes[0]
        self._drawn = self._canvas.copy_from_bbox(figure.bbox)
        (self._mark,) = self.axes.plot([], [], "o", ms=10, mfc="none", mec=VERMILION, mew=2.5, animated=True)
        self._veil = self.axes.axhspan(0, 1, color="white", alpha=0.75, animated=True)
        self._veil.set(transform=self.axes.transAxes)
        place = {"ha": "center", "va": "center", "transform": self.axes.transAxes, "wrap": True}
        self._words = self.axes.text(0.5, 0.5, "", **place, animated=True, weight="bold")

    def differences(self, scene: Scene) -> dict[str, tuple[float | None, float | None]]:
        """Parameters, other than the map's axes, in which a scene differs from the map's: by name, the map's value and the
        scene's.
        """
        ours, theirs = (_numbers(one) for one in (self.scene, scene))
        names = [name for name in dict.fromkeys([*ours, *theirs]) if name not in self.values]
        return {name: (ours.get(name), theirs.get(name)) for name in names if ours.get(name) != theirs.get(name)}

    def verdict(self, scene: Scene) -> tuple[Verdict, float] | None:
        """The verdict on a scene that is exactly one of the map's, and when it was decided (s); None for any other scene."""
        at = {name: float(scene.parameters[name]) for name in self.values if name in scene.parameters}
        if self.differences(scene) or any(not np.any(self.values[name] == x) for name, x in at.items()):
            return None
        found = self.dataset.sel(at)
        when = float(found["decided_at"]) if "decided_at" in found else np.nan
        return Verdict(int(found["verdict"])), when

    def marked(self, scene: Scene) -> bytes:
        """The map as PNG, with the scene's point marked; greyed out, with a text over it, if it belongs to another scene."""
        self._canvas.restore_region(self._drawn)
        different = self.differences(scene)
        if different:
            self._words.set_text(stale(different))
            self.axes.draw_artist(self._veil)
            self.axes.draw_artist(self._words)
        else:
            self._mark.set_data(*([float(scene.parameters[name])] for name in self.values))
            self.axes.draw_artist(self._mark)
        return png(self._canvas)

    def nearest(self, right: float, down: float) -> dict[str, float] | None:
        """The map's values nearest to a point, given as shares of the picture's width and height; None outside of the map."""
        width, height = self._canvas.get_width_height()
        place = right * width, (1 - down) * height
        if not self.axes.bbox.contains(*place):
            return None
        at = self.axes.transData.inverted().transform(place)
        return {
            name: float(values[np.argmin(np.abs(values - value))])
            for (name, values), value in zip(self.values.items(), at, strict=True)
        }


def _numbers(scene: Scene) -> dict[str, float]:
    """The parameters of a scene, those with a value for each contact one by one."""
    found = {}
    for name, value in scene.parameters.items():
        if np.ndim(value):
            found |= {f"{name}_{i}": float(x) for i, x in enumerate(value)}
        else:
            found[name] = float(value)
    return found


def stale(different: dict[str, tuple[float | None, float | None]]) -> str:
    """The text over a map that belongs to another scene than the one shown."""
    ours, theirs = (
        ", ".join(f"{name} = {pair[k]:g}" for name, pair in different.items() if pair[k] is not None) for k in (0, 1)
    )
    return f"This map is of {ours or 'another friction law'};\nshown is {theirs or 'another friction law'}."
