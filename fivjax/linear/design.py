"""Search and design by gradient: find the critical friction from any start, and move it where it does no harm.

The search follows the derivative of the largest real part through the eigenvalues. That derivative is worthless just
where it matters: below the coalescence of two modes it is almost zero, at it infinite. So each step is checked
against a bracket of one stable and one unstable friction, and halves it where the derivative leads astray.
"""

import enum
from collections.abc import Callable, Mapping
from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
import optimistix as optx
import xarray as xr
from jaxtyping import Array, Bool, Float, PyTree, Scalar

from ..foundation import arguments
from ..foundation.precision import in_double_precision, is_known, real
from ..io.datasets import labelled
from ..model.structure import Structure
from .cea import growth_rate
from .critical import Outcome, critical_friction, significant_growth
from .linearisation import linear_sliding
from .routh_hurwitz import as_scene, check_direction, margin, time_scale


class _Bracket(eqx.Module):
    lower: Float[Array, ""]  # where the function was last seen negative
    upper: Float[Array, ""]  # and positive; infinite until it was
    step: Float[Array, ""]
    settled: Bool[Array, ""]
    exhausted: Bool[Array, ""]  # arrived at the end of the range, and nothing positive on the way


class BracketedNewton(optx.AbstractRootFinder):
    """Newton's method on a scalar function that is negative at `lower`, kept inside a bracket.

    A Newton step is taken where the slope is not beyond `steepest` (at a coalescence it is infinite, or anything), the
    step stays inside the bracket and at least halves the one before; else the bracket is halved, or, as long as no
    positive value has been seen, the argument is doubled, up to `highest`.
    For `optimistix.root_find`; the solution's state says whether the range was exhausted.
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
    """What a search for the critical friction came to.

    `mu` is NaN unless the outcome is "found". `steps` counts evaluations.
    """

    mu: float
    outcome: Outcome
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
    """The critical friction by gradient, from a friction to start at: a safeguarded Newton search (`BracketedNewton`).

    - `route="eigenvalues"`: on the largest real part of the eigenvalues, differentiated through them.
    - `route="routh-hurwitz"`: on the smallest Hurwitz determinant, smooth also where modes coalesce (`cea.margin`).

    Each finds a crossing from stable to unstable; with several it need not be the first. `cea.critical_friction`
    looks at all of them, by a third way.

    **Arguments:** `start`, above 0; `highest`, where the search gives up; `direction` as in `cea.critical_friction`.

    **Returns:** a `Search`; its outcome is "found", "never unstable" (nothing up to `highest`), "always unstable" or
    "undecided" (out of steps).

    **Raises:** `ValueError` for a start that is not positive or lies above `highest`, and for Routh–Hurwitz without
    any damping.
    """
    arguments.instance("structure", structure, Structure, "a Structure, such as belt_oscillator()")
    arguments.real_number("start", start, above=0)
    arguments.real_number("highest", highest, minimum=float(start))
    arguments.one_of("route", route, ("eigenvalues", "routh-hurwitz"))
    check_direction(direction)
    if route == "routh-hurwitz" and is_known(structure.damping) and not np.any(np.asarray(structure.damping)):
        raise ValueError(
            'Argument `route` must be "eigenvalues" for an undamped structure: all its motions are on the limit, so '
            "its Hurwitz determinants are zero at any friction."
        )
    solution, bracket = _searched(structure, real(start), route, float(highest), direction, max_steps)
    mu, steps = float(solution.value), int(solution.stats["num_steps"])
    if bracket.exhausted:
        outcome = Outcome.NEVER_UNSTABLE
    elif not bracket.settled:
        outcome = Outcome.UNDECIDED
    elif mu < 1e-9:
        outcome = Outcome.ALWAYS_UNSTABLE
    else:
        outcome = Outcome.FOUND
    found = outcome is Outcome.FOUND
    return Search(mu if found else np.nan, outcome, steps, float(start), route)


# Not `compiling.compiled`: at the root the sign is rounding, and how that falls decides between ten steps and fifty.
@eqx.filter_jit
def _searched(structure, start, route, highest, direction, max_steps):
    def instability(mu, structure):
        if route == "eigenvalues":
            return significant_growth(_in_natural_units(structure, mu, direction))
        return -margin(structure, mu, direction=direction)

    solution = optx.root_find(
        instability, BracketedNewton(highest=highest), start, structure, max_steps=max_steps, throw=False
    )
    return solution, solution.state


def _in_natural_units(structure, mu, direction):
    """The state matrix for displacements in units of velocity and time in units of 1/ω₀."""
    scale = time_scale(structure)
    matrix = linear_sliding(as_scene(structure, mu, direction)).matrix
    half = matrix.shape[0] // 2
    units = jnp.concatenate([jnp.full(half, scale), jnp.ones(half)])
    return matrix * (units[:, None] / units[None, :]) / scale


class DesignOutcome(enum.StrEnum):
    """What a design came to."""

    TARGET_REACHED = "target reached"
    TARGET_NOT_REACHED = "target not reached within the bounds"
    IMPROVED = "improved"
    NOT_IMPROVED = "not improved"


class Design(eqx.Module):
    """The best design that was met: its structure, what changed, and the quantity before and after."""

    structure: Structure
    parameters: dict[str, float]
    before: float
    after: float
    target: float | None
    outcome: DesignOutcome
    quantity: str
    history: xr.Dataset = eqx.field(static=True)

    def __str__(self) -> str:
        changes = ", ".join(f"{name} = {value:.6g}" for name, value in self.parameters.items())
        aim = "" if self.target is None else f" (target {self.target:g})"
        moved = f"{self.quantity} {self.before:.6g} -> {self.after:.6g}{aim}"
        return f"{self.outcome.value.capitalize()}: {moved} with {changes}."


@in_double_precision
def raise_critical_friction(
    structure: Structure,
    bounds: Mapping[str, tuple[float, float]],
    *,
    target: float | None = None,
    tied: Mapping[str, Callable] | None = None,
    direction: int = 1,
    steps: int = 200,
    rate: float = 0.03,
) -> Design:
    """Raise μ_crit over chosen parameters within bounds, by projected gradient ascent (optax's Adam).

        design = fj.design.raise_critical_friction(
            structure, {"k1": (90e3, 110e3)}, tied={"k2": lambda p: 201e3 - p["k1"]}, target=0.4
        )
        print(design)

    The gradient is the implicit one of `cea.critical_friction`. μ_crit may jump where another window of instability
    opens, and the search is local: the best design on its way is returned.

    **Arguments:**

    - `bounds`: lowest and highest value by name of parameter; the search starts from the structure's own.
    - `target`: the top of the operating range. The search is content when μ_crit is above it, and says whether it is.
    - `tied`: parameters that follow from the others, as functions of the dictionary of all parameters.
    - `steps`, `rate`: number of steps, and their first size as a share of the bounds.

    **Raises:** `ValueError` for unknown names and bounds that do not hold the structure's own value, and where there is
    no critical friction to start from.
    """
    if target is not None:
        arguments.real_number("target", target, above=0)

    def quantity(candidate):
        return critical_friction(candidate, direction=direction)

    def loss(limit):
        return -limit if target is None else -jnp.minimum(limit, target)

    start = float(quantity(structure))
    if not np.isfinite(start) or start == 0:
        raise ValueError(
            f"There is no critical friction to raise: the structure is {'never' if start else 'always'} unstable."
        )
    return _designed(structure, bounds, tied or {}, loss, quantity, "critical friction", target, True, steps, rate)


@in_double_precision
def lower_growth_rate(
    structure: Structure,
    bounds: Mapping[str, tuple[float, float]],
    *,
    mu,
    target: float | None = None,
    tied: Mapping[str, Callable] | None = None,
    direction: int = 1,
    steps: int = 200,
    rate: float = 0.03,
) -> Design:
    """Lower the worst growth rate over a range of friction `mu` (an array), as `raise_critical_friction` raises μ_crit.

    Growth rates are in 1/s. `target` is the growth rate to stay below; -1 demands a decay of at least 1/s.
    """
    frictions = arguments.axis("mu", mu)
    arguments.real_number("mu", frictions[0], minimum=0)
    if target is not None:
        arguments.real_number("target", target)

    def quantity(candidate):
        values = real(frictions)
        return jnp.max(jax.vmap(lambda value: growth_rate(candidate, value, direction=direction))(values))

    def loss(worst):
        return worst if target is None else jnp.maximum(worst, target)

    return _designed(structure, bounds, tied or {}, loss, quantity, "worst growth rate", target, False, steps, rate)


def _designed(structure, bounds, tied, loss, quantity, name, target, larger_is_better, steps, rate) -> Design:
    bounds, low, width = _checked_bounds(structure, bounds, tied)
    names = list(bounds)
    start = np.array([(float(structure.parameters[key]) - low[i]) / width[i] for i, key in enumerate(names)])

    def values(shares):
        chosen = {key: low[i] + width[i] * shares[i] for i, key in enumerate(names)}
        everything = {**structure.parameters, **chosen}
        return {**chosen, **{key: rule(everything) for key, rule in tied.items()}}

    def judged(shares):
        reached = quantity(structure.replace(**values(shares)))
        return loss(reached), reached

    optimiser = optax.adam(optax.cosine_decay_schedule(rate, steps, 0.01))

    @jax.jit
    def search(shares):
        def step(carry, _):
            shares, memory = carry
            (value, reached), gradient = jax.value_and_grad(judged, has_aux=True)(shares)
            # Where there is no derivative the memory of the last ones carries on.
            gradient = jnp.where(jnp.isfinite(gradient), gradient, 0.0)
            updates, memory = optimiser.update(gradient, memory)
            following = optax.projections.projection_box(optax.apply_updates(shares, updates), 0.0, 1.0)
            return (following, memory), (shares, value, reached)

        _, history = jax.lax.scan(step, (shares, optimiser.init(shares)), length=steps + 1)
        return history

    shares, losses, quantities = map(np.asarray, search(real(start)))
    best = int(np.nanargmin(losses))
    parameters = {key: float(value) for key, value in values(shares[best]).items()}
    before, after = float(quantities[0]), float(quantities[best])
    if target is None:
        outcome = DesignOutcome.IMPROVED if best else DesignOutcome.NOT_IMPROVED
    else:
        reached = after >= target if larger_is_better else after <= target
        outcome = DesignOutcome.TARGET_REACHED if reached else DesignOutcome.TARGET_NOT_REACHED
    columns = jax.vmap(values)(real(shares))
    history = xr.Dataset(
        {name.replace(" ", "_"): ("step", quantities), **{k: ("step", np.asarray(v)) for k, v in columns.items()}},
        coords={"step": np.arange(steps + 1)},
    )
    history = labelled(history, as_scene(structure, 0.0, 1), analysis="design by gradient", quantity=name)
    return Design(structure.replace(**parameters), parameters, before, after, target, outcome, name, history)


def _checked_bounds(structure: Structure, bounds, tied):
    arguments.instance("structure", structure, Structure, "a Structure, such as belt_oscillator()")
    if not bounds:
        raise ValueError('Argument `bounds` must name at least one parameter, such as {"k1": (90e3, 110e3)}.')
    known = ", ".join(structure.parameters) or "none (it was given as matrices)"
    for key in (*bounds, *tied):
        if key not in structure.parameters:
            raise ValueError(f"Structure has no parameter `{key}`; it has: {known}.")
    for key, pair in bounds.items():
        pair = arguments.numeric_array(f"bounds[{key!r}]", pair)
        if pair.shape != (2,) or not np.all(np.isfinite(pair)) or pair[0] >= pair[1]:
            raise ValueError(
                f"The bounds of `{key}` must be two numbers, the lower one first, but are {pair.tolist()}."
            )
        own = float(structure.parameters[key])
        if not pair[0] <= own <= pair[1]:
            raise ValueError(
                f"The bounds of `{key}` must hold the structure's own value {own:g}, where the search starts, but are "
                f"{pair.tolist()}."
            )
        structure.replace(**{key: pair[0]})
        structure.replace(**{key: pair[1]})
    table = np.array([bounds[key] for key in bounds], dtype=np.float64)
    return dict(bounds), table[:, 0], table[:, 1] - table[:, 0]
