r"""A plane of the Poincaré section through the saddle on the boundary: verdicts, the stable manifold, and nearly critical
kicks.

The plane is spanned by the saddle's unstable direction and its slowest stable one, right eigenvectors $r$ of the return map's
derivative. With the left eigenvectors $l$, a state $x$ of the section has the coordinates $l · (x - x_s)$, relative to the size
of the saddle. The stable manifold meets the plane where verdicts change along the unstable direction; at the saddle this curve
is tangent to the stable direction.
"""

from typing import TYPE_CHECKING

import numpy as np

from ..cycles.own_coordinates import in_own_coordinates
from ..foundation import arguments
from ..foundation.precision import in_double_precision
from ..foundation.progress import reported
from ..io.datasets import labelled, named
from ..maps.basin_map import verdicts_from
from ..model.directions import directions_of
from ..model.load import Pulse
from ..model.scene import Scene
from ..section.about_sliding import sliding_state, weights_of
from ..verdicts.verdict import Verdict
from .critical import critical_perturbation
from .response import MOST_CROSSINGS, Crossings, kicked
from .stable_manifold import Saddle, critical_kick, saddle_of

if TYPE_CHECKING:
    import xarray as xr


@reported("boundary section")
@in_own_coordinates
@in_double_precision
def boundary_section(
    scene: Scene,
    *,
    reach: float = 0.15,
    points: int = 41,
    p_range: tuple[float, float] = (1.0, 5.0),
    progress: bool | None = None,
) -> "xr.Dataset":
    """The boundary between sliding and squeal in a plane of the Poincaré section through the saddle cycle.

        fj.plot.boundary_section(fj.boundary_section(scene))

    **Arguments:** `scene`, whose load is a `Pulse`; `reach`, half the width of the plane, relative to the size of the saddle;
    `points`, the number of states on each axis; `p_range`, the range in which the critical kick is sought.

    **Returns:** a dataset with

    - `verdict` over `stable` and `unstable`, the coordinates in the plane, relative to the size of the saddle, which is at
      zero;
    - `manifold` over `stable`: the coordinate `unstable` at which verdicts change, NaN where they do not;
    - `path` over `side` ("slides", "squeals"), `crossing` and `direction` ("unstable", "stable"): crossings of the section by
      the motions after kicks just below and just above the critical one, projected onto the plane; NaN far from it;
    - the attributes `p_crit` and `multiplier`, the saddle's unstable one.

    **Raises:** `ValueError` if no critical kick lands on the stable manifold of a saddle cycle.

    **Example:**

        >>> plane = fj.boundary_section(scene.replace(belt_speed=1.0), points=9, p_range=(1.0, 1.3))  # doctest: +SLOW
        >>> bool(abs(plane["manifold"].sel(stable=0.0)) < 0.05)  # doctest: +SLOW
        True
    """
    # Relative distance of the two kicks shown from the critical one.
    beside = 1e-7
    import xarray as xr

    arguments.instance("scene", scene, Scene, "a Scene")
    arguments.known("scene", scene)
    arguments.instance("scene.load", scene.load, Pulse, "a Pulse, whose critical p leads to the boundary")
    arguments.real_number("reach", reach, above=0)
    points = arguments.whole_number("points", points, minimum=3)
    found = critical_perturbation(scene, p_range=p_range, progress=False)
    found = found.squeeze(found["p_crit"].dims)
    bracket = float(found["p_crit_low"]), float(found["p_crit_high"])
    critical = critical_kick(scene, bracket, ()) if np.all(np.isfinite(bracket)) else None
    weights = weights_of(scene.structure)
    saddle = None if critical is None else saddle_of(critical.saddle, weights)
    if critical is None or saddle is None:
        raise ValueError(
            "No critical kick in the range lands on the stable manifold of a saddle cycle. Change `p_range`, or the scene."
        )
    right, left = _directions(saddle, weights)
    origin = weights * np.asarray(saddle.closed.point.y)
    axis, size = np.linspace(-reach, reach, points), np.linalg.norm(origin)
    rest, attractors = np.asarray(sliding_state(scene, scene.load.final)), {}

    def verdicts(stable: np.ndarray, unstable: np.ndarray) -> np.ndarray:
        places = unstable.reshape(-1, 1) * right[0] + stable.reshape(-1, 1) * right[1]
        states = (origin + size * places) / weights + rest
        return verdicts_from(scene, states, "section", attractors).reshape(stable.shape)

    stable, unstable = np.meshgrid(axis, axis, indexing="ij")
    verdict = verdicts(stable, unstable)
    along_p = directions_of(scene, ("p",))
    sides = [kicked(scene.replace(p=critical.p * (1 + by)), along_p, MOST_CROSSINGS) for by in (-beside, beside)]
    paths = [_path(side, weights, origin, left / size, right * size) for side in sides]
    longest = max(map(len, paths))
    padded = [np.pad(path, ((0, longest - len(path)), (0, 0)), constant_values=np.nan) for path in paths]
    dataset = xr.Dataset(
        {
            "verdict": (("stable", "unstable"), verdict.astype(np.int8)),
            "manifold": ("stable", _manifold(axis, verdict, verdicts)),
            "path": (("side", "crossing", "direction"), np.stack(padded)),
        },
        coords={"stable": axis, "unstable": axis, "side": ["slides", "squeals"], "direction": ["unstable", "stable"]},
    )
    dataset = named(
        labelled(dataset, scene),
        stable=("distance from the saddle along its slowest stable direction, relative to its size", "1"),
        unstable=("distance from the saddle along its unstable direction, relative to its size", "1"),
        side=("what becomes of the kick", "1"),
        direction=("direction of a coordinate of the path", "1"),
    )
    return dataset.assign_attrs(p_crit=critical.p, multiplier=saddle.multiplier)


def _directions(saddle: Saddle, weights: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The unstable and the slowest stable direction (rows), of length one, and the rows that give a state's coordinates."""
    scaled = weights[:, None] * saddle.closed.jacobian / weights
    values, right = np.linalg.eig(scaled)
    order = np.argsort(-np.abs(values))[:2]
    chosen = right[:, order]
    # Of a complex pair the real part is enough, because the plane only serves for a picture.
    basis = np.real(chosen / np.linalg.norm(chosen, axis=0))
    basis = basis / np.linalg.norm(basis, axis=0)
    unstable = saddle.left / (saddle.left @ basis[:, 0])
    beside = basis[:, 1] - (unstable @ basis[:, 1]) * basis[:, 0]
    beside = beside / np.linalg.norm(beside)
    # The second row is orthogonal to the first direction.
    second = beside - (beside @ basis[:, 0]) * unstable
    return np.stack([basis[:, 0], beside]), np.stack([unstable, second / (second @ beside)])


def _path(path: Crossings, weights: np.ndarray, origin: np.ndarray, left: np.ndarray, right: np.ndarray) -> np.ndarray:
    """The crossings in the plane's coordinates, in order; NaN while they are far from the plane."""
    # A crossing is shown if the part of its distance from the saddle normal to the plane is less than this share.
    flat = 0.5
    away = weights * path.y[: path.count] - origin
    inside = away @ left.T
    beside = np.linalg.norm(away - inside @ right, axis=-1)
    return np.where((beside < flat * np.linalg.norm(away, axis=-1))[:, None], inside, np.nan)


def _manifold(axis: np.ndarray, verdict: np.ndarray, verdicts) -> np.ndarray:
    """The coordinate at which each row of verdicts changes between sliding and a limit cycle, narrowed down; if there are
    several changes, the one closest to zero.
    """
    # Rounds of narrowing down the manifold, and states inside a bracket in each.
    rounds, inside = 2, 15
    low, high = np.full((2, len(axis)), np.nan)
    for row, values in enumerate(verdict):
        if len(brackets := _changes(axis, values)):
            low[row], high[row] = _closest_to_zero(brackets)
    known = np.flatnonzero(np.isfinite(low))
    for _ in range(rounds if len(known) else 0):
        inner = np.linspace(low[known], high[known], inside + 2, axis=1)
        found = verdicts(np.broadcast_to(axis[known, None], inner.shape), inner)
        for row, places, values in zip(known, inner, found, strict=True):
            if len(brackets := _changes(places, values)):
                low[row], high[row] = _closest_to_zero(brackets)
    return 0.5 * (low + high)


def _closest_to_zero(brackets: np.ndarray) -> np.ndarray:
    return brackets[np.argmin(np.abs(np.sum(brackets, axis=1)))]


def _changes(places: np.ndarray, verdict: np.ndarray) -> np.ndarray:
    """The pairs of places (rows) between which the verdict changes from sliding to a limit cycle, or back. One place between
    them may be undecided: the saddle itself is.
    """
    decided = np.flatnonzero(np.isin(verdict, [Verdict.SLIDING, Verdict.LIMIT_CYCLE]))
    before, after = decided[:-1], decided[1:]
    changed = (verdict[before] != verdict[after]) & (after - before <= 2)
    return np.stack([places[before], places[after]], axis=1)[changed]
