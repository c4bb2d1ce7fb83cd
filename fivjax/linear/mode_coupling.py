"""Where two modes of steady sliding meet: their coalescence, beyond which mode coupling makes one of them grow."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from ..foundation import arguments
from ..foundation.precision import in_double_precision
from ..model.contact_coordinates import in_contact_coordinates
from ..model.scene import refuse_several_contacts
from ..model.structure import Structure
from .critical import matrices_only
from .crossings import first_limit
from .feedback import friction_loop
from .gradients import by_numpy_if_small
from .outcomes import COALESCENCE, StabilityOutcome
from .system import checked_direction


class Coalescence(eqx.Module):
    """Where two modes of steady sliding meet.

    With damping they meet exactly only at a complex friction $\\mu + i\\mu'$. For real friction they come closest to each other
    at `mu`; `imperfection` is $|\\mu'|$, which is 0 without damping.
    """

    mu: float
    frequency: float  # Hz
    growth_rate: float  # 1/s
    imperfection: float
    damped: bool = eqx.field(static=True)
    outcome: StabilityOutcome = eqx.field(static=True)

    def __repr__(self) -> str:
        if self.outcome is not StabilityOutcome.FOUND:
            return f"coalescence of two modes: {self.outcome.value}"
        meet = f"come closest, {self.imperfection:.3g} in μ from meeting," if self.damped else "meet"
        return f"two modes {meet} at μ = {self.mu:.8g}, {self.frequency:.6g} Hz, growth rate {self.growth_rate:.4g} 1/s"


@by_numpy_if_small
def _coalescence(structure, direction):
    undamped = eqx.tree_at(lambda s: s.damping, structure, jnp.zeros_like(structure.damping))
    loop, scale = friction_loop(undamped, direction)
    limit = first_limit(loop)
    full, _ = friction_loop(structure, direction)

    # Damping is increased from zero in this many steps, with this many Newton iterations at each.
    homotopy_steps, newton_steps = 20, 4

    def step(i, s):
        share = (i // newton_steps + 1) / homotopy_steps
        partly = eqx.tree_at(
            lambda x: (x.damping, x.row_damping), full, (share * full.damping, share * full.row_damping)
        )
        slope, curvature = jax.jvp(partly.slope, (s,), (jnp.ones_like(s),))
        return s - slope / curvature

    start = jax.lax.complex(jnp.zeros_like(limit.omega), limit.omega)
    s = jax.lax.fori_loop(0, homotopy_steps * newton_steps, step, start)
    found = limit.code == COALESCENCE
    kept = found & jnp.isfinite(s) & (jnp.abs(s - start) < 0.5 * jnp.abs(start))
    return limit.gain, limit.omega * scale, 1 / full(s), s * scale, found, kept


@in_double_precision
def coalescence(structure: Structure, *, damped: bool = False, direction: int = 1) -> Coalescence:
    r"""Where the two modes that become unstable together meet.

    - `damped=False`: without the dampers (two frequencies become one, $dL/dω = 0$). This is what is usually called coalescence;
      the paper's value is 0.22.
    - `damped=True`: with the dampers. The eigenvalues then meet exactly only at a complex friction: $L'(s) = 0$ for complex
      $s$, $\mu + i\mu' = 1/L(s)$. This point is followed from the undamped one while the damping is increased. For real
      friction the eigenvalues come closest at `mu` (to second order in `imperfection`).

    **Returns:** a `Coalescence`. Where no two undamped modes meet, its outcome is "never unstable" and its numbers are
    NaN; where the damped point cannot be followed (heavy damping), it is "undecided".

    **Raises:** `ValueError` for several contacts.

    **Example:**

        >>> round(float(fj.cea.coalescence(structure).mu), 5)
        0.22636
    """
    structure = in_contact_coordinates(structure)
    arguments.known("structure", structure)
    refuse_several_contacts(structure, "`coalescence`", "`growth_rate` takes several.")
    arguments.truth("damped", damped)
    damped = bool(damped)
    direction = checked_direction(direction)
    mu, omega, damped_mu, s, found, kept = jax.tree.map(
        np.asarray, _coalescence(matrices_only(structure), jnp.asarray(float(direction)))
    )
    if not found or (damped and not kept):
        outcome = StabilityOutcome.UNDECIDED if found else StabilityOutcome.NEVER_UNSTABLE
        return Coalescence(np.nan, np.nan, np.nan, np.nan, damped=damped, outcome=outcome)
    if damped:
        values = (damped_mu.real, abs(s.imag) / (2 * np.pi), s.real, abs(damped_mu.imag))
    else:
        values = (mu, omega / (2 * np.pi), 0.0, 0.0)
    return Coalescence(*map(float, values), damped=damped, outcome=StabilityOutcome.FOUND)
