"""Complex eigenvalue analysis of steady sliding: its modes, where it loses stability, and which parameter to change.

This module collects all functions of linear theory under one name; design by gradient is in `design`.
"""

from .charts import chart as chart
from .critical import StabilityLimit as StabilityLimit
from .critical import critical_friction as critical_friction
from .critical import critical_slope as critical_slope
from .critical import friction_slope as friction_slope
from .critical import stability_limit as stability_limit
from .left_eigenvectors import eigenvalue_derivatives as eigenvalue_derivatives
from .left_eigenvectors import shape_basis as shape_basis
from .mode_coupling import Coalescence as Coalescence
from .mode_coupling import coalescence as coalescence
from .mode_curves import modes as modes
from .mode_search import ComplexModes as ComplexModes
from .mode_search import complex_modes as complex_modes
from .outcomes import Mechanism as Mechanism
from .outcomes import StabilityOutcome as StabilityOutcome
from .pencil import Pencil as Pencil
from .pencil import friction_derivative as friction_derivative
from .pencil import sliding_pencil as sliding_pencil
from .routh_hurwitz import margin as margin
from .sensitivities import Sensitivity as Sensitivity
from .sensitivities import sensitivity as sensitivity
from .spectrum import eigenvalues as eigenvalues
from .spectrum import growth_rate as growth_rate
from .spectrum import linearisation as linearisation
