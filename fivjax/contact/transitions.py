"""What follows when a contact mode ends: the next mode, chosen from the forces, and the state on its constraint."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from .contact_problem import NONE
from .coordinates import spread
from .forces import (
    State,
    acceleration,
    degrees_of_freedom,
    free_acceleration,
    gap,
    gap_rate,
    relative_velocity,
    total_forces,
    with_contact_coordinates,
)
from .guard import cone_margins
from .impacts import after_brief_flights, impact
from .mechanics import Mechanics
from .mode import Contact, Status
from .mode_forces import ModeForces, sticking_forces
from .several_contacts import affected_by, modes_from_forces, state_of


def on_constraint(mechanics: Mechanics, contact: Contact, y: State) -> State:
    """The state with what the status forbids set to exactly zero: gap and gap rate in contact, and slip while sticking."""
    touching = contact.status != Status.DETACH
    sticking = contact.status == Status.STICK
    return with_contact_coordinates(
        mechanics,
        y,
        gap=jnp.where(touching, 0.0, gap(mechanics, y)),
        gap_rate=jnp.where(touching, 0.0, gap_rate(mechanics, y)),
        tangential_velocity=jnp.where(sticking, mechanics.belt_speed, y[degrees_of_freedom(y) + mechanics.tangential]),
    )


def stuck(mechanics: Mechanics, contact: Contact, y: State) -> State:
    """A start that sticks, with the derivatives of its motion an instant later.

    Its slip is zero, but may depend on a parameter: the belt's speed, or that of a given state. A slip that begins small ends
    soon, by an impulse in proportion to it, which moves whatever the mass matrix couples to the contact. So the state is as
    after the impulse that holds it: itself, but for its derivatives.
    """
    return jnp.where(jnp.any(contact.status == Status.STICK), _held(mechanics, contact, y), y)


def _held(mechanics: Mechanics, contact: Contact, y: State) -> State:
    """The state after the impulses that a mode needs at once: those that end what slip and gap rates it forbids."""
    n = degrees_of_freedom(y)
    relative = y[n:].at[mechanics.tangential].add(-mechanics.belt_speed)
    own = mechanics.of_totals
    impulses = ModeForces(own, contact, own.friction(jnp.abs(relative_velocity(mechanics, y)))).added(own, relative)
    return y.at[n:].add(sum(spread(*of) for of in zip((own.from_tangential, own.from_normal), impulses, strict=True)))


def transition(
    mechanics: Mechanics,
    contact: Contact,
    load: Float[Array, ""],
    y: State,
    ended: Bool[Array, "*contacts 2"],
    resolution: Float[Array, ""],
    lifts_rest: bool = False,
) -> tuple[Contact, State]:
    """The next mode where the guards in `ended` are used up, and the state on its constraint.

    Without any such guard, nothing changes. A rebound that would be back on the belt within the time `resolution` (s) counts as
    rest: with restitution, bounces get shorter without end, and a stepper can follow only so many. With `lifts_rest` so does
    what the impact of another contact lifts off, which a stepper that finds no events could let go on for ever.
    """

    def following() -> tuple[Contact, State]:
        return _following(mechanics, contact, load, y, ended, resolution, lifts_rest)

    # Costly, and seldom needed.
    return jax.lax.cond(jnp.any(ended), following, lambda: (contact, y))


def stopped(mechanics: Mechanics, contact: Contact, y: State, ended: Bool[Array, "*contacts 2"]) -> State:
    """The state with exactly zero gap where it has closed, and exactly zero slip where slip has ended or the contact stuck."""
    n = degrees_of_freedom(y)
    touched = _has_touched(contact, ended)
    at_rest = ((contact.status == Status.SLIDE) & ended[..., 1]) | (contact.status == Status.STICK)
    return with_contact_coordinates(
        mechanics,
        y,
        gap=jnp.where(touched, 0.0, gap(mechanics, y)),
        gap_rate=gap_rate(mechanics, y),
        tangential_velocity=jnp.where(at_rest, mechanics.belt_speed, y[n + mechanics.tangential]),
    )


def _following(
    mechanics: Mechanics,
    contact: Contact,
    load: Float[Array, ""],
    y: State,
    ended: Bool[Array, "*contacts 2"],
    resolution: Float[Array, ""],
    lifts_rest: bool,
) -> tuple[Contact, State]:
    touched = _has_touched(contact, ended)
    y_stopped = stopped(mechanics, contact, y, ended)

    def struck() -> State:
        return _struck(mechanics, contact, load, y_stopped, touched, resolution, lifts_rest)

    # Where no force is in a contact yet that stuck, the edge of the cone that has ended says where it is pushed.
    edge = jnp.where((contact.status == Status.STICK) & ended[..., 1], -1.0, 1.0).astype(y.dtype)
    if mechanics.several:
        y_next = jax.lax.cond(jnp.any(touched), struck, lambda: y_stopped)
        following = _modes_after(mechanics, contact, load, y, y_next, ended, edge)
    else:
        y_next = jnp.where(touched, struck(), y_stopped)
        # What has ended is excluded here, too.
        following = status_from_forces(mechanics, load, y_next, may_stick=contact.status != Status.STICK, pushed=edge)
        status = jnp.where(_has_lifted(contact, ended), Status.DETACH, following.status)
        following = Contact(status.astype(contact.status.dtype), following.direction)
        rests = touched & (status != Status.DETACH)
        y_next = jax.lax.cond(
            rests, lambda: _rested(mechanics, following, load, gap_rate(mechanics, y_stopped), y_next), lambda: y_next
        )
    return following, on_constraint(mechanics, following, y_next)


def _has_touched(contact: Contact, ended: Bool[Array, "*contacts 2"]) -> Bool[Array, "*contacts"]:
    return (contact.status == Status.DETACH) & ended[..., 0]


def _has_lifted(contact: Contact, ended: Bool[Array, "*contacts 2"]) -> Bool[Array, "*contacts"]:
    return (contact.status == Status.SLIDE) & ended[..., 0]


def _struck(
    mechanics: Mechanics,
    contact: Contact,
    load: Float[Array, ""],
    y: State,
    touched: Bool[Array, "*contacts"],
    resolution: Float[Array, ""],
    lifts_rest: bool,
) -> State:
    """The state after the impacts of the contacts that have `touched`."""
    fall, rate = _fall(mechanics, contact, load, y), gap_rate(mechanics, y)
    # One that rises has landed by rounding, right after a rebound: in one that several impacts have made small nothing else
    # would end it.
    rising = touched & (rate >= 0)
    if mechanics.several:
        reached = affected_by(mechanics, touched)
        # What a rebound changes that counts as rest is made up for by its end (`after_brief_flights`).
        inelastic = _ends_within(resolution, -mechanics.restitution * rate, fall)
        restitution = jnp.where(inelastic, 0.0, mechanics.restitution)
        y_struck = impact(eqx.tree_at(lambda m: m.restitution, mechanics, restitution), y, reached)
    else:
        y_struck = jnp.where(rising, y, impact(mechanics, y))
    own = gap_rate(mechanics, y_struck)
    rests = rising | (touched & _ends_within(resolution, own, fall))
    if mechanics.several and lifts_rest:
        # pyrefly: ignore[unbound-name]
        lifted = reached & (contact.status != Status.DETACH) & (own > 0)
        free = Contact(jnp.where(lifted, Status.DETACH, contact.status), contact.direction)
        rests = rests | (lifted & _ends_within(resolution, own, _fall(mechanics, free, load, y)))
        # In truth it flies, without its force at rest, and lands by an impulse. The two differ by the impulse that would end
        # the lift at once, friction included; with it, the mean forces are those of the flight.
        slip = relative_velocity(mechanics, y_struck)
        at_rest = rests | ((gap(mechanics, y_struck) <= 0) & (own == 0))
        of_rest = jnp.where(at_rest, jnp.where(slip == 0, Status.STICK, Status.SLIDE), Status.DETACH)
        y_struck = _held(mechanics, Contact(of_rest.astype(contact.status.dtype), -jnp.sign(slip)), y_struck)
    return with_contact_coordinates(
        mechanics,
        y_struck,
        gap=gap(mechanics, y_struck),
        gap_rate=jnp.where(rests, 0.0, own),
        tangential_velocity=y_struck[degrees_of_freedom(y) + mechanics.tangential],
    )


def _rested(mechanics: Mechanics, contact: Contact, load: Float[Array, ""], rate: Float[Array, ""], y: State) -> State:
    """The state of a contact that has come to rest from a landing at this rate: after the brief flights that it leaves out."""
    # A rebound that counts as a landing as soon as it begins has its speed already.
    rebound = jnp.where(rate < 0, -mechanics.restitution, 1.0) * rate
    by = after_brief_flights(mechanics, contact, load, y)
    return y.at[degrees_of_freedom(y) :].add(by * rebound)


def _modes_after(
    mechanics: Mechanics,
    contact: Contact,
    load: Float[Array, ""],
    y: State,
    y_next: State,
    ended: Bool[Array, "contacts 2"],
    edge: Float[Array, " contacts"],
) -> Contact:
    """The modes of several contacts at `y_next`, after events of some of them at `y`."""
    own, held = ended[..., 0] | ended[..., 1], contact.status == Status.STICK
    # At the edge of the friction cone, or where N has just reached zero, rounding would decide whether the status that has
    # ended goes on. So it is excluded.
    over = (own & held) | _has_lifted(contact, ended)
    # Where slip has ended, the contact sticks if it can: where the static coefficient is larger, it could slide as well.
    slides, slips = contact.status == Status.SLIDE, relative_velocity(mechanics, y) != 0
    arrested = slides & slips & (relative_velocity(mechanics, y_next) == 0)
    # A contact that has landed is on the belt, also where no force presses it there.
    going_on = Contact(
        jnp.where(arrested | _has_touched(contact, ended), Status.STICK, contact.status), contact.direction
    )
    following = modes_from_forces(mechanics, load, y_next, going_on, jnp.where(over, state_of(contact), NONE))
    idle = own & held & _is_free_of_force(mechanics, load, y_next)
    following = Contact(following.status, jnp.where(idle, edge, following.direction))
    # What the event does not reach goes on: a contact whose mode ends at the same instant has an event of its own.
    reached = affected_by(mechanics, own)
    status = jnp.where(reached, following.status, contact.status).astype(contact.status.dtype)
    return Contact(status, jnp.where(reached, following.direction, contact.direction))


def status_from_forces(
    mechanics: Mechanics,
    load: Float[Array, ""],
    y: State,
    may_stick: Bool[Array, ""] | bool = True,
    pushed: Float[Array, ""] | float = 1.0,
) -> Contact:
    """The status of a state on its constraints, found from the forces that each status would need.

    Gap open or opening: detached. Slipping: sliding if pressed, or if no force is in the contact yet, else detached. At rest on
    the belt: sticking if the force that this needs lies in the friction cone, else sliding the way it is pushed, else detached.
    Without any force it sticks, too; where it may not, `pushed` is the direction of friction. With several contacts, all are
    found at once (`contact_problem`).
    """
    if mechanics.several:
        return modes_from_forces(mechanics, load, y)
    free = free_acceleration(mechanics, load, y)
    slip = relative_velocity(mechanics, y)
    open_ = (gap(mechanics, y) > 0) | (gap_rate(mechanics, y) > 0)
    holds = sticking_forces(mechanics, free)
    held = jnp.all(cone_margins(mechanics, *holds) >= 0)
    holding, pressing = total_forces(mechanics, *holds)
    free_of_force = (pressing == 0) & (holding == 0)
    sticks = may_stick & (slip == 0) & held & ((pressing > 0) | free_of_force)
    along = jnp.where(slip == 0, jnp.sign(holding), -jnp.sign(slip))
    direction = jnp.where(along == 0, pushed, along).astype(y.dtype)
    sliding = Contact(jnp.full_like(open_, Status.SLIDE, jnp.int32), direction)
    forces = ModeForces(mechanics, sliding, mechanics.friction(jnp.abs(slip))).added(mechanics, free)
    _, sliding_normal_force = total_forces(mechanics, *forces)
    status = jnp.where(
        open_,
        Status.DETACH,
        jnp.where(sticks, Status.STICK, jnp.where(sliding_normal_force >= 0, Status.SLIDE, Status.DETACH)),
    )
    return Contact(status=status.astype(jnp.int32), direction=direction)


def _is_free_of_force(mechanics: Mechanics, load: Float[Array, ""], y: State) -> Bool[Array, " c"]:
    """Whether nothing accelerates a contact, in contact or not; only total forces can be exactly zero."""
    if mechanics.rest is not None:
        return jnp.zeros(len(mechanics.places), bool)
    free = free_acceleration(mechanics, load, y)
    return (free[mechanics.tangential] == 0) & (free[mechanics.normal] == 0)


def _fall(mechanics: Mechanics, contact: Contact, load: Float[Array, ""], y: State) -> Float[Array, "*contacts"]:
    """The acceleration of a gap that opens."""
    if mechanics.several:
        # That before the impact, while the contact was free.
        return acceleration(mechanics, contact, load, y)[mechanics.normal]
    fall = free_acceleration(mechanics, load, y)[mechanics.normal]
    if mechanics.rest is None:
        return fall
    _, g_tn, g_nn = mechanics.compliance
    return fall - g_tn * mechanics.rest.tangential_force - g_nn * mechanics.rest.normal_force


def _ends_within(
    time: Float[Array, ""], rate: Float[Array, "*contacts"], fall: Float[Array, "*contacts"]
) -> Bool[Array, "*contacts"]:
    """Whether flights that begin at these rates end within a time. One that is about to lift off anyway has no rebound, even if
    its rate is zero: with restitution it would lift off sooner.
    """
    at_end = rate + 0.5 * fall * time
    return (at_end < 0) | ((at_end == 0) & (fall <= 0))
