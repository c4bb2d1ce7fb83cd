"""`fj.plot_linear` and its like: earlier names of `fj.plot.linear`, …, kept for those who use them."""

from . import calibration as plot_calibration
from . import energy as plot_energy
from . import linear as plot_linear

__all__ = ["plot_calibration", "plot_energy", "plot_linear"]
