"""The data that trajectories of one structure share, worked out once for all of them.

Trajectories that differ only in their kick or their initial state make a *group*: they have the same mechanics, the same
proofs and the same attractors.
"""

import functools
from collections.abc import Collection
from importlib import metadata
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.interpreters import partial_eval
from jaxtyping import Array, Float

from ..contact import Mechanics
from ..foundation.flattened import Flattened, flatten
from ..foundation.numpy_evaluation import by_numpy
from ..linear.linearisation import linear_sliding
from ..model.scene import Scene
from ..section.about_sliding import longest_return, mechanics_about_sliding
from ..steppers.base import AbstractStepper
from ..steppers.kernel_scope import has_kernel
from ..verdicts.sliding_proof import SlidingModes, sliding_modes
from ..verdicts.sticking_proof import StickingDrift, sticking_drift

# Parameters of a `Pulse` in which trajectories of one group may differ: those of the kick.
OF_KICK = ("p", "duration", "start")


class GroupConstants(eqx.Module):
    """The data that the trajectories of a group have in common."""

    scene: Scene  # with the group's parameters, and its structure given by matrices
    mechanics: Mechanics
    modes: SlidingModes
    drift: StickingDrift | None  # None with several contacts
    weights: Float[Array, " state"]  # see `Structure.weights`
    longest_return: Float[Array, ""]  # of the section's return map, s


class Limits(NamedTuple):
    """How far trajectories are followed, and with what."""

    t_max: float | None = None  # s; unless given, it depends on the attractors that are known
    max_steps: int = 2**21  # enough for 10⁵ cycles with their events; a map of such trajectories takes hours
    energy: bool = False  # whether with their energy ledgers


class Task(NamedTuple):
    """The data that all trajectories of a run have in common: whose they are, and how they are followed."""

    scene: Scene
    method: AbstractStepper
    names: tuple[str, ...]  # parameters that differ between groups
    of_kick: tuple[str, ...]  # parameters of the kick
    states: dict[str, int]  # initial displacements and velocities, with their indices in the state
    limits: Limits = Limits()
    width: int = 1  # trajectories of a group in a row of a block
    many: bool = False  # whether there are so many trajectories that fully optimised code repays its compilation
    from_afar: bool = True  # whether groups have so many that it repays to find the approaches to cycles

    @property
    def by_kernel(self) -> bool:
        """Whether kernels follow the trajectories, as they do in `simulate`."""
        return followed_by_kernel(self.scene, self.method)


def followed_by_kernel(scene: Scene, method: AbstractStepper) -> bool:
    """Whether kernels follow the trajectories of a map of such scenes."""
    return has_kernel(scene, method, called_by_xla=False)


def kernels_by(method: AbstractStepper, scene: Scene) -> dict[str, str]:
    """The version of Warp, where its kernels follow the trajectories of such a run."""
    return {"warp": metadata.version("warp-lang")} if followed_by_kernel(scene, method) else {}


def bytes_per_trajectory(scene: Scene, sharing: float) -> int:
    """Memory for one trajectory, in bytes, if `sharing` of them make a group; with its part of intermediate results."""
    n = scene.structure.size
    m = 2 * (n - 1)
    own = 8 * (3 * 2 * n + 60)
    modes = 8 * (m * m + 3 * n * n + 3 * m + 2 * n + 8) + 16 * (m * m + 4 * m)
    attractor = 8 * 512 * 2 * n  # mostly so many states are kept of a torus
    return int(own + 3 * (modes + attractor) / sharing)


def groups_of(values: dict[str, np.ndarray], within: Collection[str]) -> tuple[np.ndarray, np.ndarray]:
    """The distinct rows of parameters other than those in which trajectories differ `within` a group: those of the kick, and
    initial states; and the row of each trajectory.
    """
    own = [column for name, column in values.items() if name not in within]
    if not own:
        count = len(next(iter(values.values())))
        return np.zeros((1, 0)), np.zeros(count, int)
    distinct, group = np.unique(np.stack(own, axis=-1), axis=0, return_inverse=True)
    return distinct, group.ravel()


def constants_of(task: Task, distinct: np.ndarray) -> Flattened:
    """`GroupConstants` of each row of `distinct`, as one array."""
    # So many groups are worked out at a time: NumPy takes as long for a few as for hundreds. Intermediate results of large
    # structures take memory.
    few, parts = 64, []
    size = few if len(distinct) <= few else int(np.clip(2**16 // task.scene.structure.size**2, few, 512))
    for start in range(0, len(distinct), size):
        # Padded with copies, so that there is one size.
        rows = np.minimum(np.arange(start, start + size), len(distinct) - 1)
        scenes = _scenes(task.scene, task.names, distinct[rows])
        part = scenes, *_prepare(scenes)
        parts.append(jax.tree.map(lambda leaf, start=start: leaf[: len(distinct) - start], part))
    modes = sliding_modes(jax.tree.map(lambda *leaves: np.concatenate(leaves), *(linear for _, _, linear, *_ in parts)))
    numbers = form = None
    for start in range(0, len(distinct), size):
        # Written into the result one by one, because they are large and should not be in memory twice.
        scene, mechanics, _, *others = parts.pop(0)
        rows = slice(start, min(start + size, len(distinct)))
        own_modes = jax.tree.map(lambda leaf, rows=rows: leaf[rows], modes)
        part = flatten(GroupConstants(scene, mechanics, own_modes, *others))
        numbers = np.empty((len(distinct), part.numbers.shape[-1])) if numbers is None else numbers
        numbers[rows], form = part.numbers, part.form
    return Flattened(numbers, form)


# Both by NumPy, because XLA would compile them for longer than a map takes; and always so, because all maps are rounded alike.
@functools.partial(by_numpy, always=True)
def _scenes(scene: Scene, names: tuple[str, ...], values):
    """Those of groups with these values. Their structures are given by matrices: worked out once, not where they are used, and
    of the same form whichever parameters differ.
    """

    def one(row):
        own = with_values(scene, names, row)
        return eqx.tree_at(lambda own: own.structure.source, own, own.structure.matrices)

    return jax.vmap(one)(values)


@functools.partial(by_numpy, always=True)
def _prepare(scenes):
    def one(own):
        mechanics = mechanics_about_sliding(own)
        drift = None if mechanics.several else sticking_drift(own)
        return mechanics, linear_sliding(own), drift, own.structure.weights, longest_return(own)

    return jax.vmap(one)(scenes)


def kick_of(scene: Scene) -> dict[str, float]:
    """The parameters of a scene's kick, with its values: those of its load on which the final load does not depend. They do not
    change the mechanics.
    """
    numbers = {name: value for name, value in scene.parameters_of("load").items() if value.ndim == 0}
    with_numbers = functools.partial(eqx.tree_at, lambda load: [getattr(load, name) for name in numbers], scene.load)
    traced = jax.make_jaxpr(lambda values: jnp.asarray(with_numbers(values).final))(list(numbers.values()))
    _, used = partial_eval.dce_jaxpr(traced.jaxpr, [True])
    return {name: float(value) for (name, value), of_final in zip(numbers.items(), used, strict=True) if not of_final}


def with_values(scene: Scene, names: tuple[str, ...], row) -> Scene:
    """The scene with a row of values for these parameters."""
    return scene.replace(**{name: row[i] for i, name in enumerate(names)})
