"""Corners of a branch: cycles at which an impact begins to end the slip, or ceases to, while the contact modes stay the same.

Up to there the cycle's equations are smooth, and so they are beyond, but their derivatives differ. So the branch has a corner,
and where that is sharp, no cycle lies ahead along the tangent. It goes on along the tangent that the equations have beyond.
"""

import numpy as np
from jaxtyping import Bool, Float

from ..contact import Status
from ..model.scene import Scene
from ..model.sliding import contact_coordinates
from .branch_points import BranchPoint, branch_point, is_real_motion
from .multiple_shooting import PhaseImages
from .pseudo_arclength import ComputedCycle, Curve, Family
from .special_points import CORNER, Special


def around_corner(family: Family, here: BranchPoint, tangent: Float[np.ndarray, " m"]):
    """The corner close ahead of a point: the special point, if the parameter turns back there; and the point, tangent and step
    with which to go on. None if there is no corner.
    """
    curve, before = here.curve, _ends_slip(here.curve, here.cycle.images, here.cycle.parameter)
    # Distances at which an impact is seen to be of the other kind, and others beyond the corner at which the branch goes on.
    for ahead in (2e-6, 1e-5, 1e-4):
        _, rows, images, _, parameter = curve.system(here.cycle.u + ahead * tangent)
        changed = np.flatnonzero(_ends_slip(curve, images, parameter) != before)
        if len(changed) != 1 or not np.all(np.isfinite(rows)):
            continue
        phase, onward = int(changed[0]), curve.tangent(here.cycle._replace(jacobian=rows), None)
        for length in (1e-5, 1e-4, 1e-3):
            for way in (onward, -onward):
                found = curve.along(here.cycle, way, length)
                if found is None or _ends_slip(curve, found.images, found.parameter)[phase] == before[phase]:
                    continue
                if is_real_motion(family, found):
                    corner = _corner(curve, phase, found if before[phase] else here.cycle)
                    turns = corner is not None and way[-1] * tangent[-1] < 0
                    special = Special(CORNER, curve, corner) if corner is not None and turns else None
                    return special, (branch_point(family, curve, found), curve.tangent(found, way), 1e-3)
    return None


def _ends_slip(curve: Curve, images: PhaseImages, parameter: float) -> Bool[np.ndarray, " k"]:
    """Which phases end in an impact that ends the slip, though the contact does not stick then."""
    found = np.zeros(len(curve.modes), bool)
    for k, mode in enumerate(curve.modes):
        following = curve.modes[(k + 1) % len(curve.modes)]
        if mode.lands and following.status[mode.ending // 2] != Status.STICK:
            found[k] = images.y[k, _velocity_after(curve, k)] == _belt(curve, k, curve.family.at(parameter))
    return found


def _velocity_after(curve: Curve, phase: int) -> int:
    """Where in a state the tangential velocity of the contact is whose guard ends a phase."""
    structure = curve.family.scene.structure
    tangential, _ = contact_coordinates(structure)
    return structure.size + int(np.atleast_1d(tangential)[curve.modes[phase].ending // 2])


def _belt(curve: Curve, phase: int, of: Scene) -> float:
    """The velocity of that contact's belt in a scene, or its derivative in that of a scene."""
    mode = curve.modes[phase]
    return float(np.broadcast_to(np.asarray(of.belt_speed), len(mode.status))[mode.ending // 2])


def _corner(curve: Curve, phase: int, sliding: ComputedCycle) -> ComputedCycle | None:
    """The cycle at the corner: that on which the slip after the impact is zero, from one close by with slip after it. It is
    extrapolated from little slip, because without any the equations do not tell how the cycle goes on.
    """
    family, column = curve.family, _velocity_after(curve, phase)
    place = (phase + 1) % len(curve.modes) * len(curve.weights) + column
    belt, unit = _belt(curve, phase, family.at(sliding.parameter)), curve.scales[place]
    normal = np.eye(1, len(curve.scales), place)[0]
    # The parameter may be the belt's speed.
    normal[-1] = -_belt(curve, phase, family.direction) * curve.scales[-1] / unit
    side = np.sign(sliding.images.y[phase, column] - belt)
    near = []
    for slip in (1e-6, 2e-6):
        u = sliding.u.copy()
        u[place] = belt / unit + side * slip
        near.append(curve.corrected(u, normal))
    if near[0] is None or near[1] is None:
        return None
    u = 2 * near[0].u - near[1].u
    _, rows, images, phases, parameter = curve.system(u)
    return ComputedCycle(u, rows, images, phases, parameter, 0)
