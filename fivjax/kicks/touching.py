r"""Critical kicks of kind "grazing": the motion just touches another contact mode. And their derivatives.

Where static friction exceeds kinetic friction, a contact that only just comes to rest on the belt sticks, and the friction
force jumps when it slips again. So two motions of which only one touches sticking separate at once. The boundary between such
kicks is not the stable manifold of a saddle, but the kick for which a guard $g$ (slip speed, normal force, gap, margin of the
friction cone) just touches zero,

$$ g(p, t) = 0, \qquad \frac{∂g}{∂t}(p, t) = 0, $$

after a given number of events. The motion in one contact mode can be continued smoothly where its guard is negative, so this is
a simple root, and because $∂g/∂t$ is zero there, $dp/dθ = -g_θ / g_p$. Or the guard is lowest as the kick ends, where the jump
of the load makes a corner in it: then $g(p, t) = 0$ at that instant, which moves with the duration.
"""

from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from .. import contact as physics
from ..contact import Contact, Mechanics
from ..foundation.precision import in_double_precision
from ..kernels.functions import KernelFunction
from ..model.directions import directions_of
from ..model.load import Pulse
from ..model.scene import Scene
from ..section.about_sliding import longest_return, mechanics_about_sliding, slowest_period
from ..section.crossings import MOST_SEGMENTS
from ..steppers.core import Segment, follow
from ..steppers.event_exact import EXACT_STEPPER, for_derivatives
from ..steppers.kernel_scope import has_kernel

# The most events that are compared; and the longest time in which two motions separate, in longest returns to the section.
MOST_EVENTS, MOST_TIME = 1024, 20.0
# Events of two motions are the same if their times differ by no more than this share of the slowest period.
TOGETHER = 1e-2
MOST_ITERATIONS = 20
# Newton's method has converged if its steps in p are below this, relative to p.
EXACT_P = 1e-13


class GrazingKick(NamedTuple):
    """A critical kick of kind "grazing"."""

    p: float
    d_p: dict[str, float]  # by parameter
    trajectories: int  # number that Newton's method took
    time: float  # of the touch, s after the kick began
    events: int  # number of contact events before the touch


class _Events(NamedTuple):
    time: Float[Array, " k"]  # s after the kick began
    status: Int[Array, " k"]  # of its contact before the event
    guard: Int[Array, " k"]  # that ran out, of those of all contacts in a row
    count: Int[Array, ""]


@in_double_precision
def grazing_kick(scene: Scene, bracket: tuple[float, float], names: tuple[str, ...]) -> GrazingKick | None:
    """The kick inside a bracket for which a guard touches zero, if this separates the motions at both ends; else None.

    **Arguments:** `scene`, whose load is a `Pulse`; `bracket`, values of p on either side; `names` of the parameters.
    """
    # The most touches that are tried; and how far below one the next is sought, relative to p.
    most_touches, just_below = 8, 1e-11
    low, high = bracket
    period = float(slowest_period(scene.structure))
    directions = directions_of(scene, ("p", *names))

    def events(p: float) -> _Events:
        found, _ = _to_events((scene.replace(p=p),), by_kernel=has_kernel(scene, EXACT_STEPPER))
        return found

    below, above, found = events(low), events(high), None
    for _ in range(most_touches):
        parting = _parting(below, above, TOGETHER * period)
        if parting is None:
            return found
        touch = _Touch(scene, directions, names, period, (low, high), *parting)
        found = _touched(touch) or _touched_as_the_kick_ends(touch)
        if found is None:
            return None
        # Another oscillation may come closer and touch already at a smaller kick.
        high = found.p * (1 - just_below)
        above = events(high)
    return None


class _Touch(NamedTuple):
    """What may just touch zero: a guard of the first event that only one of the kicks at the ends of a bracket leads to."""

    scene: Scene
    directions: Scene  # by p, then by the parameters
    names: tuple[str, ...]  # of the parameters
    period: float  # the slowest, s
    bracket: tuple[float, float]  # of p
    events: int  # before that event
    time: float  # of the event, s after the kick began
    guard: int

    def of(self, scene: Scene, time: float, with_time: Sequence[float] | None = None):
        """`_guard` of the scene at a time."""
        return _guard(scene, self.directions, time, self.events, self.guard, with_time)

    def is_near(self, p: float) -> bool:
        """Whether a kick is no further outside of the bracket than that is wide."""
        low, high = self.bracket
        return low - (high - low) <= p <= high + (high - low)

    def found(self, p: float, slopes: np.ndarray, taken: int, time: float) -> GrazingKick:
        """The kick, from the guard's derivatives along the directions."""
        by_name = {name: float(-slope / slopes[0]) for name, slope in zip(self.names, slopes[1:], strict=True)}
        return GrazingKick(float(p), by_name, taken, time, self.events)


def _touched(touch: _Touch) -> GrazingKick | None:
    """Newton's method in the kick and the time of the touch."""
    # The same for the time of the touch, relative to the slowest period.
    exact_t = 1e-8
    p, time, apart = touch.bracket[1], touch.time, 1e-4 * touch.period
    for taken in range(1, MOST_ITERATIONS + 1):
        at = touch.scene.replace(p=p)
        value, slope, of_parameters = touch.of(at, time)
        before, after = (touch.of(at, time + side * apart)[1] for side in (-1, 1))
        bend = (after - before) / (2 * apart)
        if not (np.isfinite([value, slope, bend, of_parameters[0]]).all() and bend > 0 and of_parameters[0] != 0):
            return None
        shift = -slope / bend
        step = -(value + 0.5 * slope * shift) / of_parameters[0]
        if not touch.is_near(p + step) or abs(shift) > 0.1 * touch.period:
            return None
        if abs(step) <= EXACT_P * p and abs(shift) <= exact_t * touch.period:
            return touch.found(p, of_parameters, taken, time)
        p, time = p + step, time + shift
    return None


def _touched_as_the_kick_ends(touch: _Touch) -> GrazingKick | None:
    """Newton's method in the kick alone, for a guard that is lowest at the end of the pulse."""
    # So far from the end it is looked at whether the guard falls before and rises behind, relative to the duration.
    beside = 1e-9
    end = float(touch.scene.parameters["duration"])
    if abs(touch.time - end) > TOGETHER * touch.period:
        return None
    with_time = [float(name == "duration") for name in ("p", *touch.names)]
    p = touch.bracket[1]
    for taken in range(1, MOST_ITERATIONS + 1):
        value, _, slopes = touch.of(touch.scene.replace(p=p), end, with_time)
        if not (np.isfinite([value, slopes[0]]).all() and slopes[0] != 0):
            return None
        step = -value / slopes[0]
        if not touch.is_near(p + step):
            return None
        p += step
        if abs(step) <= EXACT_P * p:
            at = touch.scene.replace(p=p)
            before, after = (touch.of(at, end * (1 + side * beside))[1] for side in (-1, 1))
            return touch.found(p, slopes, taken, end) if before < 0 < after else None
    return None


def _parting(a: _Events, b: _Events, together: float) -> tuple[int, float, int] | None:
    """The first event that only one of two motions has: the number of events before it, its time and its guard."""
    for k in range(min(MOST_EVENTS, max(int(a.count), int(b.count)))):
        in_a, in_b = k < a.count, k < b.count
        if in_a and in_b and abs(a.time[k] - b.time[k]) <= together:
            if (a.status[k], a.guard[k]) != (b.status[k], b.guard[k]):
                return None
            continue
        first = a if in_a and not (in_b and b.time[k] < a.time[k]) else b
        return k, float(first.time[k]), int(first.guard[k])
    return None


def _start_of_kick(scene: Scene) -> tuple[Mechanics, Contact, Float[Array, ""], Float[Array, " state"]]:
    load = scene.load
    assert isinstance(load, Pulse)
    mechanics = mechanics_about_sliding(scene)
    # Loads are deviations from the final one.
    more = (load.p - 1.0) * load.force
    y = jnp.zeros(2 * scene.structure.size)
    return mechanics, physics.status_from_forces(mechanics, more, y), more, y


def _find_events(args, _):
    """The events of the motion after the kick."""
    (scene,) = args
    mechanics, contact, more, y = _start_of_kick(scene)

    def stretch(carry, part):
        begin, y, contact, found = carry
        h, load = part

        def observe(found: _Events, segment: Segment):
            ended = segment.after.ended.reshape(-1)
            happened = jnp.any(ended)
            place, first = jnp.where(happened, found.count, MOST_EVENTS), jnp.argmax(ended).astype(jnp.int32)
            return _Events(
                found.time.at[place].set(begin + segment.t + segment.after.h, mode="drop"),
                found.status.at[place].set(segment.contact.status.reshape(-1)[first // 2], mode="drop"),
                found.guard.at[place].set(first, mode="drop"),
                found.count + happened,
            )

        after = follow(
            EXACT_STEPPER,
            mechanics,
            contact,
            load,
            y,
            h,
            total=found,
            observe=observe,
            until=lambda found: found.count >= MOST_EVENTS,
            most=MOST_SEGMENTS,
            kind="lax",
        )
        return (begin + h, after.y, after.contact, after.total), None

    none, zero = jnp.zeros(MOST_EVENTS, jnp.int32), jnp.zeros((), y.dtype)
    nothing = _Events(jnp.full(MOST_EVENTS, jnp.inf), none, none, jnp.zeros((), jnp.int32))
    # In the kick, and after it.
    parts = jnp.stack([jnp.asarray(scene.load.duration, y.dtype), MOST_TIME * longest_return(scene)])
    carry, _ = jax.lax.scan(stretch, (zero, y, contact, nothing), (parts, jnp.stack([more, jnp.zeros_like(more)])))
    return carry[3], ()


_to_events = KernelFunction(_find_events)


def _guard(
    scene: Scene,
    directions: Scene,
    time: float,
    events: int,
    guard: int,
    with_time: Sequence[float] | None = None,
):
    """A guard at a time after `events` events, its time derivative, and its derivatives along directions of the parameters, in
    which the time changes by `with_time`.
    """
    args = scene, np.asarray(time), np.int32(events), np.int32(guard)
    count = len(jax.tree.leaves(directions)[0])
    moves = np.zeros(count) if with_time is None else np.asarray(with_time)
    # By time, then along the directions.
    along = jax.tree.map(
        lambda leaf: np.moveaxis(np.pad(leaf, [(1, 0)] + [(0, 0)] * (leaf.ndim - 1)), 0, -1), directions
    )
    moving = along, np.append(1.0, moves), None, None
    by_kernel = has_kernel(scene, EXACT_STEPPER)
    (value, _), (slopes, _) = _to_guard.derived(args, moving, by_kernel=by_kernel)
    return float(value), float(slopes[0]), slopes[1:]


def _find_guard(args, _):
    scene, time, events, guard = args
    (mechanics, contact, more, y), stepper = _start_of_kick(scene), for_derivatives(EXACT_STEPPER)
    duration, happened = scene.load.duration, jnp.zeros((), jnp.int32)

    def stretch(carry, part):
        y, contact, happened = carry
        h, load = part
        after = follow(
            stepper,
            mechanics,
            contact,
            load,
            y,
            h,
            total=happened,
            observe=lambda total, segment: total + jnp.any(segment.after.ended),
            until=lambda total: total >= events,
            most=MOST_SEGMENTS,
            kind="lax",
        )
        # After the last event the motion goes on in this mode, regardless of its guards.
        y = stepper.in_one_mode(mechanics, after.contact, after.y, after.left, load)
        return (y, after.contact, after.total), None

    in_kick, none = jnp.minimum(time, duration), jnp.zeros_like(more)
    parts = jnp.stack([in_kick, time - in_kick]), jnp.stack([more, none])
    (y, contact, _), _ = jax.lax.scan(stretch, (y, contact, happened), parts)
    guards = physics.guards(mechanics, contact, jnp.where(time < duration, more, none), y)
    return guards.reshape(-1)[guard], ()


_to_guard = KernelFunction(_find_guard)
