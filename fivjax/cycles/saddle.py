"""The unstable cycle on the boundary between sliding and squeal: edge tracking, then Newton's method.

On the line between a state that returns to sliding and one on a limit cycle there is a state on the boundary of the two basins.
A trajectory that starts very close to it stays close to the boundary for long before it leaves to either side. It approaches
the attractor within the boundary: a saddle cycle, with one multiplier outside the unit circle. Two neighbouring trajectories on
either side of the boundary pass near that cycle while they are close together, which gives Newton's method its first guess.
"""

import jax
import numpy as np

from ..foundation import arguments
from ..foundation.precision import in_double_precision
from ..foundation.progress import reported, stage
from ..linear.spectrum import eigenvalues
from ..model.scene import Scene, refuse_painleve, sliding_equilibrium
from ..steppers.event_exact import EventExact
from ..steppers.kernel_scope import has_kernel
from .closing import close
from .cycle import LimitCycle, limit_cycle_of, section_multipliers, under_final_load
from .own_coordinates import in_own_coordinates
from .search import MOST_CROSSINGS, NoLimitCycle, contacts_demanded, known_mechanics, limit_cycle
from .section_map import Return, points_along
from .section_motion import Point
from .torus import POINTS, SIDE_BY_SIDE

# A trajectory that is undecided after so many times `POINTS` points of the section counts as one that stays away from sliding.
MOST_LOOKS = 60
# How close to each other the neighbours on either side of the boundary begin, relative to the cycle's size; and how well the
# path of both must repeat for Newton's method to begin there. Closer ones take longer to find, and follow the boundary longer.
NARROW = ((1e-8, 1e-2), (1e-14, 1e-1))
# States between two neighbours that are followed to find which are the next: side by side by XLA, else few of them.
FEW = 2
# Neighbours have separated once they differ by this share of their size; then the search begins anew between them.
APART = 1e-4
ROUNDS = 24
# A trajectory has reached the cycle when it is this close to it, relative to the cycle's size.
CAPTURED = 1e-2
FADED = 1e-2
# Sliding counts as unstable above this growth rate, relative to the largest eigenvalue; below, the sign may be one of rounding.
UNSTABLE = 1e-6


@reported("saddle cycle")
@in_own_coordinates
@in_double_precision
def saddle_cycle(scene: Scene, cycle: LimitCycle | None = None, *, progress: bool | None = None) -> LimitCycle:
    """The unstable cycle on the boundary between steady sliding and a limit cycle, under the final load.

    **Arguments:** `scene`, whose steady sliding is stable; `cycle`, the limit cycle on the other side, `limit_cycle(scene)`
    unless given; `progress` as in `limit_cycle`.

    **Returns:** a `LimitCycle` with exactly one multiplier outside the unit circle.

    **Raises:** `NoLimitCycle` (a `ValueError`) if there is no limit cycle, if steady sliding is unstable, or if the attractor
    within the boundary is not periodic; `ValueError` for a scene without sliding equilibrium or beyond Painlevé's limit.

    **Example:**

        >>> saddle = fj.saddle_cycle(scene.replace(belt_speed=1.0))  # doctest: +SLOW
        >>> saddle.unstable_directions
        1
    """
    arguments.instance("scene", scene, Scene, "a Scene")
    arguments.known("scene", scene)
    refuse_painleve(scene)
    sliding_equilibrium(under_final_load(scene))
    _refuse_unstable_sliding(under_final_load(scene))
    cycle = limit_cycle(scene) if cycle is None else cycle
    stepper = EventExact()
    fates = _Fates(scene, stepper, cycle)
    low, high = np.zeros_like(cycle.deviation), cycle.deviation
    for number in range(ROUNDS):
        stage(f"tracking the edge, round {number + 1}")
        paths = None
        for share, repeated in NARROW:
            low, high = fates.narrowed(low, high, share)
            paths = fates.together(low, high)
            found = fates.saddle_near(paths, repeated)
            if found is not None:
                return found
        assert paths is not None
        low, high = paths[0][-1], paths[1][-1]
    raise NoLimitCycle(
        "No saddle cycle was met: what attracts on the boundary does not repeat within "
        f"{MOST_CROSSINGS} crossings of the section. It may be a torus."
    )


def _refuse_unstable_sliding(scene: Scene) -> None:
    rates = np.asarray(eigenvalues(scene))
    if np.max(rates.real) > UNSTABLE * np.max(np.abs(rates)):
        raise NoLimitCycle(
            f"Steady sliding is unstable: small deviations grow at {np.max(rates.real):.3g} 1/s, so that no boundary lies "
            "between it and a limit cycle. Choose parameters with stable sliding; `continue_cycle` follows other unstable "
            "cycles."
        )


class _Fates:
    """Which side of the boundary states lie on."""

    def __init__(self, scene: Scene, stepper: EventExact, cycle: LimitCycle):
        self.scene, self.stepper, self.cycle = scene, stepper, cycle
        self.weights = np.asarray(scene.structure.weights)
        self.target = self.weights * cycle.points
        self.size = np.max(np.linalg.norm(self.target, axis=-1))
        self.by_kernel = has_kernel(scene, stepper)
        self.mechanics = known_mechanics(scene)

    def in_contact(self, states: np.ndarray) -> Point:
        """States (leading axis) with the contact modes that their forces demand."""
        return Point(states, contacts_demanded(self.mechanics, states))

    def of(self, states: np.ndarray) -> np.ndarray:
        """0 for states that return to sliding, 1 for those that come to the cycle or stay away from sliding."""
        now = self.in_contact(states)
        fate, open_ = np.full(len(states), -1), np.arange(len(states))
        for _ in range(MOST_LOOKS):
            returns = points_along(self.scene, self.stepper, now, POINTS)
            fate[open_] = np.where(fate[open_] >= 0, fate[open_], self._seen(returns))
            if np.all(fate >= 0):
                break
            # XLA compiles a program for each number of them.
            left = fate[open_] < 0 if self.by_kernel else np.full(len(open_), True)
            open_, now = open_[left], jax.tree.map(lambda leaf, left=left: leaf[left, -1], returns.point)
        return np.where(fate < 0, 1, fate)

    def _seen(self, returns: Return) -> np.ndarray:
        """The same after some returns; -1 where it is not known yet."""
        y = self.weights * np.asarray(returns.point.y)
        sizes = np.linalg.norm(y, axis=-1)
        apart = np.min(np.linalg.norm(y[:, -4:, None] - self.target, axis=-1), axis=(1, 2))
        quiet = ~np.asarray(returns.events)[:, POINTS // 2 :].any(axis=1)
        shrinking = sizes[:, -1] < 0.7 * sizes[:, POINTS // 2]
        slid = (quiet & shrinking) | (sizes[:, -1] < FADED * self.size)
        fate = np.where(slid, 0, np.where(apart < CAPTURED * self.size, 1, -1))
        # The section is no longer crossed: the contact sticks for good, or a failure. Neither is sliding.
        return np.where((fate < 0) & ~np.isfinite(sizes[:, -1]), 1, fate)

    def narrowed(self, low: np.ndarray, high: np.ndarray, share: float) -> tuple[np.ndarray, np.ndarray]:
        """Two states on either side of the boundary, on the line between `low` and `high`, that differ by this share of the
        cycle's size, or by rounding.
        """
        a, b, count = 0.0, 1.0, FEW if self.by_kernel else SIDE_BY_SIDE
        while True:
            if np.linalg.norm(self.weights * (high - low)) * (b - a) < share * self.size or b - a < 4e-16 * b:
                return low + a * (high - low), low + b * (high - low)
            shares = a + (b - a) * np.arange(1, count + 1) / (count + 1)
            fates = self.of(low + shares[:, None] * (high - low))
            first = int(np.argmax(fates)) if np.any(fates == 1) else count
            a, b = (a if first == 0 else shares[first - 1]), (b if first == count else shares[first])

    def together(self, low: np.ndarray, high: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The points of the section that two neighbours pass until they separate."""
        pair = np.stack([low, high])[np.arange(2 if self.by_kernel else SIDE_BY_SIDE) % 2]
        now = self.in_contact(pair)
        paths = np.zeros((2, 0, pair.shape[1]))
        for _ in range(MOST_LOOKS):
            returns = points_along(self.scene, self.stepper, now, POINTS)
            y = np.asarray(returns.point.y)[:2]
            paths = np.concatenate([paths, y], axis=1)
            apart = np.linalg.norm(self.weights * (paths[0] - paths[1]), axis=-1)
            size = np.linalg.norm(self.weights * paths[0], axis=-1)
            gone = ~(apart < APART * size)
            if gone.any():
                last = max(int(np.argmax(gone)), 1)
                return paths[0, :last], paths[1, :last]
            now = jax.tree.map(lambda leaf: leaf[:, -1], returns.point)
        return paths[0], paths[1]

    def saddle_near(self, paths: tuple[np.ndarray, np.ndarray], repeated: float) -> LimitCycle | None:
        """The saddle cycle near the point where the path of the neighbours repeats best, to this share of its size at least."""
        path = self.weights * paths[0]
        sizes = np.linalg.norm(path, axis=-1)
        tried = []
        for crossings in range(1, MOST_CROSSINGS + 1):
            if len(path) > crossings:
                back = np.linalg.norm(path[crossings:] - path[:-crossings], axis=-1) / sizes[:-crossings]
                place = int(np.argmin(back))
                tried.append((back[place], crossings, place))
        if not tried:
            return None
        best = min(back for back, _, _ in tried)
        for back, crossings, place in tried:
            if back > max(2 * best, 1e-9) or back > repeated:
                continue
            guess = self.in_contact(paths[0][place][None])
            guess = jax.tree.map(lambda leaf: leaf[0], guess)
            closed = close(self.scene, self.stepper, guess, crossings)
            if closed is None:
                continue
            outside = int(np.sum(np.abs(section_multipliers(closed.jacobian)) > 1))
            away = np.linalg.norm(self.weights * np.asarray(closed.point.y) - path[place]) / sizes[place]
            if outside == 1 and away < 0.5:
                return limit_cycle_of(self.scene, self.stepper, closed)
        return None
