r"""The smallest perturbation of a kind found that leads to a limit cycle, and a certified bound below it.

Along a ray of perturbations, verdicts tell the smallest size that squeals. There the motion lands on the saddle's stable
manifold. The normal of the manifold, transformed back to the perturbation, gives the shape in whose direction the manifold is
closest, in the norm. The search goes in this direction as long as the size falls, from the best of the shapes that linear
sliding suggests.
"""

import math
from collections.abc import Callable
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from ..attractors.catalogue import Attractors
from ..io.datasets import labelled
from ..maps.basin_map import verdicts_from
from ..maps.crossing import FirstCrossing, first_crossings, with_ends
from ..model.scene import Scene
from .perturbations import Histories, InitialStates, Vectors
from .stable_manifold import Saddle, manifold_normal

if TYPE_CHECKING:
    import xarray as xr

# The largest size scanned along a ray at first, relative to the certified bound, and the number of sizes; later the number of
# sizes around the last crossing; and the number inside a bracket.
FARTHEST, SCANNED, AROUND, INSIDE = 4.0, 60, 16, 15
# Relative widths of brackets during the search, and at its end.
ROUGH, EXACT = 1e-5, 1e-8
SHARES = np.array([1.0, 0.5, 0.25, 0.1, 0.04, 0.015])
MOST_STEPS, GAINED = 12, 1e-6


class SmallestPerturbation(NamedTuple):
    """The smallest initial state, or load history, found that leads to a limit cycle, and a certified bound below it.

    Sizes are norms: for an initial state the square root of the energy of its deviation from steady sliding (√J), for a history
    the largest deviation of the load from its final value, as a share of it.

    **Example:**

        >>> found = fj.smallest_kick(scene.replace(belt_speed=1.0), over="state")  # doctest: +SLOW
        >>> bool(0.5 < found.ratio < 1.0)  # doctest: +SLOW
        True
    """

    over: str  # "state" or "history"
    size: float  # of the smallest one found that leads to a limit cycle
    certified: float  # every one smaller than this slides for ever
    proved_low: float  # the same shape with this size was proved to slide,
    proved_high: float  # and with this size to end on a limit cycle
    values: np.ndarray  # displacements (m) and velocities (m/s), the `y0` of `simulate`; or the factor p of each piece
    trajectories: int  # the number that the search took
    scene: Scene | None = None  # the one that was asked about

    def in_scene(self, scene: Scene, turned: Callable[[np.ndarray], np.ndarray]) -> "SmallestPerturbation":
        """The same of a scene in other coordinates, with its state, if it is one, turned to them."""
        values = turned(self.values) if self.over == "state" else self.values
        return self._replace(scene=scene, values=values)

    def to_dataset(self) -> "xr.Dataset":
        """The sizes and the state over `coordinate`, or the p of each `piece`, with names, units and the scene.

        **Raises:** `ValueError` for one without a scene.
        """
        if self.over == "state":
            displacement, velocity = np.split(np.asarray(self.values), 2)
            values: dict[str, tuple] = {
                "displacement": ("coordinate", displacement),
                "velocity": ("coordinate", velocity),
            }
        else:
            values = {"p": ("piece", np.asarray(self.values))}
        unit = "sqrt(J)" if self.over == "state" else "1"
        meanings = {
            "size": "smallest size found that leads to a limit cycle",
            "certified": "size below which everything slides for ever",
            "proved_low": "size of the same shape that was proved to slide",
            "proved_high": "size of the same shape that was proved to end on a limit cycle",
        }
        for name, meaning in meanings.items():
            values[name] = ((), getattr(self, name), {"units": unit, "long_name": meaning})
        return dataset_of(values, self.scene, over=self.over).assign_attrs(trajectories=self.trajectories)

    @property
    def ratio(self) -> float:
        """The ratio of the certified size to that found; 1 if there were no gap."""
        return self.certified / self.size

    def __str__(self) -> str:
        if self.over == "state":
            found = f"smallest initial state found: {self.size**2:.6g} J about steady sliding lead to a limit cycle"
            bound = f"certified: every state in contact with less than {self.certified**2:.6g} J slides for ever"
        else:
            found = f"smallest history found: a load within {100 * self.size:.6g} % of its own leads to a limit cycle"
            bound = f"certified: every history within {100 * self.certified:.6g} % slides for ever"
        return f"{found}\n{bound}\ngap: the bound is {100 * self.ratio:.3g} % of what was found, as a norm"

    __repr__ = __str__


def dataset_of(values: dict, scene: Scene | None, **settings) -> "xr.Dataset":
    """Values by name as a dataset of the scene; those over `coordinate` are of its coordinates."""
    import xarray as xr

    if scene is None:
        raise ValueError(
            "This result has no scene, so it cannot be saved with it. Take one that `smallest_kick` has found."
        )
    dataset = xr.Dataset(values)
    if "coordinate" in dataset.dims:
        dataset = dataset.assign_coords(coordinate=list(scene.structure.coordinates))
    return labelled(dataset, scene, **settings)


class NoSquealingKick(ValueError):
    """No kick, state or history that was tried within the bounds leads to a limit cycle.

    `certified` is the bound below which none does: the p of a kick, or the size of a `SmallestPerturbation`.

    **Example:**

        >>> try:
        ...     fj.smallest_kick(scene, over="p", bounds={"p": (1.0, 1.02)})  # doctest: +SLOW
        ... except fj.NoSquealingKick as none:
        ...     print("proved up to there:", none.certified > 1.02)
        proved up to there: True
    """

    def __init__(self, sentence: str, certified: float):
        super().__init__(sentence, certified)
        self.certified = certified

    def __str__(self) -> str:
        bound = (
            f"Below {self.certified:.6g}, the certified bound,"
            if math.isfinite(self.certified)
            else "Of whatever size,"
        )
        return f"{self.args[0]} {bound} none does."


class _Rays:
    """The smallest sizes along rays of perturbations that squeal."""

    def __init__(self, kind: InitialStates | Histories):
        self.kind = kind
        self.rest = np.asarray(kind.sliding.linear.equilibrium)
        self.attractors: dict[bytes, Attractors] = {}
        self.trajectories = 0

    def verdicts(self, u: Vectors) -> np.ndarray:
        self.trajectories += len(u)
        return verdicts_from(self.kind.scene, self.kind.states(u) + self.rest, "states", self.attractors)

    def first(self, shapes: Vectors, sizes: np.ndarray, width: float) -> FirstCrossing:
        """The first crossing along each ray among `sizes` (rays, sizes). The smallest of all, and each that may be smaller, is
        narrowed down to the relative width `width`.
        """
        found = first_crossings(sizes, self._along(shapes, sizes))
        while True:
            smallest = np.min(found.high, where=np.isfinite(found.low), initial=np.inf)
            wide = np.flatnonzero((found.high - found.low > width * found.high) & (found.low < smallest))
            if not len(wide):
                return found
            inner = np.linspace(found.low[wide], found.high[wide], INSIDE + 2, axis=1)
            now = first_crossings(inner, with_ends(self._along(shapes[wide], inner[:, 1:-1])))
            stuck = now.high - now.low >= 0.9 * (found.high[wide] - found.low[wide])
            for whole, part in zip(found, now, strict=True):
                whole[wide] = part
            # Undecided trajectories prevent further narrowing.
            found.low[wide[stuck]] = np.nan

    def _along(self, shapes: Vectors, sizes: np.ndarray) -> np.ndarray:
        return self.verdicts((shapes[:, None] * sizes[..., None]).reshape(-1, shapes.shape[1])).reshape(sizes.shape)


def smallest_of(kind: InitialStates | Histories) -> SmallestPerturbation:
    """The perturbation of this kind with the least norm that leads to a limit cycle."""
    certificate, rays = kind.certificate(), _Rays(kind)
    shapes = certificate.shapes
    if certificate.size >= kind.most:
        raise NoSquealingKick(
            f"No history of this duration leads to a limit cycle: beyond {kind.most:g} the load would have to pull. Give a "
            f"longer one.",
            certificate.size,
        )
    largest = min(FARTHEST * certificate.size, kind.most)
    sizes = np.tile(np.linspace(0.99 * certificate.size, largest, SCANNED), (len(shapes), 1))
    found = rays.first(shapes, sizes, ROUGH)
    if not np.any(np.isfinite(found.low)):
        raise NoSquealingKick(
            f"None of the {len(shapes)} shapes that were tried leads to a limit cycle at up to "
            f"{largest / certificate.size:.3g} times the certified bound. Look with `fivjax.basins`"
            f"{', or for other shapes with another number of `pieces` or longest duration' if kind.over == 'history' else ''}.",
            certificate.size,
        )
    best = int(np.nanargmin(np.where(np.isfinite(found.low), found.high, np.nan)))
    shape, low, high = shapes[best], float(found.low[best]), float(found.high[best])
    saddle: Saddle | None = None
    for _ in range(MOST_STEPS):
        u = low * shape
        normal = manifold_normal(kind.scene, kind.states(u[None])[0], saddle)
        if normal is None:
            break
        gradient, saddle = kind.pulled_back(u, normal[0]), normal[1]
        steepest = kind.steepest(gradient * np.sign(gradient @ shape))
        tried = shape + SHARES[:, None] * (steepest - shape)
        tried = tried / kind.norm(tried)[:, None]
        around = np.tile(np.linspace(max(0.9 * low, 0.99 * certificate.size), 1.001 * high, AROUND), (len(tried), 1))
        found = rays.first(tried, around, ROUGH)
        if not np.any(np.isfinite(found.low)):
            break
        best = int(np.nanargmin(np.where(np.isfinite(found.low), found.high, np.nan)))
        if found.high[best] >= high * (1 - GAINED):
            break
        shape, low, high = tried[best], float(found.low[best]), float(found.high[best])
    ends = rays.first(shape[None], np.array([[low, high]]), EXACT)
    if np.isfinite(ends.low[0]):
        low, high = float(ends.low[0]), float(ends.high[0])
    values = kind.values(high * shape)
    return SmallestPerturbation(kind.over, high, certificate.size, low, high, values, rays.trajectories, kind.scene)
