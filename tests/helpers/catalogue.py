"""What the tests compile, in few shapes: nine tenths of their time is compiling.

A trajectory is compiled once for each stepper, friction law, load and number of rows; rows are filled up to the next power of
four. Tests that look at what a motion does use `QUICK`, those of digits `LOW_ORDER` over a few
hundred steps and the default otherwise.
"""

import numpy as np

import fivjax as fj

# As exact as the default, in ten times as many steps: it compiles in half the time.
LOW_ORDER = fj.EventExact(order=8)
# For what a motion does, and not for its digits.
QUICK = fj.EventExact(order=8, tolerance=1e-10)


def steady(force: float = 100.0) -> fj.Pulse:
    """A load that does not change, as a kick that is none: compiled together with kicks."""
    return fj.Pulse(force, p=1.0)


def full_matrices(mu: float = 0.6766) -> fj.Scene:
    """Three coordinates coupled by full matrices: a cycle that sticks, slides and detaches, with strongly stable multipliers."""
    mass = np.diag([1.0328, 1.4485, 1.4689]) + np.array(
        [[0, 0.0241, 0.0012], [0.0241, 0, -0.0149], [0.0012, -0.0149, 0]]
    )
    stiffness = np.array([[2.4397, 0.6167, 1.4575], [0.6167, 4.9068, 0.135], [1.4575, 0.135, 3.6783]])
    load, contact = [-0.2283, 0.0394, -0.7886], fj.ContactPoint(1, 2)
    structure = fj.Structure(mass, 0.02 * mass + 0.01 * stiffness, stiffness, load, contacts=[contact])
    return fj.Scene(structure, fj.Coulomb(mu), belt_speed=0.3, load=fj.ConstantLoad(1.7822))
