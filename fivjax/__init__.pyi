# The public names and where they stand; `__init__.py` reads this file.

from . import plot as plot
from .calibration.fit import Calibration as Calibration
from .calibration.fit import calibrate as calibrate
from .contact import Status as Status
from .io.datasets import open as open
from .io.datasets import save as save
from .io.files import save_figure as save_figure
from .io.recordings import Recording as Recording
from .io.recordings import read_recording as read_recording
from .linear import cea as cea
from .linear import design as design
from .maps.bistability import bistability_map as bistability_map
from .maps.threshold import critical_perturbation as critical_perturbation
from .maps.tradeoff_study import tradeoff as tradeoff
from .model.friction import Coulomb as Coulomb
from .model.friction import ExponentialDecay as ExponentialDecay
from .model.load import ConstantLoad as ConstantLoad
from .model.load import Pulse as Pulse
from .model.scene import Scene as Scene
from .model.scene import painleve_friction as painleve_friction
from .model.scene import sliding_equilibrium as sliding_equilibrium
from .model.structure import Structure as Structure
from .model.structure import belt_oscillator as belt_oscillator
from .notebook.display import show as show
from .notebook.explore import explorer as explorer
from .paper.report import reproduce as reproduce
from .plot.former_names import plot_calibration as plot_calibration
from .plot.former_names import plot_energy as plot_energy
from .plot.former_names import plot_linear as plot_linear
from .simulation import energy as energy
from .simulation.differentiation import Derivatives as Derivatives
from .simulation.differentiation import derivatives as derivatives
from .simulation.ending import Ending as Ending
from .simulation.energy_cycles import energy_per_cycle as energy_per_cycle
from .simulation.energy_cycles import energy_per_event as energy_per_event
from .simulation.trajectory import Trajectory as Trajectory
from .simulation.trajectory import simulate as simulate
from .steppers.base import vector_field as vector_field
from .steppers.event_exact import EventExact as EventExact
from .steppers.where_switched import WhereSwitched as WhereSwitched
from .verdicts.verdict import Verdict as Verdict

__version__: str
