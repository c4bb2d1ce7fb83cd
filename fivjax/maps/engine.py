"""Many trajectories, each followed until its verdict is known: memory, progress, interruptions and what is kept on the way.

A trajectory (`progress`, `conclusion`) is one of a group that shares its mechanics (`sharing`); groups are followed in
blocks of one size, round by round (`rounds`).
"""

import time
import warnings
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

import jax
import numpy as np
from tqdm.auto import tqdm

from ..foundation.stopping import stop_requests
from ..model.scene import Scene
from ..steppers.base import AbstractStepper
from ..verdicts.verdict import Verdict
from . import rounds
from .attractors import Attractors
from .blocks import MANY, workers
from .results import Verdicts, counted, not_run
from .sharing import HISTORY, Batch, bytes_per_trajectory, grouped, in_bulk

# Trajectories of a group that stand side by side in a block: enough to fill a vector unit and to make matrix products pay.
SIDE_BY_SIDE = 16
# What a trajectory that shares nothing costs, in trajectories that stand side by side.
COST_OF_STANDING_ALONE = 4
# Steps that a trajectory may take: 10⁵ cycles with their events, and some hours of work for a map of them.
MOST_STEPS = 2**21
# How often what is finished is handed out to be kept, s: seldom enough to cost nothing, often enough to lose little.
KEEP_EVERY = 2.0


def run_to_verdict(
    scene: Scene,
    values: dict[str, np.ndarray],
    method: AbstractStepper,
    *,
    t_max: float,
    memory: float,
    max_steps: int = MOST_STEPS,
    progress: bool | None,
    label: str,
    known: Verdicts | None = None,
    keep: Callable[[Verdicts], None] | None = None,
    energy: bool = False,
    attractors: dict[bytes, Attractors] | None = None,
    states: dict[str, int] | None = None,
) -> Verdicts:
    """Follow one trajectory for each row of `values` (equally long arrays of parameters by name) until its verdict.

    `energy` asks for the ledger of each at its end.

    `known` is what an earlier run of the same trajectories has finished; those are not run again. `keep` is handed
    everything that is finished, every few seconds and at the end.

    `attractors` has those that were found in an earlier run over the same parameters, and gets the new ones.

    `states` are names of `values` that are no parameters but displacements or velocities at the beginning, with their places in
    the state; others begin at the sliding equilibrium.

    Interrupted by the user, it returns what is decided by then; the rest is `Verdict.NOT_RUN`.
    """
    total = len(next(iter(values.values())))
    verdicts = not_run(total, energy) if known is None else jax.tree.map(np.array, known)
    already = int(np.sum(~verdicts.pending))
    bar = tqdm(
        total=total,
        initial=already,
        # Nothing moves until the first round is compiled, which takes longer than many a map.
        desc=f"{label}, compiling …",
        unit=" trajectories",
        disable=None if progress is None else not progress,
    )
    kept, new, reports = time.monotonic(), 0, 0

    def finished(count: int) -> None:
        nonlocal kept, new, reports
        reports += 1
        if reports == 2:  # the first one comes before anything was followed
            bar.set_description(label, refresh=False)
        bar.update(count)
        new += count
        if requested:
            raise KeyboardInterrupt
        if keep is not None and new > 0 and time.monotonic() - kept >= KEEP_EVERY:
            keep(verdicts)
            kept, new = time.monotonic(), 0

    states = {} if states is None else states
    distinct, group = grouped(values, tuple(states))
    attractors = {} if attractors is None else attractors
    # The same in all rounds and portions, because products of other shapes round differently.
    in_rows = np.sum(-(-np.bincount(group) // SIDE_BY_SIDE)) * SIDE_BY_SIDE
    width = SIDE_BY_SIDE if in_rows <= COST_OF_STANDING_ALONE * total else 1
    # Portions that are filled group by group share the most.
    order = np.argsort(group, kind="stable")
    portion = max(1, int(memory // bytes_per_trajectory(scene, sharing=total / len(distinct))))
    batch = Batch(
        scene=scene,
        method=method if energy else in_bulk(method, scene),
        names=tuple(name for name in values if name not in HISTORY and name not in states),
        history=tuple(name for name in values if name in HISTORY),
        states=tuple(states.values()),
        energy=energy,
        width=width,
        many=total >= MANY,
        pool=ThreadPoolExecutor(max_workers=workers()),
    )
    with stop_requests() as requested, bar, batch.pool:
        try:
            for start in range(0, total, portion):
                chosen = order[start : start + portion]
                if np.any(verdicts.pending[chosen]):
                    rows = {name: column[chosen] for name, column in values.items()}
                    rounds.follow_all(
                        batch, rows, tuple(states), attractors, t_max, max_steps, verdicts, chosen, finished
                    )
        except KeyboardInterrupt:
            left = int(np.sum(verdicts.pending))
            warnings.warn(
                f"Interrupted: of {counted(total, 'trajectory')}, {left} without a verdict, "
                f"labelled {Verdict.NOT_RUN.value}.",
                stacklevel=2,
            )
        finally:
            if keep is not None:
                keep(verdicts)
    return verdicts
