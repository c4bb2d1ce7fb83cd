r"""Derivatives of a limit cycle in the parameters of its scene, by the implicit function theorem.

A cycle is a root of $P(y, θ) - y = 0$. With $J = ∂P/∂y$ there, $dy/dθ = (I - J)^{-1} ∂P/∂θ$; period and peak are functions of
$y$ and $θ$, and the derivative of a simple multiplier $λ$ with eigenvectors $l$ and $r$ of $J$ is
$l^H (dJ/dθ)\, r / l^H r$. Only one period is differentiated, through its events, and not the transient towards the cycle. At a
grazing event, and at a fold, there is no derivative.
"""

import math
from collections.abc import Iterable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float

from ..foundation import arguments
from ..foundation.compiling import compiled, power_of_4
from ..foundation.precision import in_double_precision
from ..model.scene import Scene
from ..steppers.event_exact import EventExact, for_derivatives
from .around import once_around, peak_speed, seen_around
from .cycle import LimitCycle, point_of
from .section_map import Point, mechanics_about_sliding, section_return, sliding_state


class CycleDerivatives(eqx.Module):
    """Derivatives of a limit cycle by name of the parameter, each per unit of that parameter."""

    period: dict[str, float]  # s
    amplitude: dict[str, float]  # m/s
    state: dict[str, Float[np.ndarray, "..."]]  # m and m/s, of the state on the section
    multipliers: dict[str, Complex[np.ndarray, "..."]]  # of `section_multipliers`, in its order; empty unless asked for


@in_double_precision
def cycle_derivatives(cycle: LimitCycle, wrt: Iterable[str], *, multipliers: bool = False) -> CycleDerivatives:
    """Derivatives of period, peak tangential speed, state and multipliers of a periodic limit cycle.

        d = fj.cycle_derivatives(fj.limit_cycle(scene), ["mu", "belt_speed", "k1"])
        d.period["k1"], d.amplitude["mu"]

    **Arguments:** `cycle`, from `limit_cycle` or `saddle_cycle`; `wrt`, names of parameters of its scene; `multipliers`,
    whether to differentiate the multipliers of the section's return map, too (largest first). This takes second derivatives,
    which need minutes to compile.

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
    names = (wrt,) if isinstance(wrt, str) else tuple(wrt)
    unknown = [name for name in names if name not in cycle.scene.parameters]
    if unknown or not names:
        raise ValueError(
            f"Argument `wrt` must name parameters of the scene, but has {(unknown or ['none'])[0]!r}; they are: "
            f"{', '.join(sorted(cycle.scene.parameters))}."
        )
    stepper, point = EventExact(), point_of(cycle)
    arguments.truth("multipliers", multipliers)
    segments = int(seen_around(cycle.scene, stepper, point, cycle.period, 60).segments.count)
    segments += math.ceil(cycle.period / float(_step(cycle.scene, stepper)))
    correction = jnp.linalg.inv(jnp.eye(len(point.y)) - jnp.asarray(cycle.return_jacobian))
    slopes = _slopes(
        cycle.scene,
        stepper,
        names,
        point,
        jnp.asarray(cycle.crossings, jnp.int32),
        correction,
        power_of_4(segments + 4),
        bool(multipliers),
    )
    period, amplitude, state, jacobian = (dict(zip(names, np.asarray(part), strict=True)) for part in slopes)
    values, right = np.linalg.eig(cycle.return_jacobian)
    order = np.argsort(-np.abs(values), kind="stable")
    left = np.linalg.pinv(right)
    moved = {name: np.einsum("ki,ij,jk->k", left, slope, right)[order] for name, slope in jacobian.items()}
    return CycleDerivatives(
        {name: float(slope) for name, slope in period.items()},
        {name: float(slope) for name, slope in amplitude.items()},
        state,
        moved if multipliers else {},
    )


@compiled
def _step(scene: Scene, stepper: EventExact) -> Float[Array, ""]:
    return jnp.asarray(for_derivatives(stepper, mechanics_about_sliding(scene)).dt)


@compiled
def _slopes(
    scene: Scene,
    stepper: EventExact,
    names: tuple[str, ...],
    point: Point,
    crossings,
    correction,
    most: int,
    twice: bool,
):
    def of(values):
        own = scene.replace(**dict(zip(names, values, strict=True)))
        mechanics = mechanics_about_sliding(own)
        short = for_derivatives(stepper, mechanics)

        def image(y):
            return section_return(short, own, mechanics, Point(y, point.contact), crossings)

        # A step of Newton's method from the root gives the same root, with its derivative. For the derivative of the return
        # map's Jacobian a second step is needed.
        y = point.y
        for _ in range(1 + twice):
            gap = image(y).point.y - y
            y = y + correction @ (gap - jax.lax.stop_gradient(gap))
        back = image(y)
        jacobian = jnp.zeros((len(y), len(y)), y.dtype)
        if twice:
            units = jnp.eye(len(y), dtype=y.dtype)
            jacobian = jax.vmap(lambda unit: jax.jvp(lambda y: image(y).point.y, (y,), (unit,))[1], out_axes=1)(units)
        around = once_around(short, mechanics, Point(y, point.contact), back.time, most)
        peak = peak_speed(short, mechanics, around)
        return back.time, peak, y + sliding_state(own, own.load.final), jacobian

    values = jnp.stack([jnp.asarray(scene.parameters[name]) for name in names])

    def along(direction):
        return jax.jvp(of, (values,), (direction,))[1]

    return jax.vmap(along)(jnp.eye(len(names), dtype=values.dtype))
