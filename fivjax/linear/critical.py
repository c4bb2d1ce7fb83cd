"""Where steady sliding loses its stability: critical friction and critical slope of the friction law."""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from ..foundation import arguments
from ..foundation.numpy_evaluation import by_numpy
from ..foundation.precision import is_known, returning_numpy
from ..model.contact_coordinates import in_contact_coordinates
from ..model.friction import slope_of
from ..model.scene import (
    Scene,
    refuse_several_contacts,
    sliding_equilibrium,
    steady_sliding,
    steady_slip_speeds,
)
from ..model.sliding import contact_coordinates, free_in_sliding
from ..model.structure import Structure
from .crossings import first_limit
from .feedback import friction_loop, slope_loop
from .gradients import by_numpy_if_small, with_own_gradient
from .outcomes import CODES, WHY, Mechanism, StabilityOutcome
from .several_contacts import critical_friction_of_several, first_limit_of_several
from .system import as_scene, checked_direction


class NoSteadySliding(ValueError):
    """Friction moves a part of the structure that no spring holds."""


class StabilityLimit(eqx.Module):
    """The friction at which steady sliding becomes unstable, and how.

    `mu` has no unit; it is infinite if the outcome is "never unstable" and 0 if it is "always unstable". `frequency` (Hz) is
    that of the mode that grows beyond the limit: 0 for divergence, NaN where there is no limit.
    """

    mu: Float[Array, ""]
    frequency: Float[Array, ""]
    code: Int[Array, ""]

    def __repr__(self) -> str:
        if not all(map(is_known, (self.mu, self.frequency, self.code))):
            return "StabilityLimit(<traced>)"
        if self.outcome is not StabilityOutcome.FOUND:
            return f"steady sliding under constant friction is {self.outcome.value}; {WHY[self.outcome]}"
        return (
            f"steady sliding is unstable above μ = {float(self.mu):.10g}, by {self.mechanism.value} at "
            f"{float(self.frequency):.6g} Hz"
        )

    @property
    def outcome(self) -> StabilityOutcome:
        """Found, never unstable or always unstable."""
        return CODES[int(self.code)][0]

    @property
    def mechanism(self) -> Mechanism:
        """Flutter, coalescence (undamped), divergence or Painlevé's paradox."""
        return CODES[int(self.code)][1]


def matrices_only(structure: Structure) -> Structure:
    """The structure as matrices, without the function that made it: one compiled program serves all structures of a size."""
    return Structure(*structure.matrices, contacts=structure.contacts)


def _checked(structure: Structure, direction) -> Structure:
    """The structure in contact coordinates, if its steady sliding may have a limit of stability.

    **Raises:** `ValueError` if friction moves a part of it ever further.
    """
    from scipy import linalg

    what = "a Structure, such as belt_oscillator()"
    arguments.instance("structure", structure, Structure, f"{what}, or `scene.structure`")
    checked_direction(direction)
    own = in_contact_coordinates(structure)
    if all(map(is_known, own.matrices)):
        free, (tangential, _) = free_in_sliding(own), contact_coordinates(own)
        # What no spring holds, and what a unit of it would move. In units that give each coordinate a stiffness of one, a very
        # stiff one does not make others seem free.
        stiffness = np.asarray(own.stiffness)[np.ix_(free, free)]
        sizes = np.abs(np.diag(stiffness))
        units = 1 / np.sqrt(np.where(sizes > 0, sizes, 1.0))
        held, motions = linalg.eigh(units[:, None] * stiffness * units)
        motions = units[:, None] * motions
        moved = np.abs(motions[np.isin(free, tangential)]).max(axis=0)
        # pyrefly: ignore[unsupported-operation]
        if np.any((held < 1e-12) & (moved > 1e-9 * np.abs(motions).max(axis=0))):
            raise NoSteadySliding(
                "There is no steady sliding: friction moves a part of the structure that no spring holds. "
                "Hold it by a spring along the belt."
            )
    return own


def _along(own: Structure, direction) -> Float[np.ndarray, "*c"]:
    """The belt's direction, at each contact where there are several: one program serves contacts of any directions."""
    return np.full(() if len(own.contacts) == 1 else len(own.contacts), float(direction))


def _is_a_limit(value):
    # Infinite stands for "never unstable" and zero for "always unstable".
    return jnp.isfinite(value) & (value != 0)


@functools.partial(with_own_gradient, exists=_is_a_limit)
def _friction_limit(structure, direction):
    """That of a structure as it was given, so that its parameters' way into the matrices is differentiated with it."""
    own = matrices_only(in_contact_coordinates(structure))
    if len(own.contacts) > 1:
        return critical_friction_of_several(own, direction)
    return first_limit(friction_loop(own, direction)[0]).gain


@returning_numpy
def critical_friction(structure: Structure, *, direction: int = 1) -> Float[Array, ""]:
    r"""μ_crit: the smallest constant friction just above which steady sliding is unstable, without unit.

    The smallest $1/L(iω)$, over all frequencies at which the loop function $L$ of friction (`linear.feedback`) is real, beyond
    which an eigenvalue of Eq. 3 has a positive real part. For an undamped structure that is where two modes coalesce.

    Differentiable in every entry and parameter of the structure, in forward and reverse mode and more than once, under
    `jax.jit`, `jax.grad` and `jax.vmap`, also without double precision being turned on. The derivative is that of the implicit
    function; it is exact at the limit, where the derivative of the eigenvalues may grow without bound. For an undamped
    structure damping stays zero: the smallest damping changes the limit by a jump, so there is no derivative with respect to
    it, and its entries are 0. Damping ratios below some 1e-11 are lost in rounding and count as none.

    **Returns:** `inf` where the structure is never unstable, 0 where it is unstable at the smallest friction; the
    derivative is NaN then. `stability_limit` gives the outcome and the mechanism by name.

    Several contacts slide under one μ. Their limit is sought among 400 coefficients up to 2 and then refined: a narrower
    interval of instability may be missed, and "never unstable" means up to 2. Without damping there is no derivative.

    **Arguments:** `structure`; `direction`, +1 for a belt that moves along the tangential coordinate, -1 against it.

    **Example:**

        >>> round(float(fj.cea.critical_friction(structure)), 10)
        0.2282253477
    """
    own = _checked(structure, direction)
    given = matrices_only(own) if all(map(is_known, jax.tree.leaves(structure))) else structure
    return _friction_limit(given, _along(own, direction))


@by_numpy_if_small
def _stability_limit(structure, direction):
    if len(structure.contacts) > 1:
        mu, omega, code = first_limit_of_several(structure, direction)
    else:
        loop, scale = friction_loop(structure, direction)
        limit = first_limit(loop)
        mu, omega, code = limit.gain, limit.omega * scale, limit.code
    return StabilityLimit(mu=mu, frequency=omega / (2 * jnp.pi), code=code)


@returning_numpy
def stability_limit(structure: Structure, *, direction: int = 1) -> StabilityLimit:
    """Critical friction and its frequency; and, by name, whether there is a limit and how stability is lost there.

        limit = fj.cea.stability_limit(structure)
        limit.mu, limit.frequency, limit.outcome, limit.mechanism

    Arguments and method as in `critical_friction`.

    **Example:**

        >>> limit = fj.cea.stability_limit(structure)
        >>> round(float(limit.frequency), 2), limit.mechanism.value  # Hz
        (67.92, 'flutter')
    """
    own = _checked(structure, direction)
    return _stability_limit(matrices_only(own), _along(own, direction))


@functools.partial(with_own_gradient, exists=_is_a_limit)
def _slope_limit(scene):
    mu = scene.friction(jnp.abs(scene.belt_speed))
    loop, _ = slope_loop(scene.structure, mu, jnp.sign(scene.belt_speed))
    _, normal_force = steady_sliding(scene, scene.load.final)
    return -first_limit(loop).gain / normal_force


@returning_numpy
def critical_slope(scene: Scene) -> Float[Array, ""]:
    r"""The slope dμ/dv of the friction law below which steady sliding is unstable, in s/m (a negative number).

    At the scene's friction $\mu(v)$ and normal force $N_0$ a falling friction law acts like a negative damper
    $N_0\, d\mu/dv$ along the belt: $\det(D_\mu(s) - γ s\, e e^T) = 0$ at $s = iω$, and the slope is $-γ/N_0$. Compare
    with `friction_slope(scene)`. Differentiable.

    **Returns:** `-inf` where no slope makes sliding unstable, and 0 where it is unstable even without a slope (by mode
    coupling).

    **Raises:** `ValueError` for a belt at rest, for a scene without sliding equilibrium, and for several contacts.

    **Example:**

        >>> falling = fj.Scene(structure, fj.ExponentialDecay(0.2, 0.1, decay=0.5), belt_speed=0.5, load=fj.ConstantLoad(100.0))
        >>> slope = fj.cea.critical_slope(falling)
    """
    scene = as_scene(_a_scene(scene), None, 1)
    refuse_several_contacts(scene.structure, "`critical_slope`", "`growth_rate` takes several.")
    sliding_equilibrium(scene)
    return _slope_limit(scene)


@returning_numpy
def friction_slope(scene: Scene) -> Float[Array, ""]:
    """The slope dμ/dv of the scene's friction law at its belt speed, in s/m; of several contacts, that of each.

    **Example:**

        >>> falling = fj.Scene(structure, fj.ExponentialDecay(0.2, 0.1, decay=0.5), belt_speed=0.5, load=fj.ConstantLoad(100.0))
        >>> round(float(fj.cea.friction_slope(falling)), 4)  # s/m
        -0.0389
    """
    scene = as_scene(_a_scene(scene), None, 1)
    return _slopes_of_friction(scene)


@by_numpy
def _slopes_of_friction(scene):
    return slope_of(scene.friction, steady_slip_speeds(scene))


def _a_scene(scene):
    arguments.instance("scene", scene, Scene, "a Scene")
    return scene
