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
Euclidean norm it need not, even if the cycle is stable. (Where the contact has just lifted off, the gap and its rate have
larger weights: they are small in all motions nearby.)

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

The state of a crossing must be known much better than the radius. The states that `WhereSwitched` interpolates have
errors of some thousandths, which is only enough to choose the trajectories to test.
"""

import functools
from collections.abc import Callable
from statistics import NormalDist
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from ..contact import same_mode
from ..section.return_maps import Section

# The largest radius tried, relative to the cycle's size.
LARGEST = 0.5
# The return map is checked on so many shells of an ellipsoid, each of half the size of the one outside it.
SHELLS = 4


class Neighbourhood(NamedTuple):
    """An ellipsoid on the section about a stable periodic cycle, checked to be mapped into itself."""

    centre: Float[np.ndarray, " state"]  # the cycle's state, as a deviation from the sliding equilibrium
    status: int | Int[np.ndarray, " c"]  # the contact mode there; with several contacts, one for each
    direction: float | Float[np.ndarray, " c"]  # the direction of friction there, if it slides
    norm: Float[np.ndarray, "state state"]  # the norm of a state y is the length of norm @ (y - centre)
    radius: float  # in that norm, which is never less than the length of the weighted deviation
    contraction: float  # the largest ratio of norms after and before one period, of the points checked
    points: int  # the number of points checked

    def contains(
        self,
        y: Float[np.ndarray, "*m state"],
        status: Int[np.ndarray, "..."],
        direction: Float[np.ndarray, "..."],
    ) -> Bool[np.ndarray, "*m"]:
        """Which of several states of the section lie in it: their trajectories are captured. Of `side_by_side` neighbourhoods
        each is asked for its own state.
        """
        size = np.linalg.norm(np.einsum("...kj,...j->...k", self.norm, y - self.centre), axis=-1)
        return (size <= self.radius) & _same_mode(y, status, direction, self.status, self.direction)


class ReturnImages(NamedTuple):
    """The images of several states of several cycles under their return maps; NaN where a motion does not come back."""

    y: Float[np.ndarray, "c m state"]
    status: Int[np.ndarray, "c m *contacts"]
    direction: Float[np.ndarray, "c m *contacts"]
    events: Int[np.ndarray, "c m"]  # contact events on the way


# The return maps of these cycles, by their places: each over its period, from its states of the section, in its contact mode.
ReturnMap = Callable[[Int[np.ndarray, " c"], Float[np.ndarray, "c m state"]], ReturnImages]


def adapted_norms(
    derivatives: Float[np.ndarray, "m f f"],
) -> tuple[Float[np.ndarray, "m f f"], Float[np.ndarray, " m"]]:
    """Square roots of $H$ (see the module's docstring), and the rates γ: NaN where the largest multiplier is too close to 1."""
    # With multipliers closer than this to the unit circle, a contraction could not be told from rounding.
    margin = 1e-6
    finite = np.all(np.isfinite(derivatives), axis=(1, 2))
    derivatives = np.where(finite[:, None, None], derivatives, 0.0)
    largest = np.max(np.abs(np.linalg.eigvals(derivatives)), axis=1, initial=0.0)
    rate = np.where(finite & (largest < 1 - margin), 0.5 * (1 + largest), np.nan)
    # The solution is a sum over all powers of the scaled derivative, whose number is doubled again and again.
    matrix, left = np.tile(np.eye(derivatives.shape[1]), (len(rate), 1, 1)), np.flatnonzero(np.isfinite(rate))
    power = derivatives[left] / rate[left, None, None]
    # Enough for the slowest decay within the margin: (1 - margin / 2) to the power 2^32 is nothing.
    for _ in range(32):
        matrix[left] += np.swapaxes(power, 1, 2) @ matrix[left] @ power
        power = power @ power
        lasts = np.max(np.abs(power), axis=(1, 2), initial=0.0) >= np.finfo(float).eps
        left, power = left[lasts], power[lasts]
    for k, one in enumerate(0.5 * (matrix + np.swapaxes(matrix, 1, 2))):
        try:
            # NumPy gives the lower Cholesky factor; its transpose is the root that acts on columns.
            matrix[k] = np.linalg.cholesky(one).T
        except np.linalg.LinAlgError:
            matrix[k], rate[k] = np.eye(len(one)), np.nan
    return matrix, rate


class CycleTrial(NamedTuple):
    """A stable cycle with its adapted norm, about which a neighbourhood is sought; or several, `side_by_side`."""

    centre: Float[np.ndarray, "*c state"]
    status: int | Int[np.ndarray, "..."]
    direction: float | Float[np.ndarray, "..."]
    norm: Float[np.ndarray, "*c state state"]
    steps: Float[np.ndarray, "*c m state"]  # deviations of the points to be checked on a shell, for a radius of one
    sizes: Float[np.ndarray, "*c m"]  # their norms
    allowed: float | Float[np.ndarray, " c"]  # the contraction κ that is required
    largest: float | Float[np.ndarray, " c"]  # the first radius to try
    smallest: float | Float[np.ndarray, " c"]  # the last one


def cycle_trials(
    at: Section,
    jacobian: Float[np.ndarray, "m state state"],
    weights: Float[np.ndarray, "m state"],
    bases: list[Float[np.ndarray, "state _"]],
) -> list[CycleTrial | None]:
    """The check to be made for each of these cycles; None if it is not stable by a margin. (Uncoupled oscillators have a second
    multiplier of 1, for a shift in time between them, so there is no check to make.)

    **Arguments:** `at`, the cycles' states on the section, deviations from the sliding equilibrium, with their contact modes;
    `jacobian`, the derivatives of the return map there; `weights` of the states' coordinates; `bases`, the weighted directions
    that are free on the section (`ReturnMaps.free_directions`).
    """
    found: list[CycleTrial | None] = [None] * len(bases)
    sizes, free = np.linalg.norm(weights * at.y, axis=1), np.array([basis.shape[1] for basis in bases], int)
    for count in np.unique(free).tolist():
        rows = np.flatnonzero(free == count)
        basis, own = np.array([bases[k] for k in rows]), weights[rows]
        outwards = sphere_directions(count, weights.shape[1])
        across = np.swapaxes(basis, 1, 2)
        root, rate = adapted_norms(across @ (own[:, :, None] * jacobian[rows] / own[:, None]) @ basis)
        norm = (basis @ root @ across + np.eye(weights.shape[1]) - basis @ across) * own[:, None]
        # Points of the unit sphere in the norm, as deviations of the state.
        steps = np.swapaxes(np.linalg.solve(root, outwards.T), 1, 2) @ across / own[:, None]
        lengths = np.linalg.norm(outwards, axis=1)
        for k, row in enumerate(rows.tolist()):
            if np.isfinite(rate[k]) and sizes[row] > 0:
                largest, smallest, allowed = LARGEST * sizes[row], 1e-8 * sizes[row], 0.5 * (1 + rate[k])
                found[row] = CycleTrial(*at.rows(row), norm[k], steps[k], lengths, allowed, largest, smallest)
    return found


def neighbourhoods(trials: list[CycleTrial], returned: ReturnMap) -> list[Neighbourhood | None]:
    """Of each cycle the largest of a halving series of ellipsoids that the return map is checked to contract into itself.

    None if no ellipsoid passes, down to the smallest: trajectories near such a cycle stay undecided.
    """
    found: list[Neighbourhood | None] = [None] * len(trials)
    if not trials:
        return found
    every = side_by_side(trials)
    events = returned(np.arange(len(trials)), every.centre[:, None]).events
    # An ellipsoid's shells but the last are the outer ones of the next smaller one, so each is checked once.
    count = np.floor(np.log2(every.largest / every.smallest)).astype(int) + SHELLS
    passed = np.arange(np.max(count)) < count[:, None]  # [cycle, shell], from outside; by all points that were checked
    contraction, stage = np.zeros(passed.shape), np.zeros(passed.shape, int)
    points = np.arange(every.steps.shape[1])
    # More and more points: most shells that fail do so at the first ones.
    of_stage = points[::32], np.setdiff1d(points[::8], points[::32]), np.setdiff1d(points, points[::8])

    def check(rows: Int[np.ndarray, " m"], shell: Int[np.ndarray, " m"], now: int) -> None:
        """Tries those of these shells whose turn it is in the points of this stage."""
        asked = passed[rows, shell] & (stage[rows, shell] == now)
        rows, shell = rows[asked], shell[asked]
        if len(rows):
            ratios = _contraction(every, rows, of_stage[now], every.largest[rows] * 0.5**shell, events[rows], returned)
            contraction[rows, shell] = ratios = np.maximum(contraction[rows, shell], ratios)
            # NaN is not below anything, so it fails.
            passed[rows, shell], stage[rows, shell] = ratios <= every.allowed[rows], now + 1

    # First those of which one passes mostly, at once.
    rows, shell = np.nonzero(passed[:, :12])
    check(rows, shell, 0)
    while True:
        runs = np.all(np.lib.stride_tricks.sliding_window_view(passed, SHELLS, axis=1), axis=2)
        left = np.flatnonzero(np.any(runs, axis=1) & np.array([one is None for one in found]))
        if not len(left):
            return found
        outermost = np.argmax(runs[left], axis=1)
        rows, shell = np.repeat(left, SHELLS), (outermost[:, None] + np.arange(SHELLS)).ravel()
        for now in range(len(of_stage)):
            check(rows, shell, now)
        for k, j in zip(left.tolist(), outermost.tolist(), strict=True):
            if np.all(passed[k, j : j + SHELLS]):
                one, radius = trials[k], float(every.largest[k] * 0.5**j)
                largest, tried = float(np.max(contraction[k, j : j + SHELLS])), SHELLS * len(one.sizes)
                found[k] = Neighbourhood(one.centre, one.status, one.direction, one.norm, radius, largest, tried)


def _contraction(
    trials: CycleTrial,
    chosen: Int[np.ndarray, " c"],
    points: Int[np.ndarray, " p"],
    radius: Float[np.ndarray, " c"],
    events: Int[np.ndarray, "c 1"],
    returned: ReturnMap,
) -> Float[np.ndarray, " c"]:
    """The largest ratio of norms after and before one period, of these points on a shell of each of the chosen cycles; NaN
    unless all come back in the cycle's contact mode after as many events as the cycle has.
    """
    own = CycleTrial(*(np.asarray(part)[chosen] for part in trials))
    centre, sizes = own.centre[:, None], own.sizes[:, points]
    images = returned(chosen, centre + radius[:, None, None] * own.steps[:, points])
    away = (images.y - centre) @ np.swapaxes(own.norm, 1, 2)
    ratios = np.max(np.linalg.norm(away, axis=2) / (radius[:, None] * sizes), axis=1)
    mode = np.expand_dims(own.status, 1), np.expand_dims(own.direction, 1)
    alike = _same_mode(images.y, images.status, images.direction, *mode)
    return np.where(np.all(alike & (images.events == events), axis=1), ratios, np.nan)


def side_by_side(several: list):
    """Several `CycleTrial`s or `Neighbourhood`s as one, whose arrays have a leading axis over them."""
    return type(several[0])(*map(np.array, zip(*several, strict=True)))


def _same_mode(y, status, direction, other, other_direction):
    """Which states are in the other contact mode; with several contacts all of them have to be."""
    same = same_mode(status, direction, other, other_direction)
    return np.all(same, axis=-1) if np.ndim(status) == np.ndim(y) else same


@functools.cache
def sphere_directions(dimension: int, size: int) -> Float[np.ndarray, "d f"]:
    """Directions that fill the unit sphere evenly, in opposite pairs, including the axes: 64, or as many as large states need;
    as many for all cycles with states of this size, however many dimensions their contact modes leave free.
    """
    axes = np.eye(dimension)
    count = max(32, size) - dimension
    inside = np.stack([_radical_inverse(np.arange(1, count + 1), base) for base in _primes(dimension)], axis=1)
    # By Python's own normal distribution: SciPy's takes longer to import than to compute.
    spread = np.vectorize(NormalDist().inv_cdf, otypes=[float])(inside)
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
