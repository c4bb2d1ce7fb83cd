"""`fj.plot_linear`, `fj.plot_energy` and `fj.plot_calibration`: other names of the modules `linear`, `energy` and `fits`."""

from . import energy as plot_energy
from . import fits as plot_calibration
from . import linear as plot_linear

__all__ = ["plot_calibration", "plot_energy", "plot_linear"]
