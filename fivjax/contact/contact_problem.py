r"""Which mode several contacts take at an instant: the laws of Signorini and Coulomb, solved together.

The contacts' accelerations $a = b + G λ$ depend on the contact forces λ; in an impact, velocities depend in the same way on
impulses. Each contact is in one of four states; every state demands something, and is admissible under a condition:

| state | demands | admissible where |
|---|---|---|
| STICK | $a_t = a_n = 0$ | $\lvert T\rvert ≤ μ_s N$, and it does not slip yet |
| FORWARD | $T = +μ N$, $a_n = 0$ | $N ≥ 0$; if it does not slip yet, $a_t ≤ 0$ |
| BACKWARD | $T = -μ N$, $a_n = 0$ | $N ≥ 0$; if it does not slip yet, $a_t ≥ 0$ |
| OPEN | $T = N = 0$ | $a_n ≥ 0$ |

If the matrix of sliding is a P-matrix, only one combination is admissible, except for ties and where static friction exceeds
kinetic friction ($μ_s > μ$): then what can stick does. Up to four contacts combinations are tried one after the other
(`enumerated`); with more contacts their states are changed one by one (`pivoted`). Ties go to sticking. At an event some
condition is zero up to rounding, so the state that has just `ended` must be admissible by a clear margin, or it would be chosen
again.
"""

import itertools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from ..foundation.carried import depending_on
from ..foundation.jaxprs import with_code_once
from ..foundation.linear_solve import solve
from .mode_forces import mode_matrix

STICK, FORWARD, BACKWARD, OPEN = range(4)
NONE = -1
# A condition counts as met if it is violated by no more than this share of the terms in it.
TIE = {"float64": 1e-12, "float32": 1e-5}


class ContactProblem(NamedTuple):
    """The laws of contact at one instant; everything but the compliances has an axis over the contacts."""

    compliance: tuple[Float[Array, "c c"], Float[Array, "c c"], Float[Array, "c c"]]  # G, as `Mechanics` has it
    tangential: Float[Array, " c"]  # b
    normal: Float[Array, " c"]
    sliding: Float[Array, " c"]  # coefficient of friction where a contact slips
    cone_edges: Float[Array, " c 2"]  # added to T's distances from the edges of its cone; zero for total forces
    static: Float[Array, " c"]  # coefficient of friction that sticking holds
    pressing: Float[Array, " c"]  # added to N for the total; zero for total forces
    otherwise: Float[Array, "c 4"]  # right-hand side of each state's equation for T; zero for total forces
    open_normal: Float[Array, " c"]  # N of an open contact; zero for total forces
    allowed: Bool[Array, "c 4"]
    slips: Bool[Array, " c"]  # slips already, so that there is no condition on its acceleration
    away: Bool[Array, " c"]  # off the belt, so that there is no condition on its gap
    ended: Int[Array, " c"]  # the state that has just ended, or NONE
    force_size: Float[Array, " c"]  # of the terms in forces, and in accelerations
    change_size: Float[Array, " c"]


def forces_of(problem: ContactProblem, state: Int[Array, " c"]) -> tuple[Float[Array, " c"], Float[Array, " c"]]:
    """(T, N) that the states demand, whether or not they are admissible."""
    sticking, closed = state == STICK, state != OPEN
    sign = jnp.where(state == FORWARD, 1.0, jnp.where(state == BACKWARD, -1.0, 0.0))
    matrix = mode_matrix(problem.compliance, sticking, closed, sign * problem.sliding)
    asked = jnp.sum(jnp.where(state[:, None] == np.arange(4), problem.otherwise, 0.0), axis=-1)
    right_t = jnp.where(sticking, -problem.tangential, asked)
    right_n = jnp.where(closed, -problem.normal, problem.open_normal)
    forces = solve(matrix, jnp.concatenate([right_t, right_n]))
    return forces[: len(state)], forces[len(state) :]


def margins(problem: ContactProblem, state: Int[Array, " c"]) -> tuple[Float[Array, " c"], Float[Array, " c"]]:
    """By how much the conditions of these states on forces, and those on accelerations, are met, relative to the terms in them;
    infinite where there is no condition.
    """
    holding, normal_force = forces_of(problem, state)
    g_tt, g_tn, g_nn = problem.compliance
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


def are_allowed(problem: ContactProblem, state: Int[Array, " c"]) -> Bool[Array, " c"]:
    """Which contacts may be in these states, by their velocities."""
    return jnp.any(problem.allowed & (state[:, None] == np.arange(4)), axis=-1)


def _judged(problem: ContactProblem, state: Int[Array, " c"]) -> Float[Array, " c"]:
    """How far each contact's state is from admissible, relative to the terms in its conditions; zero if it is admissible."""
    force_margin, change_margin = margins(problem, state)
    tie = TIE[problem.normal.dtype.name]
    need = jnp.where(state == problem.ended, tie, -tie)
    violation = jnp.maximum(jnp.maximum(need - force_margin, need - change_margin), 0.0)
    return jnp.where(~are_allowed(problem, state) | jnp.isnan(violation), jnp.inf, violation)


def settled_states(problem: ContactProblem, start: Int[Array, " c"]) -> Int[Array, " c"]:
    """The admissible states of all contacts, or the states that come closest to it; `start` is a guess."""
    # Combinations are tried for up to this many contacts: of 256 few are allowed.
    most_enumerated = 4
    problem, start = jax.lax.stop_gradient((problem, start))
    return (enumerated if len(start) <= most_enumerated else pivoted)(problem, start)


class _Search(NamedTuple):
    """How far `enumerated` has come."""

    number: Int[Array, ""]  # of the combination, -1 for the start
    asked: Int[Array, ""]  # the contact of which it is asked whether it could stick, -1 before the first
    own: Float[Array, ""]  # what there is to say against this combination, by now
    least: Float[Array, ""]
    best: Int[Array, " c"]


@jax.jit
def enumerated(problem: ContactProblem, start: Int[Array, " c"]) -> Int[Array, " c"]:
    """By trying combinations. Ties go to the one that changes the fewest states of `start`, then to the most sticking.

    Where static friction exceeds kinetic friction, several combinations may be admissible: a contact at rest that could stick
    might slip as well. It sticks, given the states of the others; but what has ended does so.
    """
    count = len(problem.slips)
    every = jnp.asarray(np.array(sorted(itertools.product(range(4), repeat=count), key=_preference), np.int32))
    # A contact that has just lifted off may be admissible on the belt as well; it stays off. To slip in vain is worse than any
    # number of changes.
    a_change = 0.1 * TIE[problem.normal.dtype.name]
    in_vain, infinite = 100 * count * a_change, jnp.asarray(jnp.inf, problem.normal.dtype)
    has_ended, places = problem.ended != NONE, np.arange(count)
    # What is admissible with one change is better than all others but `start` itself, which is tried first; where a state has
    # ended, this change costs nothing.
    enough = jnp.where(jnp.any(has_ended), 0.0, a_change)
    might_stick = ~problem.slips & ~has_ended & (problem.static > problem.sliding)

    def going(at: _Search):
        return (at.number < len(every)) & (at.least > enough)

    def step(at: _Search) -> _Search:
        state = jnp.where(at.number < 0, start, every[jnp.maximum(at.number, 0)])
        tried = jnp.where(places == at.asked, STICK, state)
        # Most combinations are not allowed, and then their forces need not be worked out.
        violation = jax.lax.cond(
            jnp.all(are_allowed(problem, tried)),
            lambda: _judged(problem, tried),
            lambda: jnp.full(count, infinite),
        )
        changed = jnp.sum((state != start) != has_ended) * a_change
        could_stick = jnp.any((places == at.asked) & (violation == 0))
        own = jnp.where(at.asked < 0, jnp.max(violation) + changed, at.own + jnp.where(could_stick, in_vain, 0.0))
        left = might_stick & ((state == FORWARD) | (state == BACKWARD)) & (places > at.asked)
        asks = jnp.any(left) & (own < at.least)
        return _Search(
            jnp.where(asks, at.number, at.number + 1),
            jnp.where(asks, jax.lax.argmax(left, 0, jnp.int32), -1),
            own,
            jnp.where(asks, at.least, jnp.minimum(own, at.least)),
            jnp.where(~asks & (own < at.least), state, at.best),
        )

    # One after the other: what tries all at once takes long to compile.
    nothing = jnp.full((), -1, jnp.int32)
    begin = _Search(nothing, nothing, infinite, infinite, start)
    return jax.lax.while_loop(going, step, depending_on(problem, begin)).best


def _preference(states: tuple[int, ...]) -> tuple[int, int]:
    return -states.count(STICK), states.count(OPEN)


@with_code_once
def pivoted(problem: ContactProblem, start: Int[Array, " c"]) -> Int[Array, " c"]:
    """By principal pivoting: in each step one contact whose state is not admissible takes a state that is, given the others'.

    At first the worst contact changes, which seldom takes more than a few steps from a good guess; later the first one (Murty's
    rule), which for a P-matrix is sure to end. The best states met are kept.
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

        def own_violation(option) -> Float[Array, ""]:
            return jnp.sum(jnp.where(mine, _judged(problem, jnp.where(mine, option, state)), 0.0))

        own = jax.lax.map(own_violation, jnp.arange(4, dtype=jnp.int32))
        # Its present state is excluded, whatever rounding says.
        own = jnp.where(jnp.arange(4) == jnp.sum(jnp.where(mine, state, 0)), jnp.inf, own)
        change = jax.lax.argmin(own, 0, jnp.int32)
        return jnp.where(mine, change, state), best, least, step + 1, worst > 0

    def going(carry):
        *_, step, wrong = carry
        return wrong & (step < 16 * count)

    infinite = jnp.asarray(jnp.inf, problem.normal.dtype)
    begin = start, start, infinite, jnp.zeros((), jnp.int32), jnp.asarray(True)
    return jax.lax.while_loop(going, body, begin)[1]
