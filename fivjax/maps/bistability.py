"""Bi-stability maps and critical perturbations: many trajectories, one batch run, labelled results."""

import functools
import itertools
import json
import math
from importlib import metadata
from pathlib import Path

import jax
import numpy as np
import xarray as xr

from ..foundation import arguments
from ..foundation.precision import in_double_precision
from ..io.datasets import describe, labelled
from ..linear.critical import critical_friction
from ..model.load import Pulse
from ..model.scene import Scene
from ..steppers.base import AbstractStepper
from ..steppers.description import describe_method
from ..steppers.event_exact import EventExact
from ..steppers.where_switched import WhereSwitched
from ..verdicts.verdict import MEANING, Verdict
from . import store as checkpoint
from .engine import MOST_STEPS, Outcome, run_to_verdict

# Lanes that a map may have: some 10 GB of results, and days of work.
MOST_LANES = 10**8


@in_double_precision
def bistability_map(
    scene: Scene,
    *,
    method: AbstractStepper | None = None,
    t_max: float = 20.0,
    memory: float = 2e9,
    max_steps: int = MOST_STEPS,
    progress: bool | None = None,
    resume: str | Path | None = None,
    energy: bool = False,
    **axes,
) -> xr.Dataset:
    """Where a scene returns to sliding after its kick, and where it ends on a limit cycle; one batch run.

        m = fj.bistability_map(scene, mu=np.linspace(0.05, 0.228, 64), p=np.linspace(1, 4, 64))

    **Arguments:**

    - `scene`: the scene; parameters that are not on an axis keep its values.
    - `**axes`: one-dimensional, strictly increasing values of any numeric parameter in `scene.parameters`, by name. One
      trajectory is run for each combination, from the sliding equilibrium of its own scene.
    - `method`: how to step, `EventExact()` unless given.
    - `t_max`: time after which a lane without a verdict is called undecided, in s.
    - `memory`: how much memory the lanes under way may take, in bytes.
    - `max_steps`: steps after which a lane without a verdict is called a step failure.
    - `progress`: show a bar; unless given, where there is a terminal or a notebook to show it in.
    - `resume`: a file in which finished lanes are kept while the map runs, every few seconds. If it exists, the map goes on
      from there: interrupted in whatever way and called again, the same call gives the same map, bit for bit. The file stays;
      delete it when the map is saved.
    - `energy`: whether to keep each lane's energy ledger up to its verdict (see `fivjax.energy`): the works, the energy
      lost in re-contacts, `kick_energy` (of the vibration when the kick ends, J), and `energy_residual`, the largest
      error of the balance on the way, with `energy_exchanged` (the sizes of the works and the loss, net of each line) to
      measure it against: 1e-8 of it at most, but for a lane in a thousand. It makes a map some ten times slower.

    **Returns:** a dataset with the axes as dimensions and, over all of them, `verdict` (0 sliding, 1 limit cycle,
    -1 undecided, other negative numbers failures; the variable's attributes give each a sentence), `amplitude` (peak
    tangential speed on the final orbit in m/s; 0 for sliding), `decided_at` (s), `contact_events` and `last_event` (s).
    With an axis p, `p_crit` over the others is the middle of the two neighbours on it between which the limit cycle
    first appears; `critical_perturbation` narrows that down. With an axis mu, the attribute `mu_crit` is the critical
    friction of linear theory.

    **Raises:** `ValueError` or `TypeError`, before anything is compiled, for unknown axis names, axes that are empty or
    not increasing, values that the scene refuses, and a `resume` file that belongs to another run.
    """
    method = EventExact() if method is None else method
    _check_run(scene, method, t_max, memory)
    arguments.whole_number("max_steps", max_steps, minimum=1)
    arguments.truth("energy", energy)
    if not axes:
        raise ValueError(
            "A map needs at least one axis, such as `mu=np.linspace(0.05, 0.228, 64)`; the scene has: "
            f"{', '.join(sorted(scene.parameters))}."
        )
    axes = _checked_axes(scene, axes)
    shape = tuple(len(values) for values in axes.values())
    if math.prod(shape) > MOST_LANES:
        raise ValueError(
            f"The axes ask for {math.prod(shape):.3g} lanes, whose results no memory holds; the most is {MOST_LANES:.0e}. Give "
            f"fewer values, or make several maps."
        )
    grid = np.meshgrid(*axes.values(), indexing="ij")
    known, keep = _kept(
        resume, scene, method, {"t_max": float(t_max), "max_steps": int(max_steps), "energy": bool(energy)}, axes
    )
    outcome = run_to_verdict(
        scene,
        {name: values.ravel() for name, values in zip(axes, grid, strict=True)},
        method,
        t_max=t_max,
        memory=memory,
        max_steps=max_steps,
        progress=progress,
        label="map",
        known=known,
        keep=keep,
        energy=bool(energy),
    )
    dataset = xr.Dataset(
        {
            "verdict": (tuple(axes), outcome.verdict.reshape(shape)),
            "amplitude": (tuple(axes), outcome.amplitude.reshape(shape)),
            "decided_at": (tuple(axes), outcome.decided_at.reshape(shape)),
            "contact_events": (tuple(axes), outcome.events.reshape(shape)),
            "last_event": (tuple(axes), outcome.last_event.reshape(shape)),
            **{name: (tuple(axes), line.reshape(shape)) for name, line in outcome.energy.items()},
        },
        coords=axes,
    )
    if "p" in axes:
        others = tuple(name for name in axes if name != "p")
        rows = dataset["verdict"].transpose(*others, "p").values.reshape(-1, len(axes["p"]))
        brackets, _ = _first_crossing(axes["p"], rows)
        dataset["p_crit"] = (others, brackets.mean(axis=-1).reshape([len(axes[name]) for name in others]))
    labelled(dataset, scene, method=describe_method(method), t_max=t_max)
    dataset["verdict"].attrs.update(
        flag_values=np.array([verdict.value for verdict in MEANING], np.int8),
        flag_meanings=" ".join(verdict.name.lower() for verdict in MEANING),
        meaning=json.dumps({verdict.value: sentence for verdict, sentence in MEANING.items()}),
    )
    _add_linear_limit(dataset, scene)
    dataset.attrs["counts"] = json.dumps(
        {verdict.name.lower(): int(np.sum(outcome.verdict == verdict)) for verdict in MEANING}
    )
    return dataset


@in_double_precision
def critical_perturbation(
    scene: Scene,
    *,
    p_range: tuple[float, float] = (1.0, 5.0),
    p_step: float = 0.01,
    tolerance: float = 1e-5,
    method: AbstractStepper | None = None,
    t_max: float = 30.0,
    memory: float = 2e9,
    progress: bool | None = None,
    energy: bool = False,
    **axis,
) -> xr.Dataset:
    """The smallest kick that leads to the limit cycle, along one or several axes; all lanes bracketed in batch.

        fj.critical_perturbation(scene, mu=np.linspace(0.05, 0.228, 40))          # Fig. 10
        fj.critical_perturbation(scene, belt_speed=[0.5, 1, 1.5, 3, 5, 10, 100])  # Table 2

    The range of p is scanned at a distance of `p_step`, then the first change from sliding to limit cycle is narrowed
    down. The boundary has islands (sliding above a limit cycle); a change narrower than the scan is not seen.

    **Arguments:**

    - `scene`: a scene whose load is a `Pulse`.
    - `**axis`: values of any numeric parameters but p, by name.
    - `p_range`, `p_step`: where to look, and how finely.
    - `tolerance`: the width of the bracket at which to stop.
    - `method`, `t_max`, `memory`, `progress`: as in `bistability_map`.
    - `energy`: whether to add the energies of the critical kick.

    **Returns:** a dataset over the axes with `p_crit` (middle of the bracket), `p_crit_low` and `p_crit_high` (proved to
    slide, proved to end on a limit cycle), `p_crit_error` (half the bracket plus the change of `p_crit` from a step twice
    as long to the method's), `crossings` and `only_crossing`. Where no change lies in the range, `p_crit` is NaN, except
    that it is the lower end of the range where the limit cycle is reached from there on.

    With `energy`, `critical_energy` is the energy of the vibration when the critical kick ends, in J: what the sliding
    state survives. Little of it comes from the load (`kick_work`, which may be negative); most is fed by the contact.

    **Raises:** `ValueError` as `bistability_map`, and for a load without a pulse or an axis named p.
    """
    method = EventExact() if method is None else method
    _check_run(scene, method, t_max, memory)
    arguments.truth("energy", energy)
    arguments.instance("scene.load", scene.load, Pulse, "a Pulse, whose p is sought")
    if "p" in axis:
        raise ValueError("Argument `p` is what is sought; limit it with `p_range` instead.")
    if not axis:
        axis = {"belt_speed": np.asarray(scene.belt_speed)[None]}
    if not isinstance(p_range, tuple | list) or len(p_range) != 2:
        kind = TypeError if not isinstance(p_range, tuple | list) else ValueError
        raise kind(f"Argument `p_range` must be a pair of numbers, such as (1.0, 5.0), but is {p_range!r}.")
    low, high = p_range
    arguments.real_number("p_range[0]", low, minimum=0)
    arguments.real_number("p_range[1]", high, above=low)
    arguments.real_number("p_step", p_step, above=0, maximum=float(high) - float(low))
    arguments.real_number("tolerance", tolerance, above=0)
    axes = _checked_axes(scene, axis)
    shape = tuple(len(values) for values in axes.values())
    columns = {
        name: values.ravel() for name, values in zip(axes, np.meshgrid(*axes.values(), indexing="ij"), strict=True)
    }

    run = functools.partial(run_to_verdict, scene, t_max=t_max, memory=memory, progress=progress)
    scan = np.linspace(low, high, round((high - low) / p_step) + 1)
    verdicts = _verdicts(run, method, columns, np.tile(scan, (len(columns[next(iter(columns))]), 1)), "scan")
    bracket, changes = _first_crossing(scan, verdicts)
    fine = _narrowed(run, method, columns, bracket, tolerance)
    if isinstance(method, WhereSwitched):
        # Event errors are first order in the step: the last halving changes the result by as much as is still missing.
        coarse_method = WhereSwitched(method.solver, 2 * method.dt)
        coarse = _narrowed(run, coarse_method, columns, _widened(fine, p_step), tolerance)
        stepping = np.abs(coarse.mean(axis=-1) - fine.mean(axis=-1))
    else:
        stepping = 0.0
    p_crit = fine.mean(axis=-1)
    dataset = xr.Dataset(
        {
            name: (tuple(axes), values.reshape(shape))
            for name, values in {
                "p_crit": p_crit,
                "p_crit_low": fine[:, 0],
                "p_crit_high": fine[:, 1],
                "p_crit_error": 0.5 * (fine[:, 1] - fine[:, 0]) + stepping,
                "crossings": changes,
                "only_crossing": changes <= 1,
            }.items()
        },
        coords=axes,
    )
    if energy:
        for name, values in _energies_of_the_kick(run, method, scene, {**columns, "p": p_crit}).items():
            dataset[name] = (tuple(axes), values.reshape(shape))
    _add_linear_limit(dataset, scene)
    dataset.attrs["range"] = json.dumps([float(low), float(high)])
    return labelled(dataset, scene, method=describe_method(method), t_max=t_max, tolerance=tolerance, p_step=p_step)


def _energies_of_the_kick(run, method, scene: Scene, columns: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """The vibration's energy at the end of each lane's kick, and the work that the kick did on the way."""
    known = np.flatnonzero(np.isfinite(columns["p"]))
    start, duration = (np.asarray(columns.get(name, scene.parameters[name])) for name in ("start", "duration"))
    energies = {name: np.full(len(columns["p"]), np.nan) for name in ("critical_energy", "kick_work")}
    if len(known):
        outcome = run(
            values={name: column[known] for name, column in columns.items()},
            method=method,
            t_max=float(np.max(start + duration)),
            label="energy",
            energy=True,
        )
        energies["critical_energy"][known] = outcome.energy["kick_energy"]
        energies["kick_work"][known] = outcome.energy["kick_work"]
    return energies


# Points inside a bracket that are tried at once: more of them means fewer rounds, and the rounds are what takes time.
POINTS_PER_ROUND = 15


def _verdicts(run, method, columns: dict[str, np.ndarray], p: np.ndarray, label: str) -> np.ndarray:
    """Verdicts for every lane (rows) at its own values of p (columns)."""
    lanes, points = p.shape
    values = {name: np.repeat(column, points) for name, column in columns.items()}
    outcome = run(values={**values, "p": p.ravel()}, method=method, label=label, lingering=label != "scan")
    return outcome.verdict.reshape(lanes, points)


def _first_crossing(scan: np.ndarray, verdicts: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Brackets (lanes, 2) of the first change from sliding to limit cycle, and the number of changes seen at all."""
    brackets = np.full((len(verdicts), 2), np.nan)
    changes = np.zeros(len(verdicts), int)
    for lane, row in enumerate(verdicts):
        decided = np.flatnonzero(row >= 0)
        if len(decided) == 0:
            continue
        known = row[decided]
        flips = np.flatnonzero(np.diff(known) != 0)
        changes[lane] = len(flips)
        upward = flips[known[flips] == Verdict.SLIDING]
        if known[0] == Verdict.LIMIT_CYCLE and decided[0] <= 1:
            # No kick at all is never proved either way where sliding is unstable; the next value up says it.
            brackets[lane] = scan[0]
        elif len(upward):
            brackets[lane] = scan[decided[upward[0]]], scan[decided[upward[0] + 1]]
    return brackets, changes


def _narrowed(run, method, columns, brackets: np.ndarray, tolerance: float) -> np.ndarray:
    """The brackets, narrowed to the tolerance or to where undecided lanes stop the narrowing."""
    brackets = brackets.copy()
    open_ = np.flatnonzero(np.diff(brackets)[:, 0] > tolerance)
    round_ = 0
    while len(open_):
        round_ += 1
        shares = np.linspace(0, 1, POINTS_PER_ROUND + 2)
        p = brackets[open_, :1] + shares * np.diff(brackets[open_])
        chosen = {name: column[open_] for name, column in columns.items()}
        inner = _verdicts(run, method, chosen, p[:, 1:-1], f"narrowing {round_}")
        still = []
        for row, lane in enumerate(open_):
            # The ends carry the verdicts that made them ends.
            verdicts = np.concatenate([[Verdict.SLIDING], inner[row], [Verdict.LIMIT_CYCLE]])
            bracket, _ = _first_crossing(p[row], verdicts[None])
            narrower = np.diff(bracket[0])[0] < 0.9 * np.diff(brackets[lane])[0]
            brackets[lane] = bracket[0]
            if narrower and np.diff(bracket[0])[0] > tolerance:
                still.append(lane)
        open_ = np.array(still, int)
    return brackets


def _widened(brackets: np.ndarray, by: float) -> np.ndarray:
    width = np.where(np.diff(brackets) > 0, by, 0.0)
    return brackets + width * np.array([-1.0, 1.0])


def _kept(path: str | Path | None, scene: Scene, method: AbstractStepper, limits: dict, axes: dict[str, np.ndarray]):
    """What an earlier run has left in the file, and how to keep more there."""
    if path is None:
        return None, None
    arguments.instance("resume", path, str | Path, 'the path of a file, such as "map.part"')
    run = {
        "fivjax": metadata.version("fivjax"),
        "jax": jax.__version__,
        "device": jax.devices()[0].device_kind,
        "scene": describe(scene),
        "method": repr(method),
        **limits,
        "axes": {name: values.tolist() for name, values in axes.items()},
    }
    found = checkpoint.recall(path, run)
    if found is not None:
        parts = {name: found.pop(name) for name in Outcome._fields if name != "energy"}
        found = Outcome(**parts, energy=found)

    def keep(outcome: Outcome) -> None:
        parts = outcome._asdict()
        checkpoint.keep(path, run, {**parts.pop("energy"), **parts})

    return found, keep


def _add_linear_limit(dataset: xr.Dataset, scene: Scene) -> None:
    """Note the critical friction of linear theory where friction is an axis and nothing else changes it."""
    changes_it = {*scene.structure.parameters, "belt_speed"} & set(dataset.dims)
    if "mu" not in dataset.dims or changes_it or float(scene.belt_speed) == 0:
        return
    limit = float(critical_friction(scene.structure, direction=1 if scene.belt_speed > 0 else -1))
    if np.isfinite(limit):
        dataset.attrs["mu_crit"] = limit


def _checked_axes(scene: Scene, axes: dict) -> dict[str, np.ndarray]:
    unknown = [name for name in axes if name not in scene.parameters]
    if unknown:
        hint = " Give the scene a Pulse as its load." if unknown[0] in ("p", "duration", "start") else ""
        raise ValueError(f"Unknown axis `{unknown[0]}`; this scene has: {', '.join(sorted(scene.parameters))}.{hint}")
    checked = {name: arguments.axis(name, values) for name, values in axes.items()}
    # Every rule on a parameter is a bound, or an order between two, so the corners of the grid stand for all of it.
    for corner in itertools.product(*((values[0], values[-1]) for values in checked.values())):
        scene.replace(**dict(zip(checked, corner, strict=True)))
    return checked


def _check_run(scene: Scene, method: AbstractStepper, t_max: float, memory: float) -> None:
    arguments.instance("scene", scene, Scene, "a Scene")
    arguments.instance("method", method, AbstractStepper, "a stepper, such as EventExact()")
    arguments.real_number("t_max", t_max, above=0)
    arguments.real_number("memory", memory, above=0)
    batched = [name for name, value in scene.parameters.items() if np.shape(value) != ()]
    if batched:
        raise ValueError(f"Parameter `{batched[0]}` of the scene must be one number; pass its values as an axis.")
