"""Where the two halves of a cycle become one: there the period of the half doubles, and the branch of the whole begins.

Beyond that point the curve comes back with its halves exchanged. The whole cycle's equations are singular there, while the half
has a multiplier -1, so it is the half whose point is found to rounding and differentiated.
"""

import numpy as np
from jaxtyping import Float

from .branch_points import BranchPoint, branch_point
from .multiple_shooting import Phases
from .pseudo_arclength import ComputedCycle, Curve, Family, multipliers_of
from .special_points import DOUBLING, FOLD, Special, critical_multiplier, doubling, root


def born_between(family: Family, curve: Curve, a: ComputedCycle, b: ComputedCycle) -> BranchPoint | None:
    """The point at which the halves of a cycle are one, between two neighbours on a curve; None if there is none."""
    half, odd = divmod(len(curve.modes), 2)
    if odd or curve.modes[:half] != curve.modes[half:]:
        return None

    def apart(cycle: ComputedCycle) -> Float[np.ndarray, " m"]:
        y = curve.weights * cycle.phases.y
        return (y[:half] - y[half:]).ravel()

    # Beyond it the halves are exchanged.
    return _where_halves_meet(family, curve, b) if apart(a) @ apart(b) < 0 else None


def without_seeming_folds(points: list[BranchPoint], born: BranchPoint) -> list[BranchPoint]:
    """The points of a branch up to there, less folds next to it: where the equations are nearly singular, they seem to turn."""
    near = 1e-5 * born.curve.family.scale
    return [one for one in points if one.name != FOLD or abs(one.cycle.parameter - born.cycle.parameter) > near]


def _where_halves_meet(family: Family, curve: Curve, near: ComputedCycle) -> BranchPoint | None:
    """That point, from a cycle whose halves are nearly one."""
    half, phases = len(curve.modes) // 2, near.phases
    mean = Phases(
        curve.modes[:half], 0.5 * (phases.y[:half] + phases.y[half:]), 0.5 * (phases.h[:half] + phases.h[half:])
    )
    single = Curve(family, mean)

    def cycle(parameter: float) -> ComputedCycle | None:
        return single.at_parameter(single.unknowns(mean, parameter), parameter)

    def passing(at: ComputedCycle) -> float:
        return doubling(multipliers_of(at.images))

    reach = 1e-6 * family.scale
    while reach < 1e-2 * family.scale:
        ends = cycle(near.parameter - reach), cycle(near.parameter + reach)
        if any(end is None for end in ends):
            return None
        if np.prod([passing(end) for end in ends if end is not None]) < 0:
            _, at = root(cycle, passing, near.parameter - reach, near.parameter + reach)
            if at is None:
                return None
            multiplier = critical_multiplier(multipliers_of(at.images), DOUBLING)
            twice = Phases(curve.modes, np.tile(at.phases.y, (2, 1)), np.tile(at.phases.h, 2))
            u = curve.unknowns(twice, at.parameter)
            _, rows, images, _, _ = curve.system(u)
            whole = ComputedCycle(u, rows, images, twice, at.parameter, 0)
            return branch_point(family, curve, whole, Special(DOUBLING, single, at, multiplier=multiplier))
        reach *= 10
    return None
