r"""Derivatives of what a scene does, with word of whether they exist.

Through contact they are exact: event times are differentiated implicitly and the state jumps as it should (`EventExact`).
They do not exist everywhere, though. Where the contact only just touches, lifts or slips, a parameter's next digit means
another sequence of events; there the state has no derivative, or one that holds on one side alone. So `derivatives` also
follows the trajectory's guards and says how close it comes to that.

At an event a guard $g$ crosses zero with slope $\dot g$; it would turn back at a depth of $\dot g^2 / (2 |\ddot g|)$ (to
second order). Between events it may come down to a smallest value and recover. Both, relative to the largest size of that
guard on the trajectory, say how far the event is from vanishing, or a new one from appearing. Two events at one instant,
or one on a jump of the load or at the very end, would swap their order; a friction cone that an impact or a contact at
rest just touches would be left. How far these are is looked at likewise.
"""

from collections.abc import Callable, Iterable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from .. import contact as physics
from ..contact import Contact, Mechanics, Status
from ..foundation import arguments
from ..foundation.compiling import compiled
from ..foundation.precision import in_double_precision, known_to_numpy
from ..model.scene import Scene, refuse_painleve, refuse_several_contacts
from ..steppers.base import AbstractStepper, rates
from ..steppers.event_exact import EventExact
from .start import start_state
from .trajectory import Trajectory, simulate

# Looks at the guards within one advance; between two of them a guard is told from its derivatives.
LOOKS = 32
GUARDS = {
    (Status.STICK, 0): "the friction force reaching one edge of the friction cone",
    (Status.STICK, 1): "the friction force reaching the other edge of the friction cone",
    (Status.SLIDE, 0): "the contact losing its normal force",
    (Status.SLIDE, 1): "the slip running out",
    (Status.DETACH, 0): "the gap closing",
}
# What an event decides beside itself, and what a decision by a hair says.
DECISIONS = (
    "an impact at the edge of the friction cone, where it either ends slip or does not",
    "the slip running out at the edge of the friction cone, where the contact either sticks or slips back",
    "sliding that begins without a normal force",
)


class Derivatives(eqx.Module):
    """A functional of a trajectory, its derivatives, and how far they are from not existing."""

    value: Array
    by_name: dict[str, Array]  # of the functional's shape, per unit of the parameter
    events: int  # contact events on the trajectory
    closest: float  # smallest distance from another sequence of events, relative; infinite without any
    closest_at: float  # when, s
    closest_event: str = eqx.field(static=True)
    exist: bool = eqx.field(static=True)

    def __getitem__(self, name: str) -> Array:
        return self.by_name[name]

    @property
    def reason(self) -> str:
        """Why the derivatives exist or do not, as a sentence."""
        if not np.isfinite(self.closest):
            return "The derivatives exist: no contact event comes anywhere near."
        where = (
            f"{self.closest_event} at t = {self.closest_at:.6g} s, {self.closest:.1e} of its range away from changing"
        )
        if self.exist:
            return f"The derivatives exist. The closest call is {where}."
        return f"No derivative can be relied on: {where}, the sequence of events is about to be another."


@in_double_precision
def derivatives(
    functional: Callable[[Trajectory], Array],
    scene: Scene,
    wrt: Iterable[str],
    t1: float = 2.0,
    dt_save: float = 1e-4,
    *,
    y0=None,
    mode: str = "forward",
    method: AbstractStepper | None = None,
    margin: float = 1e-6,
) -> Derivatives:
    """Derivatives of a functional of a trajectory in parameters of the scene, and whether they exist.

        d = fj.derivatives(lambda run: run.velocity[-1, 0], scene, ["mu", "k1"], t1=0.5)
        d["mu"], d.exist, d.reason

    **Arguments:**

    - `functional`: a smooth function of a `Trajectory`, in `jax.numpy`. A peak, an energy or a line of the spectrum will do.
      Sums of *accelerations* over saved instants have no derivative where these jump; use differences of velocities.
    - `wrt`: names of parameters, any of `scene.parameters`. `start` at 0 has a derivative to later times only.
    - `t1`, `dt_save`, `y0`, `method`: as in `simulate`. With `WhereSwitched` the derivatives are those of its steps, which
      are wrong after contact events.
    - `mode`: "forward" (best up to some ten parameters) or "reverse" (memory for the saved states only).
    - `margin`: the smallest relative distance from another sequence of events at which a derivative is said to exist.

    **Returns:** `Derivatives`.

    **Raises:** `ValueError` or `TypeError`, as a sentence, for an unknown name, and whatever `simulate` refuses.

    **Example:**

        >>> found = fj.derivatives(lambda run: run.displacement[-1, 0], scene, ["mu", "k1"], t1=0.4)  # doctest: +SLOW
    """
    arguments.instance("scene", scene, Scene, "a Scene")
    refuse_several_contacts(scene.structure, "`derivatives`")
    if not callable(functional):
        raise TypeError(
            f"Argument `functional` must be a function of a Trajectory, but is {arguments.describe(functional)}."
        )
    if isinstance(wrt, str):
        raise TypeError(f'Argument `wrt` must be a list of names, such as ["{wrt}"], but is {wrt!r} (str).')
    names = tuple(wrt)
    unknown = [name for name in names if name not in scene.parameters]
    if unknown or not names:
        raise ValueError(
            f"Argument `wrt` must name parameters of the scene, but has {(unknown or ['none'])[0]!r}; they are: "
            f"{', '.join(sorted(scene.parameters))}."
        )
    arguments.one_of("mode", mode, ("forward", "reverse"))
    arguments.real_number("margin", margin, minimum=0)
    arguments.real_number("t1", t1, above=0)
    arguments.real_number("dt_save", dt_save, above=0)
    method = EventExact() if method is None else method
    arguments.instance("method", method, AbstractStepper, "a stepper, such as EventExact()")
    refuse_painleve(scene)
    begin = start_state(scene, y0)
    value, by_name = _differentiated(functional, scene, names, float(t1), float(dt_save), y0, mode, method)
    calls = _closest_call(scene, method, begin, float(t1))
    return Derivatives(
        value=jax.tree.map(known_to_numpy, value),
        by_name={name: jax.tree.map(known_to_numpy, found) for name, found in by_name.items()},
        events=calls.events,
        closest=calls.closest,
        closest_at=calls.at,
        closest_event=calls.event,
        exist=bool(calls.closest > margin),
    )


@compiled
def _differentiated(functional, scene, names, t1, dt_save, y0, mode, method):
    def of(values):
        value = functional(simulate(scene.replace(**values), t1, dt_save, method, y0=y0, derivatives=mode))
        return value, value

    jacobian = jax.jacfwd if mode == "forward" else jax.jacrev
    found, value = jacobian(of, has_aux=True)({name: scene.parameters[name] for name in names})
    # A functional of several numbers has the parameters innermost.
    return value, {name: _of_parameter(found, name) for name in names}


def _of_parameter(found, name: str):
    return jax.tree.map(lambda leaf: leaf[name], found, is_leaf=lambda node: isinstance(node, dict))


class _Calls(eqx.Module):
    """The closest call of a trajectory."""

    events: int
    closest: float
    at: float
    event: str


def _closest_call(scene: Scene, method: AbstractStepper, y0, t1: float) -> _Calls:
    """Follow the trajectory advance by advance and look at the guards of each."""
    mechanics = Mechanics(scene)
    jumps = [float(jump) for jump in scene.load.jumps if 0 < float(jump) < t1]
    ends = [*jumps, t1]
    y, contact, t = y0, physics.status_from_forces(mechanics, scene.load(jnp.asarray(0.5 * ends[0])), y0), 0.0
    largest: dict = {}
    # Distances by guard, in its own unit, and decisions, which are relative already.
    calls, decisions, events = [], [], 0
    for end in ends:
        load = scene.load(jnp.asarray(0.5 * (t + end)))
        begin = t
        while t < end:
            look = jax.tree.map(np.asarray, _look(method, mechanics, contact, load, y, jnp.asarray(end - t)))
            status = int(contact.status)
            normal = scene.structure.normal
            # Detached before and after, but put on the belt in between: a rebound.
            bounced = status == Status.DETACH == int(look.contact.status) and look.y[normal] == 0
            fired = status != int(look.contact.status) or bool(look.turned) or bounced
            # A guard that is zero but for rounding of what it is a sum of is none: friction without a coefficient.
            relevant = [k for k in range(2) if np.abs(look.guards[:, k]).max() > 1e-12 * look.size[k]]
            relevant = relevant[:1] if status == Status.DETACH else relevant
            for which in relevant:
                guard, key = look.guards[:, which], (status, which)
                largest[key] = max(largest.get(key, 0.0), float(np.abs(guard).max()))
                turns = np.flatnonzero(look.turns[:, which])
                calls += [(key, float(look.lowest[i, which]), t + float(look.h) * i / LOOKS) for i in turns]
                # What a jump of the load leaves of a guard: next to nothing, and it might as well be less than that.
                if 0 < t == begin:
                    calls.append((key, abs(float(guard[0])), t))
            at = t + float(look.h)
            if fired and relevant:
                # What ran out is the guard that is nearest to zero at the end, in units of its size.
                which = min(relevant, key=lambda k: abs(look.guards[-1, k]) / max(largest[status, k], 1e-300))
                # One that a jump of the load used up was passed by far, not turned round.
                passed = abs(float(look.guards[0, which])) if look.h == 0 else 0.0
                depth = float(look.slope[which] ** 2 / (2 * max(abs(look.bend[which]), 1e-300)))
                calls.append(((status, which), max(depth, passed), at))
                # The others at that instant: were one of them zero as well, either might be the first.
                calls += [((status, k), abs(float(look.guards[-1, k])), at) for k in relevant if k != which]
                decisions += [(float(margin), at, DECISIONS[k]) for k, margin in enumerate(look.decisions)]
                events += 1
            elif look.h >= end - t:
                # An event on the jump of the load, or at the end, has it on either side of it.
                calls += [((status, k), abs(float(look.guards[-1, k])), at) for k in relevant]
            t = end if look.h >= end - t else at
            y, contact = jnp.asarray(look.y), jax.tree.map(jnp.asarray, look.contact)
            if not np.all(np.isfinite(look.y)) or (look.h <= 0 and not fired):
                return _Calls(events, 0.0, t, "the motion stopping to be finite")
    closest = [(value / max(largest[key], 1e-300), at, GUARDS[Status(key[0]), key[1]]) for key, value, at in calls]
    return _Calls(events, *min(closest + decisions, default=(float("inf"), float("nan"), "none")))


class _Look(eqx.Module):
    """One advance, and its guards at even instants of it."""

    y: Float[Array, " state"]
    contact: Contact
    h: Float[Array, ""]
    turned: Array  # whether it slides the other way now
    guards: Float[Array, "l 2"]
    turns: Bool[Array, "l 2"]  # whether the guard has its smallest value about this look, and recovers
    lowest: Float[Array, "l 2"]  # that value
    slope: Float[Array, "2"]  # of the guards at the end, per s, and per s²
    bend: Float[Array, "2"]
    size: Float[Array, "2"]  # of the terms that the guards are sums of
    decisions: Float[
        Array, "3"
    ]  # how clearly what follows was decided at the end, relative; infinite if it was not asked


@compiled
def _look(method, mechanics: Mechanics, contact: Contact, load, y, h) -> _Look:
    after = method.advance(mechanics, contact, load, y, h)
    # Just short of the end the status is still the same.
    shares = jnp.linspace(0.0, 1.0, LOOKS + 1)[1:] * (1 - 1e-9)
    inside = jax.vmap(lambda share: method.advance(mechanics, contact, load, y, share * after.h).y)(shares)
    states = jnp.concatenate([y[None], inside])

    def along(function):
        return lambda state: jax.jvp(function, (state,), (rates(mechanics, contact, load, state),))[1]

    orders = [lambda state: physics.guards(mechanics, contact, load, state)]
    for _ in range(3):
        orders.append(along(orders[-1]))
    value, slope, bend, third = (jax.vmap(order)(states) for order in orders)
    # Where the slope comes to zero, by the parabola; half a look to either side, but not beyond the ends.
    to_turn = -slope / jnp.where(bend > 0, bend, 1.0)
    spacing = after.h / LOOKS
    near = (bend > 0) & (jnp.abs(to_turn) <= 0.5 * spacing * (1 + 1e-6))
    look = jnp.arange(LOOKS + 1)[:, None]
    near = near & ((look > 0) | (to_turn > 0)) & ((look < LOOKS) | (to_turn < 0))
    # A guard that begins at zero, because the status has just begun there, does not turn at its own start.
    begins = jnp.abs(value[0]) <= 1e-9 * jnp.max(jnp.abs(value), axis=0)
    near = near & ~(begins & (look <= 1))
    lowest = value + to_turn * (slope + to_turn * (bend / 2 + to_turn * third / 6))
    turned = (contact.status == Status.SLIDE) & (after.contact.direction != contact.direction)
    turned = turned & (after.contact.status == Status.SLIDE)
    size, _ = physics.magnitudes(mechanics, contact, load, jnp.max(jnp.abs(states), axis=0))
    decisions = _decisions(mechanics, contact, load, states[-1], after.contact, after.y)
    return _Look(after.y, after.contact, after.h, turned, value, near, lowest, slope[-1], bend[-1], size, decisions)


def _decisions(mechanics: Mechanics, contact: Contact, load, before, following: Contact, after) -> Float[Array, "3"]:
    """Margins of the questions that an event asks, in the order of `DECISIONS`: the friction cone at an impact, the
    friction cone at rest on the belt, and the pressing force where it goes on to slide."""
    n = before.shape[0] // 2
    landed = (contact.status == Status.DETACH) & (following.status != Status.DETACH)
    # An impulse takes the place of a force, and changes of velocity that of accelerations.
    demanded = jnp.zeros(n).at[mechanics.tangential].set(physics.relative_velocity(mechanics, before))
    demanded = demanded.at[mechanics.normal].set((1 + mechanics.restitution) * before[n + mechanics.normal])
    dragged = mechanics.friction(jnp.abs(physics.relative_velocity(mechanics, before)))
    at_impact = _margin(dragged, *physics.sticking_forces(mechanics, demanded))
    by_impulse = landed & (mechanics.impact_law == "coulomb")
    came_to_rest = (contact.status != Status.STICK) & (physics.relative_velocity(mechanics, after) == 0)
    holding = physics.sticking_forces(mechanics, physics.free_acceleration(mechanics, load, after))
    at_rest = _margin(mechanics.friction.static, *holding)
    pressed = physics.guards(mechanics, following, load, after)[0]
    terms, _ = physics.magnitudes(mechanics, following, load, jnp.abs(after))
    slides = (following.status == Status.SLIDE) & (contact.status != Status.SLIDE)
    return jnp.stack(
        [
            jnp.where(by_impulse, at_impact, jnp.inf),
            jnp.where(came_to_rest & (following.status != Status.DETACH), at_rest, jnp.inf),
            jnp.where(slides, jnp.abs(pressed) / jnp.where(terms[0] > 0, terms[0], 1.0), jnp.inf),
        ]
    )


def _margin(mu, tangential, normal) -> Float[Array, ""]:
    """How far a force is from the edge of the friction cone, relative; infinite without friction and without force."""
    room, need = mu * jnp.abs(normal), jnp.abs(tangential)
    return jnp.where(room + need > 0, jnp.abs(room - need) / jnp.where(room + need > 0, room + need, 1.0), jnp.inf)
