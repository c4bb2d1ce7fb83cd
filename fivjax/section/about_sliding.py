"""Motions measured from steady sliding: mechanics for such deviations, and how long they may take to return to the section.

A small cycle under a high load is then as exact as a large one.
"""

import math

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..contact import Mechanics, Rest, State
from ..foundation.linear_solve import solve
from ..foundation.numpy_evaluation import by_numpy
from ..model.scene import Scene, steady_sliding
from ..model.sliding import contact_coordinates, free_in_sliding
from ..model.structure import Structure


def mechanics_about_sliding(scene: Scene) -> Mechanics:
    """Mechanics for displacements and loads as deviations from the sliding equilibrium under the final load.

    With total displacements, a vibration of nanometres under a load that stretches the springs by metres would be lost in
    rounding.
    """
    load = scene.load.final
    _, normal_force = steady_sliding(scene, load)
    return Mechanics(scene).about(Rest(scene, load, normal_force), scene.structure)


@by_numpy
def sliding_state(scene: Scene, load: Float[Array, ""]) -> State:
    """The state of steady sliding under a load (N)."""
    q, _ = steady_sliding(scene, load)
    return jnp.concatenate([q, jnp.zeros_like(q)])


def slowest_period(structure: Structure) -> Float[Array, ""]:
    """The period (s) of the slowest coordinate, if all others were held."""
    rates = jnp.diag(structure.stiffness) / jnp.diag(structure.mass)
    return 2 * math.pi / jnp.sqrt(jnp.min(jnp.where(rates > 0, rates, jnp.inf)))


def weights_of(structure: Structure) -> Float[np.ndarray, " state"]:
    """`Structure.weights`, all of them positive: a coordinate that no spring holds has no weight of its own."""
    weights = np.asarray(structure.weights)
    return np.where(weights > 0, weights, np.min(weights[weights > 0]))


def longest_return(scene: Scene) -> Float[Array, ""]:
    r"""A time (s) within which any sustained motion crosses the section.

    A hundred periods of the slowest vibration, and twice the time for which a contact sticks on a slow belt, from one edge of
    the friction cone to the other: $2 μ N / (k |v|)$ with the normal force of steady sliding and the stiffness $k$ along the
    belt. That period is bounded by $2 π$ times the root of the trace of $K^{-1} M$ in sliding, which is the sum of all
    $1/ω^2$; and by that of the slowest coordinate, all others held.
    """
    # Beyond this ratio of squared periods it is the rounding of what no spring holds.
    most_apart = 1e12
    structure = scene.structure
    tangential, _ = contact_coordinates(structure)
    free = free_in_sliding(structure)
    stiffness = structure.stiffness[jnp.ix_(free, free)]
    along = np.searchsorted(free, tangential)
    inverse = solve(stiffness, jnp.eye(len(free)))
    held = (slowest_period(structure) / (2 * math.pi)) ** 2
    modal = jnp.sum(inverse * structure.mass[jnp.ix_(free, free)])
    slowest = jnp.sqrt(jnp.where((modal > held) & (modal < most_apart * held), modal, held))
    compliance = inverse[along][..., along]
    compliance = jnp.diag(compliance) if jnp.ndim(compliance) else compliance
    _, force = steady_sliding(scene, scene.load.final)
    sticking = 2 * scene.friction.static * jnp.abs(force) * compliance / jnp.abs(scene.belt_speed)
    # Nothing is known of a structure that is held by no spring.
    sticking = jnp.max(jnp.where(jnp.isfinite(sticking), sticking, 0.0))
    return 100 * 2 * math.pi * slowest + 2 * sticking
