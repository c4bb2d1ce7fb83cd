"""Pictures of energy, in the manner of Figs. 7, 11–16 and 18, from results that have been computed.

Runs come from `simulate(..., energy=True)`, cycles from `energy_per_cycle(run)`. A window is a pair of instants in s. Curves
and areas differ in line style or hatching as well as in colour.
"""

from ._windows import STYLES as STYLES
from ._windows import Window as Window
from .energy_of_cycles import PER_CYCLE as PER_CYCLE
from .energy_of_cycles import contact_exchange as contact_exchange
from .energy_of_cycles import detachments as detachments
from .energy_of_cycles import growth as growth
from .energy_of_cycles import per_cycle as per_cycle
from .energy_of_runs import balance as balance
from .energy_of_runs import mechanical_energy as mechanical_energy
from .energy_of_runs import mechanical_power as mechanical_power
from .energy_of_runs import slip_reversal as slip_reversal
