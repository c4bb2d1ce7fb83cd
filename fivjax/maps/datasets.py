"""The labelled dataset of a map: verdicts, attractors and the settings of the run."""

import json
from collections.abc import Callable, Iterator

import numpy as np
import xarray as xr
from jaxtyping import Int

from ..io.datasets import labelled
from ..model.scene import Scene
from ..steppers.base import AbstractStepper
from ..steppers.description import describe_method
from ..verdicts.sliding_proof import why_withheld
from ..verdicts.verdict import FAILURES, MEANING, RESTS_ON, Proof, Verdict
from .crossing import first_crossings
from .groups import kernels_by
from .plan import Grid
from .refinement import Audit, Refined
from .results import APPROACHED, CHAOTIC, PERIODIC, TORUS, Verdicts

# Trajectories whose attractors are told apart at a time: that takes much memory.
AT_A_TIME = 2**18


def time_limit(t_max: float | None) -> dict[str, float]:
    """The attribute for a time limit, if one was given."""
    return {} if t_max is None else {"t_max": t_max}


def _proofs(verdicts: Verdicts) -> np.ndarray:
    """What each verdict rests on."""
    verdict, kind = verdicts.verdict, verdicts.attractor_kind
    captured = np.select([kind == TORUS, kind == APPROACHED], [Proof.TUBE, Proof.APPROACH], Proof.ELLIPSOID)
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
    dataset.attrs.update(kernels_by(method, scene))
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
    audited = {} if cells is None else audit_note(cells.audit)
    dataset.attrs = {"summary": summary, **dataset.attrs, "counts": json.dumps(counts), **audited}
    return dataset


def attractor_table(
    groups: Callable[[np.ndarray], Int[np.ndarray, " r"]], verdicts: Verdicts
) -> tuple[Int[np.ndarray, " trajectories"], dict[str, np.ndarray]]:
    """The index of each trajectory's attractor in the table (-1 without one), and the table's columns by name.

    Attractors are in the order of their groups, and by amplitude within a group. `groups` gives the group of each trajectory
    from its index.
    """
    on_one = np.flatnonzero(verdicts.verdict == Verdict.LIMIT_CYCLE)
    kind = np.where(verdicts.attractor_kind == APPROACHED, PERIODIC, verdicts.attractor_kind)
    group = groups(on_one)
    order = np.argsort(group, kind="stable")
    on_one, group = on_one[order], group[order]
    place, first = np.full(len(verdicts.verdict), -1, np.int32), [on_one[:0]]
    for part in _whole_groups(group):
        rows = on_one[part]
        columns = np.stack(
            [
                group[part],
                verdicts.amplitude[rows],
                verdicts.attractor_period[rows],
                kind[rows],
            ]
        )
        order = np.lexsort((columns[2], columns[1], columns[3], columns[0]))
        rows, columns = rows[order], columns[:, order]
        # Amplitudes and periods of the same cycle, computed from different guesses, agree to this relative error.
        allowed = 1e-6 * np.array([0.0, 1.0, 1.0, 0.0])[:, None] * np.abs(columns[:, 1:])
        new = np.append(True, np.any(np.abs(np.diff(columns, axis=1)) > allowed, axis=0))
        place[rows] = sum(map(len, first)) + np.cumsum(new) - 1
        first.append(rows[new])
    chosen = np.concatenate(first)
    return place, {
        "attractor_amplitude": verdicts.amplitude[chosen],
        "attractor_period": verdicts.attractor_period[chosen],
        "attractor_kind": np.array(["periodic", "torus"])[kind[chosen]],
        "attractor_multiplier": verdicts.attractor_multiplier[chosen],
        "attractor_reach": verdicts.attractor_reach[chosen],
        "attractor_contraction": verdicts.attractor_contraction[chosen],
    }


def _whole_groups(group: Int[np.ndarray, " r"]) -> Iterator[slice]:
    """Slices of sorted groups, each of whole ones and, if these are not larger, of `AT_A_TIME` trajectories at most."""
    start = 0
    while start < len(group):
        end = start + AT_A_TIME
        if end < len(group):
            before = int(np.searchsorted(group, group[end], side="left"))
            end = before if before > start else int(np.searchsorted(group, group[end], side="right"))
        yield slice(start, end)
        start = end


def audit_note(audit: Audit) -> dict[str, float | int]:
    """The audit as attributes of a dataset: counts, the rate of wrong cells and its interval of 95 %."""
    note: dict[str, float | int] = {"audit_cells": audit.cells, "audit_wrong": audit.wrong}
    if audit.cells:
        rate, low, high = (float(part) for part in wilson(audit.wrong, audit.cells))
        note |= {"audit_rate": rate, "audit_rate_low": low, "audit_rate_high": high}
    return note


def wilson(successes, total: int, z: float = 1.959963984540054) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A share and its interval by E. B. Wilson (1927), of 95 % unless `z` says otherwise."""
    share = np.asarray(successes) / total
    middle = (share + z**2 / (2 * total)) / (1 + z**2 / total)
    half = z * np.sqrt(share * (1 - share) / total + z**2 / (4 * total**2)) / (1 + z**2 / total)
    return share, np.maximum(middle - half, 0.0), np.minimum(middle + half, 1.0)
