r"""A limit cycle under changed parameters, as a function that JAX transforms: `jit`, `vmap`, `grad`.

Newton's method on the section's return map $P$ starts from a cycle that is known. Its steps are not differentiated: at the root
$y = P(y, θ)$, the derivatives are those of the implicit function theorem, $dy/dθ = (I - ∂P/∂y)^{-1} ∂P/∂θ$.
"""

import math
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Bool, Complex, Float

from ..attractors.closing import CLOSED, EXACT, HALVINGS, MOST_ITERATIONS
from ..contact import Contact, same_mode
from ..foundation import arguments
from ..foundation.compiling import compiled
from ..foundation.linear_solve import solve
from ..foundation.matrix_routines import eigenvalues
from ..foundation.precision import in_double_precision, is_known, known_to_numpy, refusing_reverse_in_single_precision
from ..model.printing import as_call
from ..model.scene import Scene
from ..model.sliding import contact_coordinates
from ..section.about_sliding import sliding_state
from ..section.crossings import Point, motion_to_section
from ..section.free_directions import jumped_to, section_row, zero_on_section
from ..steppers.event_exact import EXACT_STEPPER
from ..steppers.kernel_scope import has_kernel
from .cycle import LimitCycle, point_of, under_final_load
from .own_coordinates import in_own_coordinates


class NearbyCycle(eqx.Module):
    """A periodic motion near a known limit cycle, stable or not; arrays of JAX's, so that it can be differentiated.

    **Fields:** `period` in s; `amplitude`, the peak tangential speed, in m/s; `state`, displacements (m) and velocities (m/s)
    on the section; `residual`, how far the return is from the start, relative to the cycle's size; `found`, whether it closes
    (to 1e-10), not before as many crossings of the section, with the contact mode that the known one has there: if not, all
    else but `residual` is NaN, and `fj.limit_cycle(scene, start=cycle)` may find it; `multipliers` of the section's
    return map, largest first, without the one that is 1 for a deviation along the cycle; None unless asked for.

    **Example:**

        >>> cycle = fj.limit_cycle(scene.replace(belt_speed=1.0))  # doctest: +SLOW
        >>> isinstance(fj.nearby_cycle(cycle.scene, cycle), fj.NearbyCycle)
        True
    """

    period: Float[Array, ""]
    amplitude: Float[Array, ""]
    state: Float[Array, " state"]
    residual: Float[Array, ""]
    found: Bool[Array, ""]
    multipliers: Complex[Array, " state"] | None

    def __repr__(self) -> str:
        values = {"period": self.period, "amplitude": self.amplitude, "residual": self.residual, "found": self.found}
        return as_call("NearbyCycle", values)


@in_own_coordinates
@refusing_reverse_in_single_precision
@in_double_precision
def nearby_cycle(scene: Scene, cycle: LimitCycle, *, stages: int = 1, multipliers: bool = False) -> NearbyCycle:
    r"""The limit cycle of `scene` next to a known `cycle` of a similar scene: under `jit`, `vmap` and `grad`, too.

        amplitude = lambda mu: fj.nearby_cycle(scene.replace(mu=mu), cycle).amplitude
        jax.vmap(amplitude)(mus)
        with jax.enable_x64(True):
            jax.grad(amplitude)(0.22)

    The cycle is closed by Newton's method from the known one. Derivatives are those of the implicit function theorem; at a
    grazing event and at a fold there are none.

    **Arguments:** `scene`, with as many coordinates as `cycle.scene`; `cycle`, a periodic one, from `limit_cycle`,
    `saddle_cycle` or `cycle_at`; `stages`, the number of equal steps in which the parameters go from those of `cycle.scene` to
    those of `scene`: more where Newton's method does not find the cycle in one; `multipliers`, whether to compute them, too.
    Their derivatives are second derivatives of the motion, which take half a minute to compile once.

    **Returns:** `NearbyCycle`. Outside transformations its arrays are NumPy's.

    **Raises:** `TypeError` for anything but a `LimitCycle`; `ValueError` for a torus, or a structure of another size.

    **Example:**

        >>> cycle = fj.limit_cycle(scene.replace(belt_speed=1.0))  # doctest: +SLOW
        >>> nearby = fj.nearby_cycle(scene.replace(belt_speed=1.0, mu=0.22), cycle)
        >>> bool(nearby.found), bool(nearby.amplitude < cycle.amplitude)
        (True, True)
    """
    arguments.instance("scene", scene, Scene, "a Scene")
    arguments.instance("cycle", cycle, LimitCycle, "a limit cycle, such as `fivjax.limit_cycle(scene)`")
    if not is_known(jax.tree.leaves(cycle)):
        raise TypeError(
            "Argument `cycle` must hold known numbers, but is traced. Close over it, "
            "`jax.jit(lambda scene: fj.nearby_cycle(scene, cycle))`: the scene may be traced."
        )
    stages = arguments.whole_number("stages", stages, minimum=1)
    arguments.truth("multipliers", multipliers)
    if cycle.kind != "periodic":
        raise ValueError("Argument `cycle` must be periodic, but is a torus, on which no state returns.")
    before, after = cycle.scene, under_final_load(scene)
    if jax.tree.structure(before) != jax.tree.structure(after):
        raise ValueError(
            "Argument `cycle` must be of a scene with as many coordinates, made by the same functions, and with friction and "
            "impacts of the same kind, as `scene`; compute one with `fivjax.limit_cycle(scene)`."
        )
    found = next_to(after, before, point_of(cycle), jnp.asarray(cycle.crossings, jnp.int32), stages, bool(multipliers))
    return jax.tree.map(known_to_numpy, found)


class _Image(NamedTuple):
    """Where a motion from a point of the section returns to, after one period."""

    y: Float[Array, " state"]
    period: Float[Array, ""]  # s
    peak: Float[Array, ""]  # m/s


class _Root(NamedTuple):
    """The best root of the return map that Newton's method comes to."""

    y: Float[Array, " state"]
    period: Float[Array, ""]  # s
    peak: Float[Array, ""]  # m/s
    missed: Float[Array, ""]  # by the return, relative to the size
    jacobian: Float[Array, "state state"]  # of the return map


@compiled
def next_to(scene: Scene, before: Scene, point: Point, crossings, stages: int, multipliers: bool) -> NearbyCycle:
    """The cycle of `scene` next to a point of a cycle of the scene `before`; with no stage, the cycle of that point."""
    root = _root(scene, before, point, crossings, stages=stages, twice=multipliers)
    found = root.missed <= CLOSED
    if stages:
        found &= ~_closes_earlier(scene, root.y, point.contact, crossings)

    def where_found(value):
        return jnp.where(found, value, jnp.nan)

    return NearbyCycle(
        period=where_found(root.period),
        amplitude=where_found(root.peak),
        state=where_found(root.y + sliding_state(scene, scene.load.final)),
        residual=root.missed,
        found=found,
        multipliers=where_found(_by_size(eigenvalues(root.jacobian))) if multipliers else None,
    )


@eqx.filter_custom_jvp
def _root(scene: Scene, before: Scene, point: Point, crossings, *, stages: int, twice: bool) -> _Root:
    if stages == 0:
        image, units = _image(scene, point.contact, crossings), jnp.eye(len(point.y))
        here, _ = image(point.y)
        jacobian = _columns(lambda y: image(y)[0].y, (point.y,), (units,)) if twice else jnp.zeros_like(units)
        return _Root(point.y, here.period, here.peak, jnp.zeros_like(here.peak), jacobian)
    if stages == 1:
        return _closed(scene, point.y, point.contact, crossings)

    def stage(k, root):
        between = jax.tree.map(lambda one, other: one + (k + 1) / stages * (other - one), before, scene)
        return _closed(between, root.y, point.contact, crossings)

    return jax.lax.fori_loop(1, stages, stage, stage(0, point))


@_root.def_jvp
def _root_jvp(primals, tangents, *, stages: int, twice: bool):
    """By the implicit function theorem. A sum over columns of a matrix, which JAX can transpose, so that reverse derivatives
    need nothing but forward ones.
    """
    scene, _, point, crossings = primals
    moved, fixed = eqx.partition(scene, jax.tree.map(lambda one: one is not None, tangents[0], is_leaf=_is_none))
    values, rebuilt = ravel_pytree(moved)
    change, _ = ravel_pytree(tangents[0])
    root = _root(*primals, stages=stages, twice=twice)

    def image(values, y):
        return _image(eqx.combine(rebuilt(values), fixed), point.contact, crossings)(y)[0]

    many, units = len(values), jnp.eye(len(values) + len(root.y), dtype=root.y.dtype)
    by_all = _columns(image, (values, root.y), (units[:, :many], units[:, many:]))
    direct = _Image(*(part[..., :many] for part in by_all))
    by_state = _Image(*(part[..., many:] for part in by_all))
    y = solve(jnp.eye(len(root.y)) - by_state.y, direct.y)
    period, peak = (direct[k] + by_state[k] @ y for k in (1, 2))
    jacobian = jnp.zeros((*root.jacobian.shape, len(values)))
    if twice:

        def returned(values, y):
            return _columns(lambda y: image(values, y).y, (y,), (jnp.eye(len(y)),))

        jacobian = _columns(returned, (values, root.y), (jnp.eye(len(values)), y.T))
    return root, _Root(y @ change, period @ change, peak @ change, jnp.zeros_like(root.missed), jacobian @ change)


def _columns(function, at, directions):
    """The derivatives of a function along each of several directions (leading axis), as a last axis."""
    return jax.vmap(lambda *one: jax.jvp(function, at, one)[1], out_axes=-1)(*directions)


def _is_none(leaf) -> bool:
    return leaf is None


def _by_size(values):
    # `argsort` is lowered after double precision is off again in a caller's own `jit`.
    _, real, imaginary = jax.lax.sort((-jnp.abs(values), values.real, values.imag), num_keys=1)
    return jax.lax.complex(real, imaginary)


def _image(scene: Scene, contact: Contact, crossings):
    """The return map with period and peak, as a function of the state on the section; its further result is the contact mode
    there, and whether the section was reached.
    """
    numbers = jnp.asarray(crossings, jnp.float64)[None]

    def image(y):
        (at, _, arrived, peak), _ = motion_to_section(
            (scene, Point(y, contact), crossings, math.inf, np.True_),
            numbers,
            by_kernel=has_kernel(scene, EXACT_STEPPER),
        )
        return _Image(at.point.y, at.time, jnp.where(arrived, peak, jnp.nan)), (at.point.contact, arrived)

    return image


def _closes_earlier(scene: Scene, y, contact: Contact, crossings) -> Bool[Array, ""]:
    """Whether a motion has come back at an earlier crossing already: several contacts may cross the section less often in a
    period than they did, and then this is more than one.
    """
    # As many crossings as are looked at, and how near to its start a motion is back.
    most, near = 64, 1e-7
    scene, y = jax.lax.stop_gradient((scene, y))
    numbers = jnp.arange(1.0, most)
    _, path = motion_to_section(
        (scene, Point(y, contact), crossings, math.inf, np.True_), numbers, by_kernel=has_kernel(scene, EXACT_STEPPER)
    )
    weights = jnp.asarray(scene.structure.weights)
    missed = jnp.linalg.norm(weights * (path.point.y - y), axis=-1) / jnp.linalg.norm(weights * y)
    return jnp.any((numbers < crossings) & (missed <= near))


def _closed(scene: Scene, guess, contact: Contact, crossings) -> _Root:
    """The root of the return map next to a guess."""
    image = _image(scene, contact, crossings)
    weights = jnp.asarray(scene.structure.weights)
    units = jnp.eye(len(guess), dtype=guess.dtype)
    places = contact_coordinates(scene.structure)
    section = section_row(scene.structure.size, places[0])
    jumped = jumped_to(guess, weights, section, places[0])
    zero_there = jnp.where(jumped, guess == 0, zero_on_section(scene.structure.size, *places, contact.status))

    def going(carry):
        count, root, _, halved = carry
        # Below the bound, a step that does not help is the last one.
        return (
            (count < MOST_ITERATIONS)
            & (root.missed > EXACT)
            & (halved <= jnp.where(root.missed <= CLOSED, 0, HALVINGS))
        )

    def further(carry):
        count, root, step, halved = carry
        tried = jnp.where(zero_there, 0.0, root.y + step)
        back, tangents, (mode, arrived) = jax.vmap(
            lambda unit: jax.jvp(image, (tried,), (unit,), has_aux=True), out_axes=(None, -1, None)
        )(units)
        same = same_mode(mode.status, mode.direction, contact.status, contact.direction)
        usable = arrived & jnp.all(jnp.isfinite(tangents.y)) & jnp.all(same)
        missed = jnp.linalg.norm(weights * (back.y - tried)) / jnp.linalg.norm(weights * tried)
        new = _Root(tried, back.period, back.peak, jnp.where(usable, missed, jnp.inf), tangents.y)
        better = new.missed < root.missed
        root = jax.tree.map(lambda new, old: jnp.where(better, new, old), new, root)
        newton = solve(units - tangents.y, back.y - tried)
        return count + 1, root, jnp.where(better, newton, 0.5 * step), jnp.where(better, 0, halved + 1)

    none, still, zero = jnp.zeros((), jnp.int32), jnp.zeros_like(guess), jnp.zeros((), guess.dtype)
    begin = _Root(guess, zero, zero, zero + jnp.inf, jnp.zeros_like(units))
    return jax.lax.while_loop(going, further, (none, begin, still, none))[1]
