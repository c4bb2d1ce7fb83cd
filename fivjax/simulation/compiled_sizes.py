"""Few compiled sizes for many runs: programs differ by the number of rows and by the bound on steps between two rows."""

import math

import equinox as eqx
import numpy as np

from ..foundation.compiling import power_of_4
from ..steppers.base import AbstractStepper

# The smallest number of rows that is compiled; and the largest for which the number is rounded up to a power of four.
LEAST_ROWS, MOST_REPEATED = 64, 4**8


def compiled_rows(count: int) -> int:
    """The number of rows to compile for `count` rows. For very many rows it is `count`: compiling then takes little of the
    time.
    """
    return power_of_4(max(count, LEAST_ROWS)) if count <= MOST_REPEATED else count


def compiled_steps(count: int) -> int:
    """The bound on steps between two rows to compile for `count` steps: surplus steps are never taken."""
    return 16 ** math.ceil(math.log(count, 16)) if count else 0


def with_step_as_array(method: AbstractStepper) -> AbstractStepper:
    """A method with a fixed step, with that step as an array: as a number, each value would be compiled anew."""
    if method.chooses_its_steps:
        return method
    return eqx.tree_at(lambda method: method.dt, method, np.asarray(method.dt))
