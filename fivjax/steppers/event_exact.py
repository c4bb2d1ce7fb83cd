r"""Steps that end exactly on contact events.

Between events the motion is smooth, so its Taylor series at the start of an advance gives everything: how far the series is
accurate, where a guard is used up first, and the state there. Except for friction that depends on slip speed, the physics of
`contact` is linear in the state, so the same functions map Taylor coefficients to Taylor coefficients.
"""

import math
from typing import ClassVar, TypeVar, cast

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from diffrax import AbstractLocalInterpolation
from jaxtyping import Array, Bool, Float

from .. import contact as physics
from ..contact import Contact, Mechanics, State, Status
from ..contact.rounding import RESTING
from ..foundation import arguments
from ..foundation.carried import depending_on
from ..foundation.polynomial import in_shares, value_and_slope
from ..model.load import AbstractLoad, load_from, next_jump
from ..model.scene import Scene
from .base import MOST_ADVANCES, AbstractStepper, Advance, StepperState, Within, advance_between
from .core import end_after, next_part
from .guard_roots import implicit_root, march_to_roots, together
from .law_agreement import agreeing
from .motion_series import MotionSeries, fastest_in_mode, guard_rounding, series_of
from .section import before_section, section_speed
from .step_length import LONGEST_STEP, attainable, time_unit, trusted

Stepper = TypeVar("Stepper", bound=AbstractStepper)

# Whether a guard begins at zero is told by what it comes to in so many units of time: some rad of the fastest vibration.
NEAR = 8.0


class EventExact(AbstractStepper):
    """A Taylor-series solver that ends its advances exactly on contact events: exact to rounding through all of them.

    - The earliest of several events is taken, found on the series itself from the start of the advance onwards; a guard
      that dips below zero and returns within the advance is found too.
    - A guard that starts at zero, because the status has just begun there, does not fire at its own start.
    - After an event the state is put exactly on its constraint, and the next status follows from the forces.

    In a plain `diffeqsolve` the load may jump within a step. A derivative by the instant of a jump is lost where a step ends on
    that very instant.

    Event times are differentiable in forward and reverse mode, as roots of the series, by the implicit function.

    **Arguments:** `order` of the series; `tolerance`, the size of its last terms relative to the motion, which limits the
    duration of an advance; `dt`, the longest advance in s (no limit by default); `for_deviations`, whether steps are short
    enough for small deviations from the motion, too: derivatives have it whatever is said here.

    **Raises:** `ValueError` for an order below 4, or a tolerance or `dt` that is not positive.

    **Example:**

        >>> run = fj.simulate(scene, 0.4, 1e-3, fj.EventExact(order=20, tolerance=1e-17))  # doctest: +SLOW
    """

    order_: int = eqx.field(static=True)
    tolerance: float = eqx.field(static=True)
    dt: float = eqx.field(static=True)
    for_deviations: bool = eqx.field(static=True)

    round: ClassVar = 64
    interpolation_cls: ClassVar = staticmethod(lambda **info: _Restepped(**info))

    def __init__(
        self, order: int = 20, tolerance: float = 1e-15, dt: float = math.inf, *, for_deviations: bool = False
    ):
        order = arguments.whole_number("order", order, minimum=4)
        arguments.real_number("tolerance", tolerance, above=0)
        if not (isinstance(dt, float) and dt == math.inf):
            arguments.real_number("dt", dt, above=0)
        self.order_ = order
        self.tolerance = float(tolerance)
        self.dt = float(dt)
        self.for_deviations = bool(for_deviations)

    def order(self, terms) -> int:
        return self.order_

    def step(self, terms, t0, t1, y0: State, args: Scene, solver_state: StepperState, made_jump):
        mechanics, contact = solver_state.mechanics, solver_state.contact
        # diffrax fills what it has not reached with infinity, which is no whole number.
        mode = jax.tree.map(lambda part: part.astype(y0.dtype), contact)
        dense_info = {"y0": y0, "mode": mode, "mechanics": mechanics, "load": args.load, "stepper": self}
        y, contact, enough = _through_jumps(self, mechanics, contact, args.load, y0, t0, t1)
        result = diffrax.RESULTS.where(enough, diffrax.RESULTS.successful, diffrax.RESULTS.internal_error)
        return y, None, dense_info, StepperState(mechanics, contact), result

    def advance(
        self,
        mechanics: Mechanics,
        contact: Contact,
        load: Float[Array, ""],
        y: State,
        h: Float[Array, ""],
        at_section: bool = False,
    ) -> Advance:
        return self.with_series(mechanics, contact, load, y, h, at_section)[0]

    # Traced once for all functions that step so.
    @eqx.filter_jit
    def with_series(
        self,
        mechanics: Mechanics,
        contact: Contact,
        load: Float[Array, ""],
        y: State,
        h: Float[Array, ""],
        at_section: bool = False,
    ) -> tuple[Advance, Float[Array, "coefficient state"], Float[Array, ""]]:
        """The same, with the Taylor coefficients of the motion on the way, and the unit of their time, in s."""
        # The share of a step behind a fall of the tangential velocity through zero at which it ends, if there is a rise behind
        # it.
        fallen = 1e-3
        unit = time_unit(mechanics)
        series = series_of(mechanics, contact, load, y, self.order_, unit)
        states = series.states
        rounding = guard_rounding(mechanics, contact, load, y, unit, series.mode)
        # With several contacts, the two guards of the first, then those of the second, …
        guards, rounding = (rows.reshape(len(rows), -1) for rows in (series.guards, rounding))
        exact = physics.exactly_zero(contact).T.ravel()
        n, count = y.shape[0] // 2, 2 * len(mechanics.places)
        before, ends = before_section(mechanics, y), np.ones(count, bool)
        if at_section:
            # One more row for the rise through zero of the tangential velocity, no event of the contact; or for its fall.
            speed = jax.vmap(lambda state: section_speed(mechanics, state))(states)
            guards = jnp.concatenate([guards, jnp.where(before, -speed, speed)[:, None]], axis=1)
            # With several contacts, a small distance from the section is no rounding error.
            rounding = jnp.pad(rounding, ((0, 0), (0, 1)))
            exact, ends = jnp.append(exact, mechanics.several), jnp.append(ends, before)
        reach = jnp.minimum(h / unit, self._longest(mechanics, contact, series, unit))
        # Before the coefficients are scaled by it: over a longer time they may diverge, and roots be wrong.
        reach = reach * self._agreeing(mechanics, contact, series, reach)
        scaled = in_shares(guards, reach)
        near = jnp.minimum(1.0, NEAR / jax.lax.stop_gradient(reach))
        safe, fires = march_to_roots(jax.lax.stop_gradient(scaled), in_shares(rounding, reach), exact, near, ends)
        if at_section:
            # A fall is no event; but where there is a rise behind it, the step ends a little after it, so that the next one
            # sees the rise.
            fell, row = fires[count] & ~before, jnp.arange(count + 1) == count
            fall, end = safe[count], jnp.min(safe[:count])
            again = jax.lax.cond(
                fell & (fall < end), lambda: _rises(jax.lax.stop_gradient(scaled[:, count]), fall, end), lambda: False
            )
            safe = jnp.where(row & fell, jnp.where(again, jnp.minimum(fall + fallen, 1.0), 1.0), safe)
            fires = fires & (before | ~row)
        first = jnp.min(safe)
        # Guards whose roots differ by rounding only run out together.
        at_once = safe <= first * (1 + 4 * jnp.finfo(y.dtype).eps)
        if mechanics.several:
            at_once = together(mechanics, scaled, at_once & fires, first)
            fires = at_once
        else:
            fires = fires & at_once
        x = jnp.where(jnp.any(fires), implicit_root(scaled, fires, first, self.tolerance), first)
        ended = fires[:count].reshape(*contact.status.shape, 2)
        reached, _ = value_and_slope(states, x * reach)
        if at_section and not mechanics.several:
            reached = jnp.where((jnp.arange(2 * n) == n + mechanics.tangential) & fires[count], 0.0, reached)
        reached = physics.on_constraint(mechanics, contact, reached)
        if not mechanics.friction.constant:
            reached = jnp.where(physics.is_beyond_the_model(mechanics, contact, series.friction[0]), jnp.nan, reached)
        resting = RESTING[y.dtype.name] * unit
        next_contact, y_next = physics.transition(mechanics, contact, load, reached, ended, resting)
        h = x * reach * unit
        return advance_between(y, reached, ended, y_next, next_contact, h, mechanics), states, unit

    def within(
        self, mechanics: Mechanics, contact: Contact, load: Float[Array, ""], y: State, h: Float[Array, ""]
    ) -> Within:
        # The advance uses the same series; compiled together with it, the series is computed once. With this many Gauss points,
        # a product of two series is integrated with an error far below that of the series itself.
        unit = time_unit(mechanics)
        states = series_of(mechanics, contact, load, y, self.order_, unit).states
        points, weights = np.polynomial.legendre.leggauss(self.order_ // 2 + 2)
        times = 0.5 * (points + 1.0) * h
        inside, _ = value_and_slope(states[:, None], times[:, None] / unit)
        end, _ = value_and_slope(states, h / unit)
        return Within(inside, 0.5 * h * weights, times, end)

    def in_one_mode(
        self,
        mechanics: Mechanics,
        contact: Contact,
        y: State,
        h: Float[Array, ""],
        load: Float[Array, ""] | float = 0.0,
    ) -> State:
        """The motion in one contact mode for a time `h` (s, of either sign) under a load (N), regardless of its guards."""
        unit = time_unit(mechanics)
        load = jnp.asarray(load, y.dtype)

        def step(carry):
            y, left, _ = carry
            series = series_of(mechanics, contact, load, y, self.order_, unit)
            longest = jnp.minimum(self._longest(mechanics, contact, series, unit), LONGEST_STEP) * unit
            longest = jax.lax.stop_gradient(longest)
            last = jnp.abs(left) <= longest
            part = jnp.where(last, left, jnp.sign(left) * longest)
            share = self._agreeing(mechanics, contact, series, part / unit)
            part = part * share
            reached, _ = value_and_slope(series.states, part / unit)
            return reached, left - part, ~(last & (share == 1))

        # At least one step, so that there is a derivative with respect to `h` at zero, too.
        begin = y, jnp.asarray(h, y.dtype), jnp.asarray(True)
        return jax.lax.while_loop(lambda carry: carry[2], step, begin)[0]

    def _longest(self, mechanics: Mechanics, contact: Contact, series: MotionSeries, unit) -> Float[Array, ""]:
        """The longest step from where a series begins, in units of time, whatever the law of friction says."""
        longest = jnp.minimum(self.dt / unit, trusted(series.states, self.tolerance))
        if not self.for_deviations:
            return longest
        rate = fastest_in_mode(mechanics, contact, series.mode)
        return jnp.minimum(longest, self._angle(rate.dtype) / unit / rate)

    def _angle(self, dtype) -> float:
        """By how much (rad) the phase of a vibration may advance in a step: for an angle a, the error of the series is
        a^(order + 1) / (order + 1)!.
        """
        # How much larger a step's relative error may be in a derivative than in the motion.
        looser = 10
        after = self.order_ + 1
        tolerance = looser * attainable(self.tolerance, dtype)
        return math.exp((math.log(tolerance) + math.lgamma(after + 1)) / after)

    def _agreeing(
        self, mechanics: Mechanics, contact: Contact, series: "MotionSeries", reach
    ) -> Float[Array, ""] | float:
        """The share of a step of this length, in units of time, over which friction is that of the law."""
        law = mechanics.friction
        if law.constant:
            return 1.0
        return jax.lax.cond(
            jnp.any(contact.status == Status.SLIDE),
            lambda: agreeing(law, contact, series.friction, series.slip, reach, self.tolerance),
            lambda: jnp.ones_like(reach),
        )


def _rises(speed: Float[Array, " k"], fall: Float[Array, ""], end: Float[Array, ""]) -> Bool[Array, ""]:
    """Whether a velocity that falls through zero has risen through it again before the end of a step, by its samples."""
    # Samples behind the fall that tell.
    samples = 16
    values, _ = value_and_slope(speed, fall + (end - fall) * np.arange(1, samples + 1) / samples)
    return jnp.any(values >= 0)


def for_derivatives(stepper: Stepper) -> Stepper:
    """The stepper with steps short enough for derivatives.

    The length of a step is chosen for the *motion*. Where a fast mode of vibration is at rest, steps are too long for a
    deviation in that mode.
    """
    if not isinstance(stepper, EventExact):
        return stepper
    short = EventExact(stepper.order_, stepper.tolerance, stepper.dt, for_deviations=True)
    return cast(Stepper, short)


# How motions are followed wherever no method is asked for.
EXACT_STEPPER = EventExact()


class _Restepped(AbstractLocalInterpolation):
    """States inside a step, by stepping again from its start: as exact as the step, through every event in it."""

    t0: Float[Array, ""]
    t1: Float[Array, ""]
    y0: State
    mode: Contact  # as numbers of the type of the state
    mechanics: Mechanics
    load: AbstractLoad
    stepper: EventExact

    def evaluate(self, t0, t1=None, left=True):
        del left
        if t1 is not None:
            return self.evaluate(t1) - self.evaluate(t0)
        contact = Contact(self.mode.status.astype(jnp.int32), self.mode.direction)
        return _through_jumps(self.stepper, self.mechanics, contact, self.load, self.y0, self.t0, t0)[0]


def _through_jumps(
    stepper: EventExact,
    mechanics: Mechanics,
    contact: Contact,
    load: AbstractLoad,
    y: State,
    t0: Float[Array, ""],
    t1: Float[Array, ""],
) -> tuple[State, Contact, Bool[Array, ""]]:
    """The state and contact mode at `t1` (s), from those at `t0`, under a load that may jump in between; and whether the number
    of advances was enough.
    """

    def body(carry):
        t, y, contact = carry
        until = jnp.minimum(next_jump(load, t), t1)
        part, is_last = next_part(until - t, stepper.dt)
        after = stepper.advance(mechanics, contact, load_from(load, t), y, part)
        return end_after(after, t, until, is_last), after.y, after.contact

    def going(carry):
        return carry[0] < t1

    begin = depending_on((mechanics, load, y, t1), (jnp.asarray(t0, y.dtype), y, contact))
    t, y, contact = eqx.internal.while_loop(going, body, begin, max_steps=MOST_ADVANCES, kind="bounded")
    return y, contact, ~(t < t1)
