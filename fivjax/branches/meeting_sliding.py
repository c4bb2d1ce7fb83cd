"""The end of a branch of shrinking cycles: the sliding equilibrium at its stability limit."""

import numpy as np

from ..linear.linearisation import sliding_rates
from .branch_points import Point
from .pseudo_arclength import Family
from .special_points import MEETS_SLIDING, Special


def where_sliding_is_met(family: Family, last: Point) -> Point | None:
    """The stability limit of sliding next to the last of shrinking cycles, as a point of their branch; None if none is near."""
    from scipy.optimize import brentq

    def growth(parameter: float) -> float:
        return float(sliding_rates(family.at(parameter))[0].real)

    near, width = last.place.parameter, 1e-6 * family.scale
    for _ in range(16):
        low, high = growth(near - width), growth(near + width)
        if low * high < 0:
            limit = float(brentq(growth, near - width, near + width, xtol=1e-15, rtol=1e-15))
            fastest = sliding_rates(family.at(limit))[0]
            rest, period = np.zeros_like(last.place.phases.y), np.array([2 * np.pi / abs(fastest.imag)])
            place = last.place._replace(parameter=limit, phases=last.place.phases._replace(y=rest, h=period))
            unknown = np.full_like(last.multipliers, np.nan)
            return Point(last.curve, place, None, unknown, Special(MEETS_SLIDING, last.curve, place))
        width *= 2
    return None
