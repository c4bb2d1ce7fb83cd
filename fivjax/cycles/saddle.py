"""The unstable cycle on the boundary between sliding and squeal: edge tracking, then Newton's method.

On the line between a state that returns to sliding and one on a limit cycle there is a state on the boundary of the two basins.
A trajectory that starts very close to it stays close to the boundary for long before it leaves to either side. It approaches
the attractor within the boundary: a saddle cycle, with one multiplier outside the unit circle. Two neighbouring trajectories on
either side of the boundary pass near that cycle while they are close together, which gives Newton's method its first guess.
"""

import numpy as np

from ..attractors.closing import close_near
from ..foundation import arguments
from ..foundation.precision import in_double_precision
from ..foundation.progress import reported, stage
from ..linear.linearisation import sliding_rates
from ..model.scene import Scene
from ..section.return_maps import ReturnMaps, Section
from .cycle import LimitCycle, limit_cycle_of, section_multipliers, stability_margin, under_final_load
from .own_coordinates import in_own_coordinates
from .search import MOST_CROSSINGS, NoLimitCycle, check_scene, limit_cycle, state_of

# Points of the section that are looked at together.
POINTS = 96
# A trajectory that is undecided after so many times `POINTS` points of the section counts as one that stays away from sliding.
MOST_LOOKS = 60
# States between two neighbours that are followed to find which are the next.
FEW = 2
# Neighbours have separated once they differ by this share of their size; then the search begins anew between them.
APART = 1e-4
ROUNDS = 24
# A trajectory has reached the cycle when it is this close to it, relative to the cycle's size.
CAPTURED = 1e-2
# And it slides below this size, relative to the cycle's.
SLID_BELOW = 1e-2
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
    # How close to each other the neighbours on either side of the boundary begin, relative to the cycle's size; and how well
    # the path of both must repeat for Newton's method to begin there. Closer ones take longer to find, and follow the boundary
    # longer.
    narrow = ((1e-8, 1e-2), (1e-14, 1e-1))
    check_scene(scene)
    arguments.instance("cycle", cycle, LimitCycle | None, "a limit cycle, such as `fivjax.limit_cycle(scene)`, or None")
    if cycle is not None:
        state_of(scene, cycle.deviation, "cycle")
    _refuse_unstable_sliding(under_final_load(scene))
    cycle = limit_cycle(scene) if cycle is None else cycle
    edge = _Edge(scene, cycle)
    low, high = np.zeros_like(cycle.deviation), cycle.deviation
    for number in range(ROUNDS):
        stage(f"tracking the edge, round {number + 1}")
        paths = None
        for share, repeated in narrow:
            low, high = edge.narrowed(low, high, share)
            paths = edge.together(low, high)
            found = edge.saddle_near(paths, repeated)
            if found is not None:
                return found
        assert paths is not None
        low, high = paths[0][-1], paths[1][-1]
    raise NoLimitCycle(
        "No saddle cycle was met: what attracts on the boundary does not repeat within "
        f"{MOST_CROSSINGS} crossings of the section. It may be a torus."
    )


def _refuse_unstable_sliding(scene: Scene) -> None:
    rates = sliding_rates(scene)
    if np.max(rates.real) > UNSTABLE * np.max(np.abs(rates)):
        raise NoLimitCycle(
            f"Steady sliding is unstable: small deviations grow at {np.max(rates.real):.3g} 1/s, so that no boundary lies "
            "between it and a limit cycle. Choose parameters with stable sliding; `continue_cycle` follows other unstable "
            "cycles."
        )


class _Edge:
    """Which side of the boundary states lie on."""

    def __init__(self, scene: Scene, cycle: LimitCycle):
        self.scene, self.maps = scene, ReturnMaps.of(scene)
        self.weights = self.maps.weights
        self.target = self.weights * cycle.points
        self.size = np.max(np.linalg.norm(self.target, axis=-1))

    def in_contact(self, states: np.ndarray) -> Section:
        """States (leading axis) with the contact modes that their forces demand."""
        return self.maps.in_contact(np.zeros(len(states), int), states)

    def of(self, states: np.ndarray) -> np.ndarray:
        """0 for states that return to sliding, 1 for those that come to the cycle or stay away from sliding."""
        now = self.in_contact(states)
        fate, open_ = np.full(len(states), -1), np.arange(len(states))
        for _ in range(MOST_LOOKS):
            fate[open_], now = self._seen(now)
            left = fate[open_] < 0
            open_, now = open_[left], now.rows(left)
            if not len(open_):
                break
        return np.where(fate < 0, 1, fate)

    def _seen(self, at: Section) -> tuple[np.ndarray, Section]:
        """The same after some returns, -1 where it is not known yet; and where motions are then."""
        last = self.maps.returns(np.zeros(len(at.y), int), at, POINTS, POINTS // 2)
        before, now = (np.linalg.norm(self.weights * y, axis=-1) for y in (last.path[:, 0], last.at.y))
        ends = self.weights * last.path[:, -4:]
        apart = np.min(np.linalg.norm(ends[:, :, None] - self.target, axis=-1), axis=(1, 2))
        with np.errstate(invalid="ignore"):
            slid = ((last.events == 0) & (now < 0.7 * before)) | (now < SLID_BELOW * self.size)
            fate = np.where(slid, 0, np.where(apart < CAPTURED * self.size, 1, -1))
        # The section is no longer crossed: the contact sticks for good, or a failure. Neither is sliding.
        return np.where((fate < 0) & ~np.isfinite(now), 1, fate), last.at

    def narrowed(self, low: np.ndarray, high: np.ndarray, share: float) -> tuple[np.ndarray, np.ndarray]:
        """Two states on either side of the boundary, on the line between `low` and `high`, that differ by this share of the
        cycle's size, or by rounding.
        """
        a, b = 0.0, 1.0
        while True:
            if np.linalg.norm(self.weights * (high - low)) * (b - a) < share * self.size or b - a < 4e-16 * b:
                return low + a * (high - low), low + b * (high - low)
            shares = a + (b - a) * np.arange(1, FEW + 1) / (FEW + 1)
            fates = self.of(low + shares[:, None] * (high - low))
            first = int(np.argmax(fates)) if np.any(fates == 1) else FEW
            a, b = (a if first == 0 else shares[first - 1]), (b if first == FEW else shares[first])

    def together(self, low: np.ndarray, high: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The points of the section that two neighbours pass until they separate."""
        now, paths = self.in_contact(np.stack([low, high])), np.zeros((2, 0, len(low)))
        for _ in range(MOST_LOOKS):
            now, y = self.maps.path(np.zeros(2, int), now, POINTS)
            paths = np.concatenate([paths, y], axis=1)
            apart = np.linalg.norm(self.weights * (paths[0] - paths[1]), axis=-1)
            size = np.linalg.norm(self.weights * paths[0], axis=-1)
            gone = ~(apart < APART * size)
            if gone.any():
                last = max(int(np.argmax(gone)), 1)
                return paths[0, :last], paths[1, :last]
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
        best = min((back for back, _, _ in tried), default=0.0)
        for back, crossings, place in tried:
            if back > max(2 * best, 1e-9) or back > repeated:
                continue
            closed = close_near(self.maps, self.in_contact(paths[0][place][None]).point(0), crossings)
            if closed is None:
                continue
            margin = stability_margin(np.size(closed.point.contact.status))
            outside = int(np.sum(np.abs(section_multipliers(closed.jacobian)) > 1 + margin))
            away = np.linalg.norm(self.weights * np.asarray(closed.point.y) - path[place]) / sizes[place]
            if outside == 1 and away < 0.5:
                return limit_cycle_of(self.maps, self.scene, closed)
        return None
