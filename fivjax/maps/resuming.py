"""Where a map keeps its finished jobs, and the description by which a resumed map is recognised."""

import re
from importlib import metadata
from pathlib import Path

import jax
import jax.numpy as jnp

from .. import contact as physics
from ..foundation import arguments
from ..foundation.traced_code import digest, is_from_outside
from ..io.files import check_writable
from ..model.description import code_of, describe
from ..model.scene import Scene
from ..section.about_sliding import mechanics_about_sliding
from ..steppers.base import AbstractStepper
from .checkpoint import Checkpoint
from .groups import bytes_per_trajectory, kernels_by
from .plan import Grid, largest_job_size, takes_long
from .results import by_name, not_run
from .store import Store, is_store


def keeper_at(
    path: str | Path | None,
    scene: Scene,
    method: AbstractStepper,
    grid: Grid,
    limits: dict,
    energy: bool = False,
    sparse: bool = False,
) -> Checkpoint | Store | None:
    """The object that keeps the results of a map at this path; None without a path. `limits`: other arguments of the map that
    affect its results. A `sparse` map has results for few of its points.

    **Raises:** `TypeError` for an object that is no path; `ValueError` for a file or folder that belongs to another map, and
    for a folder if the map is sparse.
    """
    if path is None:
        return None
    arguments.instance("resume", path, str | Path, 'the path of a file, such as "map.part", or of a folder "map.zarr"')
    if not is_store(path):
        check_writable(path)
    # The working directory may change while the map is computed.
    path = Path(path).absolute()
    # Packages whose versions may change a map's last bits.
    packages = ("jax", "jaxlib", "numpy", "scipy", "diffrax", "equinox")
    # Compared by the digests of `code_of`.
    told_by_code = ("structure_code", "own_parts")
    run = {
        "fivjax": metadata.version("fivjax"),
        **{package: metadata.version(package) for package in packages},
        **kernels_by(method, scene),
        "device": jax.devices()[0].device_kind,
        "scene": {name: value for name, value in describe(scene).items() if name not in told_by_code},
        "method": re.sub(r" at 0x[0-9a-f]+", "", repr(method)),
        "code": code_of(scene) | _code_of_method(method, scene),
        **limits,
        "results": [*by_name(not_run(0, energy))],
        "axes": {name: values.tolist() for name, values in grid.axes.items()},
    }
    if not is_store(path):
        return Checkpoint(path, run, grid.total, energy)
    if sparse:
        raise ValueError(
            f"Argument `resume` must be a file for a sparse map, but is the folder `{path}`: give another name."
        )
    per_group = grid.total / grid.group_count
    each = bytes_per_trajectory(scene, per_group)
    # The chunks are those of a short run: a store that is resumed with more points, or fewer, finds the same ones.
    tile = grid.tile(largest_job_size(takes_long(scene, method, energy), each, per_group, 1))
    return Store(path, run, grid, tile, energy)


def _code_of_method(method: AbstractStepper, scene: Scene) -> dict[str, str]:
    """A digest of what a stepper of a user's own computes; the others are fixed by fivjax's version."""
    if not is_from_outside(method):
        return {}
    state, one = jnp.ones(2 * scene.structure.size), jnp.ones(())
    return {"stepper": digest(_of_method, method, scene, state, one)}


def _of_method(method: AbstractStepper, scene: Scene, y, one):
    mechanics = mechanics_about_sliding(scene)
    contact = physics.status_from_forces(mechanics, one, y)
    advances = [method.advance(mechanics, contact, one, y, one, at_section) for at_section in (False, True)]
    return advances, method.within(mechanics, contact, one, y, one)
