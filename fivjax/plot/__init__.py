"""Pictures of results. Every function takes results, returns a matplotlib `Figure`, and computes nothing."""

from . import calibration as calibration
from . import energy as energy
from . import linear as linear
from .results import SLIDING_SHADE as SLIDING_SHADE
from .results import STATUS_COLOURS as STATUS_COLOURS
from .results import STATUS_NAMES as STATUS_NAMES
from .results import bistability as bistability
from .results import comparison as comparison
from .results import critical as critical
from .results import perturbation as perturbation
from .results import phase_plane as phase_plane
from .results import response as response
from .results import shade_status as shade_status
from .results import tradeoff as tradeoff
