"""The motion after a kick: its crossings of the section, and their derivatives in the parameters of the scene."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from .. import contact as physics
from ..contact import Contact
from ..foundation.precision import known_to_numpy
from ..kernels.functions import KernelFunction
from ..model.load import Pulse
from ..model.scene import Scene
from ..model.sliding import contact_coordinates
from ..section.about_sliding import longest_return, mechanics_about_sliding
from ..section.crossings import Kick, Point, to_crossing
from ..steppers.event_exact import EXACT_STEPPER, for_derivatives
from ..steppers.kernel_scope import has_kernel

# The most crossings of the section that are kept.
MOST_CROSSINGS = 1024


class Crossings(NamedTuple):
    """The crossings of the section after a kick, in order; rows beyond `count` are empty."""

    y: Float[np.ndarray, "k state"]  # deviations from sliding
    y_parameter: Float[np.ndarray, "d k state"]  # their derivatives along directions of the parameters
    status: Int[np.ndarray, "k *contacts"]
    direction: Float[np.ndarray, "k *contacts"]
    events: Int[np.ndarray, " k"]  # contact events up to the crossing
    count: int


def kicked(scene: Scene, directions: Scene, crossings: int) -> Crossings:
    """Crossings after the kick of the scene's load, from steady sliding; as many as asked for, if there are so many."""
    each = np.shape(contact_coordinates(scene.structure)[0])
    direction = np.broadcast_to(np.sign(np.asarray(scene.belt_speed, float)), each)
    start = Point(np.zeros(2 * scene.structure.size), Contact.sliding(direction))
    return _followed(scene, start, (_last(directions), None), crossings)


def returned(scene: Scene, directions: Scene, point: Point, crossings: int) -> Crossings:
    """Crossings of the motion from a point of the section, without a kick."""
    quiet = scene.replace(p=1.0, duration=0.0)
    return _followed(quiet, point, (_last(directions), None), crossings)


def started(scene: Scene, start: Point, directions: Float[np.ndarray, "d state"], crossings: int) -> Crossings:
    """Crossings of the motion from any state, without a kick, with derivatives along directions of that state."""
    quiet = scene.replace(p=1.0, duration=0.0)
    return _followed(quiet, start, (None, Point(directions.T, None)), crossings)


def _followed(scene: Scene, start: Point, along: tuple, crossings: int) -> Crossings:
    """`along`: directions of the scene and of the start."""
    by_kernel, wanted = has_kernel(scene, EXACT_STEPPER), crossings
    if not by_kernel:
        # XLA compiles a program for each number of rows.
        wanted = MOST_CROSSINGS
    args = scene, jax.tree.map(known_to_numpy, start), np.int32(crossings)
    (end, rows), (_, slopes) = _motion_after_kick.derived(
        args, (*along, None), np.arange(1.0, wanted + 1), by_kernel=by_kernel
    )
    at, contact = rows.point, rows.point.contact
    return Crossings(
        at.y, np.moveaxis(slopes.point.y, -1, 0), contact.status, contact.direction, rows.events, int(end.crossed)
    )


def _last(directions: Scene) -> Scene:
    """The directions along the last axis."""
    return jax.tree.map(lambda leaf: np.moveaxis(np.asarray(leaf, float), 0, -1), directions)


def _after_kick(args, numbers, method=EXACT_STEPPER):
    scene, start, crossings = args
    load = scene.load
    assert isinstance(load, Pulse)
    mechanics = mechanics_about_sliding(scene)
    # Loads are deviations from the final load.
    more = (load.p - 1.0) * load.force
    contact = physics.status_from_forces(mechanics, more, start.y)
    quiet = load.duration <= 0
    contact = jax.tree.map(lambda own, other: jnp.where(quiet, own, other), start.contact, contact)
    longest = longest_return(scene) * crossings
    kick, start = Kick(more, load.duration), Point(start.y, contact)
    return to_crossing(method, mechanics, start, crossings, longest, numbers, kick)


def _derived_after_kick(args, numbers):
    return _after_kick(args, numbers, for_derivatives(EXACT_STEPPER))


# Of (scene, start, crossings).
_motion_after_kick = KernelFunction(_after_kick, _derived_after_kick)
