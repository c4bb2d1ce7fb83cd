"""The motion after a kick: its crossings of the section, and their derivatives in the parameters of the scene."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from .. import contact as physics
from ..contact import Contact
from ..foundation.compiling import compiled
from ..model.load import Pulse
from ..model.scene import Scene
from ..steppers.core import Segment, follow
from ..steppers.event_exact import EventExact, for_derivatives
from .multiple_shooting import parameter_direction
from .section_map import MOST_SEGMENTS, Point, longest_return, mechanics_about_sliding

# The most crossings of the section that are kept.
MOST_CROSSINGS = 1024


class Crossings(NamedTuple):
    """The crossings of the section after a kick, in order; rows beyond `count` are empty."""

    y: Float[np.ndarray, "k state"]  # deviations from sliding
    y_parameter: Float[np.ndarray, "d k state"]  # their derivatives along directions of the parameters
    status: Int[np.ndarray, " k"]
    direction: Float[np.ndarray, " k"]
    events: Int[np.ndarray, " k"]  # contact events up to the crossing
    count: int


class _Record(NamedTuple):
    y: Float[Array, "k state"]
    contact: Contact
    events: Int[Array, " k"]
    count: Int[Array, ""]
    happened: Int[Array, ""]


def directions_of(scene: Scene, names: tuple[str, ...]) -> Scene:
    """The scene's derivatives by several of its parameters, stacked along a first axis."""
    each = [parameter_direction(scene, name) for name in names]
    return jax.tree.map(lambda *leaves: np.stack([np.asarray(leaf) for leaf in leaves]), *each)


def kicked(scene: Scene, stepper: EventExact, directions: Scene, crossings: int, *, rough: bool = False) -> Crossings:
    """Crossings after the kick of the scene's load, from steady sliding; as many as asked for, if there are so many.

    With `rough`, derivatives take a third of the time and are only good enough for Newton's method, which corrects itself.
    """
    start = Point(jnp.zeros(2 * scene.structure.size), Contact(jnp.asarray(1, jnp.int32), jnp.sign(scene.belt_speed)))
    return _followed(scene, stepper, directions, start, None, crossings, rough)


def returned(scene: Scene, stepper: EventExact, directions: Scene, point: Point, crossings: int) -> Crossings:
    """Crossings of the motion from a point of the section, without a kick."""
    quiet = scene.replace(p=1.0, duration=0.0)
    return _followed(quiet, stepper, directions, point, None, crossings)


def started(
    scene: Scene, stepper: EventExact, start: Point, directions: Float[np.ndarray, "d state"], crossings: int
) -> Crossings:
    """Crossings of the motion from any state, without a kick, with derivatives along directions of that state."""
    quiet = scene.replace(p=1.0, duration=0.0)
    fixed = jax.tree.map(lambda leaf: np.zeros((len(directions), *np.shape(leaf))), quiet)
    return _followed(quiet, stepper, fixed, start, directions, crossings)


def _followed(
    scene: Scene, stepper: EventExact, directions: Scene, start: Point, of_start, crossings: int, rough: bool = False
) -> Crossings:
    if of_start is None:
        count = len(jax.tree.leaves(directions)[0])
        of_start = np.zeros((count, start.y.shape[0]))
    wanted = jnp.asarray(crossings, jnp.int32)
    return _cut(_kicked(scene, stepper, directions, start, jnp.asarray(of_start), wanted, MOST_CROSSINGS, rough))


def _cut(found) -> Crossings:
    y, y_parameter, status, direction, events, count = (np.asarray(part) for part in found)
    return Crossings(y, y_parameter, status, direction, events, int(count))


@compiled
def _kicked(
    scene: Scene, stepper: EventExact, directions: Scene, start: Point, of_start, crossings, most: int, rough: bool
):
    def of(scene: Scene, y: Float[Array, " state"]) -> tuple[Float[Array, "k state"], _Record]:
        load = scene.load
        assert isinstance(load, Pulse)
        mechanics = mechanics_about_sliding(scene)
        short = stepper if rough else for_derivatives(stepper, mechanics)
        # Loads are deviations from the final load.
        more = (load.p - 1.0) * load.force
        begin = physics.status_from_forces(mechanics, more, y)
        quiet = load.duration <= 0
        begin = jax.tree.map(lambda a, b: jnp.where(quiet, a, b), start.contact, begin)
        after = follow(short, mechanics, begin, more, y, load.duration, most=64 * MOST_SEGMENTS, kind="lax")
        empty = _Record(
            jnp.full((most, len(y)), jnp.nan),
            Contact(jnp.zeros(most, jnp.int32), jnp.ones(most)),
            jnp.zeros(most, jnp.int32),
            jnp.zeros((), jnp.int32),
            jnp.zeros((), jnp.int32),
        )
        found = follow(
            short,
            mechanics,
            after.contact,
            jnp.zeros_like(more),
            after.y,
            longest_return(scene) * crossings,
            total=empty,
            observe=_recorded,
            until=lambda total: total.count >= crossings,
            at_section=True,
            most=64 * MOST_SEGMENTS,
            kind="lax",
        ).total
        return found.y, found

    def along(direction: Scene, of_start: Float[Array, " state"]):
        _, tangent, found = jax.jvp(of, (scene, start.y), (direction, of_start), has_aux=True)
        return tangent, found

    tangents, found = jax.vmap(along, out_axes=(0, None))(directions, of_start)
    return found.y, tangents, found.contact.status, found.contact.direction, found.events, found.count


def _recorded(total: _Record, segment: Segment) -> _Record:
    after = segment.after
    crossed: Bool[Array, ""] = after.rise.happened
    happened = total.happened + jnp.any(after.ended)
    # An index beyond the end drops what is written.
    place = jnp.where(crossed, total.count, len(total.events))
    return _Record(
        total.y.at[place].set(after.y, mode="drop"),
        Contact(
            total.contact.status.at[place].set(after.contact.status, mode="drop"),
            total.contact.direction.at[place].set(after.contact.direction, mode="drop"),
        ),
        total.events.at[place].set(happened, mode="drop"),
        total.count + crossed,
        happened,
    )
