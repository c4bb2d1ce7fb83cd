"""`dataset.fivjax`: the picture and the scene of a dataset that fivjax made, without taking over how datasets show.

xarray is told of the accessor when fivjax makes or opens its first dataset, because only then is xarray loaded. What
draws stands in rooms above this one and cannot be imported here; whoever puts the package together (`fivjax/__init__.py`)
says who draws, by `draw_with`.
"""

import functools
from collections.abc import Callable
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import xarray as xr

    from ..model.scene import Scene

_drawing: list[Callable] = []


def draw_with(function: Callable) -> None:
    """Have datasets drawn by `function(dataset, **options)`, which returns a matplotlib figure."""
    _drawing[:] = [function]


class Accessor:
    """What a dataset of fivjax's offers beside xarray's own: `m.fivjax.plot()`, `m.fivjax.scene`."""

    def __init__(self, dataset: "xr.Dataset"):
        self._dataset = dataset

    @property
    def scene(self) -> "Scene":
        """The scene that the dataset came from, as `Scene.from_dataset`."""
        from ..model.scene import Scene

        return Scene.from_dataset(self._dataset)

    def plot(self, **options):
        """The picture of the dataset, a matplotlib figure; `options` are those of the function of `fj.plot` that draws it.

        **Raises:** `TypeError` where there is no picture of such a dataset.
        """
        return _drawing[0](self._dataset, **options)

    def show(self):
        """The picture of the dataset, as `fj.show`."""
        return self.plot()


@functools.cache
def register() -> None:
    """Tell xarray of `dataset.fivjax`, once."""
    import xarray as xr

    xr.register_dataset_accessor("fivjax")(Accessor)
