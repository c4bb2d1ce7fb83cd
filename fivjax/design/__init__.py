"""Design by gradient: raise the critical friction or the critical kick by changing parameters within bounds."""

from ..linear.design import Design as Design
from ..linear.design import DesignOutcome as DesignOutcome
from ..linear.design import lower_growth_rate as lower_growth_rate
from ..linear.design import raise_critical_friction as raise_critical_friction
from ..linear.gradient_search import BracketedNewton as BracketedNewton
from ..linear.gradient_search import Search as Search
from ..linear.gradient_search import search_critical_friction as search_critical_friction
from .critical_kick import RaisedCriticalKick as RaisedCriticalKick
from .critical_kick import raise_critical_perturbation as raise_critical_perturbation
