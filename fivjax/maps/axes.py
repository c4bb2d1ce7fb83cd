"""Axes and arguments of maps and critical kicks, checked; and the critical friction that their datasets note."""

import math
from collections.abc import Iterable, Mapping

import numpy as np

from ..foundation import arguments
from ..io.datasets import check_axis_names
from ..io.reading_limits import machine_memory
from ..linear.critical import critical_friction
from ..model.scene import Scene, check_corners
from ..steppers.base import AbstractStepper
from .results import by_name, not_run


def linear_limit(scene: Scene, axes: Mapping[str, np.ndarray]) -> dict[str, float]:
    """The critical friction of linear theory, as an attribute: where constant friction is an axis and nothing else changes it;
    none where there is no steady sliding.
    """
    changes_it = set(scene.structure.parameters) & set(axes)
    # Only the sign of the belt speed matters.
    directions = np.unique(np.sign(axes.get("belt_speed", scene.belt_speed)))
    if not scene.friction.constant or "mu" not in axes or changes_it or len(directions) != 1 or directions[0] == 0:
        return {}
    try:
        limit = float(critical_friction(scene.structure, direction=int(directions[0])))
    except ValueError:
        return {}
    return {"mu_crit": limit} if np.isfinite(limit) else {}


# Names of maps' results beside those of each trajectory.
OF_RESULTS = (
    *("attractors", "attractor", "attractor_amplitude", "proof", "chaotic", "contact_events"),
    *("computed", "point", "place", "step", "p_crit", "p_crit_low", "p_crit_high"),
)


def at_middle(scene: Scene, axes: Mapping[str, np.ndarray]) -> Scene:
    """The scene with the middle values of its parameters that are on axes: the section measures the states of all groups alike,
    by this structure, whatever values the scene had of its own.
    """
    on_axes = {name: values[len(values) // 2] for name, values in axes.items() if name in scene.parameters}
    return scene.replace(**on_axes) if on_axes else scene


def checked_axes(scene: Scene, axes: dict) -> dict[str, np.ndarray]:
    unknown = [name for name in axes if name not in scene.parameters]
    if unknown:
        hint = " Give the scene a Pulse as its load." if unknown[0] in ("p", "duration", "start") else ""
        hint = hint or arguments.did_you_mean(unknown[0], scene.parameters)
        raise ValueError(f"Unknown axis `{unknown[0]}`; this scene has: {', '.join(sorted(scene.parameters))}.{hint}")
    # Names may be NumPy's strings, such as those of a dataset's coordinates.
    checked = {str(name): arguments.axis(name, values) for name, values in axes.items()}
    check_names(checked)
    check_corners(scene, checked)
    return checked


def check_names(names: Iterable[str], *more: str) -> None:
    """Refuse axes that are called like a map's result, or one of `more`."""
    check_axis_names(names, {*by_name(not_run(1, True)), *OF_RESULTS, *more}, "maps")


def check_size(axes: Mapping, halvings: int = 0, energy: bool = False, sparse: bool = False) -> None:
    """Check how many trajectories axes ask for, before anything is made of their values; each interval is halved so often. Of a
    sparse map the coarse grid counts, and each axis.

    **Raises:** `ValueError`, with the number of bytes, for more than a map may have, or than this machine has memory for.
    """
    # The most trajectories of a map: 5 GB of results, which are in memory more than once, and days of work.
    most_trajectories = 10**8
    if 2 ** min(halvings, 64) > most_trajectories:
        raise ValueError(
            f"Argument `refine` is {halvings}: each interval of an axis would become more than {most_trajectories:,}, the "
            f"most trajectories of a map. Give a smaller one."
        )
    counts = {name: (_count(values) - 1) * 2**halvings + 1 for name, values in axes.items()}
    if sparse and math.prod(counts.values()) >= 2**62:
        listed = " × ".join(f"{count:,} of `{name}`" for name, count in counts.items())
        raise ValueError(f"The axes ask for {listed}, which is more than can be numbered. Give a smaller `refine`.")
    if sparse:
        counts = {name: _count(values) for name, values in axes.items()}
    total, each = math.prod(counts.values()), sum(part.nbytes for part in by_name(not_run(1, energy)).values())
    memory = machine_memory() or math.inf
    longest = max((_count(values) for values in axes.values()), default=1) * 2**halvings
    if sparse and 8 * longest > 0.1 * memory:
        raise ValueError(
            f"The axes ask for {longest:,} values along one of them, which take {8 * longest:,} bytes. Give a smaller `refine`."
        )
    if total <= most_trajectories and total * each <= memory:
        return
    listed = " × ".join(f"{count:,} of `{name}`" for name, count in counts.items())
    raise ValueError(
        f"The axes ask for {total:,} trajectories ({listed}), whose results alone take {total * each:,} bytes. The most is "
        f"{most_trajectories:,} trajectories, and what the memory of this machine holds. Give fewer values, or make several "
        f"maps{' or one with `sparse=True`' if halvings and not sparse else ''}."
    )


def _count(values) -> int:
    try:
        return max(len(values), 1)  # none are refused later
    except TypeError:  # one number
        return 1


def checked_time_limit(scene: Scene, method: AbstractStepper, t_max: float | None, memory: float) -> float | None:
    """`t_max` as a number of Python's, which files can hold, once it and what else all maps are given is in order."""
    arguments.instance("scene", scene, Scene, "a Scene")
    arguments.known("scene", scene)
    arguments.instance("method", method, AbstractStepper, "a stepper, such as EventExact()")
    if t_max is not None:
        arguments.real_number("t_max", t_max, above=0)
    arguments.real_number("memory", memory, above=0)
    per_contact = ("belt_speed", "restitution") if len(scene.structure.contacts) > 1 else ()
    batched = [name for name, value in scene.parameters.items() if np.shape(value) != () and name not in per_contact]
    if batched:
        raise ValueError(f"Parameter `{batched[0]}` of the scene must be one number; pass its values as an axis.")
    return None if t_max is None else float(t_max)
