r"""Derivatives of a limit cycle in the parameters of its scene, by the implicit function theorem.

A cycle is a root of $P(y, θ) - y = 0$. With $J = ∂P/∂y$ there, $dy/dθ = (I - J)^{-1} ∂P/∂θ$; period and peak are functions of
$y$ and $θ$, and the derivative of a simple multiplier $λ$ with eigenvectors $l$ and $r$ of $J$ is
$l^H (dJ/dθ)\, r / l^H r$. Only one period is differentiated, through its events, and not the transient towards the cycle. At a
grazing event, and at a fold, there is no derivative.
"""

from collections.abc import Iterable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Complex, Float

from ..foundation import arguments
from ..foundation.compiling import compiled
from ..foundation.precision import in_double_precision
from ..foundation.progress import reported
from ..model.contact_coordinates import from_contact_coordinates
from ..model.scene import Scene
from ..section.crossings import Point
from .cycle import LimitCycle, point_of
from .nearby import next_to
from .own_coordinates import cycle_in_contact_coordinates


class CycleDerivatives(eqx.Module):
    """Derivatives of a limit cycle by name of the parameter, each per unit of that parameter."""

    period: dict[str, float]  # s
    amplitude: dict[str, float]  # m/s
    state: dict[str, Float[np.ndarray, "..."]]  # m and m/s, of the state on the section
    multipliers: dict[str, Complex[np.ndarray, "..."]]  # of `section_multipliers`, in its order; empty unless asked for

    def __repr__(self) -> str:
        rows = [f"  {name:<16}{self.period[name]:>14.6g}{self.amplitude[name]:>16.6g}" for name in self.period]
        head = f"derivatives of a limit cycle, per unit of each parameter\n  {'':<16}{'period, s':>14}{'amplitude, m/s':>16}"
        return "\n".join([head, *rows])


@reported("derivatives of a cycle")
@in_double_precision
def cycle_derivatives(
    cycle: LimitCycle, wrt: Iterable[str], *, multipliers: bool = False, progress: bool | None = None
) -> CycleDerivatives:
    """Derivatives of period, peak tangential speed, state and multipliers of a periodic limit cycle.

        d = fj.cycle_derivatives(fj.limit_cycle(scene), ["mu", "belt_speed", "k1"])
        d.period["k1"], d.amplitude["mu"]

    **Arguments:** `cycle`, from `limit_cycle` or `saddle_cycle`; `wrt`, names of parameters of its scene; `multipliers`,
    whether to differentiate the multipliers of the section's return map, too (largest first). This takes second derivatives,
    which take half a minute to compile once; `progress` as in `limit_cycle`.

    **Returns:** `CycleDerivatives`.

    **Raises:** `TypeError` for anything but a `LimitCycle`; `ValueError` for a torus, or a name that is no parameter.

    **Example:**

        >>> cycle = fj.limit_cycle(scene.replace(belt_speed=1.0))  # doctest: +SLOW
        >>> slopes = fj.cycle_derivatives(cycle, ["mu", "k1"])
        >>> slopes.amplitude["mu"] > 0
        True
    """
    arguments.instance("cycle", cycle, LimitCycle, "a limit cycle, such as `fivjax.limit_cycle(scene)`")
    if cycle.kind != "periodic":
        raise ValueError(
            "Argument `cycle` must be periodic, but is a torus, which has no single period to differentiate."
        )
    names = arguments.listed_names("wrt", wrt, "mu")
    arguments.names_of_parameters("wrt", names, cycle.scene.parameters)
    arguments.truth("multipliers", multipliers)
    arguments.single_numbers("wrt", names, cycle.scene.parameters)
    own = cycle_in_contact_coordinates(cycle)
    slopes = _slopes(own.scene, names, point_of(own), jnp.asarray(cycle.crossings, jnp.int32), bool(multipliers))
    # The parameters are the last axis.
    period, amplitude, state, moved = (
        dict(zip(names, np.moveaxis(np.asarray(one), -1, 0), strict=True)) for one in slopes
    )
    return CycleDerivatives(
        {name: float(slope) for name, slope in period.items()},
        {name: float(slope) for name, slope in amplitude.items()},
        {name: _in_coordinates_of(cycle, slope) for name, slope in state.items()},
        moved if multipliers else {},
    )


def _in_coordinates_of(cycle: LimitCycle, state):
    structure = cycle.scene.structure
    return state if structure.contacts_at_coordinates else from_contact_coordinates(structure, state)


@compiled
def _slopes(scene: Scene, names: tuple[str, ...], point: Point, crossings, multipliers: bool):
    def of(values):
        own = scene.replace(**dict(zip(names, values, strict=True)))
        found = next_to(own, scene, point, crossings, 0, multipliers)
        return found.period, found.amplitude, found.state, found.multipliers if multipliers else found.state

    return jax.jacfwd(of)(jnp.stack([jnp.asarray(scene.parameters[name]) for name in names]))
