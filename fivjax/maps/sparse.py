"""Sparse maps: the computed points of a refined grid as a dataset, and parts of the grid made of them."""

import json

import numpy as np
import xarray as xr

from ..foundation import arguments
from ..io.datasets import label
from ..verdicts.verdict import Verdict
from .datasets import POINT, from_rows, summarised, with_critical_kicks
from .plan import Grid
from .refinement import Levels, Refined, finer_axis, placed


def levels_note(grid: Grid, refined: Refined) -> dict[str, str | int]:
    """The grid of a sparse map as attributes of its dataset: the axes before they were halved, the levels, and how many points
    were computed.
    """
    levels = refined.levels
    coarse = {name: values[:: levels.coarsest].tolist() for name, values in grid.axes.items()}
    return {
        "axes": json.dumps(coarse),
        "coarsest": levels.coarsest,
        "finest": levels.finest,
        "computed": len(refined.places),
    }


def _grid_of(points: xr.Dataset) -> tuple[dict[str, np.ndarray], Refined, xr.Dataset]:
    """The axes of a sparse map, its grid, and the dataset with its points in their order on it.

    **Raises:** `TypeError` or `ValueError` for what is none, or has lost some of its points.
    """
    arguments.instance("points", points, xr.Dataset, "the dataset of a sparse map")
    if POINT not in points.dims or not {"axes", "coarsest", "finest", "computed"} <= set(points.attrs):
        raise ValueError(
            "Argument `points` must be a sparse map, but has the dimensions "
            f"{', '.join(map(str, points.dims))}. Make one by `fj.bistability_map(..., refine=…, sparse=True)`."
        )
    places, computed = points["place"].values, int(points.attrs["computed"])
    if places.dtype.kind != "i" or len(np.unique(places)) != computed or len(places) != computed:
        raise ValueError(
            f"Argument `points` must have all {computed:,} points that were computed, each once, but has others: "
            f"{len(places):,}. Take the window first, and select from that."
        )
    points = points.isel({POINT: np.argsort(places)})
    coarsest = int(points.attrs["coarsest"])
    axes = {
        name: finer_axis(np.array(values), coarsest.bit_length() - 1)
        for name, values in json.loads(points.attrs["axes"]).items()
    }
    levels = Levels(tuple(map(len, axes.values())), coarsest, int(points.attrs["finest"]))
    return axes, Refined(points["place"].values, points["step"].values, levels), points


def window(points: xr.Dataset, *, most: int = 1000, **bounds: tuple[float, float]) -> xr.Dataset:
    """A part of a sparse map as a dataset over its axes: to look at it, or to draw it.

        m = fj.bistability_map(scene, mu=np.linspace(0.05, 0.228, 51), p=np.linspace(1, 4, 51), refine=11, sparse=True)
        fj.plot.bistability(fj.window(m, mu=(0.20, 0.21), p=(1.2, 1.5)))

    **Arguments:**

    - `points`: the dataset of `bistability_map(..., refine=…, sparse=True)`.
    - `**bounds`: the least and the greatest value on an axis, by its name; the whole axis unless given.
    - `most`: the most values on each axis. Of a longer one every second is left out, again and again.

    **Returns:** a dataset over the axes like that of `bistability_map`, whose points that were not computed take the result of
    the point before them on the coarser grid (`computed` says which were). `p_crit` is between neighbours of its own values.

    **Raises:** `TypeError` or `ValueError` for another dataset, unknown axes, and bounds that hold no value.

    **Example:**

        >>> m = fj.bistability_map(  # doctest: +SLOW
        ...     scene, mu=[0.1, 0.15, 0.2], p=[1.0, 2.0, 3.0], refine=3, sparse=True
        ... )
        >>> part = fj.window(m, mu=(0.15, 0.2), p=(1.0, 2.0))  # doctest: +SLOW
        >>> part["verdict"].shape  # doctest: +SLOW
        (9, 9)
    """
    most = arguments.whole_number("most", most, minimum=1)
    axes, refined, points = _grid_of(points)
    unknown = [name for name in bounds if name not in axes]
    if unknown:
        hint = arguments.did_you_mean(unknown[0], axes)
        raise ValueError(f"Unknown axis `{unknown[0]}`; this map has: {', '.join(axes)}.{hint}")
    along = [_within(name, values, bounds.get(name), most) for name, values in axes.items()]
    shape, part = refined.levels.shape, [len(index) for index in along]
    places = np.ravel_multi_index(np.ix_(*along), shape).ravel()
    rows = refined.rows(places)
    results = {
        name: (tuple(axes), from_rows(str(name), variable.values, rows).reshape(part), variable.attrs)
        for name, variable in points.data_vars.items()
        if variable.dims == (POINT,) and name not in ("place", "step")
    }
    results |= {name: variable for name, variable in points.data_vars.items() if variable.dims == ("attractors",)}
    coords = {
        name: (name, values[index], points[name].attrs)
        for (name, values), index in zip(axes.items(), along, strict=True)
    }
    of_grid = ("summary", "axes", "coarsest", "finest", "computed")
    dataset = xr.Dataset(results, coords, {name: value for name, value in points.attrs.items() if name not in of_grid})
    computed = placed(refined.places, places)[0].reshape(part) & (dataset["verdict"].values != Verdict.NOT_RUN)
    dataset["computed"] = label(xr.DataArray(computed, dims=tuple(axes), name="computed"))
    listed = f"{' × '.join(map(str, part))} of {' × '.join(map(str, shape))} trajectories over {', '.join(axes)}"
    # A number of the structure may be called so, too.
    if "p" in json.loads(dataset.attrs["scene"])["of_load"]:
        dataset = with_critical_kicks(dataset)
    return summarised(dataset, listed)


def _within(name: str, values: np.ndarray, bounds: tuple[float, float] | None, most: int) -> np.ndarray:
    """The indices of values on an axis within bounds: in steps of the least power of two with which there are few enough."""
    pair = arguments.numeric_array(name, values[[0, -1]] if bounds is None else bounds).astype(float)
    if pair.shape != (2,) or not pair[0] <= pair[1]:
        raise ValueError(f"Argument `{name}` must be a least and a greatest value, in this order, but is {bounds!r}.")
    low, high = pair
    first, last = np.searchsorted(values, low, side="left"), np.searchsorted(values, high, side="right")
    if first == last:
        raise ValueError(
            f"Argument `{name}` must hold values of the axis, which goes from {values[0]:g} to {values[-1]:g} in "
            f"{len(values) - 1:,} steps, but goes from {low:g} to {high:g}."
        )
    step = 1
    while len(index := np.arange(-(-first // step) * step, last, step)) > most:
        step *= 2
    return index
