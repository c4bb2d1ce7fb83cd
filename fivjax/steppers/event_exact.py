r"""Steps that end exactly on contact events.

Between events the motion is smooth, so its Taylor series at the start of an advance gives everything: how far the series is
accurate, where a guard is used up first, and the state there. Except for friction that depends on slip speed, the physics of
`contact` is linear in the state, so the same functions map Taylor coefficients to Taylor coefficients.
"""

import math
from typing import ClassVar, NamedTuple, TypeVar

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from diffrax import AbstractLocalInterpolation
from jaxtyping import Array, Bool, Float

from .. import contact as physics
from ..contact import Contact, Mechanics, ModeForces, State
from ..contact.rounding import RESTING, largest_rounding, zero_at_start
from ..foundation import arguments
from ..foundation.polynomial import in_shares, ratio, value_and_slope, value_slope_and_bend
from ..model.scene import Scene
from .base import AbstractStepper, Advance, StepperState, Within, advance_between
from .core import follow
from .law_agreement import agreeing
from .section import before_section, section_speed
from .step_length import LONGEST_STEP, attainable, fastest_rate, time_unit, trusted

Stepper = TypeVar("Stepper", bound=AbstractStepper)

MOST_ROOT_STEPS = 60
# How much larger a step's relative error may be in a derivative than in the motion.
LOOSER = 100


class EventExact(AbstractStepper):
    """A Taylor-series solver that ends its advances exactly on contact events: exact to rounding through all of them.

    - The earliest of several events is taken, found on the series itself from the start of the advance onwards; a guard
      that dips below zero and returns within the advance is found too.
    - A guard that starts at zero, because the status has just begun there, does not fire at its own start.
    - After an event the state is put exactly on its constraint, and the next status follows from the forces.

    Event times are differentiable in forward and reverse mode: the root is corrected by Newton steps whose derivative is that
    of the implicit function.

    **Arguments:** `order` of the series; `tolerance`, the size of its last terms relative to the motion, which limits the
    duration of an advance; `dt`, the longest advance in s (no limit by default).

    **Raises:** `ValueError` for an order below 4, or a tolerance or `dt` that is not positive.

    **Example:**

        >>> run = fj.simulate(scene, 0.4, 1e-3, fj.EventExact(order=20, tolerance=1e-17))  # doctest: +SLOW
    """

    order_: int = eqx.field(static=True)
    tolerance: float
    dt: float

    round: ClassVar = 64
    interpolation_cls: ClassVar = staticmethod(lambda **info: _Restepped(**info))

    def __init__(self, order: int = 16, tolerance: float = 1e-15, dt: float = math.inf):
        arguments.whole_number("order", order, minimum=4)
        arguments.real_number("tolerance", tolerance, above=0)
        if not (isinstance(dt, float) and dt == math.inf):
            arguments.real_number("dt", dt, above=0)
        self.order_ = int(order)
        self.tolerance = float(tolerance)
        self.dt = float(dt)

    def order(self, terms) -> int:
        return self.order_

    def prepare(self, mechanics: Mechanics) -> Mechanics:
        return mechanics

    def step(self, terms, t0, t1, y0: State, args: Scene, solver_state: StepperState, made_jump):
        mechanics, contact = solver_state.mechanics, solver_state.contact
        # Steps end at jumps of the load, so the load at mid-step is that of the whole step.
        load = args.load(0.5 * (t0 + t1))
        after = follow(self, mechanics, contact, load, y0, t1 - t0)
        dense_info = {"y0": y0, "contact": contact, "mechanics": mechanics, "load": load, "stepper": self}
        result = diffrax.RESULTS.where(after.enough, diffrax.RESULTS.successful, diffrax.RESULTS.internal_error)
        return after.y, None, dense_info, StepperState(mechanics, after.contact), result

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
        unit = time_unit(mechanics)
        series = _series(mechanics, contact, load, y, self.order_, unit)
        states = series.states
        rounding = _rounding(mechanics, contact, load, y, unit, series.mode)
        # With several contacts, the two guards of the first, then those of the second, …
        guards, rounding = (rows.reshape(len(rows), -1) for rows in (series.guards, rounding))
        exact = physics.exactly_zero(contact).T.ravel()
        n, count = y.shape[0] // 2, 2 * len(mechanics.places)
        if at_section:
            # One more row for the rise through zero of the tangential velocity, no event of the contact.
            rising = -jax.vmap(lambda state: section_speed(mechanics, state))(states)
            guards = jnp.concatenate([guards, rising[:, None]], axis=1)
            # With several contacts, a small distance from the section is no rounding error.
            rounding = jnp.pad(rounding, ((0, 0), (0, 1)))
            exact = jnp.append(exact, mechanics.several)
        reach = jnp.minimum(jnp.minimum(h, self.dt) / unit, trusted(states, self.tolerance))
        # Before the coefficients are scaled by it: over a longer time they may diverge, and roots be wrong.
        reach = reach * self._agreeing(mechanics, contact, series, reach)
        scaled = in_shares(guards, reach)
        safe, fires = _march_to_roots(jax.lax.stop_gradient(scaled), in_shares(rounding, reach), exact)
        if at_section:
            watching = jnp.arange(count + 1) < count + before_section(mechanics, y)
            safe, fires = jnp.where(watching, safe, 1.0), fires & watching
        first = jnp.min(safe)
        # Guards whose roots differ by rounding only run out together.
        together = safe <= first * (1 + 4 * jnp.finfo(y.dtype).eps)
        if mechanics.several:
            together = _together(mechanics, scaled, together & fires, first)
            fires = together
        else:
            fires = fires & together
        x = jnp.where(jnp.any(fires), _implicit(scaled, fires, first), first)
        ended = fires[:count].reshape(*contact.status.shape, 2)
        reached, _ = value_and_slope(states, x * reach)
        if at_section and not mechanics.several:
            reached = jnp.where((jnp.arange(2 * n) == n + mechanics.tangential) & fires[count], 0.0, reached)
        reached = physics.on_constraint(mechanics, contact, reached)
        if not mechanics.friction.constant:
            reached = jnp.where(physics.is_beyond_the_model(mechanics, contact, series.friction[0]), jnp.nan, reached)
        resting = RESTING[y.dtype.name] * reach * unit
        next_contact, y_next = physics.transition(mechanics, contact, load, reached, ended, resting)
        h = x * reach * unit
        return advance_between(y, reached, ended, y_next, next_contact, h, mechanics), states, unit

    def within(
        self, mechanics: Mechanics, contact: Contact, load: Float[Array, ""], y: State, h: Float[Array, ""]
    ) -> Within:
        # The advance uses the same series; compiled together with it, the series is computed once. With this many Gauss points,
        # a product of two series is integrated with an error far below that of the series itself.
        unit = time_unit(mechanics)
        states = _series(mechanics, contact, load, y, self.order_, unit).states
        points, weights = np.polynomial.legendre.leggauss(self.order_ // 2 + 2)
        times = 0.5 * (points + 1.0) * h
        inside, _ = value_and_slope(states[:, None], times[:, None] / unit)
        end, _ = value_and_slope(states, h / unit)
        return Within(inside, 0.5 * h * weights, times, end)

    def series(
        self, mechanics: Mechanics, contact: Contact, load: Float[Array, ""], y: State
    ) -> tuple[Float[Array, "coefficient state"], Float[Array, ""]]:
        """Taylor coefficients in time of the motion in one contact mode, and the unit of that time, in s."""
        unit = time_unit(mechanics)
        return _series(mechanics, contact, load, y, self.order_, unit).states, unit

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
            series = _series(mechanics, contact, load, y, self.order_, unit)
            longest = jax.lax.stop_gradient(jnp.minimum(trusted(series.states, self.tolerance), LONGEST_STEP) * unit)
            longest = jnp.minimum(longest, self.dt)
            last = jnp.abs(left) <= longest
            part = jnp.where(last, left, jnp.sign(left) * longest)
            share = self._agreeing(mechanics, contact, series, part / unit)
            part = part * share
            reached, _ = value_and_slope(series.states, part / unit)
            return reached, left - part, ~(last & (share == 1))

        # At least one step, so that there is a derivative with respect to `h` at zero, too.
        begin = y, jnp.asarray(h, y.dtype), jnp.asarray(True)
        return jax.lax.while_loop(lambda carry: carry[2], step, begin)[0]

    def _agreeing(self, mechanics: Mechanics, contact: Contact, series: "_Series", reach) -> Float[Array, ""] | float:
        """The share of a step of this length, in units of time, over which friction is that of the law."""
        law = mechanics.friction
        if law.constant:
            return 1.0
        return agreeing(law, contact, series.friction, series.slip, reach, self.tolerance)


def for_derivatives(stepper: Stepper, mechanics: Mechanics) -> Stepper:
    """The stepper with steps short enough for derivatives.

    The length of a step is chosen for the *motion*. Where a fast mode of vibration is at rest, steps are too long for a
    deviation in that mode: if its phase advances by a (rad) in a step, the error of the series is a^(order + 1) / (order + 1)!.
    """
    if not isinstance(stepper, EventExact):
        return stepper
    rate, after = fastest_rate(mechanics), stepper.order_ + 1
    tolerance = LOOSER * attainable(stepper.tolerance, rate.dtype)
    angle = (tolerance * math.factorial(after)) ** (1.0 / after)
    return eqx.tree_at(lambda own: own.dt, stepper, jnp.minimum(stepper.dt, angle / rate))


class _Series(NamedTuple):
    """Taylor coefficients, in time measured in a unit; and the forces of the mode at the start."""

    states: Float[Array, "k state"]
    guards: Float[Array, "k *contacts 2"]
    slip: Float[Array, "k *contacts"]
    friction: Float[Array, "j *contacts"]  # of μ; only its value, if it is constant
    mode: ModeForces


def _series(
    mechanics: Mechanics, contact: Contact, load: Float[Array, ""], y: State, order: int, unit: Float[Array, ""]
) -> _Series:
    """Taylor coefficients of the motion in one contact mode, in time measured in `unit` (s).

    The physics is linear in the state except for T = σμN, so it maps coefficients to coefficients; the constant terms (load,
    belt speed) enter with the first. T = σμN is the product of two series.
    """
    n = y.shape[0] // 2
    slip = physics.slip_speed(mechanics, contact, y)
    friction = [mechanics.friction(slip)]
    mode = ModeForces(mechanics, contact, friction[0])

    def following(own: Mechanics, force, state: State, slip, otherwise, divisor):
        """What follows from one coefficient of the state: the next, and those of the guards and of N."""
        free = physics.free_acceleration(own, force, state)
        forces = mode.added(own, free, otherwise)
        guards = physics.guards_under(own, contact, *forces, slip, physics.gap(own, state))
        rate = jnp.concatenate([state[n:], physics.acceleration_under(own, contact, free, *forces)])
        return rate * (unit / divisor), guards, physics.total_forces(own, *forces)[1]

    changes, none = mechanics.homogeneous, jnp.zeros_like(load)
    state, guards, normal_force = following(mechanics, load, y, slip, None, 1)
    if mechanics.friction.constant:

        def next_one(state: State, divisor):
            slip = physics.slip_speed(changes, contact, state)
            further, guards, _ = following(changes, none, state, slip, None, divisor)
            return further, (state, guards, slip)

        # A loop that XLA unrolls, and that kernels keep.
        _, rows = jax.lax.scan(next_one, state, np.arange(2.0, order + 2.0, dtype=y.dtype), unroll=True)
        first = y, guards, slip
        states, guards, slips = (jnp.concatenate([one[None], more]) for one, more in zip(first, rows, strict=True))
        return _Series(states, guards, slips, friction[0][None], mode)
    next_term = mechanics.friction.in_time(slip, order)
    states, all_guards, slips, normal_forces = [y], [guards], [slip], [normal_force]
    for k in range(1, order + 1):
        states.append(state)
        slips.append(physics.slip_speed(changes, contact, state))
        friction.append(next_term(slips, friction))
        otherwise = contact.direction * sum(
            (friction[j] * normal_forces[k - j] for j in range(2, k + 1)), friction[1] * normal_forces[k - 1]
        )
        state, guards, normal_force = following(changes, none, state, slips[k], otherwise, k + 1)
        all_guards.append(guards)
        normal_forces.append(normal_force)
    return _Series(*map(jnp.stack, (states, all_guards, slips, friction)), mode)


def _rounding(
    mechanics: Mechanics,
    contact: Contact,
    load: Float[Array, ""],
    y: State,
    unit: Float[Array, ""],
    mode: ModeForces,
) -> Float[Array, "3 *contacts 2"]:
    """Bounds on the rounding of the first three coefficients of the guards."""
    mechanics, contact, load, y, mode = jax.lax.stop_gradient((mechanics, contact, load, y, mode))

    def following(own: Mechanics, force, sizes: State, divisor):
        guards, rates = physics.magnitudes(own, contact, force, sizes, mode)
        return rates * (unit / divisor), largest_rounding(guards)

    sizes, first = following(mechanics, load, jnp.abs(y), 1)
    changes, none = mechanics.homogeneous, jnp.zeros_like(load)
    _, rest = jax.lax.scan(
        lambda sizes, divisor: following(changes, none, sizes, divisor),
        sizes,
        np.array([2.0, 3.0], y.dtype),
        unroll=True,
    )
    return jnp.concatenate([first[None], rest])


def _together(
    mechanics: Mechanics, scaled: Float[Array, "k g"], fires: Bool[Array, " g"], first: Float[Array, ""]
) -> Bool[Array, " g"]:
    """Which of the guards of several contacts that run out at the end of the advance are one event.

    An event of one contact acts at once on the contacts that the mass matrix couples with it. So their simultaneous events,
    even if the instants differ by rounding, are one event. Simultaneous events of other contacts follow one after another,
    perhaps with no time in between: each then has its own instant, and its own derivative.
    """
    count = 2 * len(mechanics.places)
    chosen = jax.lax.argmax(fires, 0, jnp.int32)
    among = physics.coupled_with(mechanics, jnp.minimum(chosen, count - 1) // 2)
    own = jnp.arange(count) // 2 == chosen // 2
    own_guards = jax.lax.stop_gradient(scaled[:, :count])
    values, slopes = value_and_slope(own_guards, first)
    size = jnp.sum(jnp.abs(own_guards), axis=0)
    nearly = (values <= 64 * jnp.finfo(size.dtype).eps * size) & (slopes < 0)
    coupled = jnp.repeat(among, 2) & jnp.any(fires[:count])
    of_contacts = coupled & (fires[:count] | (nearly & ~own))
    # The row of the section, if there is one, belongs to no contact.
    return jnp.concatenate([of_contacts, fires[count:]])


def _march_to_roots(
    c: Float[Array, "k g"],
    rounding: Float[Array, "3 g"] | None = None,
    exact: Bool[Array, " g"] | None = None,
) -> tuple[Float[Array, " g"], Bool[Array, " g"]]:
    r"""How far in [0, 1] each polynomial $\sum c_k x^k$ is known to stay positive, and whether it has its first root there.

    It marches from zero by steps d in which no root is possible: a lower bound on the second derivative gives
    $g + g' d - B_2 d^2 / 2 > 0$, and where $g$, $g'$ and $g''$ are positive, one on the third gives
    $g' + g'' d / 2 - B_3 d^2 / 6 > 0$, which is needed at the flat start after a lift-off. On [0, 1] the negative coefficients
    alone give the bounds. So no root is skipped, a dip below zero inside the interval is found at its first crossing, and near
    a simple root the march converges quadratically. Roots at zero, where the status began, are divided out; with an `exact`
    start, a small value there is no rounding error. A march that uses up its steps has still shown that there is no root up to
    where it came.
    """
    eps = jnp.finfo(c.dtype).eps
    none = jnp.zeros_like(c[0])
    size, _ = jax.lax.scan(lambda size, own: (size + jnp.abs(own), None), none, c, unroll=True)
    rounding = jnp.zeros((3, *none.shape), none.dtype) if rounding is None else rounding
    exact = jnp.zeros_like(size, bool) if exact is None else exact
    zeros = zero_at_start(c, size, rounding, exact)

    def divided(carry, here):
        """The coefficient that this one becomes, and what it adds to the bounds."""
        (next_, next_but_one, third), bound_2, bound_3 = carry
        own, k = here
        after = next_, next_but_one, third
        found = own
        for place in range(3):
            found = jnp.where(zeros[place], after[place], found)
        falling = jnp.maximum(-found, 0.0)
        bound_2 = bound_2 + k * (k - 1) * falling
        bound_3 = bound_3 + k * (k - 1) * (k - 2) * falling
        return ((own, next_, next_but_one), bound_2, bound_3), found

    places = np.arange(len(c), dtype=c.dtype)
    (_, bound_2, bound_3), c = jax.lax.scan(divided, ((none,) * 3, none, none), (c, places), reverse=True, unroll=True)
    huge = 1.0 / eps

    # Already used up: after a jump of the load, or if the last advance ended short of the root by rounding.
    spent = c[0] < 0

    def open_(x, step):
        return ~spent & (x < 1) & (step > 2 * eps * x)

    def going(carry):
        x, step, count = carry
        return jnp.any(open_(x, step)) & (count < MOST_ROOT_STEPS)

    def march(carry):
        x, step, count = carry
        value, slope, bend = value_slope_and_bend(c, x)
        value = jnp.maximum(value, 0.0)
        root = jnp.sqrt(slope**2 + 2 * bound_2 * value)
        # Two forms of the same root, each used where it has no cancellation.
        falls = slope < 0
        quadratic = ratio(jnp.where(falls, 2 * value, slope + root), jnp.where(falls, root - slope, bound_2), huge)
        cubic = ratio(0.5 * bend + jnp.sqrt(0.25 * bend**2 + (2 / 3) * bound_3 * slope), bound_3 / 3, huge)
        onward = jnp.where((slope >= 0) & (bend >= 0), jnp.maximum(quadratic, cubic), quadratic)
        onward = jnp.where(open_(x, step), onward, step)
        return jnp.where(open_(x, step), x + onward, x), onward, count + 1

    x, step, _ = jax.lax.while_loop(going, march, (none, none + 1, jnp.zeros((), jnp.int32)))
    found = spent | ((x < 1) & (step <= 2 * eps * x))
    return jnp.where(size > 0, jnp.minimum(x, 1.0), 1.0), found & (size > 0)


def _implicit(scaled: Float[Array, "k g"], fires: Bool[Array, " g"], x: Float[Array, ""]) -> Float[Array, ""]:
    """The root with the derivatives of an implicit function.

    A Newton step from a converged root, with a constant slope, changes only the derivatives: after the first step the first
    derivatives are right, after the second one the second derivatives, too.
    """
    # An index of 64 bits could not be lowered in a single-precision program.
    chosen = jnp.arange(fires.shape[0]) == jax.lax.argmax(fires, 0, jnp.int32)
    for _ in range(2):
        values, slopes = value_and_slope(scaled, x)
        value = jnp.sum(jnp.where(chosen, values, 0.0))
        slope = jax.lax.stop_gradient(jnp.sum(jnp.where(chosen, slopes, 0.0)))
        correction = value / jnp.where(slope == 0, 1.0, slope)
        x = x - (correction - jax.lax.stop_gradient(correction))
    return x


class _Restepped(AbstractLocalInterpolation):
    """States inside a step, by stepping again from its start: as exact as the step, through every event in it."""

    t0: Float[Array, ""]
    t1: Float[Array, ""]
    y0: State
    contact: Contact
    mechanics: Mechanics
    load: Float[Array, ""]
    stepper: EventExact

    def evaluate(self, t0, t1=None, left=True):
        del left
        if t1 is not None:
            return self.evaluate(t1) - self.evaluate(t0)
        return follow(self.stepper, self.mechanics, self.contact, self.load, self.y0, t0 - self.t0).y
