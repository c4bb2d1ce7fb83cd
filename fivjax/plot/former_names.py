"""`fj.plot_linear` and its like: the modules `linear`, `energy` and `fits` of `fj.plot`, kept for those who use them."""

from . import energy as plot_energy
from . import fits as plot_calibration
from . import linear as plot_linear

__all__ = ["plot_calibration", "plot_energy", "plot_linear"]
