"""Bi-stability maps: many trajectories, one batch run, labelled results."""

import contextlib
import functools
from pathlib import Path

import numpy as np
import xarray as xr

from ..foundation import arguments
from ..foundation.precision import in_double_precision
from ..model.scene import Scene
from ..steppers.base import AbstractStepper
from ..steppers.event_exact import EventExact
from .axes import check_run, checked_axes, checked_grid
from .datasets import map_dataset
from .engine import MOST_STEPS, run_to_verdict
from .executors import with_workers
from .refinement import audit_note, finer, refined
from .results import not_run
from .resuming import keeper_at


@in_double_precision
@with_workers
def bistability_map(
    scene: Scene,
    *,
    method: AbstractStepper | None = None,
    t_max: float | None = None,
    memory: float = 2e9,
    max_steps: int = MOST_STEPS,
    progress: bool | None = None,
    resume: str | Path | None = None,
    energy: bool = False,
    refine: int = 0,
    audit: float = 0.01,
    executor=None,
    **axes,
) -> xr.Dataset:
    """Where a scene returns to sliding after its kick, and where it ends on a limit cycle; one batch run.

        m = fj.bistability_map(scene, mu=np.linspace(0.05, 0.228, 64), p=np.linspace(1, 4, 64))

    **Arguments:**

    - `scene`: the scene; parameters that are not on an axis keep its values.
    - `**axes`: one-dimensional, strictly increasing values of any numeric parameter in `scene.parameters`, by name. One
      trajectory is run for each combination, from the sliding equilibrium of its own scene.
    - `method`: how to step, `EventExact()` unless given.
    - `t_max`: time after which a trajectory without a verdict is called undecided, in s. Unless given, it is 20 s, or 2,000
      periods of the structure's slowest mode if these are longer; and the time in which a motion just grows, without contact
      events, is not counted: nobody has to step through it.
    - `memory`: how much memory the jobs that run at a time in this process may take, in bytes; there is one at least.
    - `max_steps`: steps after which a trajectory without a verdict is called a step failure.
    - `progress`: show a bar; unless given, where there is a terminal or a notebook to show it in.
    - `resume`: a file in which finished jobs are kept while the map runs, every few seconds; or a folder named `*.zarr`, for
      maps of many million trajectories, in which each job is kept at once and which `xarray.open_zarr` reads at any time (extra
      `fivjax[zarr]`). If it exists, the map goes on from there: interrupted in whatever way and called again, on this
      machine or another, the same call gives the same map, bit for bit. It stays; delete it when the map is saved.
    - `executor`: who computes: threads of this process unless given, or anything like `concurrent.futures.ProcessPoolExecutor`
      (loky, `mpi4py.futures`), a Dask `Client`, or a function that makes one of these. The map is the same, bit for bit. What
      lost its worker is handed out anew; what kills its worker three times running alone has the verdict -9.
    - `energy`: whether to keep each trajectory's energy ledger up to its verdict (see `fivjax.energy`): the works, the energy
      lost in re-contacts, `kick_energy` (of the vibration when the kick ends, J), and `energy_residual`, the largest
      error of the balance on the way, with `energy_exchanged` (the sizes of the works and the loss, net of each line) to
      measure it against: 1e-8 of it at most, but for one trajectory in a thousand. It makes a map some ten times slower.

    - `refine`: how many times to halve the intervals of all axes, but only where neighbours differ in verdict or attractor. An
      axis of n values becomes one of `(n - 1) * 2**refine + 1`; places that are not computed take what the place before them
      on the coarser grid has, and the variable `computed` says which these are. What lies between the coarse grid's
      places, and touches none, is missed.
    - `audit`: the share of the places not computed that are computed all the same, at random, to count how many of them are
      wrong: the attributes `audit_cells`, `audit_wrong`, `audit_rate`, and its interval of 95 %, `audit_rate_low` and
      `audit_rate_high`.

    **Returns:** a dataset with the axes as dimensions and, over all of them, `verdict` (0 sliding, 1 limit cycle,
    -1 undecided, other negative numbers failures; the variable's attributes give each a sentence), `amplitude` (peak
    tangential speed on its attractor in m/s; 0 for sliding), `decided_at` (s), `contact_events` and `last_event` (s).
    With an axis p, `p_crit_low` and `p_crit_high` over the others are the two kicks on it between which the limit cycle
    first appears, proved to slide and proved to end on it, and `p_crit` is their middle, NaN where undecided kicks lie
    between; `critical_perturbation` narrows that down. With an axis mu, the attribute `mu_crit` is the critical friction
    of linear theory. Where no trajectory could be followed, all for the same reason, the attribute `failure` says it.

    **Raises:** `ValueError` or `TypeError`, before anything is compiled, for unknown axis names, axes that are empty or
    not increasing, values that the scene refuses, and a `resume` file that belongs to another run.

    **Example:**

        >>> m = fj.bistability_map(scene, mu=[0.1, 0.15, 0.2, 0.227], p=[1.0, 1.2, 1.5, 2.0, 3.0])  # doctest: +SLOW
        >>> m["verdict"].sel(mu=0.2).values
        array([0, 0, 1, 1, 1], dtype=int8)
    """
    method = EventExact() if method is None else method
    check_run(scene, method, t_max, memory)
    arguments.whole_number("max_steps", max_steps, minimum=1)
    arguments.truth("energy", energy)
    if not axes:
        raise ValueError(
            "A map needs at least one axis, such as `mu=np.linspace(0.05, 0.228, 64)`; the scene has: "
            f"{', '.join(sorted(scene.parameters))}."
        )
    arguments.whole_number("refine", refine, minimum=0)
    arguments.real_number("audit", audit, minimum=0, maximum=1)
    axes = {name: finer(values, refine) for name, values in checked_axes(scene, axes).items()}
    grid = checked_grid(axes)
    limits = {"t_max": t_max, "max_steps": int(max_steps), "energy": bool(energy)}
    limits |= {"refine": int(refine), "audit": float(audit)} if refine else {}
    keeper = keeper_at(resume, scene, method, grid, limits, bool(energy))
    run = functools.partial(
        run_to_verdict,
        scene,
        grid,
        method,
        t_max=t_max,
        memory=memory,
        max_steps=max_steps,
        progress=progress,
        energy=bool(energy),
        executor=executor,
        keeper=keeper,
    )
    with contextlib.nullcontext() if keeper is None else contextlib.closing(keeper):
        verdicts = None if keeper is None else keeper.verdicts
        if not refine:
            verdicts = run(label="map", verdicts=verdicts)
            return map_dataset(scene, method, t_max, grid, verdicts)
        verdicts = not_run(grid.total, bool(energy)) if verdicts is None else verdicts
        found: dict = {}  # attractors, which another level need not find anew

        def level(places: np.ndarray, what: str) -> None:
            run(label=f"map, {what}", verdicts=verdicts, places=places, attractors=found)

        source, checked = refined(grid.shape, refine, audit, verdicts, level)
    dataset = map_dataset(scene, method, t_max, grid, verdicts, source=source)
    dataset.attrs.update(audit_note(checked))
    return dataset
