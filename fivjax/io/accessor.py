"""`dataset.fivjax`: the picture and the scene of a dataset that fivjax made. How xarray displays datasets is left alone.

The accessor is registered when fivjax makes or opens its first dataset, because only then is xarray loaded. Plotting lies
above this package and cannot be imported here; `fivjax/__init__.py` hands the function that draws to `draw_with`.
"""

import functools
from collections.abc import Callable
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import xarray as xr

    from ..model.scene import Scene

_drawing: list[Callable] = []


def draw_with(function: Callable) -> None:
    """Let `function(dataset, **options)`, which returns a matplotlib figure, draw datasets."""
    _drawing[:] = [function]


class Accessor:
    """What fivjax adds to a dataset: `m.fivjax.plot()`, `m.fivjax.scene`."""

    def __init__(self, dataset: "xr.Dataset"):
        self._dataset = dataset

    @property
    def scene(self) -> "Scene":
        """The scene that the dataset came from, see `Scene.from_dataset`."""
        from ..model.scene import Scene

        return Scene.from_dataset(self._dataset)

    def plot(self, **options):
        """The picture of the dataset, a matplotlib figure; `options` are those of the function of `fj.plot` that draws it.

        **Raises:** `ValueError` where there is no picture of such a dataset.
        """
        return _drawing[0](self._dataset, **options)

    def show(self):
        """The picture of the dataset, as `fj.show` draws it."""
        return self.plot()


@functools.cache
def register() -> None:
    """Register `dataset.fivjax` with xarray, once."""
    import xarray as xr

    xr.register_dataset_accessor("fivjax")(Accessor)
