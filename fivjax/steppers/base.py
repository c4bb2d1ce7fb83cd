"""What the diffrax solvers of fivjax have in common.

They integrate the smooth vector field of the present status, find with `contact.transition` what follows when it ends, and
carry the status in their solver state. They work in a plain `diffrax.diffeqsolve`:

    sol = diffrax.diffeqsolve(
        diffrax.ODETerm(fj.vector_field), fj.WhereSwitched(diffrax.Tsit5()), t0, t1, None, y0, args=scene,
        stepsize_controller=diffrax.StepTo(ts),  # instants that have those of `scene.load.jumps` among them
    )

The state `y` is the displacements followed by the velocities, in m and m/s; `args` is the scene.
"""

import abc
import inspect
from typing import ClassVar, NamedTuple

import diffrax
import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from .. import contact as physics
from ..contact import Contact, Mechanics, State
from ..foundation import arguments
from ..model.load import load_from
from ..model.scene import Scene
from .section import Rise, rise_between

# The most advances within one diffrax step or between two saved instants. A run that needs more has failed (events without
# end).
MOST_ADVANCES = 4096


class StepperState(eqx.Module):
    """What a stepper carries from step to step."""

    mechanics: Mechanics
    contact: Contact


def vector_field(t: Float[Array, ""], y: State, args: Scene) -> State:
    """Rates of the state at one instant (m/s and m/s²), in the status that its forces demand; for `diffrax.ODETerm`.

    **Example:**

        >>> import diffrax
        >>> term = diffrax.ODETerm(fj.vector_field)  # for a plain `diffrax.diffeqsolve`, with the scene as `args`
    """
    _check(y, args)
    mechanics, load = Mechanics(args), args.load(t)
    contact = physics.status_from_forces(mechanics, load, y)
    return rates(mechanics, contact, load, y)


def _check(y: State, args: Scene) -> None:
    arguments.instance("args", args, Scene, "the scene, as in `diffeqsolve(..., args=scene)`")
    if y.dtype != args.belt_speed.dtype:
        raise TypeError(
            f"The state must have the type of the scene's numbers, {args.belt_speed.dtype}, but has {y.dtype}. Turn on double "
            "precision around the call: `with jax.enable_x64(True):`."
        )


def rates(mechanics: Mechanics, contact: Contact, load: Float[Array, ""], y: State) -> State:
    """Rates of the state in the given status: velocities (m/s) and accelerations (m/s²)."""
    velocity = y[y.shape[0] // 2 :]
    return jnp.concatenate([velocity, physics.acceleration(mechanics, contact, load, y)])


class Advance(NamedTuple):
    """The result of one advance."""

    y: State
    contact: Contact
    h: Float[Array, ""]  # its duration, s
    rise: Rise
    end: State  # where the mode's own motion ended, before anything that follows from its end
    ended: Bool[Array, "*contacts 2"]  # which of the guards ran out there


def advance_between(
    before: State,
    end: State,
    ended: Bool[Array, "*contacts 2"],
    y: State,
    contact: Contact,
    h: Float[Array, ""],
    mechanics: Mechanics,
) -> Advance:
    """An advance whose rise of the tangential velocity, if any, is found from its first and last state alone."""
    return Advance(y, contact, h, rise_between(mechanics, before, end, y), end, ended)


class Within(NamedTuple):
    """The motion inside one advance as a quadrature: an integral over time is the sum of weight times integrand at the
    states.
    """

    states: Float[Array, "k state"]
    weights: Float[Array, " k"]  # s
    times: Float[Array, " k"]  # s after the start of the advance
    end: State  # where the status's own motion ends, before anything that follows from its end


class AbstractStepper(diffrax.AbstractSolver[StepperState]):
    """A diffrax solver that handles contact events. `simulate` and the maps call its `advance`, diffrax its `step`.

    **Example:**

        >>> isinstance(fj.EventExact(), fj.AbstractStepper)
        True
    """

    # No advance is longer, in s.
    dt: eqx.AbstractVar[float]
    # Number of advances after which a map checks whether a trajectory's verdict is known: a few periods of vibration.
    round: eqx.AbstractClassVar[int]
    # Whether it finds the length of its advances itself; if not, `dt` is its step and determines its error.
    chooses_its_steps: ClassVar[bool] = True
    term_structure: ClassVar = diffrax.ODETerm

    @abc.abstractmethod
    def advance(
        self,
        mechanics: Mechanics,
        contact: Contact,
        load: Float[Array, ""],
        y: State,
        h: Float[Array, ""],
        at_section: bool = False,
    ) -> Advance:
        """Go on from a state under a constant load (N), by `h` (s) or less.

        With `at_section` the advance also ends on the Poincaré section (see `section`), if the method can.
        """

    @abc.abstractmethod
    def within(
        self, mechanics: Mechanics, contact: Contact, load: Float[Array, ""], y: State, h: Float[Array, ""]
    ) -> Within:
        """States inside an advance of duration `h` (s), and weights that integrate over it to the method's order."""

    def init(self, terms, t0, t1, y0: State, args: Scene) -> StepperState:
        _check(y0, args)
        # diffrax wraps a term, in order to turn time around.
        if getattr(terms, "term", terms).vector_field is not vector_field:
            raise ValueError("The term must be `diffrax.ODETerm(fj.vector_field)`: a stepper knows of no other motion.")
        y0 = eqx.error_if(
            y0, getattr(terms, "direction", 1) < 0, "`t1` must be after `t0`: friction has no way back in time."
        )
        mechanics = Mechanics(args)
        return StepperState(mechanics, physics.status_from_forces(mechanics, load_from(args.load, t0), y0))

    def func(self, terms, t0, y0: State, args: Scene) -> State:
        return terms.vf(t0, y0, args)


def describe_method(method: AbstractStepper) -> str:
    """A method with its inner solver, its step, and numbers that are not the usual ones, for the provenance of results:
    "WhereSwitched(Tsit5, dt=0.0001)".
    """
    inner, said = getattr(method, "solver", None), []
    for name, parameter in inspect.signature(type(method)).parameters.items():
        usual = parameter.default
        # diffrax has a method `order`.
        own = getattr(method, f"{name}_", getattr(method, name, usual))
        if name != "dt" and isinstance(usual, int | float) and isinstance(own, int | float) and own != usual:
            said.append(f"{name}={own}")
    said = [*([] if inner is None else [type(inner).__name__]), *said, f"dt={method.dt:g}"]
    return f"{type(method).__name__}({', '.join(said)})"
