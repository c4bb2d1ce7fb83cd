"""What the tests compile, in few shapes: nine tenths of their time is compiling.

A trajectory is compiled once for each stepper, friction law, load and number of rows; rows are filled up to the next power of
four. Tests that look at what a motion does use `QUICK`, those of digits `LOW_ORDER` over a few
hundred steps and the default otherwise.
"""

import fivjax as fj

# As exact as the default, in ten times as many steps: it compiles in half the time.
LOW_ORDER = fj.EventExact(order=8)
# For what a motion does, and not for its digits.
QUICK = fj.EventExact(order=8, tolerance=1e-10)


def steady(force: float = 100.0) -> fj.Pulse:
    """A load that does not change, as a kick that is none: compiled together with kicks."""
    return fj.Pulse(force, p=1.0)
