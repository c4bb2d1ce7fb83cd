r"""The physics of contact, written once: accelerations, contact forces, what ends a status, and what follows.

A contact sticks (0), slides (1) or is detached (2). With the free acceleration $a^f = M^{-1}(fF - C\dot q - Kq)$ and the
contact's compliance $G = E^T M^{-1} E$, $E = [e_t, e_n]$, every status is the free structure plus contact forces
$a = a^f + M^{-1}(e_t T + e_n N)$ that keep what the status demands:

| status | demands | forces |
|---|---|---|
| stick | $a_t = a_n = 0$ | $(T, N) = -G^{-1} (a^f_t, a^f_n)$ |
| slide | $a_n = 0$, $T = \sigma \mu N$ | $N = -a^f_n / (G_{nn} + \sigma \mu G_{nt})$ |
| detach | | $T = N = 0$ |

with $\sigma = -\mathrm{sign}(\dot q_t - v_{belt})$. These are Eqs. 6, 3 and 5 of the paper, for any structure: each follows by
projection from the symmetric matrices of the free structure.

A status lasts while its *guards* are positive: the two edges of the friction cone while sticking, N and the slip speed
while sliding, the gap while detached. When one is used up, `transition` puts the state on its constraint, applies the
impact law where the gap closed, and chooses the next status from the forces, never from which guard it was.

Under a high load, a small vibration is lost in the rounding of the static displacements. `Mechanics.about` therefore makes
mechanics for displacements and loads that are deviations from a `Rest`. The free acceleration then includes the contact forces
at rest, and `ModeForces` are *added* to those; `guards` and `contact_forces` are those of the total forces in both cases.

Everything here is about one instant; batches come from `jax.vmap`. With one contact a status, a force or a guard's value is a
number. With several, each has a last axis over the contacts: the demands of all contacts are one linear system
(`mode_forces`), and what follows from an event is found for all of them at once (`contact_problem`).
"""

from .forces import State as State
from .forces import acceleration as acceleration
from .forces import acceleration_under as acceleration_under
from .forces import added_forces as added_forces
from .forces import constrained_coordinates as constrained_coordinates
from .forces import contact_forces as contact_forces
from .forces import free_acceleration as free_acceleration
from .forces import free_matrices as free_matrices
from .forces import gap as gap
from .forces import measured as measured
from .forces import relative_velocity as relative_velocity
from .forces import slip_speed as slip_speed
from .forces import total_forces as total_forces
from .guard import cone_margins as cone_margins
from .guard import guards as guards
from .guard import guards_under as guards_under
from .impacts import impact as impact
from .mechanics import Mechanics as Mechanics
from .mechanics import Rest as Rest
from .mode import Contact as Contact
from .mode import Status as Status
from .mode import same_mode as same_mode
from .mode_forces import ModeForces as ModeForces
from .mode_forces import sticking_forces as sticking_forces
from .rounding import exactly_zero as exactly_zero
from .rounding import magnitudes as magnitudes
from .several_contacts import affected_by as affected_by
from .several_contacts import clearness_of_impact as clearness_of_impact
from .several_contacts import clearness_of_modes as clearness_of_modes
from .transitions import on_constraint as on_constraint
from .transitions import status_from_forces as status_from_forces
from .transitions import stopped as stopped
from .transitions import stuck as stuck
from .transitions import transition as transition
from .uniqueness import is_beyond_the_model as is_beyond_the_model
from .uniqueness import slides_uniquely as slides_uniquely
