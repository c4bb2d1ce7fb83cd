r"""Which mode several contacts take at an instant: the laws of Signorini and Coulomb, solved together.

Forces change what the contacts do, $a = b + G λ$: accelerations by forces, or velocities by impulses. Each contact is in one of
four states, and every state demands something and is admissible under a condition:

| state | demands | admissible where |
|---|---|---|
| STICK | $a_t = a_n = 0$ | $|T| ≤ μ_s N$, and it does not slip yet |
| FORWARD | $T = +μ N$, $a_n = 0$ | $N ≥ 0$; if it does not slip yet, $a_t ≤ 0$ |
| BACKWARD | $T = -μ N$, $a_n = 0$ | $N ≥ 0$; if it does not slip yet, $a_t ≥ 0$ |
| OPEN | $T = N = 0$ | $a_n ≥ 0$ |

For a P-matrix of sliding one combination is admissible but for ties. Up to three contacts all are tried at once (`enumerated`),
beyond that one contact's state is changed after another (`pivoted`). Ties go to what sticks. At an event some condition is
zero but for rounding; the state that has just `ended` must then be admissible clearly, or it would be taken again.
"""

import itertools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from ..foundation.linear_solve import solve
from .mechanics import Mechanics
from .mode_forces import mode_matrix

STICK, FORWARD, BACKWARD, OPEN = range(4)
NONE = -1
# All combinations are tried for up to this many contacts: 64.
MOST_ENUMERATED = 3
# Conditions are met where they are this share of the terms in them, or less, on the wrong side.
TIE = {"float64": 1e-12, "float32": 1e-5}


class ContactProblem(NamedTuple):
    """The laws of contact at one instant; everything but the compliances has an axis over the contacts."""

    mechanics: Mechanics
    tangential: Float[Array, " c"]  # b
    normal: Float[Array, " c"]
    sliding: Float[Array, " c"]  # coefficient of friction where a contact slips
    cone_edges: Float[Array, " c 2"]  # added to T's distances from the edges of its cone; zero for total forces
    static: Float[Array, " c"]  # coefficient of friction that sticking holds
    pressing: Float[Array, " c"]  # added to N for the total; zero for total forces
    otherwise: Float[Array, "c 4"]  # what each state asks of T beside its law, of forces that are not totals
    open_normal: Float[Array, " c"]  # N of an open contact; zero for total forces
    allowed: Bool[Array, "c 4"]
    slips: Bool[Array, " c"]  # already, so that the state does not have to agree with its acceleration
    away: Bool[Array, " c"]  # off the belt, so that nothing is asked of its gap
    ended: Int[Array, " c"]  # the state that has just ended, or NONE
    force_size: Float[Array, " c"]  # of the terms in forces, and in accelerations
    change_size: Float[Array, " c"]


def forces_of(problem: ContactProblem, state: Int[Array, " c"]) -> tuple[Float[Array, " c"], Float[Array, " c"]]:
    """(T, N) that the states demand, whether or not they are admissible."""
    sticking, closed = state == STICK, state != OPEN
    sign = jnp.where(state == FORWARD, 1.0, jnp.where(state == BACKWARD, -1.0, 0.0))
    matrix = mode_matrix(problem.mechanics, sticking, closed, sign * problem.sliding)
    asked = jnp.sum(jnp.where(state[:, None] == np.arange(4), problem.otherwise, 0.0), axis=-1)
    right_t = jnp.where(sticking, -problem.tangential, asked)
    right_n = jnp.where(closed, -problem.normal, problem.open_normal)
    forces = solve(matrix, jnp.concatenate([right_t, right_n]))
    return forces[: len(state)], forces[len(state) :]


def margins(problem: ContactProblem, state: Int[Array, " c"]) -> tuple[Float[Array, " c"], Float[Array, " c"]]:
    """By how much the conditions of these states on forces and on accelerations are met, relative to the terms in them;
    infinite where there is none.
    """
    holding, normal_force = forces_of(problem, state)
    g_tt, g_tn, g_nn = problem.mechanics.compliance
    along = problem.tangential + g_tt @ holding + g_tn @ normal_force
    apart = problem.normal + g_tn.T @ holding + g_nn @ normal_force
    edge = problem.static * normal_force
    pressed = normal_force + problem.pressing
    edges = jnp.stack([edge - holding, edge + holding], axis=-1) + problem.cone_edges
    in_cone = jnp.minimum(jnp.min(edges, axis=-1), pressed)
    sign = jnp.where(state == FORWARD, 1.0, -1.0)
    sliding, infinite = (state == FORWARD) | (state == BACKWARD), jnp.inf
    force_margin = jnp.where(state == STICK, in_cone, jnp.where(sliding, pressed, infinite)) / problem.force_size
    change_margin = jnp.where(sliding & ~problem.slips, -sign * along, infinite)
    change_margin = jnp.where((state == OPEN) & ~problem.away, apart, change_margin) / problem.change_size
    return force_margin, change_margin


def _judged(problem: ContactProblem, state: Int[Array, " c"]) -> Float[Array, " c"]:
    """How far each contact is from being admissible in these states, relative to the terms in its conditions; zero if it is."""
    force_margin, change_margin = margins(problem, state)
    tie = TIE[problem.normal.dtype.name]
    need = jnp.where(state == problem.ended, tie, -tie)
    violation = jnp.maximum(jnp.maximum(need - force_margin, need - change_margin), 0.0)
    forbidden = ~jnp.any(problem.allowed & (state[:, None] == np.arange(4)), axis=-1)
    return jnp.where(forbidden | jnp.isnan(violation), jnp.inf, violation)


def settled_states(problem: ContactProblem, start: Int[Array, " c"]) -> Int[Array, " c"]:
    """The admissible states of all contacts, or those that come closest; `start` is a guess."""
    problem, start = jax.lax.stop_gradient((problem, start))
    return (enumerated if len(start) <= MOST_ENUMERATED else pivoted)(problem, start)


def enumerated(problem: ContactProblem, start: Int[Array, " c"]) -> Int[Array, " c"]:
    """By trying all combinations. Ties go to what most contacts are in at the `start`, then to what sticks most."""
    every = np.array(sorted(itertools.product(range(4), repeat=len(problem.slips)), key=_preference), np.int32)
    violations = jax.vmap(lambda state: jnp.max(_judged(problem, state)))(jnp.asarray(every))
    # A contact that has just lifted off may be put back as well as not; it is left alone.
    changes = jnp.sum(every != start, axis=1) * (0.1 * TIE[violations.dtype.name])
    best = jax.lax.argmin(violations + changes, 0, jnp.int32)
    # A sum over a row of ones and a rest of zeros: in a batch, no gather.
    return jnp.sum(jnp.where((jnp.arange(len(every)) == best)[:, None], every, 0), axis=0).astype(jnp.int32)


def _preference(states: tuple[int, ...]) -> tuple[int, int]:
    return -states.count(STICK), states.count(OPEN)


def pivoted(problem: ContactProblem, start: Int[Array, " c"]) -> Int[Array, " c"]:
    """By principal pivoting: one contact that is not admissible after another takes the state that is, as the others are.

    First the worst of them, which seldom takes more than a few changes from a good guess; then, as Murty's rule has it, the
    first, which for a P-matrix comes to an end. The best states met are kept.
    """
    count = len(problem.slips)

    def body(carry):
        state, best, least, step, _ = carry
        violation = _judged(problem, state)
        worst = jnp.max(violation)
        better = worst < least
        best, least = jnp.where(better, state, best), jnp.minimum(worst, least)
        chosen = jnp.where(
            step < 4 * count, jax.lax.argmax(violation, 0, jnp.int32), jax.lax.argmax(violation > 0, 0, jnp.int32)
        )
        mine = np.arange(count) == chosen
        options = jnp.where(mine, jnp.arange(4, dtype=jnp.int32)[:, None], state)
        own = jax.vmap(lambda option: jnp.sum(jnp.where(mine, _judged(problem, option), 0.0)))(options)
        # Its present state is not the answer, whatever rounding says.
        own = jnp.where(jnp.arange(4) == jnp.sum(jnp.where(mine, state, 0)), jnp.inf, own)
        change = jax.lax.argmin(own, 0, jnp.int32)
        return jnp.where(mine, change, state), best, least, step + 1, worst > 0

    def going(carry):
        *_, step, wrong = carry
        return wrong & (step < 16 * count)

    infinite = jnp.asarray(jnp.inf, problem.normal.dtype)
    begin = start, start, infinite, jnp.zeros((), jnp.int32), jnp.asarray(True)
    return jax.lax.while_loop(going, body, begin)[1]
