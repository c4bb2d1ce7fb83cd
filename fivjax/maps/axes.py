"""Axes and arguments of maps and critical kicks, checked; and the critical friction that their datasets note."""

import itertools
import math
from collections.abc import Mapping, Sequence

import numpy as np

from ..foundation import arguments
from ..linear.critical import critical_friction
from ..model.scene import Scene, refuse_vector_contacts
from ..steppers.base import AbstractStepper
from .trajectories import Grid

# The most trajectories of a map: some 10 GB of results, and days of work.
MOST_TRAJECTORIES = 10**8


def linear_limit(scene: Scene, axes: Mapping[str, np.ndarray]) -> dict[str, float]:
    """The critical friction of linear theory, as an attribute: where friction is an axis and nothing else changes it."""
    changes_it = set(scene.structure.parameters) & set(axes)
    # Only the sign of the belt speed matters.
    directions = np.unique(np.sign(axes.get("belt_speed", scene.belt_speed)))
    if "mu" not in axes or changes_it or len(directions) != 1 or directions[0] == 0:
        return {}
    limit = float(critical_friction(scene.structure, direction=int(directions[0])))
    return {"mu_crit": limit} if np.isfinite(limit) else {}


def checked_axes(scene: Scene, axes: dict) -> dict[str, np.ndarray]:
    unknown = [name for name in axes if name not in scene.parameters]
    if unknown:
        hint = " Give the scene a Pulse as its load." if unknown[0] in ("p", "duration", "start") else ""
        hint = hint or arguments.did_you_mean(unknown[0], scene.parameters)
        raise ValueError(f"Unknown axis `{unknown[0]}`; this scene has: {', '.join(sorted(scene.parameters))}.{hint}")
    checked = {name: arguments.axis(name, values) for name, values in axes.items()}
    # Every rule on a parameter is a bound, or an order between two parameters, so it is enough to check the corners of the
    # grid.
    for corner in itertools.product(*((values[0], values[-1]) for values in checked.values())):
        scene.replace(**dict(zip(checked, corner, strict=True)))
    return checked


def checked_grid(axes: dict[str, np.ndarray], states: Sequence[str] = ()) -> Grid:
    """One trajectory for each combination of values on the axes; the axes named in `states` are initial displacements and
    velocities.

    **Raises:** `ValueError` for more trajectories than a map may have.
    """
    total = math.prod(len(values) for values in axes.values())
    if total > MOST_TRAJECTORIES:
        raise ValueError(
            f"The axes ask for {total:.3g} trajectories, whose results no memory holds; the most is "
            f"{MOST_TRAJECTORIES:.0e}. Give fewer values, or make several maps."
        )
    return Grid(axes, states)


def check_run(scene: Scene, method: AbstractStepper, t_max: float | None, memory: float) -> None:
    arguments.instance("scene", scene, Scene, "a Scene")
    arguments.known("scene", scene)
    refuse_vector_contacts(scene.structure, "A map")
    arguments.instance("method", method, AbstractStepper, "a stepper, such as EventExact()")
    if t_max is not None:
        arguments.real_number("t_max", t_max, above=0)
    arguments.real_number("memory", memory, above=0)
    per_contact = ("belt_speed", "restitution") if len(scene.structure.contacts) > 1 else ()
    batched = [name for name, value in scene.parameters.items() if np.shape(value) != () and name not in per_contact]
    if batched:
        raise ValueError(f"Parameter `{batched[0]}` of the scene must be one number; pass its values as an axis.")
