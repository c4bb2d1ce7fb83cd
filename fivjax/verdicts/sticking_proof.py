r"""The proof that a contact sticks for ever, its forces growing without bound: it jams on the belt.

Where friction is strong and the structure leans into the belt, a sticking contact is pressed on ever harder, and the belt
carries it along for ever: the model has no bounded motion then. While it sticks, $q_t = x + v s$ after the time $s$, and the
other coordinates $q_r$ follow a drift $a + b s$ with a deviation $e$ that obeys
$M_{rr} \ddot e + C_{rr} \dot e + K_{rr} e = 0$, so that $\tfrac12 \dot e^T M_{rr} \dot e + \tfrac12 e^T K_{rr} e$ never grows.
The guards are affine in the state: they rise along the drift, and the deviation changes them by a bounded amount.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from .. import contact as physics
from ..contact import Contact, Mechanics, State, Status
from ..foundation.linear_solve import solve
from ..model.scene import Scene


class StickingDrift(eqx.Module):
    """The data of a scene that the proof needs, worked out once."""

    load: Float[Array, ""]  # N
    base: Float[Array, " state"]  # the drift's state where the tangential displacement is zero
    per_displacement: Float[Array, " state"]  # derivative of the drift's state by that displacement
    slopes: Float[Array, "2"]  # rates at which the guards rise along the drift, N/s
    energy: Float[Array, "state state"]  # the deviation's energy as a quadratic form, J
    reach: Float[Array, "2"]  # largest change of the guards by a deviation of unit energy, N/√J


def sticking_drift(scene: Scene) -> StickingDrift:
    """The drift of a sticking contact under the final load, and its guards along it."""
    structure, mechanics, load = scene.structure, Mechanics(scene), scene.load.final
    n, t = structure.size, structure.tangential
    rest = np.array([i for i in range(n) if i not in (t, structure.normal)], int)
    block = np.ix_(rest, rest)
    mass, damping, stiffness = structure.mass[block], structure.damping[block], structure.stiffness[block]
    speed = scene.belt_speed
    coupling, drag = structure.stiffness[rest, t], structure.damping[rest, t]
    per_x = -_solve(stiffness, coupling)
    rate = per_x * speed
    base = _solve(stiffness, structure.load_direction[rest] * load - drag * speed - damping @ rate)
    zero = jnp.zeros(n, structure.mass.dtype)
    velocity = zero.at[rest].set(rate).at[t].set(speed)
    contact = Contact(jnp.asarray(Status.STICK, jnp.int32), jnp.ones((), zero.dtype))

    def guards(y):
        return physics.guards(mechanics, contact, load, y)

    at = jnp.concatenate([zero.at[rest].set(base), velocity])
    along = jnp.concatenate([velocity, zero])
    _, slopes = jax.jvp(guards, (at,), (along,))
    rows = jax.jacfwd(guards)(at)
    position, motion = rows[:, rest], rows[:, n + rest]
    squares = jnp.sum(position * _solve(stiffness, position.T).T + motion * _solve(mass, motion.T).T, axis=-1)
    energy = jnp.zeros((2 * n, 2 * n), zero.dtype).at[block].set(stiffness).at[np.ix_(n + rest, n + rest)].set(mass)
    return StickingDrift(
        load=load,
        base=at,
        per_displacement=jnp.concatenate([zero.at[rest].set(per_x).at[t].set(1.0), zero]),
        slopes=slopes,
        energy=energy,
        reach=jnp.sqrt(jnp.where(squares >= 0, squares, jnp.inf)),
    )


def sticks_forever(drift: StickingDrift, mechanics: Mechanics, contact: Contact, y: State) -> Bool[Array, ""]:
    """Whether a bound shows that a contact which sticks now, under its final load, sticks for ever."""
    carried = drift.base + drift.per_displacement * y[mechanics.tangential]
    deviation = y - carried
    size = jnp.sqrt(jnp.maximum(jnp.sum(deviation * jnp.sum(drift.energy * deviation, axis=-1)), 0.0))
    guards = physics.guards(mechanics, contact, drift.load, carried)
    sticking = contact.status == Status.STICK
    return sticking & jnp.all(drift.slopes > 0) & jnp.all(guards > drift.reach * size)


def _solve(matrix, right):
    return right if matrix.shape[0] == 0 else solve(matrix, right)
