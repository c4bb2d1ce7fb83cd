"""Many trajectories, each followed until its verdict is known.

A *lane* is one trajectory of a batch. `follow` is written for one lane and a fixed number of steps; `jax.vmap` makes it
a tile of lanes. After each round of steps the decided lanes leave, the others close ranks, and the tiles are filled
anew: work is spent only where the verdict is open.
"""

import itertools
import os
import warnings
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int
from tqdm.auto import tqdm

from . import contact as physics
from . import orbit as orbits
from .contact import Contact, Mechanics, State
from .load import AbstractLoad
from .orbit import Orbit
from .scene import Scene, steady_sliding
from .sliding import SlidingModes, linear_sliding, slides_forever, sliding_modes
from .steppers import AbstractStepper
from .verdict import Verdict

# Small enough that a tile's working set stays in a core's cache, large enough to fill its vector units.
TILE_ON_CPU = 1024
TILE_ELSEWHERE = 65536
SMALL_TILE = 64


class Lane(eqx.Module):
    """One trajectory on its way to a verdict."""

    t: Float[Array, ""]
    y: State
    contact: Contact
    orbit: Orbit
    events: Int[Array, ""]  # status changes so far
    last_event: Float[Array, ""]  # when the last of them was, s; NaN before the first
    verdict: Int[Array, ""]


class Outcome(NamedTuple):
    """What is known of each lane at its end; arrays over lanes."""

    verdict: np.ndarray
    amplitude: np.ndarray  # m/s
    decided_at: np.ndarray  # s
    events: np.ndarray
    last_event: np.ndarray  # s


def begin(scene: Scene, modes: SlidingModes) -> Lane:
    """A lane at the sliding equilibrium of its scene, just before anything happens."""
    mechanics = Mechanics(scene)
    q, _ = steady_sliding(scene, scene.load.force)
    y = jnp.concatenate([q, jnp.zeros_like(q)])
    verdict = jnp.where(
        ~modes.linear.solvable,
        Verdict.PAINLEVE,
        jnp.where(modes.linear.exists, Verdict.UNDECIDED, Verdict.NO_EQUILIBRIUM),
    )
    finite = jnp.all(jnp.stack([jnp.all(jnp.isfinite(leaf)) for leaf in jax.tree.leaves(scene)]))
    return Lane(
        t=jnp.zeros((), y.dtype),
        y=y,
        contact=physics.status_from_forces(mechanics, scene.load.force, y),
        orbit=orbits.new_orbit(y),
        events=jnp.zeros((), jnp.int32),
        last_event=jnp.full((), jnp.nan, y.dtype),
        verdict=jnp.where(finite, verdict, Verdict.NOT_FINITE).astype(jnp.int8),
    )


def next_step_end(load: AbstractLoad, t: Float[Array, ""], dt: Float[Array, ""]) -> Float[Array, ""]:
    """The end of a step from `t`: at most `dt` on, never across a jump of the load, and exactly on it when one is reached."""
    ahead = load.jumps > t
    jump = jnp.min(jnp.where(ahead, load.jumps, jnp.inf), initial=jnp.inf)
    # Equal steps up to the jump; the allowance keeps rounding from adding one more, vanishingly short.
    steps = jnp.ceil((jump - t) / dt - 1e-6)
    return jnp.where(steps <= 1, jump, t + jnp.where(jnp.isfinite(jump), (jump - t) / jnp.maximum(steps, 1), dt))


def follow(scene: Scene, method: AbstractStepper, modes: SlidingModes, lane: Lane, steps: int) -> Lane:
    """One lane, `steps` steps further, with the verdict if it can be proved by then."""
    mechanics = Mechanics(scene)
    structure = scene.structure
    # The square roots of the diagonals make squares of displacements and velocities comparable energies.
    resolution = method.resolution
    weights = jnp.sqrt(jnp.concatenate([jnp.diag(structure.stiffness), jnp.diag(structure.mass)]))

    def step(_, lane: Lane) -> Lane:
        t = next_step_end(scene.load, lane.t, method.dt)
        load = scene.load(0.5 * (lane.t + t))
        y, contact, h = method.advance(mechanics, lane.contact, load, lane.y, t - lane.t)
        t = jnp.where(h >= t - lane.t, t, lane.t + h)
        changed = contact.status != lane.contact.status
        orbit = orbits.observe(
            lane.orbit,
            weights,
            modes.linear.equilibrium,
            structure.tangential,
            lane.y,
            y,
            changed,
            resolution,
        )
        return Lane(
            t=t,
            y=y,
            contact=contact,
            orbit=orbit,
            events=lane.events + changed,
            last_event=jnp.where(changed, t, lane.last_event),
            verdict=lane.verdict,
        )

    after = jax.lax.fori_loop(0, steps, step, lane)
    quiet_load = jnp.all(scene.load.jumps <= after.t)
    verdict = jnp.where(
        ~jnp.all(jnp.isfinite(after.y)),
        Verdict.NOT_FINITE,
        jnp.where(
            after.t <= lane.t,
            Verdict.TOO_MANY_EVENTS,
            jnp.where(
                quiet_load & slides_forever(mechanics, modes, after.contact, after.y),
                Verdict.SLIDING,
                jnp.where(quiet_load & after.orbit.returned, Verdict.LIMIT_CYCLE, Verdict.UNDECIDED),
            ),
        ),
    )
    return eqx.tree_at(lambda lane: lane.verdict, after, verdict.astype(jnp.int8))


def run_to_verdict(
    scene: Scene,
    values: dict[str, np.ndarray],
    method: AbstractStepper,
    *,
    t_max: float,
    memory: float,
    progress: bool | None,
    label: str,
) -> Outcome:
    """Follow one lane for each row of `values` (equally long arrays of parameters by name) until its verdict.

    Interrupted by the user, it returns what is decided by then; the rest is `Verdict.NOT_RUN`.
    """
    total = len(next(iter(values.values())))
    outcome = Outcome(
        verdict=np.full(total, Verdict.NOT_RUN, np.int8),
        amplitude=np.full(total, np.nan),
        decided_at=np.full(total, np.nan),
        events=np.zeros(total, np.int32),
        last_event=np.full(total, np.nan),
    )
    bar = tqdm(total=total, desc=label, unit="lane", disable=None if progress is None else not progress)
    block = max(1, int(memory // bytes_per_lane(scene)))
    try:
        with bar:
            for start in range(0, total, block):
                chosen = np.arange(start, min(start + block, total))
                rows = {name: column[chosen] for name, column in values.items()}
                _run_block(scene, rows, method, t_max, outcome, chosen, bar)
    except KeyboardInterrupt:
        open_lanes = int(np.sum(outcome.verdict == Verdict.NOT_RUN))
        warnings.warn(
            f"Interrupted: {open_lanes} of {total} lanes have no verdict and are labelled {Verdict.NOT_RUN.value}.",
            stacklevel=2,
        )
    return outcome


def bytes_per_lane(scene: Scene) -> int:
    """Memory that a lane takes, its share of a step's intermediate results included."""
    n = scene.structure.size
    m = 2 * (n - 1)
    state_and_orbit = 8 * (2 * 2 * n + 20)
    modes = 8 * (m * m + 3 * m + 2 * n + 8) + 16 * (m * m + 4 * m)
    return 3 * (state_and_orbit + modes)


def _run_block(scene, values, method, t_max, outcome: Outcome, index: np.ndarray, bar) -> None:
    """Lanes that fit in memory together; writes their outcomes at `index`."""
    modes = _modes(scene, values)
    tile = _tile_size(len(index))
    names = tuple(values)
    columns = np.stack([values[name] for name in names], axis=-1)
    lanes = _collect(_in_tiles(lambda *a: _begin(scene, names, *a), len(index), tile, (columns, modes)))
    pending = np.arange(len(index))
    with ThreadPoolExecutor(max_workers=_workers()) as pool:
        while True:
            verdict, t = np.asarray(lanes.verdict), np.asarray(lanes.t)
            finished = (verdict != Verdict.UNDECIDED) | (t >= t_max)
            _record(outcome, index[pending[finished]], jax.tree.map(lambda leaf, done=finished: leaf[done], lanes))
            bar.update(int(finished.sum()))
            if finished.all():
                return
            pending = pending[~finished]
            lanes = jax.tree.map(lambda leaf, done=finished: leaf[~done], lanes)
            inputs = (columns[pending], jax.tree.map(lambda leaf, rows=pending: leaf[rows], modes), lanes)
            step = lambda *a: _follow(scene, method, names, *a)  # noqa: E731
            lanes = _collect(_in_tiles(step, len(pending), _tile_size(len(pending)), inputs, pool))


def _record(outcome: Outcome, index: np.ndarray, lanes: Lane) -> None:
    verdict = np.asarray(lanes.verdict)
    outcome.verdict[index] = verdict
    amplitude = np.where(verdict == Verdict.LIMIT_CYCLE, lanes.orbit.amplitude, np.nan)
    outcome.amplitude[index] = np.where(verdict == Verdict.SLIDING, 0.0, amplitude)
    outcome.decided_at[index] = np.where(verdict >= 0, lanes.t, np.nan)
    outcome.events[index] = lanes.events
    outcome.last_event[index] = lanes.last_event


def _modes(scene: Scene, values: dict[str, np.ndarray]) -> SlidingModes:
    """Modal coordinates for each lane, worked out once for lanes that differ in their load history only."""
    relevant = [name for name in values if name not in ("p", "duration", "start")]
    if not relevant:
        count = len(next(iter(values.values())))
        distinct, which = np.zeros((1, 0)), np.zeros(count, int)
    else:
        rows = np.stack([values[name] for name in relevant], axis=-1)
        distinct, which = np.unique(rows, axis=0, return_inverse=True)
    tile = _tile_size(len(distinct))
    linear = _collect(_in_tiles(lambda x: _linear(scene, tuple(relevant), x), len(distinct), tile, (distinct,)))
    return jax.tree.map(lambda leaf: np.asarray(leaf)[which.ravel()], sliding_modes(linear))


@eqx.filter_jit
def _linear(scene: Scene, names: tuple[str, ...], values):
    return jax.vmap(lambda row: linear_sliding(_with(scene, names, row)))(values)


@eqx.filter_jit
def _begin(scene: Scene, names: tuple[str, ...], values, modes):
    return jax.vmap(lambda row, own: begin(_with(scene, names, row), own))(values, modes)


@eqx.filter_jit
def _follow(scene: Scene, method: AbstractStepper, names: tuple[str, ...], values, modes, lanes):
    def one(row, own, lane):
        return follow(_with(scene, names, row), method, own, lane, method.round)

    return jax.vmap(one)(values, modes, lanes)


def _with(scene: Scene, names: tuple[str, ...], row) -> Scene:
    return scene.replace(**{name: row[i] for i, name in enumerate(names)})


def _tile_size(count: int) -> int:
    """One of few sizes, so that a scene is compiled once and not once per size of map."""
    if count <= SMALL_TILE:
        return SMALL_TILE
    return TILE_ON_CPU if jax.default_backend() == "cpu" else TILE_ELSEWHERE


def _workers() -> int:
    # A tile is too small for XLA to split among cores; tiles side by side use them all.
    if jax.default_backend() != "cpu":
        return 1
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else (os.cpu_count() or 1)


def _in_tiles(function, count: int, tile: int, inputs, pool: ThreadPoolExecutor | None = None) -> Iterator:
    """`function` over tiles of the inputs' leading axis; the last tile is filled up with copies of its first lane."""

    def run(start: int):
        rows = np.arange(start, start + tile)
        rows = np.where(rows < count, rows, start)
        with jax.enable_x64(True):  # the setting is a thread's own
            result = function(*jax.tree.map(lambda leaf: leaf[rows], inputs))
            return jax.tree.map(lambda leaf: np.asarray(leaf)[: count - start], result)

    starts = range(0, count, tile)
    return map(run, starts) if pool is None else pool.map(run, starts)


def _collect(tiles: Iterator):
    return jax.tree.map(lambda *leaves: np.concatenate(leaves), *itertools.chain(tiles))
