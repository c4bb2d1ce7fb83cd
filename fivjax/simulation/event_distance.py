r"""How close a trajectory comes to another sequence of contact events.

At an event a guard $g$ crosses zero with slope $\dot g$; without the event it would turn back at a depth of
$\dot g^2 / (2 |\ddot g|)$ (to second order). Between events a guard may fall to a smallest positive value and rise again. Both
values, relative to the largest size of that guard on the trajectory, say how far the event is from vanishing, or a new one from
appearing. Two events close to each other, or one close to a jump of the load or to the end, may swap their order; and at an
impact, or where a contact comes to rest, the force or impulse may be close to the edge of the friction cone. These distances
are measured, too.

With several contacts, an event of one acts at once on those that the mass matrix couples with it: their order matters, and an
event of one may leave another's guard close to zero. Events of contacts that only springs and dampers couple may coincide: in
either order the motion after them is the same to first order.

Flights that impacts begin follow on one another, ever shorter: the rebounds of one contact, or of two that the mass matrix
couples and that kick each other up. What changes one changes those after it in proportion, so each is measured by its own
largest gap.

At the start a force may be close to where another mode begins. A slip that is zero there stays zero, unless a parameter changes
it: then a contact that slides has a derivative on one side only, and one that sticks must be held by the friction of sliding.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from .. import contact as physics
from ..contact import Contact, Mechanics, Status
from ..foundation.carried import depending_on
from ..foundation.numpy_evaluation import by_numpy
from ..kernels.functions import KernelFunction
from ..model.scene import Scene
from ..steppers.base import AbstractStepper
from ..steppers.kernel_scope import has_kernel
from .event_margins import (
    DECISIONS,
    DECISIONS_OF_SEVERAL,
    LOOKS,
    AdvanceMargins,
    advance_margins,
    held_by_sliding,
    margin_from_cone,
)

GUARDS = {
    (Status.STICK, 0): "the friction force reaching one edge of the friction cone",
    (Status.STICK, 1): "the friction force reaching the other edge of the friction cone",
    (Status.SLIDE, 0): "the contact losing its normal force",
    (Status.SLIDE, 1): "the slip running out",
    (Status.DETACH, 0): "the gap closing",
}
OF_START = (
    "a slip that starts at zero, which a parameter changes",
    "a start that sticks, whose slip a parameter changes, at the edge of the friction cone of sliding",
    "a start without slip at the edge of the friction cone",
)


class ClosestCall(eqx.Module):
    """The smallest distance of a trajectory from another sequence of events."""

    events: int
    closest: float  # relative; infinite without any
    at: float  # s
    event: str
    landed_at: float = np.nan  # when a contact first came back to the belt, s
    held: float = np.inf  # smallest relative margin by which the friction of sliding holds one that then sticks


def closest_call(
    scene: Scene, method: AbstractStepper, y0, t1: float, slips_move: Bool[np.ndarray, "*c"] | bool = False
) -> ClosestCall:
    """The smallest distance, found by following the trajectory advance by advance.

    `slips_move`: which contacts' slips at the start change with a parameter.
    """
    by_kernel = has_kernel(scene, method)
    ends = [*(float(jump) for jump in np.asarray(scene.load.jumps) if 0 < jump < t1), t1]
    # The load is the same until each of these ends, at which it jumps.
    loads = _loads(scene, 0.5 * (np.array([0.0, *ends[:-1]]) + ends))
    mechanics, contact, start = _start(scene, loads[0], y0)
    y, t = y0, 0.0
    seen = _Seen(mechanics, start, np.broadcast_to(slips_move, len(mechanics.places)))
    for end, load in zip(ends, loads, strict=True):
        begins = True
        for look in _looks_until(_Asked(method), mechanics, contact, load, y, end - t, by_kernel):
            arrives = bool(look.left == 0)
            happened = seen.add(np.atleast_1d(contact.status), look, t, begins, arrives)
            # A mode that begins with an event there has begun at the edge of that event.
            begins = False
            t = end if arrives else t + float(look.h)
            # At the end of a chain of impacts a contact comes to rest without another event.
            moved = happened or look.h > 0 or np.any(look.contact.status != contact.status)
            y, contact = look.y, look.contact
            if not np.all(np.isfinite(look.y)) or not moved:
                return ClosestCall(seen.events, 0.0, t, "the motion stopping to be finite")
    return seen.closest()


class _Asked(eqx.Module):
    """How the trajectory is followed, fixed when that is traced."""

    method: AbstractStepper = eqx.field(static=True)


def _looks_until(asked: _Asked, mechanics: Mechanics, contact: Contact, load, y, left: float, by_kernel: bool):
    """The advances from here for so much time (s), one after the other."""
    # So many are followed in one call, and the time at which each of them would find nothing left.
    over, time = np.zeros(32), np.asarray(left)
    while time > 0:
        (y, contact, time), looks = _looks((asked, mechanics, contact, load, y, time), over, by_kernel=by_kernel)
        looks = jax.tree.map(np.asarray, looks)
        for row in range(len(over)):
            look = jax.tree.map(lambda leaf, row=row: leaf[row], looks)
            yield look
            if look.left == 0:
                return


def _follow(args, over: Float[Array, " k"]):
    asked, mechanics, contact, load, y, left = args
    begin = depending_on((mechanics, load, left), (y, contact, left))

    def further(now, over):
        y, contact, left = now
        goes_on = left > over

        def look() -> AdvanceMargins:
            return advance_margins(asked.method, mechanics, contact, load, y, left)

        def none() -> AdvanceMargins:
            return jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), jax.eval_shape(look))

        found = jax.lax.cond(goes_on, look, none)
        after = found.y, found.contact, found.left
        return jax.tree.map(lambda new, old: jnp.where(goes_on, new, old), after, now), found

    return jax.lax.scan(further, begin, over)


_looks = KernelFunction(_follow)


class _Start(eqx.Module):
    """How the contacts start, and which are affected at once by an event of each of them."""

    status: Int[Array, " c"]
    slip: Float[Array, " c"]  # m/s
    # Relative margins: by which the friction of sliding would hold the contact, and from the edge of the cone without slip.
    held: Float[Array, " c"]
    at_rest: Float[Array, " c"]
    coupled: Bool[Array, "c c"]


class _Guard(NamedTuple):
    """A guard of a contact."""

    contact: int
    status: int
    which: int
    flight: int = 0  # its number, of those that an impact has begun


class _Seen:
    """The distances found on a trajectory so far."""

    def __init__(self, mechanics: Mechanics, start: _Start, slips_move: Bool[np.ndarray, " c"]):
        self.mechanics, self.several, self.slips_move = mechanics, mechanics.several, slips_move
        count, self.coupled = len(mechanics.places), start.coupled
        # The largest size of each guard: on the whole trajectory where there is no flight.
        self.largest: dict[_Guard, float] = {}
        # Distances by guard, in its own unit, and decisions, which are relative already.
        self.calls: list[tuple[_Guard, float, float]] = []
        self.decisions: list[tuple[float, float, str]] = []
        self.events, self.landed_at, self.held = 0, np.nan, np.inf
        # The numbers of flights that impacts have begun, zero for contacts that are in none; and how many there have been.
        self.flight, self.flights = np.zeros(count, int), 0
        # Contacts on which another's event has just acted while their own status lasted, and their guards before it.
        self.struck = np.zeros(count, bool)
        self.before = np.zeros((count, 2))
        self._begin(start)

    def _begin(self, start: _Start) -> None:
        slides, sticks = (self.slips_move & (start.status == of) for of in (Status.SLIDE, Status.STICK))
        if np.any(slides & (start.slip == 0)):
            self.decisions.append((0.0, 0.0, OF_START[0]))
        self.decisions += [(max(float(margin), 0.0), 0.0, OF_START[1]) for margin in start.held[sticks]]
        without_slip = (start.status != Status.DETACH) & (start.slip == 0)
        self.decisions += [(float(margin), 0.0, OF_START[2]) for margin in start.at_rest[without_slip]]

    def add(self, status: np.ndarray, look: AdvanceMargins, t: float, begins: bool, arrives: bool) -> bool:
        """Add an advance, which `begins` at the start or at a jump of the load. Returns whether it ended in an event."""
        after = np.atleast_1d(look.contact.status)
        at = t + float(look.h)
        relevant = [self._of_contact(i, status, look, t, begins) for i in range(len(status))]
        fired = [i for i in range(len(status)) if relevant[i] and self._fires(i, int(status[i]), int(after[i]), look)]
        for i in fired:
            # The guard that ran out is the one nearest to zero at the end, in units of its size.
            ran_out = min(
                (self._guard(i, status, k) for k in relevant[i]),
                key=lambda guard: abs(look.guards[-1, guard.contact, guard.which]) / max(self.largest[guard], 1e-300),
            )
            which = ran_out.which
            # After a jump of the load a guard may be far below zero.
            passed = abs(float(look.guards[0, i, which])) if look.h == 0 else 0.0
            slope, bend = float(look.slope[i, which]), abs(float(look.bend[i, which]))
            depth = slope**2 / (2 * bend) if bend > 0 else float("inf")
            self.calls.append((ran_out, max(depth, passed), at))
            # The other guards at that instant: if one of them is zero as well, either may be the first. A guard of another
            # contact that rises was zero when its status began, an event that has been counted already.
            for j in np.flatnonzero(self.coupled[i]).tolist():
                others = [k for k in relevant[j] if (j, k) != (i, which) and (j == i or look.slope[j, k] < 0)]
                self.calls += [(self._guard(j, status, k), abs(float(look.guards[-1, j, k])), at) for k in others]
        if fired:
            names = DECISIONS_OF_SEVERAL if self.several else DECISIONS
            self.decisions += [(float(m), at, name) for m, name in zip(look.decisions, names, strict=True)]
            self.events += 1
            self.held = min(self.held, float(look.held))
        elif arrives:
            # An event at a jump of the load, or at the end, may come before or after it: of a whole chain of impacts.
            for i, own in enumerate(relevant):
                self.calls += [(_Guard(i, int(status[i]), k), abs(float(look.guards[-1, i, k])), at) for k in own]
        impact = any(status[i] == Status.DETACH for i in fired)
        if impact:
            self.landed_at = np.fmin(self.landed_at, at)
        self._number_flights(status, after, fired, impact)
        felt = np.any(self.coupled[fired], axis=0)
        felt[fired] = False
        self.struck, self.before = felt & (after == status), np.asarray(look.guards[-1])
        return bool(fired)

    def _number_flights(self, status: np.ndarray, after: np.ndarray, fired: list[int], impact: bool) -> None:
        """Give a number to each flight that an impact begins: a rebound, or that of a contact which another's impact lifts."""
        for i in np.flatnonzero((status != Status.DETACH) | np.isin(np.arange(len(status)), fired)).tolist():
            begun = impact and after[i] == Status.DETACH and (status[i] == Status.DETACH or i not in fired)
            self.flights += begun
            self.flight[i] = self.flights if begun else 0

    def _guard(self, i: int, status: np.ndarray, which: int) -> _Guard:
        return _Guard(i, int(status[i]), which, int(self.flight[i]) if status[i] == Status.DETACH else 0)

    def _of_contact(self, i: int, status: np.ndarray, look: AdvanceMargins, t: float, begins: bool) -> list[int]:
        """Add the distances of the guards of one contact inside an advance. Returns the guards that count."""
        # A guard that is a rounding error all the time does not count: with zero friction the friction cone has no width.
        relevant = [k for k in range(2) if np.abs(look.guards[:, i, k]).max() > 1e-12 * look.size[i, k]]
        relevant = relevant[:1] if status[i] == Status.DETACH else relevant
        for which in relevant:
            guard, key = look.guards[:, i, which], self._guard(i, status, which)
            for one in {key, key._replace(flight=0)}:
                self.largest[one] = max(self.largest.get(one, 0.0), float(np.abs(guard).max()))
            turns = np.flatnonzero(look.turns[:, i, which])
            self.calls += [(key, float(look.lowest[at, i, which]), t + float(look.h) * at / LOOKS) for at in turns]
            # The start, a jump of the load or another contact's event may leave a guard close to zero, on either side. At the
            # start, what is given stays as it is: the gap, and the slip unless it moves.
            jumped = abs(float(guard[0]) - self.before[i, which]) > 1e-6 * self.largest[key]
            is_force = status[i] == Status.STICK or (status[i] == Status.SLIDE and which == 0)
            moves = t > 0 or is_force or (status[i] == Status.SLIDE and self.slips_move[i] and guard[0] != 0)
            if (begins and moves) or (self.struck[i] and jumped):
                self.calls.append((key, abs(float(guard[0])), t))
        return relevant

    def _fires(self, i: int, status: int, after: int, look: AdvanceMargins) -> bool:
        """Whether an event of this contact ended the advance."""
        if self.several:
            return bool(look.ended[i])
        # Detached before and after, but with zero gap in between: a rebound.
        bounced = status == Status.DETACH == after and look.y[self.mechanics.normal] == 0
        return bool(status != after or look.turned[i] or bounced)

    def closest(self) -> ClosestCall:
        """The smallest of all distances."""

        def name(guard: _Guard) -> str:
            event = GUARDS[Status(guard.status), guard.which]
            return f"{event} (contact {guard.contact})" if self.several else event

        closest = [(value / max(self.largest[guard], 1e-300), at, name(guard)) for guard, value, at in self.calls]
        nearest = min(closest + self.decisions, default=(float("inf"), float("nan"), "none"))
        return ClosestCall(self.events, *nearest, self.landed_at, self.held)


@by_numpy
def _loads(scene: Scene, instants: Float[Array, " k"]) -> Float[Array, " k"]:
    return jax.vmap(scene.load)(instants)


@by_numpy
def _start(scene: Scene, load, y) -> tuple[Mechanics, Contact, _Start]:
    mechanics = Mechanics(scene)
    contact = physics.status_from_forces(mechanics, load, y)
    slip = physics.relative_velocity(mechanics, y)
    coupled = jnp.ones((1, 1), bool)
    if mechanics.several:
        at_rest = physics.clearness_of_modes(mechanics, load, y, contact)
        coupled = jax.vmap(lambda one: physics.affected_by(mechanics, one))(jnp.eye(len(slip), dtype=bool))
    else:
        holding = physics.sticking_forces(mechanics, physics.free_acceleration(mechanics, load, y))
        at_rest = margin_from_cone(mechanics.friction.static, *holding)
    held = held_by_sliding(mechanics, contact, load, y)
    status, slip, held, at_rest = map(jnp.atleast_1d, (contact.status, slip, held, at_rest))
    return mechanics, contact, _Start(status, slip, held, at_rest, coupled)
