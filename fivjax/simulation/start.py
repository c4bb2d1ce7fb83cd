"""The state that a run starts from."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool

from ..contact import State
from ..foundation import arguments
from ..foundation.precision import is_known, real
from ..model.contact_coordinates import to_contact_coordinates
from ..model.scene import Scene, refuse_belt_at_rest, scene_in_contact_coordinates, sliding_equilibrium, steady_sliding
from ..model.sliding import contact_coordinates


def refuse_without_equilibrium(scene: Scene) -> None:
    """Refuse a scene without sliding equilibrium, as far as its values are known."""
    if all(map(is_known, jax.tree.leaves(scene))):
        sliding_equilibrium(scene)
    else:
        refuse_belt_at_rest(scene)


def start_state(scene: Scene, y0) -> State | np.ndarray:
    """The state that a run starts from: `y0`, checked, or else the sliding equilibrium at rest."""
    n = scene.structure.size
    if y0 is None:
        if all(map(is_known, jax.tree.leaves(scene))):
            q = sliding_equilibrium(scene)
            return np.concatenate([q, np.zeros_like(q)])
        refuse_belt_at_rest(scene)
        # Inside a compiled function, a scene without equilibrium cannot be refused.
        y, exists = at_equilibrium(scene)
        return jnp.where(exists, y, jnp.nan)
    y = checked_start(n, y0)
    if is_known(y):
        # Rounding may put the state of a cycle, or of a run before, a little below the belt.
        rounding = 64 * np.finfo(np.float64).eps * np.max(np.abs(np.asarray(y).reshape(2, n)), axis=1)
        for normal in map(int, np.ravel(contact_coordinates(scene.structure)[1])):
            if -rounding[0] <= y[normal] < 0:
                y = y.at[normal].set(0.0)
            if y[normal] == 0 and -rounding[1] <= y[n + normal] < 0:
                y = y.at[n + normal].set(0.0)
            if y[normal] < 0:
                raise ValueError(
                    f"Argument `y0` must not start below the belt, but its displacement {normal} (the gap) is "
                    f"{float(y[normal]):g} m."
                )
            if y[normal] == 0 and y[n + normal] < 0:
                raise ValueError(
                    f"Argument `y0` must not start on the belt and moving into it, but its velocity {normal} (of the gap) "
                    f"is {float(y[n + normal]):g} m/s. Start a little above the belt."
                )
    return y


def at_equilibrium(scene: Scene) -> tuple[State, Bool[Array, ""]]:
    """The state of steady sliding, and whether there is one: the belt moves, and its normal forces press."""
    q, normal_force = steady_sliding(scene, scene.load.force)
    exists = jnp.all((normal_force >= 0) & (scene.belt_speed != 0)) & jnp.all(jnp.isfinite(q))
    return jnp.concatenate([q, jnp.zeros_like(q)]), exists


def checked_start(n: int, y0, name: str = "y0") -> State:
    """Displacements and velocities, given as a pair or as one array, with their shapes checked."""
    is_pair = isinstance(y0, tuple | list) and len(y0) == 2
    parts = tuple(y0) if is_pair else (y0,)
    for part in parts:
        if is_known(part):
            arguments.numeric_array(name, part)
    parts = tuple(map(real, parts))
    shapes = tuple(part.shape for part in parts)
    if shapes != (((n,), (n,)) if is_pair else ((2 * n,),)):
        raise ValueError(
            f"Argument `{name}` must hold {n} displacements and {n} velocities, as a pair of arrays or one of shape "
            f"({2 * n},), but has shape {' and '.join(map(str, shapes))}."
        )
    y = jnp.concatenate(parts)
    if is_known(y) and not np.all(np.isfinite(y)):
        raise ValueError(f"Argument `{name}` must be finite.")
    if is_known(y) and np.any(np.abs(y) > arguments.LARGEST):
        raise ValueError(
            f"Argument `{name}` must be at most {arguments.LARGEST:g} in size, because products of it are computed."
        )
    return y


def start_in_contact_coordinates(scene: Scene, y0, name: str = "y0") -> State:
    """A given start, checked, with the directions of all contacts as coordinates."""
    y, structure = checked_start(scene.structure.size, y0, name), scene.structure
    if structure.contacts_at_coordinates:
        return y
    return snapped_to_belt(scene_in_contact_coordinates(scene), jnp.asarray(to_contact_coordinates(structure, y)))


def snapped_to_belt(scene: Scene, y: State) -> State:
    """The state with gaps and slip set to exactly zero where only the rounding of a change of coordinates made them nonzero."""
    tangential, normal = contact_coordinates(scene.structure)
    n = scene.structure.size
    size = 64 * np.finfo(np.float64).eps * jnp.repeat(jnp.max(jnp.abs(y.reshape(2, n)), axis=1), n)
    at_rest = jnp.zeros_like(y).at[n + tangential].set(scene.belt_speed)
    contact_values = np.isin(
        np.arange(2 * n), np.concatenate([np.ravel(k) for k in (normal, n + normal, n + tangential)])
    )
    return jnp.where(contact_values & (jnp.abs(y - at_rest) <= size), at_rest, y)
