r"""A branch of cycles with one sequence of contact modes, followed by its arclength.

The unknowns of `multiple_shooting` and the parameter together are one more than the equations, so the cycles form a curve.
Newton's method finds a point of it in the plane through a prediction that is normal to the tangent. This works at folds, too,
where the parameter turns back.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Complex, Float

from ..contact import Status
from ..model.directions import moved_along
from ..model.scene import Scene
from ..section.about_sliding import weights_of
from .multiple_shooting import AT_SECTION, Mode, PhaseImages, Phases, images


class Family(NamedTuple):
    """Scenes that differ in one parameter."""

    scene: Scene
    direction: Scene  # the derivative of the scene in the parameter
    name: str
    value: float  # of the parameter in `scene`
    bounds: tuple[float, float]  # of the parameter, which scenes can have

    @property
    def scale(self) -> float:
        """A large change of the parameter."""
        return self.bounds[1] - self.bounds[0]

    def at(self, parameter: float) -> Scene:
        """The scene with this value of the parameter."""
        return moved_along(self.scene, self.direction, parameter - self.value)

    def is_within(self, parameter: float) -> bool:
        """Whether this value lies within the bounds."""
        return self.bounds[0] <= parameter <= self.bounds[1]

    def is_possible(self, parameter: float) -> bool:
        """Whether there is a scene with this value: a step may come to one beyond the bounds that no scene has."""
        if self.is_within(parameter):
            return True
        try:
            self.scene.replace(**{self.name: parameter})
        except ValueError:
            return False
        return True


class ComputedCycle(NamedTuple):
    """A cycle on the branch."""

    u: Float[np.ndarray, " m"]  # the unknowns, scaled; the parameter comes last
    jacobian: Float[np.ndarray, "m-1 m"]
    images: PhaseImages
    phases: Phases
    parameter: float
    iterations: int


class Curve:
    """The curve of cycles with one sequence of modes."""

    def __init__(self, family: Family, phases: Phases):
        """`phases`: a cycle of these modes, or a guess of one; its size and period are the units of the unknowns."""
        self.family, self.modes = family, phases.modes
        self.weights = weights_of(family.scene.structure)
        self.size = phases.size(self.weights)
        self.time = phases.period
        self.of_state = np.tile(self.size / self.weights, len(self.modes))
        self.scales = np.concatenate([self.of_state, np.full(len(self.modes), self.time), [family.scale]])

    def unknowns(self, phases: Phases, parameter: float) -> Float[np.ndarray, " m"]:
        """Phases and parameter as one vector, in the units of the curve."""
        return np.concatenate([phases.y.ravel(), phases.h, [parameter]]) / self.scales

    def phases(self, u: Float[np.ndarray, " m"]) -> tuple[Phases, float]:
        """Phases and parameter from such a vector."""
        count, values = len(self.modes), u * self.scales
        many = count * len(self.weights)
        return Phases(self.modes, values[:many].reshape(count, -1), values[many:-1]), float(values[-1])

    def system(self, u: Float[np.ndarray, " m"]) -> tuple[np.ndarray, np.ndarray, PhaseImages, Phases, float]:
        """Residuals and their derivatives, each equation scaled by the size of its derivatives."""
        phases, parameter = self.phases(u)
        family = self.family
        found = images(family.at(parameter), family.direction, phases)
        residuals, rows = assembled(found, phases)
        rows, sizes = scaled(rows * self.scales)
        return residuals / sizes, rows, found, phases, parameter

    def corrected(
        self, u: Float[np.ndarray, " m"], normal: Float[np.ndarray, " m"] | None = None
    ) -> ComputedCycle | None:
        """The cycle near a guess: in the plane through the guess with this normal, or without a normal the nearest one."""
        most_iterations = 10
        # Newton's method has converged if its next correction would be this small, relative to the cycle's size.
        exact = 3e-12
        # If corrections no longer shrink, this is small enough: they are rounding errors.
        close = 1e-9
        target, last = u.copy(), np.inf
        for iteration in range(most_iterations):
            residuals, rows, found, phases, parameter = self.system(u)
            if not (np.all(np.isfinite(residuals)) and np.all(np.isfinite(rows))):
                return None
            try:
                if normal is None:
                    step = -_least_solution(rows, residuals)
                else:
                    step = -_solution(np.vstack([rows, normal]), np.append(residuals, normal @ (u - target)))
            except np.linalg.LinAlgError:
                return None
            size = float(np.max(np.abs(step)))
            if size < exact or (last < close and size > 0.5 * last):
                return ComputedCycle(u, rows, found, phases, parameter, iteration)
            if size > 1.0 or (iteration > 4 and size > last):
                return None
            u, last = u + step, size
        return None

    def tangent(self, cycle: ComputedCycle, like: Float[np.ndarray, " m"] | None) -> Float[np.ndarray, " m"]:
        """The unit tangent of the curve, on the side of `like`."""
        found = _null_vector(cycle.jacobian, like)
        return found if like is None or found @ like >= 0 else -found

    def along(self, cycle: ComputedCycle, tangent: Float[np.ndarray, " m"], by: float) -> ComputedCycle | None:
        """The cycle at a distance of about `by` along the tangent."""
        return self.corrected(cycle.u + by * tangent, tangent)

    def at_parameter(self, guess: Float[np.ndarray, " m"], parameter: float) -> ComputedCycle | None:
        """The cycle near a guess at this value of the parameter."""
        u, normal = guess.copy(), np.zeros_like(guess)
        u[-1], normal[-1] = parameter / self.scales[-1], 1.0
        found = self.corrected(u, normal)
        # Exactly this value, which its share of the scale may round: it may be a bound.
        return None if found is None else found._replace(parameter=parameter)


# A system of so many equations or more, of a cycle of twenty phases, is taken for sparse: each phase has to do with itself, the
# next one and the parameter alone.
SPARSE = 120


def _solution(matrix: Float[np.ndarray, "m m"], right: Float[np.ndarray, " m"]) -> Float[np.ndarray, " m"]:
    """**Raises:** `LinAlgError` for a singular matrix."""
    if len(matrix) < SPARSE:
        return np.linalg.solve(matrix, right)
    from scipy.sparse import csc_array
    from scipy.sparse.linalg import splu

    try:
        return splu(csc_array(matrix)).solve(right)
    except RuntimeError as error:
        raise np.linalg.LinAlgError(str(error)) from None


def _null_vector(rows: Float[np.ndarray, "m-1 m"], like: Float[np.ndarray, " m"] | None) -> Float[np.ndarray, " m"]:
    """The unit vector, of either sign, that one equation less than unknowns leave; `like` another one near by, if known."""
    if len(rows) >= SPARSE:
        # Bordered by another vector, the equations have one solution; by any at first, then by what that gave.
        found = np.random.default_rng(0).standard_normal(rows.shape[1]) if like is None else like
        last = np.eye(1, rows.shape[1], rows.shape[1] - 1)[0]
        try:
            for _ in range(2):
                found = _solution(np.vstack([rows, found]), last)
                found = found / np.linalg.norm(found)
        except np.linalg.LinAlgError:
            found = np.full(rows.shape[1], np.nan)
        if np.all(np.isfinite(found)):
            return found
    return np.linalg.svd(rows)[2][-1]


def _least_solution(rows: Float[np.ndarray, "m-1 m"], right: Float[np.ndarray, " m-1"]) -> Float[np.ndarray, " m"]:
    """The shortest solution of one equation less than unknowns: that at right angles to what they leave."""
    if len(rows) < SPARSE:
        return np.linalg.lstsq(rows, right, rcond=None)[0]
    return _solution(np.vstack([rows, _null_vector(rows, None)]), np.append(right, 0.0))


def roots_at_start(modes: tuple[Mode, ...], k: int, rebounds: bool = True) -> int:
    """The multiplicity of the root that the guard which ends a phase has at the phase's own start.

    A slip speed after a reversal of slip has a simple root there, after sticking a double one; a gap after an impact, its own
    or one that has lifted it, a simple one, after lift-off a triple one. A duration of zero would always solve their equations,
    so these roots are divided out. After an impact of its own the root is double unless the contact `rebounds`.
    """
    before, own = modes[k - 1], modes[k]
    if own.lands and before.lands and before.status[own.ending // 2] != Status.DETACH:
        return 1
    if AT_SECTION in (before.ending, own.ending) or before.ending // 2 != own.ending // 2:
        # The mode of that contact has begun earlier.
        return 0
    (was, ended), (status, guard) = before.of_guard(before.ending), own.of_guard(own.ending)
    if status == Status.SLIDE and guard == 1:
        if was == Status.SLIDE and ended == 1:
            return 1
        return 2 if was == Status.STICK and len(modes) > 1 else 0
    if status == Status.DETACH:
        return 3 if was != Status.DETACH else 1 if rebounds else 2
    return 0


def scaled(rows: Float[np.ndarray, "k m"]) -> tuple[Float[np.ndarray, "k m"], Float[np.ndarray, " k"]]:
    """Rows of derivatives divided by their largest entries, and these; a row of zeros as it is."""
    sizes = np.max(np.abs(rows), axis=1)
    sizes = np.where(sizes > 0, sizes, 1.0)
    return rows / sizes[:, None], sizes


def assembled(found: PhaseImages, phases: Phases) -> tuple[np.ndarray, np.ndarray]:
    """Residuals of all equations of a cycle, and their derivatives by states, durations and the parameter."""
    count, size = phases.y.shape
    many = count * size
    found = _without_roots_at_start(found, phases)
    residuals = np.concatenate([(found.y - np.roll(phases.y, -1, axis=0)).ravel(), found.guard])
    rows = np.zeros((many + count, many + count + 1))
    for k in range(count):
        own, following = slice(k * size, (k + 1) * size), (k + 1) % count
        rows[own, own] += found.y_y[k]
        rows[own, following * size : (following + 1) * size] -= np.eye(size)
        rows[own, many + k] = found.y_h[k]
        rows[own, -1] = found.y_parameter[k]
        rows[many + k, own] = found.guard_y[k]
        rows[many + k, many + k] = found.guard_h[k]
        rows[many + k, -1] = found.guard_parameter[k]
    return residuals, rows


def _without_roots_at_start(found: PhaseImages, phases: Phases) -> PhaseImages:
    power = np.array([roots_at_start(phases.modes, k, found.rebounds[k - 1]) for k in range(len(phases.modes))])
    h = phases.h / phases.period
    # Below these a guard is a rounding error; that of a rebound, which begins on the belt, has smaller ones.
    least = np.where([mode.lands for mode in phases.modes] & (power == 1), 1e-13, 1e-9)
    h = np.where(np.abs(h) < least, least, h)
    share = h**-power
    return found._replace(
        guard=found.guard * share,
        guard_y=found.guard_y * share[:, None],
        guard_h=found.guard_h * share - power * found.guard * share / (h * phases.period),
        guard_parameter=found.guard_parameter * share,
    )


def monodromy(found: PhaseImages) -> Float[np.ndarray, "state state"]:
    """The derivative of the motion over one period, from the start of the first phase, with saltation at each event."""
    matrix = np.eye(found.y.shape[1])
    for k in range(len(found.guard)):
        with np.errstate(all="ignore"):
            saltation = found.y_y[k] - np.outer(found.y_h[k], found.guard_y[k]) / found.guard_h[k]
        matrix = saltation @ matrix
    return matrix


def multipliers_of(found: PhaseImages) -> Complex[np.ndarray, " m"]:
    """Floquet multipliers without the one for a deviation along the cycle, largest first; NaN at a grazing."""
    matrix = monodromy(found)
    if not np.all(np.isfinite(matrix)):
        return np.full(len(matrix) - 1, complex(np.nan, np.nan))
    values = np.linalg.eigvals(matrix).astype(complex)
    return values[np.lexsort((-values.imag, -np.abs(values)))][:-1]
