r"""Cycles with a prescribed sequence of contact modes, as roots of a system that is smooth even where the sequence ends.

A cycle consists of *phases*: in phase $k$ the motion starts at $y_k$ and stays in one contact mode for a time $h_k$, at whose
end one guard is zero (or, in a cycle without events, the tangential velocity rises through zero). With $φ$ the flow of one mode
and $T$ the transition at its end,

$$ T_k(φ_k(y_k, h_k)) = y_{k+1}, \qquad g_k(φ_k(y_k, h_k)) = 0, $$

cyclically, are as many equations as unknowns. The flow of one mode can be continued smoothly where its guards are no longer
positive, and for negative times. So the equations have solutions beyond a grazing, too, where the real motion has other phases,
and the grazing is a simple root, which Newton's method finds to rounding.
"""

from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from .. import contact as physics
from ..contact import Contact, Status
from ..cycles.one_period import PeriodSegments
from ..foundation.carried import depending_on
from ..foundation.compiling import power_of_4
from ..kernels.functions import KernelFunction
from ..model.scene import Scene
from ..section.about_sliding import mechanics_about_sliding
from ..steppers.event_exact import EXACT_STEPPER, for_derivatives
from ..steppers.kernel_scope import has_kernel
from ..steppers.section import section_speed

# A phase ends at a guard of its mode, or at the section.
AT_SECTION = -1
# Instants of each phase at which its guards are evaluated.
LOOKS = 48
# A contact bounces ever less high until it rests. Rebounds shorter than these shares of the period are none to speak of.
SHORTEST_REBOUNDS = (1e-7, 3e-7)


class Mode(NamedTuple):
    """The contact mode of a phase, and the guard that ends it. Guards are those of `contact.guards`: two of the first contact,
    then two of the second, …
    """

    status: tuple[int, ...]  # of each contact
    direction: tuple[float, ...]  # of friction, where a contact slides; else zero
    ending: int  # a guard, or `AT_SECTION`

    def of_guard(self, guard: int) -> tuple[Status, int]:
        """The status of the contact that a guard belongs to, and which of its two guards it is."""
        contact, which = divmod(guard, 2)
        return Status(self.status[contact]), which

    def mode_of(self, contact: int) -> tuple[int, float]:
        """What one of the contacts does."""
        return self.status[contact], self.direction[contact]

    def with_mode_of(self, contact: int, mode: tuple[int, float]) -> "Mode":
        """The mode in which that contact does this instead (see `mode_of`)."""
        status, direction = list(self.status), list(self.direction)
        status[contact], direction[contact] = mode
        return self._replace(status=tuple(status), direction=tuple(direction))

    @property
    def lands(self) -> bool:
        """Whether a gap that closes ends the phase."""
        return self.ending != AT_SECTION and self.of_guard(self.ending)[0] == Status.DETACH

    @property
    def contact(self) -> Contact:
        """As the physics has it: numbers for one contact, arrays for several."""
        return jax.tree.map(lambda rows: rows[0], _contacts([self]))


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
        return any(same_modes(*(one._modes(shortest) for one in (self, other))) for shortest in SHORTEST_REBOUNDS)

    def _modes(self, shortest: float) -> tuple:
        """The modes of what is no such short rebound, each with the guards that end it: those of two contacts, if these end at
        once, but for rounding. Then either may be first.
        """
        found: list[tuple] = []
        for k in self.lasting(shortest):
            status, direction, ending = self.modes[k]
            if found and self.is_at_once(k):
                found[-1] = *found[-1][:2], found[-1][2] | {ending}
            else:
                found.append((status, direction, frozenset({ending})))
        return tuple(found)

    def is_at_once(self, k: int) -> bool:
        """Whether a phase begins and ends by events of two contacts at the same instant, but for rounding."""
        before, ending = self.modes[k - 1].ending, self.modes[k].ending
        return before // 2 != ending // 2 and abs(self.h[k]) <= 1e-9 * self.period

    def lasting(self, shortest: float = SHORTEST_REBOUNDS[0]) -> list[int]:
        """The phases that are no rebounds shorter than this share of the period."""
        limit = shortest * self.period
        return [k for k in range(len(self.h)) if not self._rebound(k) < limit]

    def _rebound(self, k: int) -> float:
        """The duration of the flight at whose end a phase ends, if a landing has begun it: the contact's own, or one that has
        lifted it. Infinite for any other phase.
        """
        modes, begun = self.modes, k - 1
        if not modes[k].lands:
            return np.inf
        contact, ending = modes[k].ending // 2, modes[k].ending
        while (
            begun > k - len(modes) and modes[begun].ending != ending and modes[begun].status[contact] == Status.DETACH
        ):
            begun -= 1
        return float(np.sum(self.h[np.arange(begun + 1, k + 1)])) if modes[begun].lands else np.inf


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
    rebounds: Bool[np.ndarray, " k"]  # whether a landing at the end leaves a velocity away from the belt


def phases_around(segments: PeriodSegments) -> Phases | None:
    """The phases of one period of real motion from a point of the section; None where it is at rest, or where the modes of two
    contacts end at once.
    """
    count = len(segments.h)
    modes, starts, lengths, whole = [], [], [], True
    for k in range(count):
        if whole:
            starts.append(np.asarray(segments.y[k]))
            lengths.append(0.0)
        lengths[-1] += float(segments.h[k])
        whole = bool(np.any(segments.ended[k]))
        if whole:
            ended = np.atleast_2d(segments.ended[k])
            if np.sum(np.any(ended, axis=1)) > 1:
                return None
            modes.append(_mode_in(segments, k, int(np.argmax(ended))))
    if not modes:
        return Phases((_mode_in(segments, 0, AT_SECTION),), np.stack(starts), np.array(lengths)) if count else None
    if not whole:
        # The section cuts the first phase in two.
        starts[0], lengths[0] = starts[-1], lengths[0] + lengths[-1]
        del starts[-1], lengths[-1]
    return Phases(tuple(modes), np.stack(starts), np.array(lengths))


def _mode_in(segments: PeriodSegments, k: int, ending: int) -> Mode:
    status = np.atleast_1d(segments.contact.status[k])
    direction = np.where(status == Status.SLIDE, np.atleast_1d(segments.contact.direction[k]), 0.0)
    return Mode(tuple(status.tolist()), tuple(direction.tolist()), ending)


def same_modes(a: tuple, b: tuple) -> bool:
    """Whether two sequences are the same up to rotation."""
    return len(a) == len(b) and any(a == b[k:] + b[:k] for k in range(len(b)))


def images(scene: Scene, direction: Scene, phases: Phases) -> PhaseImages:
    """Images of all phases, and their derivatives by state and duration and along a direction of the parameters."""
    return images_of_phases(scene, direction, *one_after_another(phases))


def one_after_another(phases: Phases):
    """The modes of all phases, those that follow, states and durations."""
    return phases.modes, phases.modes[1:] + phases.modes[:1], phases.y, phases.h


def images_of_phases(scene: Scene, direction: Scene, modes, following, y, h) -> PhaseImages:
    """`images` of single phases, each with the mode that follows it."""
    (found,) = images_along(scene, [direction], modes, following, y, h)
    return found


def images_along(scene: Scene, directions: Sequence[Scene], modes, following, y, h) -> list[PhaseImages]:
    """The same along each of several directions of the parameters, by one kernel for all of them."""
    by_kernel, count = has_kernel(scene, EXACT_STEPPER), len(modes)
    ends = Ends(_contacts(modes), np.array([mode.ending for mode in modes], np.int32), _contacts(following))
    own = _filled((np.asarray(y, float), np.asarray(h, float), ends), by_kernel)
    size = own[0].shape[1]
    # Directions of the derivatives: those of the state, the duration, the parameters.
    total = size + 1 + len(directions)
    units = np.eye(total)
    none = jax.tree.map(lambda leaf: np.zeros(np.shape(leaf)), directions[0])
    of_parameters = jax.tree.map(lambda *leaves: np.stack(leaves, axis=-1), *[none] * (size + 1), *directions)
    along = of_parameters, units[:size], units[size], None
    found = _image.derived((scene,), along, own=own, by_kernel=by_kernel)
    ((y, guard), _), ((to, of_guard), _) = found
    restitution = np.broadcast_to(np.asarray(scene.restitution), len(modes[0].status))
    rebounds = np.array([restitution[mode.ending // 2] > 0 for mode in modes])

    def of_one(column: int) -> PhaseImages:
        parts = y, guard, to[..., :size], to[..., size], to[..., column]
        parts = *parts, of_guard[:, :size], of_guard[:, size], of_guard[:, column], rebounds
        return PhaseImages(*(part[:count] for part in parts))

    return list(map(of_one, range(size + 1, total)))


class Ends(NamedTuple):
    """The contact mode of a phase, how it ends, and the mode that follows; as arrays."""

    contact: Contact
    ending: Int[np.ndarray, "..."]
    following: Contact


def _contacts(modes: Sequence[Mode]) -> Contact:
    status = np.array([mode.status for mode in modes], np.int32)
    direction = np.array([mode.direction for mode in modes])
    each = np.s_[:, 0] if status.shape[1] == 1 else np.s_[:]
    return Contact(status[each], np.where(direction == 0, 1.0, direction)[each])


def _filled(own, by_kernel: bool):
    """The arrays of all phases; for XLA, which compiles each number of them, filled up to one of few numbers."""
    # The smallest number of phases that is compiled: few cycles have more.
    least = 16
    if by_kernel:
        return own
    count = len(jax.tree.leaves(own)[0])
    fill = np.minimum(np.arange(power_of_4(max(count, least))), count - 1)
    return jax.tree.map(lambda leaf: leaf[fill], own)


def _image_of_phase(args, numbers):
    scene, y, h, ends = args
    del numbers
    mechanics = mechanics_about_sliding(scene)
    contact, none = ends.contact, jnp.zeros((), y.dtype)
    begin = physics.on_constraint(mechanics, contact, y)
    end = physics.on_constraint(
        mechanics, contact, for_derivatives(EXACT_STEPPER).in_one_mode(mechanics, contact, begin, h)
    )
    guards = physics.guards(mechanics, contact, none, end)
    ended = (jnp.arange(guards.size) == ends.ending).reshape(guards.shape)
    guard = jnp.sum(jnp.where(ended, guards, 0.0))
    _, after = physics.transition(mechanics, contact, none, end, ended, none)
    # What follows a landing begins on the belt: a rebound of a microsecond is far lower than what Newton's method misses.
    landed = (contact.status == Status.DETACH) & jnp.any(ended, axis=-1)
    after = after.at[mechanics.normal].set(jnp.where(landed, 0.0, after[mechanics.normal]))
    after = physics.on_constraint(mechanics, ends.following, after)
    # Of several contacts, a sum of velocities is zero on the section: no one of them is.
    velocity = y.shape[0] // 2 + mechanics.tangential
    at_section = end if mechanics.several else end.at[velocity].set(0.0)
    whole = ends.ending == AT_SECTION
    return (jnp.where(whole, at_section, after), jnp.where(whole, -section_speed(mechanics, end), guard)), ()


class Inside(NamedTuple):
    """Guards and states inside phases, at equally spaced instants of each."""

    guards: Float[np.ndarray, "k look guard"]
    states: Float[np.ndarray, "k look state"]


def inside(scene: Scene, phases: Phases) -> Inside:
    """Guards and states along all phases, including both ends of each."""
    by_kernel = has_kernel(scene, EXACT_STEPPER)
    own = _filled((phases.y, phases.h, _contacts(phases.modes)), by_kernel)
    _, rows = _looks((scene,), np.linspace(0.0, 1.0, LOOKS + 1), own=own, by_kernel=by_kernel)
    return Inside(*(part[: len(phases.modes)] for part in rows))


def _inside_of_phase(args, shares):
    scene, y, h, contact = args
    mechanics, none = mechanics_about_sliding(scene), jnp.zeros((), y.dtype)

    def to_next(before, share):
        y, gone = before
        y = EXACT_STEPPER.in_one_mode(mechanics, contact, y, (share - gone) * h)
        return (y, share), Inside(physics.guards(mechanics, contact, none, y).reshape(-1), y)

    return (), jax.lax.scan(to_next, depending_on(mechanics, (y, none)), shares)[1]


# Of (scene, y, h, ends), and of (scene, y, h, contact).
_image, _looks = KernelFunction(_image_of_phase), KernelFunction(_inside_of_phase)
