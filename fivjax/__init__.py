"""fivjax: friction-induced vibration in JAX: slide, stick, detach, squeal; differentiable and in batches."""

from . import cea as cea
from . import design as design
from . import plot as plot
from . import plot_linear as plot_linear
from .contact import Status as Status
from .event_exact import EventExact as EventExact
from .friction import Coulomb as Coulomb
from .friction import ExponentialDecay as ExponentialDecay
from .load import ConstantLoad as ConstantLoad
from .load import Pulse as Pulse
from .maps import bistability_map as bistability_map
from .maps import critical_perturbation as critical_perturbation
from .results import save as save
from .results import save_figure as save_figure
from .scene import Scene as Scene
from .scene import painleve_friction as painleve_friction
from .scene import sliding_equilibrium as sliding_equilibrium
from .simulate import Trajectory as Trajectory
from .simulate import simulate as simulate
from .steppers import vector_field as vector_field
from .structure import Structure as Structure
from .structure import belt_oscillator as belt_oscillator
from .verdict import Verdict as Verdict
from .where_switched import WhereSwitched as WhereSwitched
