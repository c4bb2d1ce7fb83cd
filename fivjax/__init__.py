"""fivjax: friction-induced vibration in JAX: slide, stick, detach, squeal; differentiable and in batches."""

from . import cea as cea
from . import design as design
from . import energy as energy
from . import plot as plot
from . import plot_calibration as plot_calibration
from . import plot_energy as plot_energy
from . import plot_linear as plot_linear
from .calibrate import Calibration as Calibration
from .calibrate import calibrate as calibrate
from .contact import Status as Status
from .display import register as _register_displays
from .display import show as show
from .energy_cycles import energy_per_cycle as energy_per_cycle
from .energy_cycles import energy_per_event as energy_per_event
from .event_exact import EventExact as EventExact
from .explorer import explorer as explorer
from .friction import Coulomb as Coulomb
from .friction import ExponentialDecay as ExponentialDecay
from .gradients import Derivatives as Derivatives
from .gradients import derivatives as derivatives
from .load import ConstantLoad as ConstantLoad
from .load import Pulse as Pulse
from .maps import bistability_map as bistability_map
from .maps import critical_perturbation as critical_perturbation
from .reproduce import reproduce as reproduce
from .results import save as save
from .results import save_figure as save_figure
from .scene import Scene as Scene
from .scene import painleve_friction as painleve_friction
from .scene import sliding_equilibrium as sliding_equilibrium
from .signals import Recording as Recording
from .signals import read_recording as read_recording
from .simulate import Trajectory as Trajectory
from .simulate import simulate as simulate
from .steppers import vector_field as vector_field
from .structure import Structure as Structure
from .structure import belt_oscillator as belt_oscillator
from .tradeoff import tradeoff as tradeoff
from .verdict import Ending as Ending
from .verdict import Verdict as Verdict
from .where_switched import WhereSwitched as WhereSwitched

_register_displays()
