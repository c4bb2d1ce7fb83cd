"""One trajectory on its way to a verdict.

A lane takes steps (`step`), now and then has a `look` at the limit cycle that it may come to, and is asked for its verdict
after a while (`conclude`): each is written for one lane; `lanes` makes many of it. States are deviations from the
sliding equilibrium under the final load: crossing states, kicks and events are then as exact as they are small.
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from .. import contact as physics
from ..contact import Contact, Mechanics, Rest, State
from ..model.load import AbstractLoad
from ..model.scene import Scene, steady_sliding
from ..simulation.energy import Books, Ledger, enter, mechanical_energy, open_ledger
from ..steppers.base import AbstractStepper, Advance
from ..steppers.core import Segment
from ..steppers.windowed import Windowed
from ..verdicts import ensemble as attractors
from ..verdicts import recurrence as orbits
from ..verdicts.ensemble import Approach, Attractor
from ..verdicts.recurrence import Orbit
from ..verdicts.sliding_proof import SlidingModes, slides_forever
from ..verdicts.sticking_proof import Wedge, sticks_forever
from ..verdicts.verdict import Verdict

# Steps between two looks at how near a lane is to a known limit cycle: one or two cycles for the fastest method.
LOOK_EVERY = 8
# The longest advance that a ledger is asked to enter, s.
LONGEST_ENTRY = 1.0
# A deviation from equilibrium this much larger than the equilibrium itself, or than the belt's motion, has no bound.
GROWTH = 1e9


class Lane(eqx.Module):
    """One trajectory on its way to a verdict."""

    t: Float[Array, ""]
    y: State  # as a deviation from the sliding equilibrium under the final load, see `measured_from_rest`
    contact: Contact
    orbit: Orbit
    events: Int[Array, ""]  # status changes so far
    last_event: Float[Array, ""]  # when the last of them was, s; NaN before the first
    approach: Approach
    verdict: Int[Array, ""]
    account: "Account | None" = None  # where its energy went, when asked for


class Course(eqx.Module):
    """What a lane is followed with."""

    scene: Scene
    method: AbstractStepper | Windowed
    resolution: orbits.Resolution
    mechanics: Mechanics  # see `measured_from_rest`
    prepared: Any  # the method's own, see `AbstractStepper.prepare`
    modes: SlidingModes
    wedge: Wedge
    attractor: Attractor


class Account(eqx.Module):
    """Where the energy of one lane went."""

    ledger: Ledger
    vibration: Float[Array, ""]  # vibration energy when the load had jumped for the last time, J; NaN before


def measured_from_rest(scene: Scene) -> Mechanics:
    """Mechanics for displacements and loads as deviations from the sliding equilibrium under the final load.

    A vibration of nanometres under a load that bends the springs by metres would be lost in the rounding of totals: events
    would be decided, and the balance of energy upset, by noise.
    """
    load = scene.load.final
    _, normal_force = steady_sliding(scene, load)
    return Mechanics(scene).about(Rest(scene, load, normal_force), scene.structure)


def begin(scene: Scene, mechanics: Mechanics, modes: SlidingModes, energy: bool) -> Lane:
    """A lane at the sliding equilibrium of its scene, just before anything happens."""
    q, _ = steady_sliding(scene, scene.load.force)
    equilibrium = jnp.concatenate([q, jnp.zeros_like(q)])
    # As a number an equilibrium is off by a rounding. Without that, an unstable one that nothing kicks would never be left.
    y = equilibrium - modes.linear.equilibrium + jnp.finfo(q.dtype).eps * jnp.abs(equilibrium)
    verdict = jnp.where(
        ~modes.linear.solvable,
        Verdict.PAINLEVE,
        jnp.where(modes.linear.exists, Verdict.UNDECIDED, Verdict.NO_EQUILIBRIUM),
    )
    finite = jnp.all(jnp.stack([jnp.all(jnp.isfinite(leaf)) for leaf in jax.tree.leaves(scene)]))
    return Lane(
        t=jnp.zeros((), y.dtype),
        y=y,
        contact=physics.status_from_forces(mechanics, scene.load.force - scene.load.final, y),
        orbit=orbits.new_orbit(y),
        events=jnp.zeros((), jnp.int32),
        last_event=jnp.full((), jnp.nan, y.dtype),
        approach=attractors.no_approach(y),
        verdict=jnp.where(finite, verdict, Verdict.NOT_FINITE).astype(jnp.int8),
        account=Account(open_ledger(Books(scene), y), jnp.full((), jnp.nan, y.dtype)) if energy else None,
    )


def released(scene: Scene, modes: SlidingModes, lane: Lane, load: Float[Array, ""]) -> Lane:
    """The lane at rest under so many times its final load, which jumps to its final value now, after all kicks; not a
    number, and the lane stays as it is.
    """
    q, _ = steady_sliding(scene, load * scene.load.final)
    deviation = jnp.concatenate([q, jnp.zeros_like(q)]) - modes.linear.equilibrium
    after = deviation, jnp.max(scene.load.jumps, initial=0.0)
    chosen = jax.tree.map(lambda new, old: jnp.where(jnp.isnan(load), old, new), after, (lane.y, lane.t))
    return eqx.tree_at(lambda lane: (lane.y, lane.t), lane, chosen)


def next_step_end(load: AbstractLoad, t: Float[Array, ""], dt: Float[Array, ""]) -> Float[Array, ""]:
    """The end of a step from `t`: at most `dt` on, never across a jump of the load, and exactly on it when one is reached."""
    ahead = load.jumps > t
    jump = jnp.min(jnp.where(ahead, load.jumps, jnp.inf), initial=jnp.inf)
    # Equal steps up to the jump; the allowance keeps rounding from adding one more, vanishingly short.
    steps = jnp.ceil((jump - t) / dt - 1e-6)
    return jnp.where(steps <= 1, jump, t + jnp.where(jnp.isfinite(jump), (jump - t) / jnp.maximum(steps, 1), dt))


def step(course: Course, lane: Lane) -> Lane:
    """One step further, which ends at the next event at the latest."""
    scene, structure, method = course.scene, course.scene.structure, course.method
    # At rest an exact stepper would go on for ever, and work over an endless time is not to be had.
    longest = method.dt if lane.account is None else min(method.dt, LONGEST_ENTRY)
    t = next_step_end(scene.load, lane.t, longest)
    load = scene.load(0.5 * (lane.t + t)) - scene.load.final
    after = method.advance(course.prepared, lane.contact, load, lane.y, t - lane.t, at_section=True)
    y, contact, h, peak, rise, *_ = after
    t = jnp.where(h >= t - lane.t, t, lane.t + h)
    changed = contact.status != lane.contact.status
    orbit = orbits.observe(
        lane.orbit,
        structure.weights,
        jnp.zeros_like(y),
        rise,
        changed,
        peak,
        t,
        course.modes.slowest_decay,
        course.resolution,
    )
    return Lane(
        t=t,
        y=y,
        contact=contact,
        orbit=orbit,
        events=lane.events + changed,
        last_event=jnp.where(changed, t, lane.last_event),
        approach=lane.approach,
        verdict=lane.verdict,
        account=None if lane.account is None else _entered(course, lane.account, lane, load, after, t),
    )


def _entered(course: Course, account: Account, before: Lane, load, after: Advance, t) -> Account:
    scene = course.scene
    segment = Segment(before.t, load, before.contact, before.y, after)
    ledger = enter(Books(scene), course.method, course.mechanics, account.ledger, segment)
    kick_ends = jnp.max(scene.load.jumps, initial=0.0)
    just_kicked = (t >= kick_ends) & jnp.isnan(account.vibration)
    vibration = mechanical_energy(scene.structure, after.y)
    return Account(ledger, jnp.where(just_kicked, vibration, account.vibration))


def look(course: Course, lane: Lane, reached: Bool[Array, ""]) -> tuple[Lane, Bool[Array, ""]]:
    """A look at how near the lane is to the known limit cycle, and whether it has `reached` it by now."""
    crossing = course.scene.structure.weights * lane.orbit.latest
    approach, reached_now = attractors.approached(lane.approach, course.attractor, crossing)
    return eqx.tree_at(lambda lane: lane.approach, lane, approach), reached | reached_now


def conclude(course: Course, began: Float[Array, ""], lane: Lane, reached: Bool[Array, ""]) -> Lane:
    """The lane with the verdict, if it can be proved by now; it has been followed since the time `began` (s) and has
    `reached` its known limit cycle, or not.
    """
    scene, mechanics, modes = course.scene, course.mechanics, course.modes
    structure = scene.structure
    weights = structure.weights
    reached = reached & ~lane.orbit.returned
    amplitude = jnp.where(reached, course.attractor.amplitude, lane.orbit.amplitude)
    lane = eqx.tree_at(lambda lane: lane.orbit.amplitude, lane, amplitude)
    equilibrium, velocity = modes.linear.equilibrium, structure.size + structure.tangential
    yardstick = jnp.max(jnp.abs(weights * equilibrium)) + weights[velocity] * jnp.abs(scene.belt_speed)
    grown = jnp.max(jnp.abs(weights * lane.y)) > GROWTH * yardstick
    wedged = sticks_forever(course.wedge, mechanics.of_totals, lane.contact, lane.y + equilibrium)
    quiet_load = jnp.all(scene.load.jumps <= lane.t)
    verdict = jnp.where(
        ~jnp.all(jnp.isfinite(lane.y)),
        Verdict.NOT_FINITE,
        jnp.where(
            lane.t <= began,
            Verdict.TOO_MANY_EVENTS,
            jnp.where(
                slides_forever(mechanics, modes, lane.contact, lane.y, quiet_load),
                Verdict.SLIDING,
                jnp.where(
                    quiet_load & (lane.orbit.returned | reached),
                    Verdict.LIMIT_CYCLE,
                    jnp.where(
                        quiet_load & (wedged | grown),
                        Verdict.UNBOUNDED,
                        Verdict.UNDECIDED,
                    ),
                ),
            ),
        ),
    )
    return eqx.tree_at(lambda lane: lane.verdict, lane, verdict.astype(jnp.int8))
