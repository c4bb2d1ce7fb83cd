"""Bi-stability maps: the verdicts of many trajectories over any parameters, as a labelled dataset."""

import contextlib
import warnings
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path

import numpy as np
import xarray as xr

from ..cycles.own_coordinates import in_own_coordinates
from ..foundation import arguments
from ..foundation.precision import in_double_precision
from ..foundation.stopping import stop_requests
from ..model.scene import Scene
from ..steppers.base import AbstractStepper
from ..steppers.event_exact import EventExact
from .axes import at_middle, check_size, checked_axes, checked_time_limit, linear_limit
from .datasets import audit_note, map_dataset
from .engine import RunOptions, interrupted, run_to_verdict
from .executors import with_workers
from .groups import Limits, kick_of
from .plan import Grid
from .refinement import finer_axis, refine_grid
from .results import Verdicts, not_run
from .resuming import keeper_at
from .sparse import levels_note


@in_own_coordinates
@in_double_precision
@with_workers
def bistability_map(
    scene: Scene,
    *,
    method: AbstractStepper | None = None,
    t_max: float | None = None,
    memory: float = 2e9,
    max_steps: int = Limits().max_steps,
    progress: bool | None = None,
    resume: str | Path | None = None,
    energy: bool = False,
    refine: int = 0,
    sparse: bool = False,
    audit: float = 0.01,
    executor=None,
    **axes,
) -> xr.Dataset:
    """Where a scene returns to sliding after its kick, and where it ends on a limit cycle, over any parameters.

        m = fj.bistability_map(scene, mu=np.linspace(0.05, 0.228, 64), p=np.linspace(1, 4, 64))

    **Arguments:**

    - `scene`: the scene; parameters that are not on an axis keep its values.
    - `**axes`: one-dimensional, strictly increasing values of any numeric parameter in `scene.parameters`, by name. One
      trajectory is run for each combination, from the sliding equilibrium of its own scene.
    - `method`: how to step, `EventExact()` unless given.
    - `t_max`: time after which a trajectory without a verdict is called undecided, in s. Unless given, it is 2,000
      periods of the slowest mode of sliding after the last jump of the load; where a cycle is known that attracts slowly,
      twelve of its time constants. After that a few of each group are followed on, for up to forty thousand crossings of the
      section (`docs/verdicts.md`), and those that grow slowly without contact events by leaps. Of one contact under constant
      friction such time does not count, because it is not stepped through.
    - `memory`: the memory that all jobs running at a time in this process may take, in bytes; at least one job always runs.
    - `max_steps`: steps after which a trajectory without a verdict is called a step failure.
    - `progress`: whether to show a progress bar; unless given, in terminals and notebooks.
    - `resume`: a file in which finished jobs are kept while the map runs, every few seconds; or a folder named `*.zarr`, for
      maps of many million trajectories, in which each job is kept at once and which `xarray.open_zarr` reads at any time (extra
      `fivjax[zarr]`). If it exists, the map goes on from there: after any interruption the same call, on this machine or
      another, gives the same map, bit for bit. What was damaged on the disk meanwhile is named in a warning and computed
      anew. The file is not deleted at the end.
    - `executor`: what runs the jobs: threads of this process unless given, or anything like
      `concurrent.futures.ProcessPoolExecutor` (loky, `mpi4py.futures`), a Dask `Client`, or a function that makes one of these.
      The map is the same, bit for bit. A job that lost its worker is run again; one that loses its worker three times while it
      runs alone has the verdict -9.
    - `energy`: whether to keep each trajectory's energy ledger up to its verdict (see `fivjax.energy`): work by line, the
      energy lost in re-contacts, `kick_energy` (of the vibration when the kick ends, J), `energy_residual` (the largest error
      of the balance, J) and its measure `energy_exchanged` (the sum of the sizes of the lines, J). The residual is at most 1e-8
      of the energy exchanged, except in one trajectory of a thousand. A map with energies takes some ten times longer.

    - `refine`: how many times to halve the intervals of all axes, but only where neighbours differ in verdict or attractor. An
      axis of n values becomes one of `(n - 1) * 2**refine + 1`. Points that are not computed take the result of the point
      before them on the coarser grid; the variable `computed` says which points were computed. A region between the points of
      the coarse grid, which contains none of them, is missed.
    - `sparse`: whether the dataset of a refined map has the points alone that were computed, over the dimension `point`: memory
      then grows with the length of the boundaries, so that an axis may have a hundred thousand values. `fj.window` makes any
      part of the grid of it.
    - `audit`: the share of points not computed that are computed in the end all the same, at random (a hundred thousand at
      most), to count how many results are wrong: attributes `audit_cells`, `audit_wrong`, `audit_rate`, and its 95 % interval,
      `audit_rate_low` and `audit_rate_high`.

    **Returns:** a dataset with the axes as dimensions and, over all of them, `verdict` (0 sliding, 1 limit cycle, -1
    undecided, other negative numbers failures; the variable's attributes give each a sentence), `amplitude` (peak
    tangential speed on its attractor in m/s; 0 for sliding), `decided_at` (s), `contact_events` and `last_event` (s), and
    what a verdict rests on, `proof` and `bound`. What is not known of a trajectory is NaN. Which attractor captured it is
    `attractor` (-1 for none), an index into the table over `attractors`, which has the amplitude, period, kind, multiplier,
    reach and contraction of each; `chaotic` marks undecided trajectories from which neighbours diverge exponentially. With
    an axis p, `p_crit_low` and `p_crit_high` over the other axes are the two kicks between which the limit cycle first
    appears, one proved to slide and one proved to end on a limit cycle, and `p_crit` is their middle, NaN if undecided
    kicks lie between, or if already the first of the axis squeals (1 if that is no kick, p = 1); `critical_perturbation`
    narrows that down. With an axis mu, the attribute `mu_crit` is the critical friction of linear theory. If no trajectory
    could be followed, all for the same reason, the attribute `failure` says why.

    **Raises:** `ValueError` or `TypeError`, before anything is compiled, for unknown axis names, axes that are empty or
    not increasing, values that the scene refuses, and a `resume` file that belongs to another run.

    **Example:**

        >>> m = fj.bistability_map(scene, mu=[0.1, 0.15, 0.2, 0.227], p=[1.0, 1.2, 1.5, 2.0, 3.0])  # doctest: +SLOW
        >>> m["verdict"].sel(mu=0.2).values
        array([0, 0, 1, 1, 1], dtype=int8)
    """
    method = EventExact() if method is None else method
    t_max = checked_time_limit(scene, method, t_max, memory)
    max_steps = arguments.whole_number("max_steps", max_steps, minimum=1)
    arguments.truth("energy", energy)
    if not axes:
        raise ValueError(
            "A map needs at least one axis, such as `mu=np.linspace(0.05, 0.228, 64)`; the scene has: "
            f"{', '.join(sorted(scene.parameters))}."
        )
    refine = arguments.whole_number("refine", refine, minimum=0)
    arguments.real_number("audit", audit, minimum=0, maximum=1)
    arguments.truth("sparse", sparse)
    if sparse and not refine:
        raise ValueError(
            "Argument `sparse` is for maps that are refined: give `refine`, how often to halve the intervals."
        )
    check_size(axes, refine, bool(energy), bool(sparse))
    axes = checked_axes(scene, axes)
    followed = at_middle(scene, axes)
    axes = {name: finer_axis(values, refine) for name, values in axes.items()}
    grid = Grid(axes, of_kick=kick_of(scene))
    limits = Limits(t_max, max_steps, bool(energy))
    refinement = {"refine": refine, "audit": float(audit)} if refine else {}
    refinement |= {"sparse": True} if sparse else {}
    keeper = keeper_at(resume, scene, method, grid, limits._asdict() | refinement, limits.energy, sparse)
    options = RunOptions("map", memory, progress, executor, keeper)
    with contextlib.nullcontext() if keeper is None else contextlib.closing(keeper):
        # Compiled and computed while trajectories are followed.
        aside = ThreadPoolExecutor(1)
        limit = aside.submit(linear_limit, scene, axes)
        aside.shutdown(wait=False)
        if not refine:
            verdicts = run_to_verdict(followed, grid, method, limits, options)
            return map_dataset(scene, method, t_max, grid, verdicts, _known_by_now(limit, verdicts))
        found: dict = {}  # attractors, which finer levels need not find again

        def level(places: np.ndarray, what: str) -> Verdicts:
            if requested:
                # Since the last trajectory of the level before had ended.
                return interrupted(not_run(len(places), limits.energy))
            return run_to_verdict(followed, grid, method, limits, options._replace(label=f"map, {what}"), places, found)

        with stop_requests() as requested:
            refined, verdicts, checked = refine_grid(grid.shape, refine, audit, level)
        found.clear()  # of a large map they take as much memory as its results
    linear = _known_by_now(limit, verdicts)
    dataset = map_dataset(scene, method, t_max, grid, verdicts, linear, refined, sparse)
    return dataset.assign_attrs(audit_note(checked) | (levels_note(grid, refined) if sparse else {}))


def _known_by_now(limit: Future, verdicts: Verdicts) -> dict[str, float]:
    """The linear limit. Whoever interrupts a map does not wait for it."""
    try:
        return {} if np.any(verdicts.pending()) and not limit.done() else limit.result()
    except KeyboardInterrupt:
        warnings.warn("Interrupted: all verdicts are known, but not `mu_crit` of linear theory.", stacklevel=3)
        return {}
