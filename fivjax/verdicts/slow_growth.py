r"""How long a sliding motion is certain to go on sliding, and its state at the end of that time.

A little above the stability limit the motion about an unstable sliding equilibrium grows for thousands of periods before its
first event. While the contact slides, the deviation is exactly $z(t) = \sum_k v_k w_k e^{λ_k t}$, so this time need not be
stepped through: with $σ = \max_k \mathrm{Re} λ_k > 0$, a sum $\sum_k a_k w_k e^{λ_k t}$ stays within its margin $m$ at
least until $e^{σt} \sum_k |a_k w_k| = m$.
"""

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from ..contact import Contact, Mechanics, State, Status
from ..foundation import complex_pairs
from ..foundation.complex_pairs import Pair
from ..model.sliding import sliding_states
from .sliding_proof import SlidingModes


def slide_while_certain(
    mechanics: Mechanics, modes: SlidingModes, contact: Contact, deviation: State, allowed: Bool[Array, ""]
) -> tuple[State, Float[Array, ""]]:
    """The deviation from the equilibrium at the end of the time for which sliding is certain, and that time (s).

    Zero time, and the same state, if that time is short, or if it is not `allowed`: the load must be the final one.
    """
    linear = modes.linear
    keep = sliding_states(deviation.shape[0] // 2, mechanics.normal)
    modal = complex_pairs.from_real(modes.to_modal, deviation[keep])
    growth = jnp.max(modes.eigenvalues.real)
    sliding = (contact.status == Status.SLIDE) & (contact.direction == linear.direction) & linear.exists & allowed
    parts = [complex_pairs.times(shares, modal) for shares in (modes.pressing, modes.slip)]
    sizes = jnp.stack([jnp.sum(complex_pairs.size(part)) for part in parts])
    margins = jnp.stack([linear.pressing_margin, linear.slip_margin])
    # Only this share of the time for which sliding is certain is used: rounding must not lead past an event.
    used = 0.999
    time = used * jnp.min(jnp.log(margins / sizes)) / growth
    frequency = jnp.max(jnp.where(modes.eigenvalues.real >= growth, modes.eigenvalues.imag, 0.0))
    # Times shorter than so many periods are left to the stepper.
    least_periods = 4.0
    worthwhile = time * frequency > least_periods * 2 * jnp.pi
    # Beside a longer time than this a step is lost in rounding. Without damping growth is a rounding error, and time that long.
    counts = time * jnp.max(complex_pairs.size(modes.eigenvalues)) < 1e15
    taken = sliding & modes.regular & (growth > 0) & worthwhile & counts
    time = jnp.where(taken, time, 0.0)
    rates = Pair(modes.eigenvalues.real * time, modes.eigenvalues.imag * time)
    moved = complex_pairs.real_part(modes.from_modal, complex_pairs.times(complex_pairs.exponential(rates), modal))
    return jnp.where(taken, deviation.at[keep].set(moved), deviation), time
