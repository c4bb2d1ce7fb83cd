"""A trajectory from its start to its last saved instant, by steps that instants do not shorten: rows are read off the series of
the step that they lie in.

It is written for kernels, where a step's branches and loops cost only what is gone through.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from .. import contact as physics
from ..contact import Contact, Mechanics, State
from ..foundation.carried import depending_on
from ..foundation.polynomial import value_and_rate
from ..kernels.functions import KernelFunction
from ..kernels.tiered import THOROUGHLY
from ..model.load import load_from, next_jump
from ..model.scene import Scene
from ..steppers.base import advance_between
from ..steppers.core import Segment, end_after, next_part
from ..steppers.event_exact import EventExact, for_derivatives
from . import energy as accounts
from .ending import Ending
from .energy import EnergyData, Ledger
from .jump_instants import StartOfRun, start_of_run
from .rows import after_jump, grown, row_of
from .start import at_equilibrium


class MotionAsked(eqx.Module):
    """How a motion is followed, fixed when it is traced."""

    method: EventExact = eqx.field(static=True)
    energy: bool = eqx.field(static=True)


class Step(NamedTuple):
    """One step of a motion, and where it ended."""

    t: Float[Array, ""]  # s
    y: State
    contact: Contact
    load: Float[Array, ""]  # N
    series: Float[Array, "k state"]  # Taylor coefficients, in time measured in the unit
    unit: Float[Array, ""]  # s
    ledger: Ledger | None
    end: Float[Array, ""]  # s
    y_end: State
    contact_end: Contact
    ledger_end: Ledger | None
    highest: Float[Array, ""]  # the largest load so far, N
    # Since the last row.
    count: Int[Array, ""]
    events: Int[Array, ""]


def _motion(args, instants: Float[Array, " T"]) -> tuple[Int[Array, ""], dict]:
    """How a motion ended (an `Ending`), and its rows.

    `args`: the scene, the state at the first instant (None for the sliding equilibrium, whose derivatives then need no
    directions of their own), the most steps between two rows, and a `MotionAsked`.
    """
    return _followed(args, instants, args[3].method)


def _differentiated(args, instants: Float[Array, " T"]) -> tuple[Int[Array, ""], dict]:
    return _followed(args, instants, for_derivatives(args[3].method))


_by_kernel = KernelFunction(_motion, _differentiated, THOROUGHLY)


def rows_by_kernel(
    scene: Scene, method: EventExact, y0: State | None, saved: Float[Array, " T"], most: int, energy: bool
) -> tuple[Int[Array, ""], dict]:
    """What a `Trajectory` has at its saved instants, by name; and how the motion ended (an `Ending`). It starts at the sliding
    equilibrium unless `y0` is given.
    """
    ending, rows = _by_kernel((scene, y0, np.asarray(most, np.int32), MotionAsked(method, energy)), saved)
    rows["status"] = rows["status"].astype(np.int8)
    return ending, {"t": saved, **rows}


def _followed(args, instants, method: EventExact):
    scene, y0, most, how = args
    exists = jnp.ones((), bool)
    if y0 is None:
        y0, exists = at_equilibrium(scene)
    mechanics = Mechanics(scene)
    energy_data = EnergyData(scene) if how.energy else None
    begin = _first_step(scene, mechanics, y0, method, energy_data)

    def step(now: Step) -> Step:
        return _next_step(scene, mechanics, method, energy_data, now)

    def to_row(carry, instant):
        now, lost, ending = carry

        def going(now: Step) -> Bool[Array, ""]:
            return (now.end < instant) & (now.count < most)

        now = jax.lax.while_loop(going, step, now)
        y, ledger = _at(mechanics, method, energy_data, now, instant)
        finite = jnp.all(jnp.isfinite(y))
        # Too few steps, or a step of no length: the series does not reach the row.
        short = now.end < instant
        load = load_from(scene.load, instant)
        highest = jnp.maximum(now.highest, jnp.abs(load))
        beyond = ~lost & finite & ~short & grown(scene, y0, instant, highest, y)
        failure = jnp.where(
            beyond,
            Ending.UNBOUNDED,
            jnp.where(
                ~finite,
                Ending.NOT_FINITE,
                jnp.where(2 * now.events > most, Ending.TOO_MANY_EVENTS, Ending.STEP_FAILURE),
            ),
        )
        failing = ~lost & (beyond | ~finite | short)
        ending = jnp.where(failing, failure, ending).astype(jnp.int32)
        lost = lost | failing
        y, ledger = jax.tree.map(
            lambda leaf: jnp.where(lost, jnp.nan, leaf) if eqx.is_inexact_array(leaf) else leaf, (y, ledger)
        )
        # A row at a jump of the load shows the load and the contact just after it.
        on_jump = jnp.any(instant == scene.load.jumps) & (instant > instants_begin)
        contact, ledger = after_jump(mechanics, now.contact, ledger, load, y, on_jump)
        row = row_of(mechanics, energy_data, contact, load, y, ledger, lost)
        now = now._replace(highest=highest, count=jnp.zeros_like(now.count), events=jnp.zeros_like(now.events))
        return (now, lost, ending), row

    instants_begin = begin.t
    ending = jnp.where(exists, Ending.FINISHED, Ending.NO_EQUILIBRIUM).astype(jnp.int32)
    start = begin, ~exists, ending
    (_, _, ending), rows = jax.lax.scan(to_row, start, instants)
    return jnp.where(physics.slides_uniquely(mechanics), ending, Ending.PAINLEVE).astype(jnp.int32), rows


def _first_step(
    scene: Scene, mechanics: Mechanics, y0: State, method: EventExact, energy_data: EnergyData | None
) -> Step:
    """A step of no length at the start."""
    none, no = jnp.zeros((), y0.dtype), jnp.zeros((), jnp.int32)
    load = load_from(scene.load, none)
    contact = physics.status_from_forces(mechanics, load, y0)
    ledger = None if energy_data is None else accounts.open_ledger(energy_data, y0)
    series = jnp.zeros((method.order_ + 1, y0.shape[0]), y0.dtype).at[0].set(y0)

    def enter(ledger, segment: Segment):
        return accounts.entered(energy_data, method, mechanics, ledger, segment)

    start = StartOfRun(none, physics.stuck(mechanics, contact, y0), ledger)
    if method.for_deviations:
        start = start_of_run(scene, mechanics, contact, y0, none, ledger, enter)
    begin = Step(
        t=none,
        y=y0,
        contact=contact,
        load=load,
        series=series,
        unit=jnp.ones_like(none),
        ledger=ledger,
        end=start.t,
        y_end=start.y,
        contact_end=contact,
        ledger_end=start.total,
        highest=jnp.abs(load),
        count=no,
        events=no,
    )
    return depending_on((scene, method), begin)


def _next_step(scene: Scene, mechanics: Mechanics, method: EventExact, energy_data, now: Step) -> Step:
    t, y, contact = now.end, now.y_end, now.contact_end
    until = next_jump(scene.load, t)
    load = load_from(scene.load, t)
    part, is_last = next_part(until - t, method.dt)
    # The ledger counts crossings of the section.
    after, states, unit = method.with_series(mechanics, contact, load, y, part, energy_data is not None)
    ledger = accounts.entered(energy_data, method, mechanics, now.ledger_end, Segment(t, load, contact, y, after))
    return Step(
        t=t,
        y=y,
        contact=contact,
        load=load,
        series=states,
        unit=unit,
        ledger=now.ledger_end,
        end=end_after(after, t, until, is_last),
        y_end=after.y,
        contact_end=after.contact,
        ledger_end=ledger,
        highest=jnp.maximum(now.highest, jnp.abs(load)),
        count=now.count + 1,
        events=now.events + jnp.any(after.ended),
    )


def _at(mechanics: Mechanics, method: EventExact, energy_data, now: Step, instant) -> tuple[State, Ledger | None]:
    """The state and the ledger within a step."""
    y, _ = value_and_rate(now.series, now.unit, instant - now.t)
    y = physics.on_constraint(mechanics, now.contact, y)
    if energy_data is None:
        return y, None
    none = jnp.zeros((*now.contact.status.shape, 2), bool)
    after = advance_between(now.y, y, none, y, now.contact, instant - now.t, mechanics)
    segment = Segment(now.t, now.load, now.contact, now.y, after)
    return y, accounts.enter(energy_data, method, mechanics, now.ledger, segment)
