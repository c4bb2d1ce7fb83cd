"""Cycles and maps of structures with contacts given by vectors: computed in contact coordinates, given in the structure's own.

Everything about contact is computed where the contacts' directions are coordinates (`model.contact_coordinates`). What a user
gives and gets, such as the state of a cycle on the section, is in the coordinates of the user's structure.
"""

import dataclasses
import functools
import inspect
import json
from collections.abc import Callable
from typing import Any, ParamSpec, TypeVar

import equinox as eqx
import numpy as np

from ..foundation import arguments
from ..foundation.precision import in_double_precision
from ..io.datasets import about
from ..model.contact_coordinates import from_contact_coordinates, to_contact_coordinates, transformation
from ..model.contact_point import directions
from ..model.description import describe
from ..model.scene import Scene, scene_in_contact_coordinates
from ..section.free_directions import snapped_to_section
from ..simulation.start import start_in_contact_coordinates
from ..simulation.trajectory import Trajectory
from .cycle import LimitCycle, under_final_load

P = ParamSpec("P")
R = TypeVar("R")


def in_own_coordinates(function: Callable[P, R]) -> Callable[P, R]:
    """A function of a scene, and perhaps of a `start`, `starts` or a `cycle`, that needs contacts at coordinates: for contacts
    given by vectors, too.
    """
    call: Callable = function
    names = list(inspect.signature(function).parameters)

    @functools.wraps(function)
    def wrapped(*args: P.args, **kwargs: P.kwargs) -> R:
        given: dict[str, Any] = dict(zip(names, args, strict=False)) | dict(kwargs)
        scene, own = given.get("scene"), {"start", "cycle"} & set(names) & given.keys()
        if isinstance(scene, Scene):
            for name in own:
                _refuse_other_contacts(name, given[name], scene)
        if not isinstance(scene, Scene) or scene.structure.contacts_at_coordinates:
            return function(*args, **kwargs)
        for name in own:
            given[name] = _inside(scene, given[name], name)
        # Anything else is refused by the function.
        if "starts" in names and arguments.is_listed(given.get("starts")):
            given["starts"] = [_inside(scene, one, f"starts[{number}]") for number, one in enumerate(given["starts"])]
        given["scene"] = in_double_precision(scene_in_contact_coordinates)(scene)
        return _outside(scene, call(**given))

    return wrapped


def cycle_in_contact_coordinates(cycle: LimitCycle) -> LimitCycle:
    """The same cycle in contact coordinates; itself, if its scene has them already."""
    structure = cycle.scene.structure
    if structure.contacts_at_coordinates:
        return cycle
    turned = functools.partial(to_contact_coordinates, structure)
    own = _turned(cycle, scene_in_contact_coordinates(cycle.scene), turned, np.linalg.inv(transformation(structure)[0]))
    first = snapped_to_section(own.scene, np.asarray(own.points[0]), cycle.contact)
    return dataclasses.replace(own, points=np.concatenate([first[None], own.points[1:]]))


def cycle_in_own_coordinates(scene: Scene, cycle: LimitCycle) -> LimitCycle:
    """A cycle that was computed in contact coordinates, in those of the scene."""
    if scene.structure.contacts_at_coordinates:
        return cycle
    turned = functools.partial(from_contact_coordinates, scene.structure)
    return _turned(cycle, under_final_load(scene), turned, transformation(scene.structure)[0])


def _turned(cycle: LimitCycle, scene: Scene, turned: Callable, matrix: np.ndarray) -> LimitCycle:
    twice = np.kron(np.eye(2), matrix)
    return dataclasses.replace(
        cycle,
        scene=scene,
        state=turned(cycle.state),
        points=turned(cycle.points),
        harmonics=cycle.harmonics @ matrix.T,
        return_jacobian=twice @ cycle.return_jacobian @ np.linalg.inv(twice),
    )


def _refuse_other_contacts(name: str, start, scene: Scene) -> None:
    """Refuse a cycle whose contacts lie elsewhere: its coordinates are others, too."""
    if not isinstance(start, LimitCycle) or start.scene.structure.size != scene.structure.size:
        return
    one, other = (np.array(directions(own.structure.contacts, own.structure.size)) for own in (start.scene, scene))
    # Those of neighbours may differ a little.
    if one.shape != other.shape or np.max(np.abs(one - other)) > 0.1 * np.max(np.abs(other)):
        raise ValueError(
            f"Argument `{name}` must be a cycle whose contacts are the coordinates or vectors of those of `scene`: in other "
            "coordinates its states are others. Compute one of this scene by `fivjax.limit_cycle(scene)`."
        )


@in_double_precision
def _inside(scene: Scene, start, name: str):
    if isinstance(start, LimitCycle):
        return cycle_in_contact_coordinates(start)
    if start is None:
        return None
    if isinstance(start, Trajectory):
        start.refuse_batch("A start")
        start = np.concatenate([np.asarray(start.displacement)[-1], np.asarray(start.velocity)[-1]])
    if isinstance(start, tuple | list) and len(start) == 2:
        state, status = start
        return np.asarray(start_in_contact_coordinates(scene, state, name)), status
    return np.asarray(start_in_contact_coordinates(scene, start, name))


@in_double_precision
def _outside(scene: Scene, found) -> Any:
    if isinstance(found, LimitCycle):
        return cycle_in_own_coordinates(scene, found)
    if isinstance(found, list):
        return [_outside(scene, one) for one in found]
    if hasattr(found, "attrs"):
        return _dataset_outside(scene, found)
    turned = functools.partial(from_contact_coordinates, scene.structure)
    if hasattr(found, "in_scene"):
        return found.in_scene(scene, turned)
    # A cycle nearby has a state; what else there is has no coordinates.
    if isinstance(found, eqx.Module) and hasattr(found, "state"):
        return dataclasses.replace(found, state=turned(found.state))  # pyrefly: ignore[unexpected-keyword]
    return found


def _dataset_outside(scene: Scene, dataset):
    """A dataset with the user's scene; and with states of cycles in its coordinates."""
    if "scene" in dataset.attrs:
        dataset.attrs["scene"] = json.dumps(describe(scene))
        dataset.attrs["about"] = about(scene, json.loads(dataset.attrs["settings"]))
    if "state" in dataset.variables and dataset["state"].dims == ("point", "coordinate"):
        names = scene.structure.coordinates
        dataset["state"] = (dataset["state"].dims, from_contact_coordinates(scene.structure, dataset["state"].values))
        dataset = dataset.assign_coords(coordinate=[*names, *(f"d{name}" for name in names)])
    return dataset
