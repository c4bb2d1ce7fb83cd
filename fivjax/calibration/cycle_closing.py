"""Newton's method for the limit cycles of a fit: in every step each is closed, starting from the one of the step before."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..contact import Contact, Status
from ..contact.coordinates import at_places
from ..model.sliding import contact_coordinates
from ..model.structure import Structure
from .shooting import Cycle, first_tangential

# A cycle is closed when its correction is this small, relative to its size: the next one would be rounding.
CLOSED = 1e-7


def predicted(tangential: int, moved: Float[Array, " j"], about) -> tuple[Cycle, ...]:
    """The cycles of a point, from those of the point `about`, to first order in the change `moved` of the parameters."""
    return tuple(
        cycle.at(cycle.unknowns(tangential) + follow @ moved, tangential)
        for cycle, follow in zip(about.cycles, about.follow, strict=True)
    )


def corrected(structure: Structure, cycle: Cycle, step, gap, contact: Contact) -> tuple[Cycle, Float[Array, ""]]:
    """The cycle after a step of Newton's method, and the relative size of the step; or its state one period later, if the
    contact mode has changed.
    """
    n, first = len(step) // 2, first_tangential(structure)
    _, normal = contact_coordinates(structure)
    held = cycle.contact.status != Status.DETACH
    # On the belt a normal coordinate is exactly zero.
    constrained = at_places(2 * n, normal, held) | at_places(2 * n, n + normal, held)
    step = jnp.where(constrained, -cycle.y, step)
    sizes = [jnp.full(n, jnp.max(jnp.abs(part))) for part in (cycle.y[:n], cycle.y[n:])]
    sizes = jnp.concatenate(sizes).at[n + first].set(cycle.period)
    better = cycle.at(cycle.unknowns(first) + step, first)
    changed = jnp.any(contact.status != cycle.contact.status)
    later = Cycle(cycle.y + gap, contact, cycle.period)
    # A period that has changed by a factor of two is no longer a guess.
    astray = (better.period < 0.5 * cycle.period) | (better.period > 2 * cycle.period)
    better = eqx.tree_at(lambda c: c.period, better, jnp.where(astray, jnp.nan, better.period))
    chosen = jax.tree.map(lambda a, b: jnp.where(changed, a, b), later, better)
    moved = jnp.where(changed, jnp.inf, jnp.max(jnp.abs(step) / sizes))
    return chosen, jnp.where(astray & ~changed, jnp.nan, moved)


def growth_of_disturbances(system: Float[np.ndarray, "state state"], where: int) -> float:
    """The largest factor by which a disturbance of a cycle grows from one return to the next: the largest multiplier's size."""
    rest = np.delete(np.arange(len(system)), where)
    # A disturbed motion returns after another time: the one at which the tangential velocity has its value again.
    period = system[:, where]
    carried = (system + np.eye(len(system)))[:, rest]
    with np.errstate(all="ignore"):
        returned = (carried - np.outer(period, carried[where] / period[where]))[rest]
    # Where no cycle was closed, it counts as unstable.
    return float(np.max(np.abs(np.linalg.eigvals(returned)))) if np.all(np.isfinite(returned)) else np.inf
