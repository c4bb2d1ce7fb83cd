"""The system of a linear analysis: a scene, or a structure under constant friction; and the axes of its parameters."""

import numpy as np

from ..foundation import arguments
from ..foundation.precision import is_known
from ..model.friction import Coulomb
from ..model.load import ConstantLoad
from ..model.scene import Scene, check_corners, scene_in_contact_coordinates
from ..model.structure import Structure


def checked_direction(direction) -> int:
    """The direction of the belt, which is +1 or -1."""
    if np.ndim(direction) or direction not in (1, -1):
        raise ValueError(f"Argument `direction` must be 1 or -1, but is {direction!r}.")
    return 1 if direction == 1 else -1


def as_scene(system: Structure | Scene, mu, direction: int) -> Scene:
    """The scene to analyse: the given one, or a structure under constant friction.

    A structure gets no load: its linear motion with constant friction is the same under any load.
    """
    arguments.instance("system", system, (Structure, Scene), "a Structure or a Scene")
    direction = checked_direction(direction)
    if isinstance(system, Structure):
        if mu is None:
            raise ValueError("Argument `mu` must be given with a structure; a scene carries its own friction.")
        return _with_coordinates(Scene(system, Coulomb(mu), belt_speed=float(direction), load=ConstantLoad(0.0)))
    if mu is not None:
        raise ValueError("Argument `mu` must not be given with a scene; use `scene.replace(mu=...)`.")
    if direction != 1:
        raise ValueError("Argument `direction` must not be given with a scene: the sign of its belt speed says it.")
    if is_known(system.belt_speed) and np.any(np.asarray(system.belt_speed) == 0):
        raise ValueError("Argument `belt_speed` must not be zero: nothing slides steadily on a belt at rest.")
    return _with_coordinates(system)


def _with_coordinates(scene: Scene) -> Scene:
    """The scene with the directions of its contact as coordinates; of several contacts, as it is."""
    return scene_in_contact_coordinates(scene) if len(scene.structure.contacts) == 1 else scene


def with_axes(
    system: Structure | Scene, direction: int, parameters: dict, *, count: int
) -> tuple[Scene, dict[str, np.ndarray]]:
    """The scene with the single numbers set, and the checked axes, `count` of them."""
    arguments.instance("system", system, (Structure, Scene), "a Structure or a Scene")
    for name, value in {"system": system, **parameters}.items():
        arguments.known(name, value)
    if isinstance(system, Structure):
        if "mu" not in parameters:
            raise ValueError("Argument `mu` must be given with a structure, as a number or an axis.")
        scene = as_scene(system, 0.0, direction)
        known = ["mu", *system.parameters]
    else:
        scene = as_scene(system, None, direction)
        known = sorted(scene.parameters)
    # Names of an array are NumPy's own, which JAX takes for arrays.
    parameters = {str(name): value for name, value in parameters.items()}
    unknown = [name for name in parameters if name not in known]
    if unknown:
        near = arguments.did_you_mean(unknown[0], known)
        raise ValueError(f"Unknown parameter `{unknown[0]}`; this system has: {', '.join(known)}.{near}")
    axes = {name: arguments.axis(name, values) for name, values in parameters.items() if np.ndim(values) > 0}
    if len(axes) != count:
        wanted = "one axis, such as `mu=np.linspace(0, 0.5, 501)`" if count == 1 else "two axes"
        given = ", ".join(axes) or "none"
        raise ValueError(f"Give exactly {wanted}, as arrays; here the axes are: {given}.")
    scene = scene.replace(**{name: value for name, value in parameters.items() if name not in axes})
    check_corners(scene, axes)
    for name, values in axes.items():
        if _unseen(scene, name, values):
            raise ValueError(
                f"Axis `{name}` changes nothing in linear theory, which looks at steady sliding under the load's final value: "
                f"no kick and no impact. Follow another parameter, or make a map over `{name}` by `bistability_map`."
            )
    return scene, axes


def _unseen(scene: Scene, name: str, values: np.ndarray) -> bool:
    """Whether a parameter is of impacts, or of the load without changing its final value."""
    if name == "restitution":
        return True
    if name in scene.structure.parameters or name not in vars(scene.load):
        return False
    ends = [float(scene.replace(**{name: value}).load.final) for value in (values[0], values[-1])]
    return len(values) > 1 and ends[0] == ends[1]
