"""The labelled dataset of a map: verdicts, attractors and the settings of the run."""

import json

import numpy as np
import xarray as xr

from ..io.datasets import labelled
from ..model.scene import Scene
from ..steppers.base import AbstractStepper
from ..steppers.description import describe_method
from ..verdicts.sliding_proof import why_withheld
from ..verdicts.verdict import FAILURES, MEANING, RESTS_ON, Proof, Verdict
from .attractors_listed import attractor_table
from .crossing import first_crossings
from .groups import kernels_by
from .refinement import Refined
from .results import CHAOTIC, Verdicts
from .trajectories import Grid


def time_limit(t_max: float | None) -> dict[str, float]:
    """The attribute for a time limit, if one was given."""
    return {} if t_max is None else {"t_max": t_max}


def _proofs(verdicts: Verdicts) -> np.ndarray:
    """What each verdict rests on."""
    verdict, captured = verdicts.verdict, np.where(verdicts.attractor_kind == 1, Proof.TUBE, Proof.ELLIPSOID)
    proofs = {Verdict.SLIDING: Proof.BOUND, Verdict.LIMIT_CYCLE: captured, Verdict.UNBOUNDED: Proof.GROWTH}
    chosen = [verdict == one for one in proofs]
    return np.select(chosen, [np.broadcast_to(one, verdict.shape) for one in proofs.values()], Proof.NONE).astype(
        np.int8
    )


def map_dataset(
    scene: Scene,
    method: AbstractStepper,
    t_max: float | None,
    grid: Grid,
    verdicts: Verdicts,
    linear: dict[str, float],
    cells: Refined | None = None,
) -> xr.Dataset:
    """The labelled dataset of a grid of trajectories; `linear` is what linear theory says, see `axes.linear_limit`.
    If not all trajectories were computed, `verdicts` are those of the `cells`.
    """
    axes, shape = grid.axes, grid.shape
    place, table = attractor_table(
        grid.groups if cells is None else lambda rows: grid.groups(cells.places[rows]), verdicts
    )

    def over_axes(values: np.ndarray) -> tuple[tuple[str, ...], np.ndarray]:
        return tuple(axes), (values if cells is None else values[cells.row]).reshape(shape)

    dataset = xr.Dataset(
        {
            "verdict": over_axes(verdicts.verdict),
            "amplitude": over_axes(verdicts.amplitude),
            "decided_at": over_axes(verdicts.decided_at),
            "proof": over_axes(_proofs(verdicts)),
            "bound": over_axes(verdicts.bound),
            "contact_events": over_axes(verdicts.events),
            "last_event": over_axes(verdicts.last_event),
            "attractor": over_axes(place),
            "chaotic": over_axes(verdicts.attractor_kind == CHAOTIC),
            **{name: ("attractors", column) for name, column in table.items()},
            **{name: over_axes(line) for name, line in verdicts.energy.items()},
        },
        coords=axes,
    )
    if cells is not None:
        computed = np.zeros(grid.total, bool)
        computed[cells.places] = ~verdicts.pending(slice(len(cells.places)))
        described = {"long_name": "whether it was computed", "units": "1"}
        dataset["computed"] = (tuple(axes), computed.reshape(shape), described)
    if "p" in axes:
        others = tuple(name for name in axes if name != "p")
        rows = dataset["verdict"].transpose(*others, "p").values.reshape(-1, len(axes["p"]))
        crossing, over = first_crossings(axes["p"], rows), [len(axes[name]) for name in others]
        dataset["p_crit"] = (others, crossing.middle.reshape(over))
        dataset["p_crit_low"] = (others, crossing.low.reshape(over))
        dataset["p_crit_high"] = (others, crossing.high.reshape(over))
    labelled(dataset, scene, method=describe_method(method), **time_limit(t_max))
    dataset.attrs.update(kernels_by(method, scene, bool(verdicts.energy)))
    meaning, withheld = dict(MEANING), why_withheld(scene)
    if withheld is not None:
        dataset.attrs["withheld"] = withheld
        meaning[Verdict.UNDECIDED] = f"{meaning[Verdict.UNDECIDED]}. {withheld}"
    dataset["verdict"].attrs.update(
        flag_values=np.array([verdict.value for verdict in MEANING], np.int8),
        flag_meanings=" ".join(verdict.name.lower() for verdict in MEANING),
        meaning=json.dumps({verdict.value: sentence for verdict, sentence in meaning.items()}),
    )
    dataset["proof"].attrs.update(
        flag_values=np.array(list(RESTS_ON), np.int8),
        flag_meanings=" ".join(proof.name.lower() for proof in RESTS_ON),
        meaning=json.dumps({proof.value: sentence for proof, sentence in RESTS_ON.items()}),
    )
    dataset.attrs.update(linear)
    every = dataset["verdict"].values
    first = Verdict(int(every.flat[0]))
    if first in FAILURES and np.all(every == first):
        dataset.attrs["failure"] = MEANING[first]
    counts = {verdict.name.lower(): int(np.sum(every == verdict)) for verdict in MEANING}
    found = ", ".join(f"{count} {name.replace('_', ' ')}" for name, count in counts.items() if count)
    summary = f"{' × '.join(map(str, shape))} trajectories over {', '.join(axes)}: {found}"
    dataset.attrs = {"summary": summary, **dataset.attrs, "counts": json.dumps(counts)}
    return dataset
