"""The labelled dataset of a map: verdicts, attractors and the settings of the run."""

import json
from collections.abc import Callable, Iterator

import numpy as np
import xarray as xr
from jaxtyping import Int

from ..io.datasets import label, labelled
from ..model.scene import Scene
from ..steppers.base import AbstractStepper, describe_method
from ..verdicts.sliding_proof import why_withheld
from ..verdicts.verdict import FAILURES, MEANING, RESTS_ON, Proof, Verdict
from .axes import at_middle
from .crossing import first_crossings
from .groups import kernels_by
from .plan import Grid
from .refinement import Audit, Refined
from .results import APPROACHED, CHAOTIC, PERIODIC, TORUS, Verdicts

# The dimension of sparse maps.
POINT = "point"

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
    refined: Refined | None = None,
    sparse: bool = False,
) -> xr.Dataset:
    """The labelled dataset of a grid of trajectories; `linear` is what linear theory says, see `axes.linear_limit`.
    Of a `refined` grid `verdicts` are those of its computed points: the dataset is over all points, or `sparse`, over these.
    """
    place, table = attractor_table(
        grid.groups if refined is None else lambda rows: grid.groups(refined.places[rows]), verdicts
    )
    results = {
        "verdict": verdicts.verdict,
        "amplitude": verdicts.amplitude,
        "decided_at": verdicts.decided_at,
        "proof": _proofs(verdicts),
        "bound": verdicts.bound,
        "contact_events": verdicts.events,
        "last_event": verdicts.last_event,
        "attractor": place,
        "chaotic": verdicts.attractor_kind == CHAOTIC,
    }
    results |= verdicts.energy
    if refined is not None and not sparse:
        rows = refined.every_row()
        results = {name: from_rows(name, values, rows) for name, values in results.items()}
        results["computed"] = np.zeros(grid.total, bool)
        results["computed"][refined.places] = ~verdicts.pending()
    dims, coords = tuple(grid.axes), grid.axes
    if refined is not None and sparse:
        results |= {"place": refined.places, "step": refined.steps}
        dims, coords = (POINT,), {name: (POINT, column) for name, column in grid.columns(refined.places).items()}
    shape = (-1,) if sparse else grid.shape
    dataset = xr.Dataset({name: (dims, values.reshape(shape)) for name, values in results.items()}, coords)
    dataset = dataset.assign({name: ("attractors", column) for name, column in table.items()})
    if not sparse and "p" in grid.of_kick:
        dataset = with_critical_kicks(dataset)
    labelled(dataset, scene, method=describe_method(method), **time_limit(t_max))
    dataset.attrs.update(kernels_by(method, scene))
    _explain(dataset, why_withheld(at_middle(scene, grid.axes)))
    dataset.attrs.update(linear)
    every = dataset["verdict"].values
    first = Verdict(int(every.flat[0]))
    if first in FAILURES and np.all(every == first):
        dataset.attrs["failure"] = MEANING[first]
    computed = f"{len(every):,} computed ones of " if sparse else ""
    return summarised(dataset, f"{computed}{' × '.join(map(str, grid.shape))} trajectories over {', '.join(grid.axes)}")


def from_rows(name: str, values: np.ndarray, rows: Int[np.ndarray, " r"]) -> np.ndarray:
    """The values of a variable at these rows, of which -1 was not run."""
    missing = {"verdict": Verdict.NOT_RUN, "proof": Proof.NONE, "attractor": -1}
    nothing = missing.get(name, np.nan if values.dtype.kind == "f" else 0)
    return np.append(values, np.array(nothing, values.dtype))[rows]


def with_critical_kicks(dataset: xr.Dataset) -> xr.Dataset:
    """The dataset of a grid, with the critical kicks over its other axes if there is one of kicks."""
    if "p" not in dataset.dims:
        return dataset
    others, p = tuple(name for name in dataset["verdict"].dims if name != "p"), dataset["p"].values

    def by_kick(name: str) -> np.ndarray:
        return dataset[name].transpose(*others, "p").values.reshape(-1, len(p))

    computed = by_kick("computed") if "computed" in dataset else True
    verdicts, over = by_kick("verdict"), [dataset.sizes[name] for name in others]
    crossing = first_crossings(p, verdicts, computed)
    # Where already the first kick squeals, the critical one lies below it, unless that is none at all.
    below = (verdicts[:, 0] == Verdict.LIMIT_CYCLE) & (p[0] != 1)
    found = {
        "p_crit": np.where(below, np.nan, crossing.middle),
        "p_crit_low": crossing.low,
        "p_crit_high": crossing.high,
    }
    return dataset.assign(
        {name: label(xr.DataArray(values.reshape(over), dims=others, name=name)) for name, values in found.items()}
    )


def _explain(dataset: xr.Dataset, withheld: str | None) -> None:
    """Write what the numbers of verdicts and proofs mean into their attributes; and why some verdicts are withheld."""
    meaning = dict(MEANING)
    if withheld is not None:
        dataset.attrs["withheld"] = withheld
        meaning[Verdict.UNDECIDED] = f"{meaning[Verdict.UNDECIDED]}. {withheld}"
    for name, sentences in {"verdict": meaning, "proof": RESTS_ON}.items():
        dataset[name].attrs.update(
            flag_values=np.array([int(one) for one in sentences], np.int8),
            flag_meanings=" ".join(one.name.lower() for one in sentences),
            meaning=json.dumps({int(one): sentence for one, sentence in sentences.items()}),
        )


def summarised(dataset: xr.Dataset, what: str) -> xr.Dataset:
    """The dataset with how many of its trajectories have which verdict."""
    every = dataset["verdict"].values
    counts = {verdict.name.lower(): int(np.sum(every == verdict)) for verdict in MEANING}
    found = ", ".join(f"{count} {name.replace('_', ' ')}" for name, count in counts.items() if count)
    # What is read first comes first.
    dataset.attrs = {"summary": f"{what}: {found}", **dataset.attrs, "counts": json.dumps(counts)}
    return dataset


def attractor_table(
    groups: Callable[[np.ndarray], Int[np.ndarray, " r"]], verdicts: Verdicts
) -> tuple[Int[np.ndarray, " trajectories"], dict[str, np.ndarray]]:
    """The index of each trajectory's attractor in the table (-1 without one), and the table's columns by name.

    Attractors are in the order of their groups, and by kind and amplitude within a group. `groups` gives the group of each
    trajectory from its index.
    """
    on_one = np.flatnonzero(verdicts.verdict == Verdict.LIMIT_CYCLE)
    kind = np.where(verdicts.attractor_kind == APPROACHED, PERIODIC, verdicts.attractor_kind)
    group = groups(on_one)
    order = np.argsort(group, kind="stable")
    on_one, group = on_one[order], group[order]
    place, first = np.full(len(verdicts.verdict), -1, np.int32), [on_one[:0]]
    for part in _whole_groups(group):
        rows = on_one[part]
        amplitude, period = verdicts.amplitude[rows], verdicts.attractor_period[rows]
        # Those of the same cycle, computed from different guesses, agree to this error.
        error = 1e-6
        which = _told_apart(
            (group[part], 0.0),
            (kind[rows], 0.0),
            (amplitude, error * amplitude),
            (period, error * period),
            # A symmetric structure has cycles in pairs, of one amplitude and one period.
            (verdicts.attractor_position[rows], error),
        )
        place[rows] = sum(map(len, first)) + which
        first.append(rows[np.unique(which, return_index=True)[1]])
    chosen = np.concatenate(first)
    return place, {
        "attractor_amplitude": verdicts.amplitude[chosen],
        "attractor_period": verdicts.attractor_period[chosen],
        "attractor_kind": np.array(["periodic", "torus"])[kind[chosen]],
        "attractor_multiplier": verdicts.attractor_multiplier[chosen],
        "attractor_reach": verdicts.attractor_reach[chosen],
        "attractor_contraction": verdicts.attractor_contraction[chosen],
    }


def _told_apart(*columns: tuple[np.ndarray, np.ndarray | float]) -> Int[np.ndarray, " r"]:
    """The place of each row in the order of these columns, of which the first counts most. Rows are the same where they differ
    in each column by no more than is allowed there, or by as little from others that are the same.
    """
    place = np.zeros(len(columns[0][0]), int)
    for values, allowed in columns:
        order = np.lexsort((values, place))
        apart = np.diff(values[order]) > np.broadcast_to(allowed, len(values))[order][1:]
        place[order] = np.cumsum(np.append(False, apart | (np.diff(place[order]) > 0)))
    return place


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
