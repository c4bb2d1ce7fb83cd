"""The points of a branch of cycles."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Complex

from .pseudo_arclength import Curve, Family, Place, multipliers_of
from .special_points import Special
from .verification import Real, real_motion


class Point(NamedTuple):
    """A cycle on the branch with its multipliers, and its kind if it is a special point."""

    curve: Curve
    place: Place
    real: Real | None
    multipliers: Complex[np.ndarray, " m"]
    special: Special | None = None

    @property
    def is_real(self) -> bool:
        """Whether the real motion has the contact modes with which the cycle was computed, and its events where that has
        them.
        """
        return _is_real(self.real, self.place)

    @property
    def name(self) -> str:
        """The kind of special point; empty for all others."""
        return "" if self.special is None else self.special.name


def seen(family: Family, curve: Curve, place: Place, special: Special | None = None) -> Point:
    """A point of the branch from a computed cycle, with the real motion that starts on it."""
    real = real_motion(family.at(place.parameter), family.stepper, place.phases)
    return Point(curve, place, real, multipliers_of(place.images), special)


def is_real(family: Family, place: Place) -> bool:
    """The same of a computed cycle."""
    return _is_real(real_motion(family.at(place.parameter), family.stepper, place.phases), place)


def _is_real(real: Real | None, place: Place) -> bool:
    found = None if real is None else real.phases
    return found is not None and found.has_the_modes_of(place.phases) and not risen_to_zero(place)


def risen_to_zero(place: Place) -> list[int]:
    """The phases at whose computed end the guard rises: it has passed zero before, where the real motion has its event. In the
    last rebounds of a chain it neither rises nor falls, to rounding.
    """
    return [k for k in place.phases.lasting() if not place.images.guard_h[k] < 0]
