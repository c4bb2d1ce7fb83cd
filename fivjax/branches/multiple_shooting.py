r"""Cycles with a prescribed sequence of contact modes, as roots of a system that is smooth even where the sequence ends.

A cycle consists of *phases*: in phase $k$ the motion starts at $y_k$ and stays in one contact mode for a time $h_k$, at whose
end one guard is zero (or, in a cycle without events, the tangential velocity rises through zero). With $φ$ the flow of one mode
and $T$ the transition at its end,

$$ T_k(φ_k(y_k, h_k)) = y_{k+1}, \qquad g_k(φ_k(y_k, h_k)) = 0, $$

cyclically, are as many equations as unknowns. The flow of one mode can be continued smoothly where its guards are no longer
positive, and for negative times. So the equations have solutions beyond a grazing, too, where the real motion has other phases,
and the grazing is a simple root, which Newton's method finds to rounding.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from .. import contact as physics
from ..contact import Contact, Status
from ..cycles.one_period import PeriodSegments
from ..foundation.carried import depending_on
from ..foundation.compiling import power_of_4
from ..kernels.functions import KernelFunction
from ..model.scene import Scene
from ..section.about_sliding import mechanics_about_sliding
from ..section.crossings import ByMethod
from ..steppers.event_exact import EventExact, for_derivatives
from ..steppers.kernel_scope import has_kernel

# A phase ends at one of the two guards of its mode (0 or 1), or at the section.
AT_SECTION = 2
# Instants of each phase at which its guards are evaluated.
LOOKS = 48
# A contact bounces ever less high until it rests. Rebounds shorter than these shares of the period are none to speak of.
SHORTEST_REBOUNDS = (1e-7, 3e-7)


class Mode(NamedTuple):
    """The contact mode of a phase, and the guard that ends it."""

    status: int
    direction: float  # of friction, if it slides; else zero
    ending: int  # 0 or 1, a guard of the mode (`contact.guards`), or `AT_SECTION`


class Phases(NamedTuple):
    """A cycle, or a guess of one: mode, first state and duration of each phase. States are deviations from sliding."""

    modes: tuple[Mode, ...]
    y: Float[np.ndarray, "k state"]
    h: Float[np.ndarray, " k"]  # s

    @property
    def period(self) -> float:
        """The sum of the durations, in s."""
        return float(np.sum(self.h))

    def size(self, weights: Float[np.ndarray, " state"]) -> float:
        """The largest weighted deviation at which a phase begins."""
        return float(np.max(np.linalg.norm(weights * self.y, axis=-1)))

    def has_the_modes_of(self, other: "Phases") -> bool:
        """Whether both go through the same modes, but for the last rebounds of a chain, of which rounding tells the number."""
        # A rebound may be as long as one of these limits, but not as long as both.
        return any(
            same_modes(*(tuple(one.modes[k] for k in one.lasting(shortest)) for one in (self, other)))
            for shortest in SHORTEST_REBOUNDS
        )

    def lasting(self, shortest: float = SHORTEST_REBOUNDS[0]) -> list[int]:
        """The phases that are no rebounds shorter than this share of the period."""
        flies = [mode.status == Status.DETACH for mode in self.modes]
        least = shortest * self.period
        return [k for k, h in enumerate(self.h) if not (flies[k] and flies[k - 1] and h < least)]


class PhaseImages(NamedTuple):
    """The state after each phase, the guard that ends it, and their derivatives."""

    y: Float[np.ndarray, "k state"]  # the start of the next one
    guard: Float[np.ndarray, " k"]
    y_y: Float[np.ndarray, "k state state"]
    y_h: Float[np.ndarray, "k state"]
    y_parameter: Float[np.ndarray, "k state"]
    guard_y: Float[np.ndarray, "k state"]
    guard_h: Float[np.ndarray, " k"]
    guard_parameter: Float[np.ndarray, " k"]


def phases_around(segments: PeriodSegments) -> Phases | None:
    """The phases of one period of real motion from a point of the section; None where it is at rest."""
    count = len(segments.h)
    modes, starts, lengths, whole = [], [], [], True
    for k in range(count):
        status = int(segments.contact.status[k])
        direction = float(segments.contact.direction[k]) if status == Status.SLIDE else 0.0
        if whole:
            starts.append(np.asarray(segments.y[k]))
            lengths.append(0.0)
        lengths[-1] += float(segments.h[k])
        whole = bool(np.any(segments.ended[k]))
        if whole:
            ending = int(np.argmax(segments.ended[k])) if status != Status.DETACH else 0
            modes.append(Mode(status, direction, ending))
    if not modes:
        if not count:
            return None
        status = int(segments.contact.status[0])
        direction = float(segments.contact.direction[0]) if status == Status.SLIDE else 0.0
        return Phases((Mode(status, direction, AT_SECTION),), np.stack(starts), np.array(lengths))
    if not whole:
        # The section cuts the first phase in two.
        starts[0], lengths[0] = starts[-1], lengths[0] + lengths[-1]
        del starts[-1], lengths[-1]
    return Phases(tuple(modes), np.stack(starts), np.array(lengths))


def same_modes(a: tuple[Mode, ...], b: tuple[Mode, ...]) -> bool:
    """Whether two sequences are the same up to rotation."""
    return len(a) == len(b) and any(a == b[k:] + b[:k] for k in range(len(b)))


def images(scene: Scene, direction: Scene, stepper: EventExact, phases: Phases) -> PhaseImages:
    """Images of all phases, and their derivatives by state and duration and along a direction of the parameters."""
    modes = phases.modes
    following = modes[1:] + modes[:1]
    return images_of_phases(scene, direction, stepper, modes, following, phases.y, phases.h)


def images_of_phases(scene: Scene, direction: Scene, stepper: EventExact, modes, following, y, h) -> PhaseImages:
    """`images` of single phases, each with the mode that follows it."""
    by_kernel, count = has_kernel(scene, stepper), len(modes)
    ends = Ends(*_typed(modes), *_typed(following)[:2])
    own = _filled((np.asarray(y, float), np.asarray(h, float), ends), by_kernel)
    size = own[0].shape[1]
    # Directions of the derivatives: those of the state, the duration, the parameter.
    args = ByMethod(stepper), scene
    still = jax.tree.map(lambda leaf: np.zeros((*np.shape(leaf), size + 2)), (*args, *_first(own)))
    of_parameter = jax.tree.map(lambda leaf: np.asarray(leaf, float)[..., None] * np.eye(size + 2)[-1], direction)
    units = np.eye(size + 2)
    directions = still[0], of_parameter, units[:size], units[size], still[4]
    found = _image.derived(args, directions, own=own, by_kernel=by_kernel)
    ((y, guard), _), ((to, of_guard), _) = found
    parts = y, guard, to[..., :size], to[..., size], to[..., size + 1]
    return PhaseImages(
        *(part[:count] for part in (*parts, of_guard[:, :size], of_guard[:, size], of_guard[:, size + 1]))
    )


class Ends(NamedTuple):
    """The contact mode of a phase, how it ends, and the mode that follows; as arrays."""

    status: Int[np.ndarray, "..."]
    pointing: Float[np.ndarray, "..."]
    ending: Int[np.ndarray, "..."]
    next_status: Int[np.ndarray, "..."]
    next_pointing: Float[np.ndarray, "..."]


def _typed(modes) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    status, direction, ending = np.array(modes, float).T
    return status.astype(np.int32), direction, ending.astype(np.int32)


def _filled(own, by_kernel: bool):
    """The arrays of all phases; for XLA, which compiles each number of them, filled up to one of few numbers."""
    # The smallest number of phases that is compiled: few cycles have more.
    least = 16
    if by_kernel:
        return own
    count = len(jax.tree.leaves(own)[0])
    fill = np.minimum(np.arange(power_of_4(max(count, least))), count - 1)
    return jax.tree.map(lambda leaf: leaf[fill], own)


def _first(own):
    return jax.tree.map(lambda leaf: leaf[0], own)


def _image_of_phase(args, numbers):
    how, scene, y, h, ends = args
    del numbers
    mechanics = mechanics_about_sliding(scene)
    stepper = for_derivatives(how.method)
    contact, following = Contact(ends.status, ends.pointing), Contact(ends.next_status, ends.next_pointing)
    n, none = y.shape[0] // 2, jnp.zeros((), y.dtype)
    begin = physics.on_constraint(mechanics, contact, y)
    end = physics.on_constraint(mechanics, contact, stepper.in_one_mode(mechanics, contact, begin, h))
    velocity = n + mechanics.tangential
    guards = jnp.append(physics.guards(mechanics, contact, none, end), -end[velocity])
    ended = jnp.arange(2) == ends.ending
    _, after = physics.transition(mechanics, contact, none, end, ended, none)
    # What follows a landing begins on the belt: a rebound of a microsecond is far lower than what Newton's method misses.
    after = jnp.where(ends.status == Status.DETACH, after.at[mechanics.normal].set(0.0), after)
    after = jnp.where(
        ends.ending == AT_SECTION, end.at[velocity].set(0.0), physics.on_constraint(mechanics, following, after)
    )
    return (after, jnp.sum(jnp.where(jnp.arange(3) == ends.ending, guards, 0.0))), ()


class Inside(NamedTuple):
    """Guards and states inside phases, at equally spaced instants of each."""

    guards: Float[np.ndarray, "k look 2"]
    states: Float[np.ndarray, "k look state"]


def inside(scene: Scene, stepper: EventExact, phases: Phases) -> Inside:
    """Guards and states along all phases, including both ends of each."""
    by_kernel, (status, direction, _) = has_kernel(scene, stepper), _typed(phases.modes)
    own = _filled((phases.y, phases.h, status, direction), by_kernel)
    _, rows = _looks((ByMethod(stepper), scene), np.linspace(0.0, 1.0, LOOKS + 1), own=own, by_kernel=by_kernel)
    return Inside(*(part[: len(phases.modes)] for part in rows))


def _inside_of_phase(args, shares):
    how, scene, y, h, status, direction = args
    mechanics, contact = mechanics_about_sliding(scene), Contact(status, direction)
    none = jnp.zeros((), y.dtype)

    def to_next(before, share):
        y, gone = before
        y = how.method.in_one_mode(mechanics, contact, y, (share - gone) * h)
        return (y, share), Inside(physics.guards(mechanics, contact, none, y), y)

    return (), jax.lax.scan(to_next, depending_on(mechanics, (y, none)), shares)[1]


# Of (how, scene, y, h, ends), and of (how, scene, y, h, status, direction).
_image, _looks = KernelFunction(_image_of_phase), KernelFunction(_inside_of_phase)
