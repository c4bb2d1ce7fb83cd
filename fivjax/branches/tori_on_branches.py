"""Attractors where a pair of multipliers of a branch's cycles has left the unit circle: tori, and cycles locked on them."""

from typing import TYPE_CHECKING

import numpy as np

from ..cycles.cycle import LimitCycle
from ..cycles.own_coordinates import cycle_in_contact_coordinates
from ..cycles.search import attractors_met
from ..foundation import arguments
from ..foundation.precision import in_double_precision
from ..foundation.progress import reported
from ..io.datasets import labelled, named
from ..model.scene import Scene
from ..section.return_maps import ReturnMaps
from .continuation import cycle_at

if TYPE_CHECKING:
    import xarray as xr

# Relative distances from the cycle at which motions are released: inside and outside of a small torus.
RELEASED = (1e-3, -1e-3, 0.02, -0.02)


@reported("tori")
@in_double_precision
def tori_along(branch: "xr.Dataset", points: int = 12, *, progress: bool | None = None) -> "xr.Dataset":
    """The attractors beside the cycles of a branch that a pair of multipliers has made unstable.

        tori = fj.tori_along(fj.continue_cycle(scene, "mu", (0.02, 0.3)))

    Where exactly one complex pair of multipliers lies outside the unit circle, beyond a Neimark–Sacker bifurcation, motions are
    released beside some of the cycles and followed to their attractor.

    **Arguments:** `branch`, from `continue_cycle`; `points`, the largest number of its points that are examined;
    `progress` as in `continue_cycle`.

    **Returns:** a dataset over `point`: `place` (the index on the branch), `parameter`, `kind` ("torus"; "locked", a cycle that
    closes after more crossings of the section; "another cycle"; "none", if no attractor was found), `amplitude` (peak
    tangential speed, m/s) and `rotation_number` of a torus (turns per return, without sign; NaN where
    its points lie on no closed curve, or on one of more than a dozen pieces).

    **Raises:** `ValueError` for an object that is no branch.

    **Example:**

        >>> branch = fj.continue_cycle(scene.replace(mu=0.227, belt_speed=1.8), "belt_speed", (1.7, 3.0))  # doctest: +SLOW
        >>> bool(np.any(fj.tori_along(branch, points=2)["kind"] == "torus"))  # doctest: +SLOW
        True
    """
    import xarray as xr

    if not {"multipliers", "special", "parameter"} <= set(getattr(branch, "variables", ())):
        raise ValueError("Argument `branch` must come from `fivjax.continue_cycle`.")
    points = arguments.whole_number("points", points, minimum=1)
    places = turning(np.asarray(branch["multipliers"]))
    places = places[branch["special"].values[places] == ""]
    places = (
        places[np.unique(np.linspace(0, len(places) - 1, min(points, len(places))).round().astype(int))]
        if len(places)
        else places
    )
    kinds, amplitudes, rotation = [], [], []
    for place in places:
        cycle = cycle_at(branch, int(place))
        found = _attractor(cycle)
        if found is None:
            kinds.append("none")
        elif found.kind == "torus":
            kinds.append("torus")
        else:
            kinds.append("locked" if found.crossings > cycle.crossings else "another cycle")
        amplitudes.append(np.nan if found is None else float(found.amplitude))
        turns = None if found is None else found.rotation_number
        rotation.append(np.nan if turns is None else float(turns))
    dataset = xr.Dataset(
        {
            "place": ("point", places),
            "parameter": ("point", np.asarray(branch["parameter"])[places]),
            "kind": ("point", np.array(kinds, dtype="<U13")),
            "amplitude": ("point", amplitudes),
            "rotation_number": ("point", rotation),
        }
    )
    dataset = labelled(dataset, Scene.from_dataset(branch)).assign_attrs(parameter=branch.attrs["parameter"])
    dataset["parameter"].attrs = dict(branch["parameter"].attrs)
    return named(
        dataset, place=("index of the point on the branch", "1"), kind=("kind of the attractor beside the cycle", "1")
    )


def turning(multipliers: np.ndarray) -> np.ndarray:
    """Points with exactly one complex pair of multipliers outside the unit circle."""
    outside = np.abs(multipliers) > 1 + 1e-6
    complex_ = np.abs(multipliers.imag) > 1e-9
    return np.flatnonzero((outside.sum(axis=1) == 2) & ((outside & complex_).sum(axis=1) == 2))


def _attractor(cycle: LimitCycle) -> LimitCycle | None:
    """The attractor of motions that are released beside a cycle; a torus rather than a cycle."""
    cycle = cycle_in_contact_coordinates(cycle)
    states = np.stack([(1 + by) * cycle.deviation for by in RELEASED])
    found = attractors_met(ReturnMaps.of(cycle.scene), cycle.scene, states).cycles
    tori = [one for one in found if one.kind == "torus"]
    return next(iter(tori or found), None)
