"""Pictures of results. Every function takes results, returns a matplotlib `Figure`, and computes no results.

Read first: `style`, by which all of them look alike, and `maps` as one of them. `fj.plot` has what is listed here; `energy`,
`linear` and `fits` are also `fj.plot_energy`, `fj.plot_linear` and `fj.plot_calibration`.
"""

from . import energy as energy
from . import fits
from . import linear as linear
from .boundary import boundary_section as boundary_section
from .branches import branch as branch
from .contact_status import STATUS_COLOURS as STATUS_COLOURS
from .contact_status import STATUS_NAMES as STATUS_NAMES
from .contact_status import shade_status as shade_status
from .cycles import cycle as cycle
from .fits import calibration as calibration
from .initial_states import basins as basins
from .maps import SLIDING_SHADE as SLIDING_SHADE
from .maps import bistability as bistability
from .responses import comparison as comparison
from .responses import perturbation as perturbation
from .responses import phase_plane as phase_plane
from .responses import response as response
from .thresholds import critical as critical
from .work_precision import tradeoff as tradeoff

plot_energy, plot_linear, plot_calibration = energy, linear, fits
