r"""Derivatives of special points of a branch in all parameters of the scene, by the implicit function theorem.

A special point is a root of the cycle's equations $F(u, λ; θ) = 0$ together with one more equation. At a grazing it says that
the minimum of a guard is zero, at the vanishing of a phase that its duration is zero: one linear system gives the derivatives.
Where the parameter turns back there is a vector $l$ with $l^T ∂F/∂u = 0$, so $dλ/dθ = - l^T F_θ / l^T F_λ$. Where a
multiplier $m$ passes the unit circle, $|m|(λ, θ) = 1$, and the derivatives of $|m|$ along the family of cycles are differences
of values that are exact to rounding.
"""

import numpy as np
from jaxtyping import Float

from ..contact import Status
from ..linear.linearisation import sliding_rates
from ..model.directions import direction_of, moved_along
from ..model.scene import Scene
from .branch_points import BranchPoint
from .grazing import images_up_to_minimum, row_of, up_to_minimum, without_minimum
from .multiple_shooting import PhaseImages, images_along, one_after_another
from .pseudo_arclength import Curve, Family, assembled, multipliers_of, scaled
from .special_points import MEETS_SLIDING, Special, critical_multiplier

# Relative change of a parameter for differences of rates; and of multipliers, of cycles that Newton's method corrects only
# where they are off by more than rounding.
APART, APART_ON_CURVE = 1e-6, 1e-5


def derivatives_of_special_points(
    family: Family, points: list[BranchPoint]
) -> tuple[list[str], Float[np.ndarray, "point of"]]:
    """Names of the parameters, and the derivatives for each point; NaN where there are none."""
    scene = family.scene
    names = [name for name, value in scene.parameters.items() if np.ndim(value) == 0 and name != family.name]
    values = np.full((len(points), len(names)), np.nan)
    for row, point in enumerate(points):
        if point.special is not None:
            values[row] = _derivatives(family, point.special, names)
    return names, values


def _derivatives(family: Family, special: Special, names: list[str]) -> list[float]:
    cycle, phases = special.cycle, special.cycle.phases
    if special.name == MEETS_SLIDING:
        return [_of_stability_limit(family, cycle.parameter, name) for name in names]
    directions = [direction_of(family.scene, name) for name in names]
    asked, row = one_after_another(phases), special.row
    if special.grazing is not None:
        minimum = special.grazing.minimum
        asked = up_to_minimum(phases, minimum)
        _, partial = images_up_to_minimum(special.curve, cycle.parameter, phases, minimum)
        row = row_of(special.curve, phases, minimum, partial)
    found = images_along(family.at(cycle.parameter), directions, *asked)
    return [_derivative(family, special, row, *each) for each in zip(names, directions, found, strict=True)]


def _derivative(family: Family, special: Special, row, name: str, direction: Scene, found: PhaseImages) -> float:
    """From the images of phases along the direction, of which the last is up to the minimum that grazes, if one does. The
    `row` has the derivatives of what is zero at the point besides the cycle's equations.
    """
    curve, cycle = special.curve, special.cycle
    if name == "restitution" and _is_inelastic(family) and _rebounds_change(special):
        return np.nan
    last = 0.0
    if special.grazing is not None:
        found, partial = without_minimum(found)
        last = float(partial.guard_parameter[0])
    _, rows = assembled(found, cycle.phases)
    _, own = assembled(cycle.images, cycle.phases)
    slope, own = rows[:, -1], own * curve.scales
    if special.turns:
        each, sizes = scaled(own)
        left, _, _ = np.linalg.svd(each[:, :-1])
        null = left[:, -1] / sizes
        return float(-(null @ slope) / (null @ own[:, -1]) * curve.scales[-1])
    if special.multiplier is not None:
        return _of_multiplier(family, special, name, direction, own, slope)
    if row is None:
        return np.nan
    system, sizes = scaled(np.vstack([own, row]))
    # Where two special points coincide the equations do not tell them apart. Else this is some thousand.
    if not np.linalg.cond(system) < 1e10:
        return np.nan
    change = np.linalg.solve(system, -np.append(slope, last) / sizes)
    return float(change[-1] * curve.scales[-1])


def _is_inelastic(family: Family) -> bool:
    return float(np.asarray(family.scene.restitution)) == 0


def _rebounds_change(special: Special) -> bool:
    """Whether a special point without restitution has no derivative by it, or none that is worked out.

    With a little restitution a landing that comes to rest does so by ever smaller rebounds, which are no phases here. What they
    change of multipliers is not worked out; and where a contact is about to lift off after the landing, its own or another's, a
    rebound grows from nothing to a flight, and there is no such point.
    """
    modes = special.cycle.phases.modes
    if special.turns:
        return False
    if special.multiplier is not None:
        pairs = zip(modes, modes[1:] + modes[:1], strict=True)
        return any(a.lands and b.of_guard(a.ending)[0] != Status.DETACH for a, b in pairs)
    if special.grazing is None:
        return False
    minimum = special.grazing.minimum
    return minimum.time == 0 and modes[minimum.phase - 1].lands


def _of_stability_limit(family: Family, limit: float, name: str) -> float:
    def slope(other: str) -> float:
        scene, direction = family.at(limit), direction_of(family.scene, other)
        value = abs(float(np.asarray(scene.parameters[other])))
        by = APART * (value if value else 1.0)
        low, high = (sliding_rates(moved_along(scene, direction, side * by))[0].real for side in (-1.0, 1.0))
        return float(high - low) / (2 * by)

    return -slope(name) / slope(family.name)


def _of_multiplier(
    family: Family, special: Special, name: str, direction: Scene, own: np.ndarray, slope: np.ndarray
) -> float:
    """By differences of the multiplier's size along the curve, and across it with the other parameter: next to a fold, where it
    has no derivative by the curve's own parameter.
    """
    curve, cycle = special.curve, special.cycle
    value = float(np.asarray(family.at(cycle.parameter).parameters[name]))
    by = APART_ON_CURVE * (abs(value) if value else 1.0)
    tangent = curve.tangent(cycle, None)
    each, sizes = scaled(own)
    across = np.linalg.lstsq(each, -slope / sizes, rcond=None)[0]

    def size(along: float, other: float) -> float:
        moved = family._replace(scene=moved_along(family.scene, direction, other))
        there = Curve(moved, cycle.phases)
        # Converted to the units of its own curve.
        guess = (cycle.u + along * tangent + other * across) * curve.scales / there.scales
        at = there.corrected(guess, tangent)
        which = None if at is None else critical_multiplier(multipliers_of(at.images), special.name)
        return np.nan if which is None else abs(which)

    if name == "restitution" and value < by:
        # No impact has less than none.
        with_other = (4 * size(0.0, by) - 3 * size(0.0, 0.0) - size(0.0, 2 * by)) / (2 * by)
    else:
        with_other = (size(0.0, by) - size(0.0, -by)) / (2 * by)
    with_own = (size(APART_ON_CURVE, 0.0) - size(-APART_ON_CURVE, 0.0)) / (2 * APART_ON_CURVE)
    change = across - with_other / with_own * tangent
    return float(change[-1] * curve.scales[-1])
