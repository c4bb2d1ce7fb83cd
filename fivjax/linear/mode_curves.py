"""Frequencies and growth rates of the modes over one parameter, as a dataset (Fig. 3)."""

from typing import TYPE_CHECKING

import numpy as np

from ..foundation.precision import in_double_precision
from ..foundation.progress import following, stage, tick
from ..io.datasets import check_axis_names, labelled
from ..model.contact_coordinates import in_contact_coordinates
from ..model.scene import Scene
from ..model.sliding import free_in_sliding
from ..model.structure import Structure
from .critical import NoSteadySliding, stability_limit
from .mode_coupling import coalescence
from .mode_following import HALVINGS, LOOKS, Sampler, match_modes
from .outcomes import Mechanism
from .system import with_axes

if TYPE_CHECKING:
    import xarray as xr


# Names in the dataset of modes.
OF_RESULTS = (
    *("mode", "coordinate", "frequency", "growth_rate", "damping_ratio", "eigenvalue", "partner", "shape"),
    *("mu_crit", "frequency_crit", "mu_coalescence"),
)


@in_double_precision
def modes(system: Structure | Scene, *, direction: int = 1, progress: bool | None = None, **parameters) -> "xr.Dataset":
    r"""The modes of steady sliding over one parameter, each followed along the axis.

        fj.cea.modes(fj.belt_oscillator(), mu=np.linspace(0, 0.5, 501))
        fj.cea.modes(scene, belt_speed=np.linspace(0.1, 3, 200))

    A mode is a conjugate pair of eigenvalues, or two real ones where it is overdamped. Modes are numbered by frequency at the
    start of the axis and followed by continuity: an interval in which an eigenvalue moves nearly as far as to its neighbour is
    halved until none does. Modes that cross without coupling are told apart by their shapes. Where two modes meet (undamped
    coalescence), nothing distinguishes them beyond; the one of higher frequency continues as the one that grows.

    **Arguments:** `system`; one axis by name, as in `chart`; single numbers replace the system's own value; `progress`, whether
    to show how far it is: unless given, in terminals and notebooks.

    **Returns:** a dataset over the axis and `mode` with `frequency` (Hz, damped), `growth_rate` (1/s), `damping_ratio`
    (-Re λ/|λ|), `eigenvalue` (the one of the pair with positive imaginary part, or the larger of two real ones; 1/s),
    `partner` (the other one) and `shape` (complex displacements over `coordinate`, including the normal one, the largest
    scaled to 1; for contacts given by vectors, those of `fj.in_contact_coordinates`). NaN where there is no steady
    sliding. Over `mu`, with constant friction, also `mu_crit`, `frequency_crit` (Hz) and `mu_coalescence` (undamped), from
    `stability_limit` and `coalescence`.

    **Example:**

        >>> modes = fj.cea.modes(structure, mu=np.linspace(0.0, 0.5, 101))
    """
    scene, axes = with_axes(system, direction, parameters, count=1)
    check_axis_names(axes, OF_RESULTS, "modes")
    ((name, values),) = axes.items()
    with following("modes", shown=progress, total=len(values), unit=" values"):
        stage("compiling")
        at = Sampler(scene, name)
        samples = at.many(values)
        stage("following")
        followed = [samples[0]]
        tick()
        for k in range(1, len(values)):
            before, now = followed[-1], samples[k]
            at.looks = LOOKS
            if before is not None and now is not None:
                now = now.reorder(match_modes(at, values[k - 1], before, values[k], now, HALVINGS))
            followed.append(now)
            tick()
        dataset = _modes_dataset(scene, name, values, followed)
        directions = np.unique(np.sign(values if name == "belt_speed" else scene.belt_speed)).astype(int)
        slides = int(directions[0]) if len(directions) == 1 else None
        # Of contacts that slide in several directions the limit is not known.
        if name == "mu" and scene.friction.constant and slides is not None:
            stage("finding the stability limit")
            dataset = dataset.assign(_limits(scene, slides))
    return labelled(
        dataset, scene, analysis="modes of steady sliding", direction="several" if slides is None else slides
    )


def _limits(scene: Scene, direction: int) -> dict:
    try:
        limit = stability_limit(scene.structure, direction=direction)
    except NoSteadySliding as error:
        mu, frequency, said = np.nan, np.nan, {"outcome": str(error), "mechanism": Mechanism.NONE.value}
    else:
        mu, frequency = limit.mu, limit.frequency
        said = {"outcome": limit.outcome.value, "mechanism": limit.mechanism.value}
    found = {
        "mu_crit": ((), mu, {"long_name": "critical friction", "units": "1", **said}),
        "frequency_crit": ((), frequency, {"long_name": "frequency at the critical friction", "units": "Hz"}),
    }
    if len(scene.structure.contacts) == 1:
        meeting = coalescence(scene.structure, direction=direction).mu
        long_name = "friction at the coalescence of the undamped modes"
        found["mu_coalescence"] = ((), meeting, {"long_name": long_name, "units": "1"})
    return found


def _modes_dataset(scene: Scene, name: str, values: np.ndarray, followed: list) -> "xr.Dataset":
    import xarray as xr

    structure = scene.structure
    n, keep = structure.size, free_in_sliding(in_contact_coordinates(structure))
    m = len(keep)
    eigenvalue, partner = np.full((2, len(values), m), complex(np.nan, np.nan))
    shape = np.full((len(values), m, n), complex(np.nan, np.nan))
    for k, sample in enumerate(followed):
        if sample is not None:
            eigenvalue[k], partner[k] = sample.eigenvalue, sample.partner
            shape[k] = 0
            shape[k][:, keep] = sample.shape
    size = np.abs(eigenvalue)
    ratio = -np.real(eigenvalue) / np.where(size > 0, size, 1.0)
    variables = {
        "frequency": (np.imag(eigenvalue) / (2 * np.pi), "frequency", "Hz"),
        "growth_rate": (np.real(eigenvalue), "growth rate", "1/s"),
        "damping_ratio": (ratio, "damping ratio", "1"),
        "eigenvalue": (eigenvalue, "eigenvalue", "1/s"),
        "partner": (partner, "the mode's other eigenvalue", "1/s"),
    }
    dataset = xr.Dataset(
        {key: ((name, "mode"), v, {"long_name": long, "units": unit}) for key, (v, long, unit) in variables.items()},
        coords={
            name: values,
            "mode": np.arange(m),
            "coordinate": np.arange(n),
        },
    )
    dataset["shape"] = ((name, "mode", "coordinate"), shape, {"long_name": "mode shape", "units": "1"})
    dataset["mode"].attrs["long_name"] = "mode, by frequency at the start of the axis"
    dataset["coordinate"].attrs["long_name"] = "coordinate of the structure"
    return dataset
