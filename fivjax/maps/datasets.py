"""The labelled dataset of a map: verdicts, attractors and the settings of the run."""

import json

import jax
import numpy as np
import xarray as xr
from jaxtyping import Int

from ..io.datasets import labelled
from ..model.scene import Scene
from ..steppers.base import AbstractStepper
from ..steppers.description import describe_method
from ..verdicts.verdict import FAILURES, MEANING, Verdict
from .attractors_listed import attractor_table
from .crossing import first_crossings
from .results import CHAOTIC, Verdicts
from .sharing import kernels_by
from .trajectories import Grid


def time_limit(t_max: float | None) -> dict[str, float]:
    """The attribute for a time limit, if one was given."""
    return {} if t_max is None else {"t_max": t_max}


def map_dataset(
    scene: Scene,
    method: AbstractStepper,
    t_max: float | None,
    grid: Grid,
    verdicts: Verdicts,
    linear: dict[str, float],
    source: Int[np.ndarray, " trajectories"] | None = None,
) -> xr.Dataset:
    """The labelled dataset of a grid of trajectories; `linear` is what linear theory says, see `axes.linear_limit`.

    `source`, if not all trajectories were computed: for each one the trajectory whose result it takes, in `verdicts` itself.
    """
    axes, shape = grid.axes, grid.shape
    place, table = attractor_table(grid.groups, verdicts)
    computed = {}
    if source is not None:
        own = source == np.arange(len(source), dtype=source.dtype)
        computed["computed"] = (tuple(axes), own.reshape(shape), {"long_name": "whether it was computed", "units": "1"})
        place = place[source]
        # One after the other in place: together they take as much memory as all the rest.
        for leaf in jax.tree.leaves(verdicts):
            leaf[:] = leaf[source]
    dataset = xr.Dataset(
        {
            "verdict": (tuple(axes), verdicts.verdict.reshape(shape)),
            "amplitude": (tuple(axes), verdicts.amplitude.reshape(shape)),
            "decided_at": (tuple(axes), verdicts.decided_at.reshape(shape)),
            "contact_events": (tuple(axes), verdicts.events.reshape(shape)),
            "last_event": (tuple(axes), verdicts.last_event.reshape(shape)),
            "attractor": (tuple(axes), place.reshape(shape)),
            "chaotic": (tuple(axes), (verdicts.attractor_kind == CHAOTIC).reshape(shape)),
            **computed,
            **{name: ("attractors", column) for name, column in table.items()},
            **{name: (tuple(axes), line.reshape(shape)) for name, line in verdicts.energy.items()},
        },
        coords=axes,
    )
    if "p" in axes:
        others = tuple(name for name in axes if name != "p")
        rows = dataset["verdict"].transpose(*others, "p").values.reshape(-1, len(axes["p"]))
        crossing, over = first_crossings(axes["p"], rows), [len(axes[name]) for name in others]
        dataset["p_crit"] = (others, crossing.middle.reshape(over))
        dataset["p_crit_low"] = (others, crossing.low.reshape(over))
        dataset["p_crit_high"] = (others, crossing.high.reshape(over))
    labelled(dataset, scene, method=describe_method(method), **time_limit(t_max))
    dataset.attrs.update(kernels_by(method, scene, bool(verdicts.energy)))
    dataset["verdict"].attrs.update(
        flag_values=np.array([verdict.value for verdict in MEANING], np.int8),
        flag_meanings=" ".join(verdict.name.lower() for verdict in MEANING),
        meaning=json.dumps({verdict.value: sentence for verdict, sentence in MEANING.items()}),
    )
    dataset.attrs.update(linear)
    first = Verdict(int(verdicts.verdict[0]))
    if first in FAILURES and np.all(verdicts.verdict == first):
        dataset.attrs["failure"] = MEANING[first]
    dataset.attrs["counts"] = json.dumps(
        {verdict.name.lower(): int(np.sum(verdicts.verdict == verdict)) for verdict in MEANING}
    )
    return dataset
