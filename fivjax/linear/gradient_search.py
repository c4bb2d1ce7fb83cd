"""The critical friction by Newton's method from any start, kept inside a bracket.

The search follows the derivative of the largest real part of the eigenvalues. That derivative is of no use close to the
coalescence of two modes: it is almost zero below it and infinite at it. So each step is checked against a bracket of one stable
and one unstable friction, which is halved where the derivative misleads.
"""

from collections.abc import Callable
from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array, Bool, Float, PyTree, Scalar

from ..foundation import arguments
from ..foundation.precision import in_double_precision, is_known, real
from ..model.structure import Structure
from .gradients import in_natural_units, significant_growth
from .linearisation import linear_sliding, time_scale
from .outcomes import StabilityOutcome
from .routh_hurwitz import margin
from .system import as_scene, checked_direction


class _Bracket(eqx.Module):
    lower: Float[Array, ""]  # where the function was last found negative
    upper: Float[Array, ""]  # where it was last found positive; infinite before that
    step: Float[Array, ""]
    settled: Bool[Array, ""]
    exhausted: Bool[Array, ""]  # the end of the range was reached without a positive value


class BracketedNewton(optx.AbstractRootFinder):
    """Newton's method on a scalar function that is negative at `lower`, kept inside a bracket.

    A Newton step is taken if the slope is at most `steepest` (at a coalescence it is infinite or meaningless), if the step
    stays inside the bracket, and if it is at most half the one before. Else the bracket is halved, or, as long as no positive
    value has been found, the argument is doubled, up to `highest`. For `optimistix.root_find`; the solution's state says
    whether the range was exhausted.
    """

    rtol: float = 1e-13
    atol: float = 1e-15
    lower: float = 0.0
    highest: float = 100.0
    steepest: float = 1e5
    norm: ClassVar[Callable[[PyTree], Scalar]] = jnp.abs

    def init(self, fn, y, args, options, f_struct, aux_struct, tags):
        far = jnp.full_like(y, jnp.inf)
        return _Bracket(jnp.full_like(y, self.lower), far, far, jnp.array(False), jnp.array(False))

    def step(self, fn, y, args, options, state, tags):
        value, slope, aux = _value_and_slope(fn, y, args)
        lower = jnp.where(value > 0, state.lower, jnp.maximum(state.lower, y))
        upper = jnp.where(value > 0, jnp.minimum(state.upper, y), state.upper)
        newton = jnp.where(jnp.abs(slope) < self.steepest, y - value / slope, jnp.nan)
        bounded = jnp.isfinite(upper)
        halved = 0.5 * (lower + upper)
        doubled = jnp.minimum(2 * y + 1e-3, self.highest)
        inside = (newton > lower) & (newton < jnp.where(bounded, upper, doubled))
        quick = jnp.abs(newton - y) < 0.5 * jnp.abs(state.step)
        trusted = inside & (quick | ~bounded)
        following = jnp.where(trusted, newton, jnp.where(bounded, halved, doubled))
        tolerance = self.atol + self.rtol * jnp.abs(y)
        settled = (value == 0) | (jnp.abs(newton - y) <= tolerance) | (upper - lower <= tolerance)
        following = jnp.where(value == 0, y, following)
        exhausted = ~bounded & (y >= self.highest) & ~settled
        return following, _Bracket(lower, upper, jnp.abs(following - y), settled, exhausted), aux

    def terminate(self, fn, y, args, options, state, tags):
        return state.settled | state.exhausted, optx.RESULTS.successful

    def postprocess(self, fn, y, aux, args, options, state, tags, result):
        return y, aux, {}


def _value_and_slope(fn, y, args):
    (value, aux), (slope, _) = jax.jvp(lambda x: fn(x, args), (y,), (jnp.ones_like(y),))
    return value, slope, aux


class Search(eqx.Module):
    """The result of a search for the critical friction.

    `mu` (without unit) is NaN unless the outcome is "found". `steps` counts evaluations.
    """

    mu: float
    outcome: StabilityOutcome
    steps: int
    start: float
    route: str


@in_double_precision
def search_critical_friction(
    structure: Structure,
    start=0.1,
    *,
    route: str = "eigenvalues",
    highest: float = 100.0,
    direction: int = 1,
    max_steps: int = 200,
) -> Search:
    """The critical friction by gradient, from a given first guess: a safeguarded Newton search (`BracketedNewton`).

    - `route="eigenvalues"`: on the largest real part of the eigenvalues, differentiated through them.
    - `route="routh-hurwitz"`: on the smallest Hurwitz determinant, smooth also where modes coalesce (`cea.margin`).

    Both find a crossing from stable to unstable, which need not be the first if there are several. `cea.critical_friction`
    checks all of them, by a third method.

    **Arguments:** `structure`; `start`, above 0; `highest`, the friction at which the search gives up; `direction` as in
    `cea.critical_friction`; `max_steps`, the most evaluations.

    **Returns:** a `Search`; its outcome is "found", "never unstable" (nothing up to `highest`), "always unstable" or
    "undecided" (out of steps).

    **Raises:** `ValueError` for a start that is not positive or lies above `highest`, and for Routh–Hurwitz without
    any damping.

    **Example:**

        >>> found = fj.design.search_critical_friction(structure, start=0.1)  # doctest: +SLOW
    """
    arguments.instance("structure", structure, Structure, "a Structure, such as belt_oscillator()")
    arguments.known("structure", structure)
    arguments.real_number("start", start, above=0)
    arguments.real_number("highest", highest, minimum=float(start))
    arguments.one_of("route", route, ("eigenvalues", "routh-hurwitz"))
    direction = checked_direction(direction)
    max_steps = arguments.whole_number("max_steps", max_steps, minimum=1)
    if route == "routh-hurwitz" and is_known(structure.damping) and not np.any(np.asarray(structure.damping)):
        raise ValueError(
            'Argument `route` must be "eigenvalues" for an undamped structure: all its motions are on the limit, so '
            "its Hurwitz determinants are zero at any friction."
        )
    solution, bracket = _search(structure, real(start), route, float(highest), direction, max_steps)
    mu, steps = float(solution.value), int(solution.stats["num_steps"])
    if bracket.exhausted:
        outcome = StabilityOutcome.NEVER_UNSTABLE
    elif not bracket.settled:
        outcome = StabilityOutcome.UNDECIDED
    elif mu < 1e-9:
        outcome = StabilityOutcome.ALWAYS_UNSTABLE
    else:
        outcome = StabilityOutcome.FOUND
    found = outcome is StabilityOutcome.FOUND
    return Search(mu if found else np.nan, outcome, steps, float(start), route)


# Not `compiling.compiled`: at the root the sign is a matter of rounding, which decides between ten steps and fifty.
@eqx.filter_jit
def _search(structure, start, route, highest, direction, max_steps):
    def instability(mu, structure):
        if route == "eigenvalues":
            return significant_growth(_in_natural_units(structure, mu, direction))
        return -margin(structure, mu, direction=direction)

    solver = BracketedNewton(highest=highest)  # pyrefly: ignore[missing-argument]
    solution = optx.root_find(instability, solver, start, structure, max_steps=max_steps, throw=False)
    return solution, solution.state


def _in_natural_units(structure, mu, direction):
    return in_natural_units(linear_sliding(as_scene(structure, mu, direction)).matrix, time_scale(structure))
