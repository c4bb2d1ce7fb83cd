"""Verdicts on initial states: their names as axes of a map, and trajectories from given states under the final load."""

import numpy as np
from jaxtyping import Float, Int

from ..attractors.known import Attractors
from ..cycles.cycle import under_final_load
from ..model.scene import Scene
from ..model.structure import Structure
from ..steppers.event_exact import EventExact
from .engine import run_to_verdict


def state_places(structure: Structure) -> dict[str, int]:
    """The index in the state of each displacement and, with a `d` in front of its name, of each velocity."""
    names = structure.coordinates
    return {name: k for k, name in enumerate([*names, *(f"d{name}" for name in names)])}


def verdicts_from(
    scene: Scene, states: Float[np.ndarray, "k 2n"], label: str, attractors: dict[bytes, Attractors] | None = None
) -> Int[np.ndarray, " k"]:
    """The verdicts on motions that start in these states (displacements in m, velocities in m/s) under the final load.

    `attractors` as in `run_to_verdict`.
    """
    places = state_places(scene.structure)
    values = {name: np.ascontiguousarray(states[:, place]) for name, place in places.items()}
    return run_to_verdict(
        under_final_load(scene),
        values,
        EventExact(),
        t_max=30.0,
        memory=2e9,
        progress=False,
        label=label,
        states=places,
        attractors=attractors,
    ).verdict
