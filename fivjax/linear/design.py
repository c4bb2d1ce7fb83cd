"""Design by gradient: raise the critical friction, or lower growth rates, by changing parameters within bounds."""

import enum
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from ..foundation import arguments
from ..foundation.compiling import compiled
from ..foundation.digits import apart
from ..foundation.precision import in_double_precision, real
from ..io.datasets import check_axis_names, labelled
from ..model.structure import Structure
from .critical import critical_friction
from .spectrum import growth_rate
from .system import as_scene

if TYPE_CHECKING:
    import xarray as xr


class DesignOutcome(enum.StrEnum):
    """The outcome of a design."""

    TARGET_REACHED = "target reached"
    TARGET_NOT_REACHED = "target not reached"
    IMPROVED = "improved"
    NOT_IMPROVED = "not improved"


class Design(eqx.Module):
    """The best design met in the search: its structure, the parameters that changed, and the quantity before and after.

    `history` holds the quantity and the parameters over the steps of the search, up to the one that first reached the
    target; its attribute `chosen_step` says which step is the design.
    """

    structure: Structure
    parameters: dict[str, float]
    before: float
    after: float
    target: float | None
    outcome: DesignOutcome
    quantity: str
    history: "xr.Dataset" = eqx.field(static=True)

    def __str__(self) -> str:
        changes = ", ".join(f"{name} = {value:.6g}" for name, value in self.parameters.items())
        before, after, *target = apart(self.before, self.after, *([] if self.target is None else [self.target]))
        moved = f"{self.quantity} {before} -> {after}" + (f" (target {target[0]})" if target else "")
        return f"{self.outcome.value.capitalize()}: {moved} with {changes}."

    __repr__ = __str__


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

    The gradient is that of `cea.critical_friction`. μ_crit may jump where another interval of instability appears, and the
    search is local: the best design met is returned.

    **Arguments:**

    - `bounds`: lowest and highest value by name of parameter; the search starts from the structure's own values.
    - `target`: the friction that μ_crit shall reach; the design is the first that does. Unless given, μ_crit is raised as far
      as the steps go.
    - `tied`: parameters that follow from the others, as functions of the dictionary of all parameters.
    - `direction`: as in `cea.critical_friction`.
    - `steps`, `rate`: number of steps, and the size of the first ones as a share of the bounds.

    **Returns:** a `Design`: the structure, what was changed, and whether the target is reached.

    **Raises:** `ValueError` for unknown names, bounds that do not contain the structure's own value, and a structure without
    critical friction.
    """
    within = _checked_bounds(structure, bounds, tied)
    if target is not None:
        arguments.real_number("target", target, above=0)

    def quantity(candidate):
        return critical_friction(candidate, direction=direction)

    start = float(quantity(structure))
    if not np.isfinite(start) or start == 0:
        raise ValueError(
            f"There is no critical friction to raise: the structure is {'never' if start else 'always'} unstable."
        )
    goal = _Goal("critical friction", quantity, target, direction, larger_is_better=True)
    return _design(structure, within, tied or {}, goal, steps, rate)


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
    """Lower the largest growth rate over friction coefficients `mu` (a number or an array), as `raise_critical_friction` raises
    μ_crit.

    Growth rates are in 1/s. `target` is the growth rate to stay below; -1 demands a decay of at least 1/s. All other arguments
    are those of `raise_critical_friction`.

    **Returns:** a `Design`.

    **Raises:** `ValueError` for unknown names, and bounds that do not contain the structure's own value.

    **Example:**

        >>> better = fj.design.lower_growth_rate(structure, {"k1": (98e3, 102e3)}, mu=0.25, steps=5)  # doctest: +SLOW
    """
    within = _checked_bounds(structure, bounds, tied)
    frictions = arguments.axis("mu", mu)
    arguments.real_number("mu", frictions[0], minimum=0)
    if target is not None:
        arguments.real_number("target", target)

    def quantity(candidate):
        values = real(frictions)
        return jnp.max(jax.vmap(lambda value: growth_rate(candidate, value, direction=direction))(values))

    # Of growth rates, which are far smaller than the structure's own rates.
    mass, _, stiffness, *_ = map(np.asarray, structure.matrices)
    unit = 1e-4 * float(np.sqrt(np.max(np.abs(np.diag(stiffness) / np.diag(mass)))))
    goal = _Goal("worst growth rate", quantity, target, direction, larger_is_better=False, unit=unit)
    return _design(structure, within, tied or {}, goal, steps, rate)


class _Goal(NamedTuple):
    """The quantity of a structure that a design changes, and the value that it shall reach."""

    name: str
    quantity: Callable
    target: float | None
    direction: int  # of the belt
    larger_is_better: bool
    unit: float = 1.0  # that its gradient is measured in

    def loss(self, value):
        """What is minimised: constant beyond the target."""
        if self.larger_is_better:
            return -value if self.target is None else -jnp.minimum(value, self.target)
        return value if self.target is None else jnp.maximum(value, self.target)


def _design(structure: Structure, within: "_Bounds", tied, goal: _Goal, steps: int, rate: float) -> Design:
    import optax
    import xarray as xr

    name, quantity, target, direction, larger_is_better, _ = goal
    names, low, width = within
    check_axis_names({*names, *tied}, ("step", name.replace(" ", "_")), "designs")
    steps = arguments.whole_number("steps", steps, minimum=1)
    arguments.real_number("rate", rate, above=0)
    start = np.array([(float(structure.parameters[key]) - low[i]) / width[i] for i, key in enumerate(names)])

    def values(shares):
        chosen = {key: low[i] + width[i] * shares[i] for i, key in enumerate(names)}
        everything = {**structure.parameters, **chosen}
        try:
            return {**chosen, **{key: rule(everything) for key, rule in tied.items()}}
        except KeyError as unknown:
            raise ValueError(
                f"A function in `tied` asks for {unknown}, which is no parameter of the structure; it has: "
                f"{', '.join(structure.parameters)}."
            ) from None

    # What `tied` gives is refused before anything compiles.
    structure.replace(**values(start))

    def loss_and_quantity(shares):
        reached = quantity(structure.replace(**values(shares)))
        return goal.loss(reached), reached

    optimiser = optax.adam(optax.cosine_decay_schedule(rate, steps, 0.01), eps=1e-8 * goal.unit)

    @compiled
    def search(shares):
        def step(carry, _):
            shares, memory = carry
            (value, reached), gradient = jax.value_and_grad(loss_and_quantity, has_aux=True)(shares)
            # Where there is no derivative, Adam's averages of the last ones continue the search.
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
    # With a target, the search is over where it is first reached; later steps are no part of the design.
    taken = best + 1 if outcome is DesignOutcome.TARGET_REACHED else steps + 1
    history = xr.Dataset(
        {name.replace(" ", "_"): ("step", quantities), **{k: ("step", np.asarray(v)) for k, v in columns.items()}},
        coords={"step": np.arange(steps + 1)},
    ).isel(step=slice(taken))
    history[name.replace(" ", "_")].attrs.update(long_name=name, units="1" if larger_is_better else "1/s")
    history = labelled(history, as_scene(structure, 0.0, direction), analysis="design by gradient", quantity=name)
    history.attrs["chosen_step"] = best
    if target is not None:
        history.attrs["target"] = float(target)
    return Design(structure.replace(**parameters), parameters, before, after, target, outcome, name, history)


class _Bounds(NamedTuple):
    """What the parameters of a design may be."""

    names: list[str]
    low: np.ndarray
    width: np.ndarray


def _checked_bounds(structure: Structure, bounds, tied) -> _Bounds:
    arguments.instance("structure", structure, Structure, "a Structure, such as belt_oscillator()")
    arguments.known("structure", structure)
    bounds = arguments.by_name("bounds", bounds, '"k1": (90e3, 110e3)')
    if not bounds:
        raise ValueError('Argument `bounds` must name at least one parameter, such as {"k1": (90e3, 110e3)}.')
    known = ", ".join(structure.parameters) or "none (it was given as matrices)"
    tied = arguments.by_name("tied", tied, '"k2": lambda own: 2 * own["k1"]')
    for key, rule in tied.items():
        if not callable(rule):
            raise TypeError(
                f"Argument `tied[{key!r}]` must be a function of the parameters, but is {arguments.describe(rule)}."
            )
        if key in bounds:
            raise ValueError(f"Parameter `{key}` is both in `bounds` and in `tied`. Drop one of the two.")
    for key in (*bounds, *tied):
        if key not in structure.parameters:
            near = arguments.did_you_mean(str(key), structure.parameters)
            raise ValueError(f"Structure has no parameter `{key}`; it has: {known}.{near}")
    for key, pair in bounds.items():
        pair = arguments.bounds_about(key, pair, float(structure.parameters[key]))
        structure.replace(**{key: pair[0]})
        structure.replace(**{key: pair[1]})
    table = np.array([bounds[key] for key in bounds], dtype=np.float64)
    return _Bounds(list(bounds), table[:, 0], table[:, 1] - table[:, 0])
