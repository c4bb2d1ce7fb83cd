"""Where a map keeps its finished jobs, and the description by which a resumed map is recognised."""

from importlib import metadata
from pathlib import Path

import jax

from ..batches.sharing import bytes_per_trajectory, in_bulk, kernels_by
from ..foundation import arguments
from ..io.datasets import describe
from ..model.scene import Scene
from ..steppers.base import AbstractStepper
from .checkpoint import Checkpoint
from .plan import in_a_job
from .store import Store, is_store
from .trajectories import Grid


def keeper_at(
    path: str | Path | None, scene: Scene, method: AbstractStepper, grid: Grid, limits: dict, energy: bool = False
) -> Checkpoint | Store | None:
    """The object that keeps the results of a map at this path; None without a path. `limits`: other arguments of the map that
    affect its results.

    **Raises:** `TypeError` for an object that is no path; `ValueError` for a file or folder that belongs to another map.
    """
    if path is None:
        return None
    arguments.instance("resume", path, str | Path, 'the path of a file, such as "map.part", or of a folder "map.zarr"')
    run = {
        "fivjax": metadata.version("fivjax"),
        "jax": jax.__version__,
        **kernels_by(method, scene, energy),
        "device": jax.devices()[0].device_kind,
        "scene": describe(scene),
        "method": repr(method),
        **limits,
        "axes": {name: values.tolist() for name, values in grid.axes.items()},
    }
    if not is_store(path):
        return Checkpoint(path, run, grid.total, energy)
    of_group = grid.total / grid.group_count
    each = bytes_per_trajectory(scene, of_group)
    tile = grid.tile(in_a_job(method if energy else in_bulk(method, scene), each, of_group))
    return Store(path, run, grid, tile, energy)
