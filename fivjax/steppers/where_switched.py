"""Status switching at step ends, on top of any explicit Runge–Kutta solver of diffrax."""

from typing import ClassVar

import diffrax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from .. import contact as physics
from ..contact import Contact, Mechanics, State
from ..foundation import arguments
from ..model.scene import Scene
from .base import AbstractStepper, Advance, StepperState, Within, advance_between, rates


class WhereSwitched(AbstractStepper):
    """Any explicit Runge–Kutta solver of diffrax, with the contact's status decided at the end of each step.

    Within a step the status is fixed, and its smooth vector field (selected by `jnp.where`, so that a batch of trajectories in
    different statuses is one computation) is integrated to the solver's order. The guards are checked at the end of the step.
    So an event is noticed up to one step late: after an event the error is **first order in `dt`**, whatever the solver's
    order, and a contact shorter than a step is missed.

    **Arguments:** `solver`, for instance `diffrax.Tsit5()`; `dt`, the step in s (in a plain `diffeqsolve`, the step
    size controller decides). Steps end on saved instants, so `simulate` takes equal parts of the time between two of them,
    each `dt` at most, and refuses a `dt` that is longer than that time.

    Steps should end at the jumps of the load: `simulate` and the maps see to that; in a plain `diffeqsolve` use
    `diffrax.StepTo` with these instants among its own, or `diffrax.ClipStepSizeController` about a `PIDController`.

    **Raises:** `TypeError` for a solver that is not an explicit Runge–Kutta method, `ValueError` for a step that is
    not positive.

    **Example:**

        >>> import diffrax
        >>> run = fj.simulate(scene, 0.4, 1e-3, fj.WhereSwitched(diffrax.Tsit5(), dt=5e-5))  # doctest: +SLOW
    """

    solver: diffrax.AbstractERK
    dt: float

    round: ClassVar = 1024
    chooses_its_steps: ClassVar = False
    interpolation_cls: ClassVar = diffrax.ThirdOrderHermitePolynomialInterpolation

    def __init__(self, solver: diffrax.AbstractERK | None = None, dt: float = 5e-5):
        solver = diffrax.Tsit5() if solver is None else solver
        arguments.instance(
            "solver", solver, diffrax.AbstractERK, "an explicit Runge–Kutta solver, such as diffrax.Tsit5()"
        )
        arguments.real_number("dt", dt, above=0)
        self.solver = solver
        self.dt = float(dt)

    def order(self, terms) -> int | None:
        # Of the smooth motion between events.
        return self.solver.order(terms)

    def step(self, terms, t0, t1, y0: State, args: Scene, solver_state: StepperState, made_jump):
        mechanics, contact = solver_state.mechanics, solver_state.contact
        # Steps end at jumps of the load, so the load at mid-step is that of the whole step.
        load, h = args.load(0.5 * (t0 + t1)), t1 - t0
        smooth, error = self._smooth_step(mechanics, contact, load, y0, h)
        y1, next_contact, _ = self._switched(mechanics, contact, load, smooth, h)
        dense_info = {
            "y0": y0,
            "y1": y1,
            "k0": h * rates(mechanics, contact, load, y0),
            "k1": h * rates(mechanics, next_contact, load, y1),
        }
        return y1, error, dense_info, StepperState(mechanics, next_contact), diffrax.RESULTS.successful

    def advance(
        self,
        mechanics: Mechanics,
        contact: Contact,
        load: Float[Array, ""],
        y: State,
        h: Float[Array, ""],
        at_section: bool = False,
    ) -> Advance:
        del at_section  # steps are not shortened to end on the section
        smooth, _ = self._smooth_step(mechanics, contact, load, y, h)
        y_next, next_contact, ended = self._switched(mechanics, contact, load, smooth, h)
        return advance_between(y, smooth, ended, y_next, next_contact, h, mechanics)

    def within(
        self, mechanics: Mechanics, contact: Contact, load: Float[Array, ""], y: State, h: Float[Array, ""]
    ) -> Within:
        # The stages and weights of the step itself: the same as if the integral were one more state.
        tableau = self.solver.tableau
        states, stages = self._stages(mechanics, contact, load, y, h)
        weights = h * jnp.asarray(tableau.b_sol, y.dtype)
        times = h * jnp.asarray([0.0, *tableau.c], y.dtype)
        return Within(jnp.stack(states), weights, times, y + h * _weighted(tableau.b_sol, stages))

    def _smooth_step(self, mechanics, contact, load, y, h) -> tuple[State, State]:
        """The status's vector field integrated over the step, and diffrax's error estimate."""
        tableau = self.solver.tableau
        _, stages = self._stages(mechanics, contact, load, y, h)
        return y + h * _weighted(tableau.b_sol, stages), h * _weighted(tableau.b_error, stages)

    def _stages(self, mechanics, contact, load, y, h) -> tuple[list[State], list[State]]:
        """The states of the Runge–Kutta stages, and the rates there."""
        # The stages are written out instead of calling `solver.step`: diffrax loops over a buffer of stages, which
        # XLA cannot fuse; written out, a batch runs three to five times faster.
        states, stages = [y], [rates(mechanics, contact, load, y)]
        for row in self.solver.tableau.a_lower:
            states.append(y + h * _weighted(row, stages))
            stages.append(rates(mechanics, contact, load, states[-1]))
        return states, stages

    def _switched(self, mechanics, contact, load, smooth, h) -> tuple[State, Contact, Bool[Array, "*contacts 2"]]:
        ended = physics.guards(mechanics, contact, load, smooth) < 0
        # An impact that is noticed up to a step late is too fast by that much, which would keep rebounds of up to e/(1 - e)
        # steps going for ever.
        e = jnp.max(mechanics.restitution) if mechanics.several else mechanics.restitution
        resolution = h * jnp.clip(2 * e / jnp.maximum(1 - e, 0.01), 2.0, 200.0)
        next_contact, y = physics.transition(mechanics, contact, load, smooth, ended, resolution, lifts_rest=True)
        return y, next_contact, ended


def _weighted(weights, stages: list[State]) -> State:
    terms = [float(weight) * stage for weight, stage in zip(weights, stages, strict=True) if weight != 0]
    return sum(terms[1:], terms[0]) if terms else jnp.zeros_like(stages[0])
