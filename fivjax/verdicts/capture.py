r"""The proof of a limit cycle: a trajectory has entered a neighbourhood that the return map contracts into itself.

Recurrence is no proof: a slow fade, and the ghost of a cycle just past its fold, come back for hundreds of periods. So the
attractor is computed first: a state $q^*$ of the Poincaré section with $P(q^*) = q^*$, where $P$ is the section's return map
over one period of the cycle, and where all eigenvalues of the derivative $J$ of $P$ (the multipliers without the one for a
deviation along the cycle) lie inside the unit circle. It is then shown that a trajectory cannot leave a neighbourhood of $q^*$.

**Norm.** On the section only some coordinates are free: the tangential velocity is zero, and so is everything that the contact
mode forbids. With deviations $x$ of the free coordinates, weighted so that displacements and velocities are comparable
(`Structure.weights`), and $A$ the derivative of $P$ in these coordinates, a rate $γ$ is taken half way between the spectral
radius of $A$ and one. The discrete Lyapunov equation

$$ (A/γ)^T H (A/γ) - H = -I $$

has a positive definite solution, and in the norm $|x|_H = \sqrt{x^T H x}$ the linear map contracts by $γ$ in one period. In the
Euclidean norm it need not, even if the cycle is stable.

**Radius.** Within an ellipsoid $|x|_H ≤ r$ on which every motion passes through the same events, $P$ is analytic, and its
difference from $A x$ is of second order. So $r$ is halved, from a share of the cycle's size, until at all points checked (on
the boundary and on smaller ellipsoids inside, in directions that fill the sphere evenly, including the axes)

- $P$ comes back to the section in the same contact mode after the same number of contact events, and
- $|P(x)|_H ≤ κ |x|_H$ with $κ$ half way between $γ$ and one: half of the margin of the linear contraction is left for the
  second-order terms.

The ellipsoid is then mapped into itself and shrinks at least by $κ$ in each period: every trajectory in it goes to $q^*$. Only
finitely many points are checked; their number (`points`), the largest $|P(x)|_H / |x|_H$ among them (`contraction`), the radius
and the norm are part of the result.

**Capture.** A trajectory is on the limit cycle once one of its crossings of the section, after the last jump of its load, lies
in the ellipsoid and has the cycle's contact mode. This test compares one state with one attractor and does not depend on other
trajectories. Coexisting cycles have ellipsoids of their own, and a trajectory has the amplitude of the cycle that captured it.

The state of a crossing must be known much better than the radius. The states that `Windowed` interpolates from its samples have
errors of some thousandths, which is only enough to choose the trajectories to test.
"""

import functools
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from ..contact import same_mode

# With multipliers closer than this to the unit circle, a contraction could not be told from rounding.
MARGIN = 1e-6
# The largest and the smallest radius tried, relative to the cycle's size.
LARGEST, SMALLEST = 0.5, 1e-8
# Sizes of the ellipsoids on which the return map is checked, relative to the radius; and the number of directions on each.
SHELLS = (1.0, 0.5, 0.25, 0.125)
DIRECTIONS = 64
# One in so many points of a radius is tried first, then one in so many.
PROBED = (32, 8)


class Neighbourhood(NamedTuple):
    """An ellipsoid on the section about a stable periodic cycle, checked to be mapped into itself."""

    centre: Float[np.ndarray, " state"]  # the cycle's state, as a deviation from the sliding equilibrium
    status: int | Int[np.ndarray, " c"]  # the contact mode there; with several contacts, one for each
    direction: float | Float[np.ndarray, " c"]  # the direction of friction there, if it slides
    norm: Float[np.ndarray, "k state"]  # the norm of a state y is the length of norm @ (y - centre)
    radius: float  # in that norm, which is never less than the length of the weighted deviation
    contraction: float  # the largest ratio of norms after and before one period, of the points checked
    points: int  # the number of points checked

    def contains(
        self, y: Float[np.ndarray, "*m state"], status: Int[np.ndarray, "*m"], direction: Float[np.ndarray, "*m"]
    ) -> Bool[np.ndarray, "*m"]:
        """Which of several states of the section lie in it: their trajectories are captured."""
        size = np.linalg.norm((y - self.centre) @ self.norm.T, axis=-1)
        return (size <= self.radius) & _same_mode(status, direction, self.status, self.direction)


class Returned(NamedTuple):
    """The images of several states (leading axis) under a return map; NaN where a motion does not come back."""

    y: Float[np.ndarray, "m state"]
    status: Int[np.ndarray, "m *contacts"]
    direction: Float[np.ndarray, "m *contacts"]
    events: Int[np.ndarray, " m"]  # contact events on the way


# The return map over one period of the cycle, from many states of the section in the cycle's contact mode.
ReturnMap = Callable[[Float[np.ndarray, "m state"]], Returned]


def adapted_norm(derivative: Float[np.ndarray, "f f"]) -> tuple[Float[np.ndarray, "f f"], float] | None:
    """A square root of $H$ (see the module's docstring) and the rate γ; None if the largest multiplier is too close to 1."""
    from scipy.linalg import solve_discrete_lyapunov

    if not np.all(np.isfinite(derivative)):
        return None
    largest = np.max(np.abs(np.linalg.eigvals(derivative)), initial=0.0)
    if largest >= 1 - MARGIN:
        return None
    rate = 0.5 * (1 + largest)
    scaled = derivative / rate
    matrix = solve_discrete_lyapunov(scaled.T, np.eye(len(derivative)))
    try:
        # NumPy gives the lower Cholesky factor; its transpose is the root that acts on columns.
        return np.linalg.cholesky(0.5 * (matrix + matrix.T)).T, rate
    except np.linalg.LinAlgError:
        return None


class Trial(NamedTuple):
    """A stable cycle with its adapted norm, about which a neighbourhood is sought."""

    centre: Float[np.ndarray, " state"]
    status: int | Int[np.ndarray, " c"]
    direction: float | Float[np.ndarray, " c"]
    norm: Float[np.ndarray, "k state"]
    steps: Float[np.ndarray, "m state"]  # deviations of the points to be checked, for a radius of one
    sizes: Float[np.ndarray, " m"]  # their norms
    allowed: float  # the contraction κ that is required
    largest: float  # the first radius to try

    def probe(self, one_in: int) -> "Trial":
        """The same with one in so many points: most radii that are too large fail already at few."""
        return self._replace(steps=self.steps[::one_in], sizes=self.sizes[::one_in])

    def states(self, radius: float) -> Float[np.ndarray, "point state"]:
        """The states at which the return map is to be evaluated: the centre, for comparison, and the points."""
        return np.concatenate([self.centre[None], self.centre + radius * self.steps])

    def passed(self, radius: float, images: Returned) -> Neighbourhood | None:
        """The neighbourhood of this radius, if the images of `states` show that it is one."""
        ratios = np.linalg.norm((images.y[1:] - self.centre) @ self.norm.T, axis=1) / (radius * self.sizes)
        alike = _same_mode(images.status, images.direction, self.status, self.direction)
        # NaN is not below anything, so it fails.
        if not (np.all(alike & (images.events == images.events[0])) and np.all(ratios <= self.allowed)):
            return None
        contraction = float(np.max(ratios))
        return Neighbourhood(self.centre, self.status, self.direction, self.norm, radius, contraction, len(self.sizes))


def trial(
    centre: Float[np.ndarray, " state"],
    status: int | Int[np.ndarray, " c"],
    direction: float | Float[np.ndarray, " c"],
    jacobian: Float[np.ndarray, "state state"],
    weights: Float[np.ndarray, " state"],
    basis: Float[np.ndarray, "state f"],
) -> Trial | None:
    """The check to be made for a cycle; None if it is not stable by a margin. (Uncoupled oscillators have a second multiplier
    of 1, for a shift in time between them, so there is no check to make.)

    **Arguments:** `centre`, the cycle's state on the section; `status` and `direction`, its contact mode; `jacobian`, the
    derivative of the return map there; `weights` of the state's coordinates; `basis`, the weighted directions that are free on
    the section (`verdicts.free_directions`). States are deviations from the sliding equilibrium.
    """
    found = adapted_norm(basis.T @ (weights[:, None] * jacobian / weights) @ basis)
    size = float(np.linalg.norm(weights * centre))
    if found is None or size == 0:
        return None
    root, rate = found
    shells = np.concatenate([share * directions(basis.shape[1]) for share in SHELLS])
    # Points of the unit ball in the norm, as deviations of the state.
    steps = np.linalg.solve(root, shells.T).T @ basis.T / weights
    norm = np.concatenate([root @ basis.T, np.eye(len(weights)) - basis @ basis.T]) * weights
    return Trial(
        centre, status, direction, norm, steps, np.linalg.norm(shells, axis=1), 0.5 * (1 + rate), LARGEST * size
    )


def neighbourhood(attempt: Trial | None, returned: ReturnMap) -> Neighbourhood | None:
    """The largest of a halving series of ellipsoids that the return map is checked to contract into itself.

    None if there is no check to make, or if no ellipsoid of at least `SMALLEST` of the cycle's size passes: trajectories near
    such a cycle stay undecided.
    """
    if attempt is None:
        return None
    radius = attempt.largest
    while radius >= SMALLEST / LARGEST * attempt.largest:
        found = attempt.passed(radius, returned(attempt.states(radius)))
        if found is not None:
            return found
        radius = 0.5 * radius
    return None


def _same_mode(status, direction, other, other_direction):
    same = same_mode(status, direction, other, other_direction)
    return np.all(same, axis=-1) if np.ndim(other) else same


@functools.cache
def directions(dimension: int) -> Float[np.ndarray, "d f"]:
    """Directions that fill the unit sphere evenly, in opposite pairs, including the axes."""
    from scipy.special import ndtri

    axes = np.eye(dimension)
    count = max(DIRECTIONS // 2 - dimension, 1)
    inside = np.stack([_radical_inverse(np.arange(1, count + 1), base) for base in _primes(dimension)], axis=1)
    spread = ndtri(inside)
    lengths = np.linalg.norm(spread, axis=1, keepdims=True)
    spread = np.where(lengths > 0, spread / np.where(lengths > 0, lengths, 1.0), axes[:1])
    half = np.concatenate([axes, spread])
    return np.concatenate([half, -half])


def _radical_inverse(numbers: Int[np.ndarray, " m"], base: int) -> Float[np.ndarray, " m"]:
    """The digits of these numbers behind the point in opposite order: in prime bases the coordinates of Halton's points.
    (SciPy's take a second to import.)
    """
    found, left, place = np.zeros(len(numbers)), numbers, 1.0
    while np.any(left):
        place /= base
        found, left = found + place * (left % base), left // base
    return found


def _primes(count: int) -> list[int]:
    """The first so many prime numbers."""
    found: list[int] = []
    number = 2
    while len(found) < count:
        if all(number % prime for prime in found):
            found.append(number)
        number += 1
    return found
