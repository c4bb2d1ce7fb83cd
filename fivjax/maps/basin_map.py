"""Basins of attraction: a map over initial states."""

import contextlib
from pathlib import Path

import numpy as np
import xarray as xr
from jaxtyping import Float, Int

from ..attractors.catalogue import Attractors
from ..cycles.cycle import under_final_load
from ..cycles.own_coordinates import in_own_coordinates
from ..foundation import arguments
from ..foundation.precision import in_double_precision
from ..model.scene import Scene
from ..model.sliding import contact_coordinates
from ..model.structure import Structure
from ..steppers.base import AbstractStepper
from ..steppers.event_exact import EventExact
from ..verdicts.verdict import Verdict
from .axes import at_middle, check_names, check_size, checked_axes, checked_time_limit, linear_limit
from .datasets import map_dataset, wilson
from .engine import RunOptions, run_to_verdict
from .executors import with_workers
from .groups import Limits, kick_of
from .plan import Grid, TrajectoryList
from .resuming import keeper_at

# The share of each basin, and its interval.
SHARES = ("share", "share_low", "share_high")


def state_places(structure: Structure) -> dict[str, int]:
    """The index in the state of each displacement and, with a `d` in front of its name, of each velocity."""
    names = structure.coordinates
    return {name: k for k, name in enumerate([*names, *(f"d{name}" for name in names)])}


def verdicts_from(
    scene: Scene, states: Float[np.ndarray, "k 2n"], label: str, attractors: dict[bytes, Attractors] | None = None
) -> Int[np.ndarray, " k"]:
    """The verdicts on motions that start in these states (displacements in m, velocities in m/s) under the final load.

    `attractors` as in `run_to_verdict`.
    """
    places = state_places(scene.structure)
    values = {name: np.ascontiguousarray(states[:, place]) for name, place in places.items()}
    scene, options = under_final_load(scene), RunOptions(label, progress=False, all_or_none=True)
    listed = TrajectoryList(values, places)
    return run_to_verdict(scene, listed, EventExact(), Limits(), options, attractors=attractors).verdict


@in_own_coordinates
@in_double_precision
@with_workers
def basins(
    scene: Scene,
    *,
    kick: bool = False,
    method: AbstractStepper | None = None,
    t_max: float | None = None,
    memory: float = 2e9,
    progress: bool | None = None,
    executor=None,
    resume: str | Path | None = None,
    **axes,
) -> xr.Dataset:
    """Which attractor each initial state leads to: a map over displacements and velocities, and the share of each basin.

        b = fj.basins(scene, x2=np.linspace(-0.02, 0.02, 64), dx2=np.linspace(-6.0, 6.0, 64))

    **Arguments:**

    - `scene`: the scene; coordinates that are not on an axis start at the sliding equilibrium under the load at the start.
    - `**axes`: one-dimensional, strictly increasing values: displacements (m) by the names of `scene.structure.coordinates`,
      velocities (m/s) by these names with a `d` in front; and any parameters of the scene, as in `bistability_map`.
      Displacements are totals, as in `y0` of `simulate`, not deviations from sliding.
    - `kick`: whether the load goes through its kick; else it has its final value from the start.
    - `method`, `t_max`, `memory`, `progress`, `executor`, `resume`: as in `bistability_map`.

    **Returns:** a dataset like that of `bistability_map`, with `verdict`, `amplitude` and `attractor` over the axes and the
    table of attractors. Over the attractors there is also `share`, the share of states that lead there, with `share_low` and
    `share_high` (a 95 % Wilson interval, as if the states were drawn at random); for sliding these are `sliding_share`,
    `sliding_share_low` and `sliding_share_high`. States without a verdict count for neither.

    With contacts given by vectors, the axes are coordinates of `fj.in_contact_coordinates(scene.structure)`: "tangential",
    "dtangential", …

    **Raises:** `ValueError` or `TypeError`, before anything is compiled, for unknown axis names, axes without a coordinate, and
    states below the belt or moving into it.

    **Example:**

        >>> b = fj.basins(scene, x2=np.linspace(-0.002, 0.002, 6), dx2=[-1.0, 0.0, 1.0])  # doctest: +SLOW
        >>> bool(b["sliding_share"] + b["share"].sum() <= 1.0)  # doctest: +SLOW
        True
    """
    method = EventExact() if method is None else method
    t_max = checked_time_limit(scene, method, t_max, memory)
    arguments.truth("kick", kick)
    kicked = scene
    if not kick:
        scene = under_final_load(scene)
    if of_kick := [name for name in axes if name in kicked.parameters and name not in scene.parameters]:
        raise ValueError(f"Axis `{of_kick[0]}` is of the kick, which is left out here. Give `kick=True`.")
    states = _states_among(scene, axes)
    if not states:
        names = ", ".join(f"{name}, d{name}" for name in scene.structure.coordinates)
        raise ValueError(f"A map of basins needs at least one displacement or velocity as its axis: {names}.")
    check_size(axes)
    parameters = checked_axes(scene, {name: values for name, values in axes.items() if name not in states})
    check_names(axes, *SHARES, *(f"sliding_{share}" for share in SHARES))
    axes = {name: parameters[name] if name in parameters else arguments.axis(name, axes[name]) for name in axes}
    grid = Grid(axes, states, kick_of(scene))
    _check_gap(scene.structure, axes)
    keeper = keeper_at(resume, scene, method, grid, {"t_max": t_max, "kick": bool(kick)})
    with contextlib.nullcontext() if keeper is None else contextlib.closing(keeper):
        verdicts = run_to_verdict(
            at_middle(scene, parameters),
            grid,
            method,
            Limits(t_max),
            RunOptions("basins", memory, progress, executor, keeper),
        )
    dataset = map_dataset(scene, method, t_max, grid, verdicts, linear_limit(scene, axes))
    for name, place in states.items():
        n = scene.structure.size
        what, unit = ("displacement", "m") if place < n else ("velocity", "m/s")
        dataset[name].attrs.update(long_name=f"initial {what} {scene.structure.coordinates[place % n]}", units=unit)
    return _with_shares(dataset)


def _states_among(scene: Scene, axes: dict) -> dict[str, int]:
    """The axes that are displacements or velocities, with their indices in the state."""
    known = state_places(scene.structure)
    unknown = [name for name in axes if name not in known and name not in scene.parameters]
    if unknown:
        raise ValueError(
            f"Unknown axis `{unknown[0]}`; the states are {', '.join(known)}, and the scene has "
            f"{', '.join(sorted(scene.parameters))}.{arguments.did_you_mean(unknown[0], [*known, *scene.parameters])}"
        )
    both = next((name for name in axes if name in known and name in scene.parameters), None)
    if both is not None:
        raise ValueError(
            f"Axis `{both}` is a part of the state and a parameter of the scene. Call one of them otherwise: `coordinates` of "
            f"the structure are names of your choice."
        )
    return {name: known[name] for name in axes if name in known}


def _check_gap(structure: Structure, axes: dict[str, np.ndarray]) -> None:
    for place in np.atleast_1d(contact_coordinates(structure)[1]):
        name = structure.coordinates[place]
        # Steady sliding is in contact.
        gap, rate = axes.get(name, np.zeros(1)), axes.get(f"d{name}", np.zeros(1))
        if gap[0] < 0:
            raise ValueError(f"Axis `{name}` must not go below the belt, but holds {gap[0]:g} m.")
        if gap[0] == 0 and rate[0] < 0:
            raise ValueError(
                f"Axis `d{name}` must not hold velocities into the belt where the contact is closed, but holds {rate[0]:g} "
                f"m/s. Start a little above the belt: give `{name}` positive values."
            )


def _with_shares(dataset: xr.Dataset) -> xr.Dataset:
    """The dataset with the share of each basin, and its interval."""
    total = dataset["verdict"].size
    reached = np.bincount(dataset["attractor"].values.ravel() + 1, minlength=dataset.sizes["attractors"] + 1)[1:]
    shares = np.stack(wilson(reached, total))
    sliding = np.stack(wilson(np.sum(dataset["verdict"].values == Verdict.SLIDING), total))
    for name, of_attractors, of_sliding in zip(SHARES, shares, sliding, strict=True):
        dataset[name] = ("attractors", of_attractors, {"long_name": "share of the initial states", "units": "1"})
        dataset[f"sliding_{name}"] = ((), of_sliding, {"long_name": "share of states that slide", "units": "1"})
    return dataset
