"""Where steady sliding loses its stability: critical friction and critical slope of the friction law."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from ..foundation import arguments
from ..foundation.compiling import compiled
from ..foundation.kept_programs import kept
from ..foundation.precision import returning_numpy
from ..model.contact_coordinates import in_contact_coordinates
from ..model.scene import Scene, steady_sliding
from ..model.structure import Structure
from .crossings import first_limit
from .feedback import friction_loop, slope_loop
from .gradients import with_own_gradient
from .outcomes import CODES, Mechanism, StabilityOutcome
from .several_contacts import critical_friction_of_several, first_limit_of_several, one_contact
from .system import as_scene, check_direction


class StabilityLimit(eqx.Module):
    """The friction where steady sliding becomes unstable, and how.

    `mu` is infinite where the outcome is "never unstable" and 0 where it is "always unstable"; `frequency` in Hz (of
    the mode that grows beyond the limit; 0 for divergence) is NaN then.
    """

    mu: Float[Array, ""]
    frequency: Float[Array, ""]
    code: Int[Array, ""]

    @property
    def outcome(self) -> StabilityOutcome:
        """Found, never unstable or always unstable."""
        return CODES[int(self.code)][0]

    @property
    def mechanism(self) -> Mechanism:
        """Flutter, coalescence (undamped), divergence or Painlevé's paradox."""
        return CODES[int(self.code)][1]


def bare(structure: Structure) -> Structure:
    """The structure without the memory of how it was made: one compiled program serves every builder."""
    return Structure(*structure.matrices, contacts=structure.contacts)


def _several(structure: Structure, direction) -> tuple[Structure, Float[Array, " c"]]:
    # In coordinates of the contacts, so that one compiled program serves all directions that they may have.
    return bare(in_contact_coordinates(structure)), jnp.full(len(structure.contacts), float(direction))


def _is_a_limit(value):
    # Infinite stands for "never unstable" and zero for "always unstable".
    return jnp.isfinite(value) & (value != 0)


def _friction_limit(structure, direction):
    return first_limit(friction_loop(structure, direction)[0]).gain


_critical_friction = kept(with_own_gradient(_friction_limit, _is_a_limit))
_critical_friction_of_several = compiled(with_own_gradient(critical_friction_of_several, _is_a_limit))


@returning_numpy
def critical_friction(structure: Structure, *, direction: int = 1) -> Float[Array, ""]:
    r"""μ_crit: the smallest constant friction just above which steady sliding is unstable, without unit.

    The smallest $1/L(iω)$ over all frequencies where the friction loop $L$ is real, beyond which an eigenvalue of Eq. 3
    has a positive real part (see the module's text). For an undamped structure that is where two modes coalesce.

    Differentiable in every entry and parameter of the structure, forward and reverse and more than once, under
    `jax.jit`, `jax.grad` and `jax.vmap`, also in a process that never turned on double precision. The derivative is
    implicit and exact through the limit, where that of the eigenvalues would grow without bound. An undamped structure
    is differentiated among undamped ones (the slightest damping moves the limit by a jump, so there is no derivative in
    it; its entries are 0). Damping ratios below some 1e-11 drown in rounding and count as none.

    **Returns:** `inf` where the structure is never unstable, 0 where it is unstable at the slightest friction; the
    derivative is NaN then. `stability_limit` says the outcome and the mechanism by name.

    Several contacts slide under one μ. Their limit is looked for among 400 coefficients up to 2 and then closed in on: a
    narrower unstable window may be missed, and "never" means up to 2. Undamped, it has no derivative there.

    **Arguments:** `structure`; `direction`, +1 for a belt that moves along the tangential coordinate, -1 against it.

    **Example:**

        >>> round(float(fj.cea.critical_friction(structure)), 10)
        0.2282253477
    """
    arguments.instance("structure", structure, Structure, "a Structure, such as belt_oscillator()")
    check_direction(direction)
    if not one_contact(structure):
        return _critical_friction_of_several(*_several(structure, direction))
    return _critical_friction(bare(structure), jnp.asarray(float(direction)))


@compiled
def _stability_limit(structure, direction):
    loop, scale = friction_loop(structure, direction)
    limit = first_limit(loop)
    return StabilityLimit(mu=limit.gain, frequency=limit.omega * scale / (2 * jnp.pi), code=limit.code)


@compiled
def _stability_limit_of_several(structure, direction):
    mu, omega, code = first_limit_of_several(structure, direction)
    return StabilityLimit(mu=mu, frequency=omega / (2 * jnp.pi), code=code)


@returning_numpy
def stability_limit(structure: Structure, *, direction: int = 1) -> StabilityLimit:
    """Critical friction with its frequency, and by name whether there is one and how stability is lost there.

        limit = fj.cea.stability_limit(structure)
        limit.mu, limit.frequency, limit.outcome, limit.mechanism

    Arguments and method as in `critical_friction`.

    **Example:**

        >>> limit = fj.cea.stability_limit(structure)
        >>> round(float(limit.frequency), 2), limit.mechanism.value  # Hz
        (67.92, 'flutter')
    """
    arguments.instance("structure", structure, Structure, "a Structure, such as belt_oscillator()")
    check_direction(direction)
    if not one_contact(structure):
        return _stability_limit_of_several(*_several(structure, direction))
    return _stability_limit(bare(structure), jnp.asarray(float(direction)))


def _slope_limit(scene):
    mu = scene.friction(jnp.abs(scene.belt_speed))
    loop, _ = slope_loop(scene.structure, mu, jnp.sign(scene.belt_speed))
    _, normal_force = steady_sliding(scene, scene.load.final)
    return -first_limit(loop).gain / normal_force


_critical_slope = compiled(with_own_gradient(_slope_limit, _is_a_limit))


@returning_numpy
def critical_slope(scene: Scene) -> Float[Array, ""]:
    r"""The slope dμ/dv of the friction law below which steady sliding is unstable, in s/m (a negative number).

    At the scene's friction $\mu(v)$ and normal force $N_0$ a falling friction law acts like a negative damper
    $N_0\, d\mu/dv$ along the belt: $\det(D_\mu(s) - γ s\, e e^T) = 0$ at $s = iω$, and the slope is $-γ/N_0$. Compare
    with `friction_slope(scene)`. Differentiable.

    **Returns:** `-inf` where no slope makes sliding unstable, and 0 where it is unstable (coupled modes) even without
    a slope.

    **Raises:** `ValueError` for a belt at rest.

    **Example:**

        >>> falling = fj.Scene(structure, fj.ExponentialDecay(0.2, 0.1, decay=0.5), belt_speed=0.5, load=fj.ConstantLoad(100.0))
        >>> slope = fj.cea.critical_slope(falling)
    """
    scene = as_scene(_a_scene(scene), None, 1)
    return _critical_slope(scene)


@returning_numpy
def friction_slope(scene: Scene) -> Float[Array, ""]:
    """The slope dμ/dv of the scene's friction law at its belt speed, in s/m.

    **Example:**

        >>> falling = fj.Scene(structure, fj.ExponentialDecay(0.2, 0.1, decay=0.5), belt_speed=0.5, load=fj.ConstantLoad(100.0))
        >>> round(float(fj.cea.friction_slope(falling)), 4)  # s/m
        -0.0389
    """
    scene = as_scene(_a_scene(scene), None, 1)
    return jax.grad(lambda speed: scene.friction(speed))(jnp.abs(scene.belt_speed))


def _a_scene(scene):
    arguments.instance("scene", scene, Scene, "a Scene")
    return scene
