"""Few sizes for many runs: a trajectory is compiled for each number of rows, and for each bound on the steps between them."""

import math

import equinox as eqx
import numpy as np

from ..foundation.compiling import power_of_4
from ..steppers.base import AbstractStepper

# Trajectories up to the second are compiled for the next power of four of rows, none for fewer than the first.
LEAST_ROWS, MOST_REPEATED = 64, 4**8


def compiled_rows(count: int) -> int:
    """The number of rows that is compiled for so many. Where these are many, compiling is little beside them."""
    return power_of_4(max(count, LEAST_ROWS)) if count <= MOST_REPEATED else count


def compiled_steps(count: int) -> int:
    """The number of steps between two rows that is compiled for so many: those beyond the last are never taken."""
    return 16 ** math.ceil(math.log(count, 16)) if count else 0


def with_step_as_array(method: AbstractStepper) -> AbstractStepper:
    """A method that takes the step it is told, with the step as an array: as a number, each would be compiled anew."""
    if method.chooses_its_steps:
        return method
    return eqx.tree_at(lambda method: method.dt, method, np.asarray(method.dt))
