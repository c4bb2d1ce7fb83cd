r"""The proof of a limit cycle: a trajectory has entered a neighbourhood that the return map contracts into itself.

Recurrence is no proof: a slow fade, and the ghost of a cycle just past its fold, come back for hundreds of periods. Here the
attractor comes first. It was computed: a state $q^*$ of the Poincaré section with $P(q^*) = q^*$, where $P$ is the section's
return map over one period of the cycle, and the derivative $J$ of $P$ there has all its eigenvalues (the multipliers but the
one of the cycle's own direction) inside the unit circle. What is then to be shown of a trajectory is that it cannot leave.

**Norm.** On the section only some coordinates are free: the tangential velocity is zero, and what the contact mode forbids is
zero too. With deviations $x$ of the free ones, weighted so that displacements and velocities compare
(`Structure.weights`), and $A$ the derivative in these coordinates, a rate $γ$ is taken half way between the spectral radius
of $A$ and one. The discrete Lyapunov equation

$$ (A/γ)^T H (A/γ) - H = -I $$

has a positive definite solution, and in the norm $|x|_H = \sqrt{x^T H x}$ the linear map contracts by $γ$ in one period, which
in the plain norm it need not, however stable the cycle.

**Radius.** Within an ellipsoid $|x|_H ≤ r$ on which every motion passes through the same events, $P$ is analytic, and what it
adds to $A x$ is of second order. So $r$ is halved, from a share of the cycle's own size, until at all of the points checked
(on the boundary and on smaller ellipsoids inside, in directions that fill the sphere evenly, the axes among them)

- $P$ comes back to the section in the same contact mode after the same number of contact events, and
- $|P(x)|_H ≤ κ |x|_H$ with $κ$ half way between $γ$ and one: half of the linear contraction's margin is left for the second
  order, at every size.

The ellipsoid is then mapped into itself, shrunken by $κ$ at least, time after time: whoever is in it goes to $q^*$. The check
is one of finitely many points, and says how many (`points`), the largest $|P(x)|_H / |x|_H$ among them (`contraction`), the
radius and the norm.

**Capture.** A trajectory is on the limit cycle once one of its crossings of the section, after the last jump of its load, is a
state in the ellipsoid and in the cycle's contact mode. This is a test of one state against one attractor: it knows nothing of
other trajectories, so their number never matters; coexisting cycles have ellipsoids of their own, and a trajectory has the
amplitude of the one that it has entered.

A crossing's state must be known far better than the radius: the states that `Windowed` reads off its samples are good to some
thousandths, which is enough to tell which trajectories to ask, and no more.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from ..contact import Status

# Multipliers closer than this to the unit circle leave no room for a contraction that could be told from rounding.
MARGIN = 1e-6
# The largest radius tried and the smallest that counts, relative to the cycle's size.
LARGEST, SMALLEST = 0.5, 1e-8
# Ellipsoids on which the return map is checked, relative to the radius, and directions on each.
SHELLS = (1.0, 0.5, 0.25, 0.125)
DIRECTIONS = 64
# Of the points of a radius, one in so many is tried first.
PROBED = 8


class Neighbourhood(NamedTuple):
    """An ellipsoid on the section about a stable periodic cycle, checked to be mapped into itself."""

    centre: Float[np.ndarray, " state"]  # the cycle's state, as a deviation from the sliding equilibrium
    status: int | Int[np.ndarray, " c"]  # the contact mode there; of several contacts, of each
    direction: float | Float[np.ndarray, " c"]  # and the way friction points, if it slides
    norm: Float[np.ndarray, "k state"]  # sizes are lengths of norm @ (y - centre)
    radius: float  # in that norm, which is never less than the weighted deviation's length
    contraction: float  # the largest that was seen in one period, in that norm
    points: int  # how many were checked

    def contains(
        self, y: Float[np.ndarray, "*m state"], status: Int[np.ndarray, "*m"], direction: Float[np.ndarray, "*m"]
    ) -> Bool[np.ndarray, "*m"]:
        """Which of several states of the section lie in it: trajectories that are captured."""
        size = np.linalg.norm((y - self.centre) @ self.norm.T, axis=-1)
        return (size <= self.radius) & _same_mode(status, direction, self.status, self.direction)


class Returned(NamedTuple):
    """Where a return map leads from several states (leading axis); NaN where it does not come back."""

    y: Float[np.ndarray, "m state"]
    status: Int[np.ndarray, "m *contacts"]
    direction: Float[np.ndarray, "m *contacts"]
    events: Int[np.ndarray, " m"]  # contact events on the way


# The return map over one period of the cycle, from many states of the section in the cycle's contact mode.
ReturnMap = Callable[[Float[np.ndarray, "m state"]], Returned]


def free_on_section(size: int, tangential: int, normal: int, status: int) -> Int[np.ndarray, " f"]:
    """Places in the state that the section and a contact mode leave free, in a structure of `size` coordinates."""
    held = [size + tangential]
    if status != Status.DETACH:
        held += [normal, size + normal]
    return np.delete(np.arange(2 * size), held)


def adapted_norm(derivative: Float[np.ndarray, "f f"]) -> tuple[Float[np.ndarray, "f f"], float] | None:
    """A square root of the norm $H$ of the module's text and the rate γ; none where no norm contracts by enough."""
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
        # Cholesky's factor is lower: its transpose is the root that acts on columns.
        return np.linalg.cholesky(0.5 * (matrix + matrix.T)).T, rate
    except np.linalg.LinAlgError:
        return None


class Trial(NamedTuple):
    """A stable cycle with the norm of the module's text, about which a neighbourhood is sought."""

    centre: Float[np.ndarray, " state"]
    status: int | Int[np.ndarray, " c"]
    direction: float | Float[np.ndarray, " c"]
    norm: Float[np.ndarray, "k state"]
    steps: Float[np.ndarray, "m state"]  # deviations of the points to be checked, for a radius of one
    sizes: Float[np.ndarray, " m"]  # of these, in the norm
    allowed: float  # the contraction asked for
    largest: float  # the radius to begin with

    def probe(self) -> "Trial":
        """The same with few points: most radii that are too large fail at these."""
        return self._replace(steps=self.steps[::PROBED], sizes=self.sizes[::PROBED])

    def states(self, radius: float) -> Float[np.ndarray, "point state"]:
        """Where the return map is to be evaluated: the centre, to compare with, and the points."""
        return np.concatenate([self.centre[None], self.centre + radius * self.steps])

    def passed(self, radius: float, images: Returned) -> Neighbourhood | None:
        """The neighbourhood of this radius, if the images of `states` show that it is one."""
        ratios = np.linalg.norm((images.y[1:] - self.centre) @ self.norm.T, axis=1) / (radius * self.sizes)
        alike = _same_mode(images.status, images.direction, self.status, self.direction)
        # Not a number is not below anything.
        if not (np.all(alike & (images.events == images.events[0])) and np.all(ratios <= self.allowed)):
            return None
        contraction = float(np.max(ratios))
        return Neighbourhood(self.centre, self.status, self.direction, self.norm, radius, contraction, len(self.sizes))


def trial(
    centre: Float[np.ndarray, " state"],
    status: int,
    direction: float,
    jacobian: Float[np.ndarray, "state state"],
    weights: Float[np.ndarray, " state"],
    free: Int[np.ndarray, " f"],
) -> Trial | None:
    """What is to be checked about a cycle; none where it is not stable by a margin.

    **Arguments:** `centre`, the cycle's state on the section; `status` and `direction`, its contact mode; `jacobian`, the
    derivative of the return map there; `weights` of the state's coordinates, and the places `free` on the section
    (`free_on_section`). States are deviations from the sliding equilibrium.
    """
    scale = weights[free]
    found = adapted_norm(scale[:, None] * jacobian[np.ix_(free, free)] / scale)
    size = float(np.linalg.norm(weights * centre))
    if found is None or size == 0:
        return None
    root, rate = found
    shells = np.concatenate([share * directions(len(free)) for share in SHELLS])
    # Of unit size in the norm, as deviations of the state.
    steps = np.zeros((len(shells), len(centre)))
    steps[:, free] = np.linalg.solve(root, shells.T).T / scale
    norm = np.diag(weights)
    norm[np.ix_(free, free)] = root * scale
    sizes = np.linalg.norm(shells, axis=1)
    return Trial(centre, status, direction, norm, steps, sizes, 0.5 * (1 + rate), LARGEST * size)


def neighbourhood(attempt: Trial | None, returned: ReturnMap) -> Neighbourhood | None:
    """The largest of a halving series of ellipsoids that the return map is checked to contract into itself.

    None where there is nothing to be tried, or no ellipsoid of at least `SMALLEST` of the cycle's size passes: what comes near
    such a cycle stays undecided.
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
    same = (status == other) & ((other != Status.SLIDE) | (direction == other_direction))
    return np.all(same, axis=-1) if np.ndim(other) else same


def directions(dimension: int) -> Float[np.ndarray, "d f"]:
    """Directions that fill the unit sphere evenly, in opposite pairs, the axes among them."""
    from scipy.special import ndtri
    from scipy.stats import qmc

    axes = np.eye(dimension)
    count = max(DIRECTIONS // 2 - dimension, 1)
    # Halton's points without scrambling are the same ones every time; the first of them is a corner.
    inside = qmc.Halton(dimension, scramble=False).random(count + 1)[1:]
    spread = ndtri(inside)
    lengths = np.linalg.norm(spread, axis=1, keepdims=True)
    spread = np.where(lengths > 0, spread / np.where(lengths > 0, lengths, 1.0), axes[:1])
    half = np.concatenate([axes, spread])
    return np.concatenate([half, -half])
