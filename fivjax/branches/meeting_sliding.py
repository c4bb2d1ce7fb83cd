"""The end of a branch of shrinking cycles: the sliding equilibrium at its stability limit."""

import numpy as np
from jaxtyping import Complex

from ..foundation.kept_programs import kept
from ..linear.linearisation import linear_sliding
from ..model.scene import Scene
from .branch_points import Point
from .pseudo_arclength import Family
from .special_points import MEETS_SLIDING, Special


@kept
def _sliding_matrix(scene: Scene):
    return linear_sliding(scene).matrix


def sliding_rates(scene: Scene) -> Complex[np.ndarray, " m"]:
    """Eigenvalues of steady sliding, in 1/s, the fastest growing first."""
    matrix = np.asarray(_sliding_matrix(scene))
    if not np.all(np.isfinite(matrix)):
        return np.full(len(matrix), np.nan, complex)
    values = np.linalg.eigvals(matrix).astype(complex)
    return values[np.lexsort((-values.imag, -values.real))]


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
