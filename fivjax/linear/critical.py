r"""Where steady sliding loses its stability: critical friction, critical slope, coalescence.

Friction closes a feedback loop: the normal force moves the structure along the belt, and that motion changes the normal
force. One gain γ multiplies the whole loop, so with $D(s) = s^2 M + s C + K$ of the sliding coordinates

$$\det(D - γ\, e\, b^T) = \det D\; (1 - γ L(s)), \qquad L(s) = b(s)^T D(s)^{-1} e .$$

For friction γ = μ, $e$ is the tangential unit vector and $b(s)$ the normal row of the structure (times σ): Eq. 3. For a
falling friction law γ is the damping that its slope takes away and $b = s\, e$. Sliding can lose stability only where
$1/γ = L(iω)$ for some real ω, that is where $L(iω)$ is real. The frequencies where it is are eigenvalues of one small
matrix: **all** crossings are found at once, and no narrow window of instability is stepped over. Between two crossings
stability does not change, so one look at the eigenvalues there settles it. An undamped loop is real for all ω; it loses
stability where two modes meet, $dL/dω = 0$, and those points come from another such matrix.

The crossing is a solution of $L(iω; \text{parameters}) = 1/γ$, so it is differentiable by the implicit function
theorem, also where the eigenvalues themselves are not.

General eigenvalues (`jax.numpy.linalg.eig`) run on the CPU and, in recent versions of JAX, on some GPUs; what needs
none is in `stability`.
"""

import enum
from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float, Int

from ..foundation import arguments
from ..foundation.compiling import compiled
from ..foundation.linear_solve import inverse, solve
from ..foundation.precision import in_double_precision, returning_numpy
from ..model.scene import Scene, steady_sliding
from ..model.structure import Structure
from .routh_hurwitz import as_scene, check_direction, sliding_matrices, time_scale


class Outcome(enum.StrEnum):
    """What came of the search for a stability limit."""

    FOUND = "found"
    NEVER_UNSTABLE = "never unstable"
    ALWAYS_UNSTABLE = "always unstable"
    UNDECIDED = "undecided"


class Mechanism(enum.StrEnum):
    """How stability is lost at the limit."""

    NONE = "none"
    FLUTTER = "flutter"  # a damped pair of eigenvalues crosses the imaginary axis
    COALESCENCE = "coalescence"  # two undamped modes meet and part into a growing and a decaying one
    DIVERGENCE = "divergence"  # an eigenvalue crosses zero: the springs no longer hold
    PAINLEVE = "Painlevé's paradox"  # an eigenvalue passes through infinity: no unique contact force


# What the compiled search returns: an index into this table.
CODES = [
    (Outcome.NEVER_UNSTABLE, Mechanism.NONE),
    (Outcome.ALWAYS_UNSTABLE, Mechanism.NONE),
    (Outcome.FOUND, Mechanism.FLUTTER),
    (Outcome.FOUND, Mechanism.COALESCENCE),
    (Outcome.FOUND, Mechanism.DIVERGENCE),
    (Outcome.FOUND, Mechanism.PAINLEVE),
]
NEVER, ALWAYS, FLUTTER, COALESCENCE, DIVERGENCE, PAINLEVE = range(len(CODES))


class StabilityLimit(eqx.Module):
    """The friction where steady sliding becomes unstable, and how.

    `mu` is infinite where the outcome is "never unstable" and 0 where it is "always unstable"; `frequency` in Hz (of
    the mode that grows beyond the limit; 0 for divergence) is NaN then.
    """

    mu: Float[Array, ""]
    frequency: Float[Array, ""]
    code: Int[Array, ""]

    @property
    def outcome(self) -> Outcome:
        """Found, never unstable or always unstable."""
        return CODES[int(self.code)][0]

    @property
    def mechanism(self) -> Mechanism:
        """Flutter, coalescence (undamped), divergence or Painlevé's paradox."""
        return CODES[int(self.code)][1]


class Coalescence(eqx.Module):
    """Where two modes of steady sliding meet.

    With damping they meet exactly only at a complex friction $\\mu + i\\mu'$: on the real axis they pass each other
    closest at `mu`, and `imperfection` is $|\\mu'|$. Without damping it is 0.
    """

    mu: float
    frequency: float  # Hz
    growth_rate: float  # 1/s
    imperfection: float
    damped: bool = eqx.field(static=True)
    outcome: Outcome = eqx.field(static=True)


class Loop(eqx.Module):
    """A structure in steady sliding, opened at one rank-one feedback $e\\, b(s)^T$."""

    mass: Float[Array, "m m"]
    damping: Float[Array, "m m"]
    stiffness: Float[Array, "m m"]
    column: Float[Array, " m"]
    row_mass: Float[Array, " m"]
    row_damping: Float[Array, " m"]
    row_stiffness: Float[Array, " m"]

    def matrix(self, s):
        """D(s), opened: without the feedback."""
        return self.stiffness + s * self.damping + s**2 * self.mass

    def row(self, s):
        """b(s)."""
        return self.row_stiffness + s * self.row_damping + s**2 * self.row_mass

    def matrix_slope(self, s):
        """dD/ds."""
        return self.damping + 2 * s * self.mass

    def row_slope(self, s):
        """db/ds."""
        return self.row_damping + 2 * s * self.row_mass

    def __call__(self, s: Complex[Array, ""]) -> Complex[Array, ""]:
        """L(s), the loop's transfer function at gain one."""
        return self.row(s) @ solve(self.matrix(s), self.column.astype(complex))

    def slope(self, s: Complex[Array, ""]) -> Complex[Array, ""]:
        """dL/ds."""
        return jax.jvp(self, (s,), (jnp.ones_like(s),))[1]

    @property
    def limits(self) -> tuple[Float[Array, ""], Float[Array, ""]]:
        """L(0), the answer to a static push, and L(∞), that to an impulse."""
        static = self.row_stiffness @ solve(self.stiffness, self.column)
        return static, self.row_mass @ solve(self.mass, self.column)


def _bare(structure: Structure) -> Structure:
    """The structure without the memory of how it was made: one compiled program serves every builder."""
    return Structure(
        structure.mass,
        structure.damping,
        structure.stiffness,
        structure.load_direction,
        structure.tangential,
        structure.normal,
    )


def friction_loop(structure: Structure, direction: Float[Array, ""]) -> tuple[Loop, Float[Array, ""]]:
    """The loop whose gain is μ, and its unit of frequency ω₀ in rad/s."""
    zero = jnp.zeros_like(direction)
    matrices = sliding_matrices(structure, zero, direction, zero)
    keep = np.array([i for i in range(structure.size) if i != structure.normal])
    free = (structure.mass, structure.damping, structure.stiffness)
    rows = [direction * matrix[structure.normal][keep] for matrix in free]
    return _scaled(Loop(*matrices, _tangential(structure), *rows), time_scale(structure))


def slope_loop(
    structure: Structure, mu: Float[Array, ""], direction: Float[Array, ""]
) -> tuple[Loop, Float[Array, ""]]:
    """The loop at constant friction μ whose gain is the damping taken away (N·s/m), and its unit of frequency."""
    matrices = sliding_matrices(structure, mu, direction, jnp.zeros_like(mu))
    column = _tangential(structure)
    zero = jnp.zeros_like(column)
    return _scaled(Loop(*matrices, column, zero, column, zero), time_scale(structure))


def _tangential(structure: Structure):
    keep = np.array([i for i in range(structure.size) if i != structure.normal])
    return jnp.asarray(keep == structure.tangential, structure.mass.dtype)


def _scaled(loop: Loop, scale) -> tuple[Loop, Float[Array, ""]]:
    # Unit masses and frequencies of order one, so that the tolerances below mean something. L keeps its value.
    size = 1 / jnp.sqrt(jnp.abs(jnp.diagonal(loop.mass)))
    both = jnp.outer(size, size)
    return Loop(
        mass=loop.mass * both,
        damping=loop.damping * both / scale,
        stiffness=loop.stiffness * both / scale**2,
        column=loop.column * size,
        row_mass=loop.row_mass * size,
        row_damping=loop.row_damping * size / scale,
        row_stiffness=loop.row_stiffness * size / scale**2,
    ), scale


class _Limit(NamedTuple):
    gain: Float[Array, ""]
    omega: Float[Array, ""]
    code: Float[Array, ""]  # index into CODES


@jax.custom_jvp
def _first_limit(loop: Loop) -> _Limit:
    """The smallest gain above which the loop is unstable, by looking at every crossing."""
    m = loop.mass.shape[0]
    eye, none = np.eye(m), np.zeros((m, m))
    solved = solve(loop.mass, jnp.concatenate([loop.stiffness, loop.damping, loop.column[:, None]], axis=1))
    stiffness, damping, column = solved[:, :m], solved[:, m : 2 * m], solved[:, 2 * m]
    row_position = loop.row_stiffness - loop.row_mass @ stiffness
    row_velocity = loop.row_damping - loop.row_mass @ damping

    static, impulsive = loop.limits

    # Crossings: L(s) - L(-s) = 2s c (s² - A²)⁻¹ b with the loop's state matrix A. In units of the damping, so that
    # light damping costs no digits.
    unit = jnp.max(jnp.abs(damping)) + jnp.max(jnp.abs(row_velocity))
    unit = jnp.where(unit > 0, unit, 1.0)
    squared = jnp.block([[-stiffness, -damping / unit], [unit * damping @ stiffness, damping @ damping - stiffness]])
    output = jnp.concatenate([row_position, row_velocity / unit])
    # Coalescence of an undamped loop: dL/ds² = -c (s² + M⁻¹K)⁻² b.
    chained = jnp.block([[-stiffness, eye], [none, -stiffness]])
    chained_output = jnp.concatenate([row_position, jnp.zeros(m)])
    input_ = jnp.concatenate([jnp.zeros(m), column])
    squares = jax.vmap(_zeros, in_axes=(0, None, 0))(
        jnp.stack([squared, chained]), input_, jnp.stack([output, chained_output])
    ).ravel()
    omega = jnp.sqrt(jnp.maximum(-squares.real, 0.0))
    inverse_gain = jax.vmap(lambda w: loop(1j * w).real)(omega)
    real_frequency = (squares.real < 0) & (jnp.abs(squares.imag) < 1e-6 * jnp.abs(squares))
    inverse_gain = jnp.where(real_frequency, inverse_gain, 0.0)
    inverse_gain = jnp.concatenate([inverse_gain, jnp.stack([static, impulsive])])
    omega = jnp.concatenate([omega, jnp.array([0.0, jnp.inf])])
    codes = jnp.array([FLUTTER] * (2 * m) + [COALESCENCE] * (2 * m) + [DIVERGENCE, PAINLEVE], jnp.int32)
    state = jnp.block([[none, eye], [-stiffness, -damping]])
    row = jnp.concatenate([row_position, row_velocity])
    typical = 1 / (jnp.abs(impulsive) + jnp.linalg.norm(row) * jnp.linalg.norm(column))
    typical = jnp.where(jnp.isfinite(typical), typical, 1.0)
    usable = jnp.isfinite(inverse_gain) & (inverse_gain > 0)
    # A mode that no damper reaches is on the imaginary axis at no gain at all, which is not a crossing.
    marginal = jnp.max(jnp.linalg.eigvals(state).real) > -1e-11
    usable = usable & ~(marginal & (codes == FLUTTER) & (inverse_gain * typical > 1e5))
    gains = jnp.where(usable, 1 / jnp.where(usable, inverse_gain, 1.0), jnp.inf)
    gains, omega, codes = jax.lax.sort((gains, omega, codes), num_keys=1)

    # Between two neighbouring crossings stability is the same everywhere. Any gain in between will do; one of ordinary
    # size, because the next crossing may be very far off, or be rounding.
    lower = jnp.concatenate([jnp.zeros(1), gains])
    upper = jnp.concatenate([gains, jnp.array([jnp.inf])])
    between = jnp.minimum(0.5 * (lower + upper), jnp.maximum(2 * lower, typical))
    empty = ~jnp.isfinite(lower) | (upper <= lower * (1 + 1e-12))

    def unstable(gain):
        closed = state + jnp.outer(input_, row) * gain / (1 - gain * impulsive)
        return significant_growth(closed) > 0

    def searching(carry):
        i, found = carry
        return (i < lower.size) & ~found

    def step(carry):
        i, _ = carry
        return i + 1, ~empty[i] & unstable(between[i])

    i, found = jax.lax.while_loop(searching, step, (jnp.zeros((), jnp.int32), jnp.array(False)))
    last = i - 1
    code = jnp.where(found, jnp.where(last == 0, ALWAYS, codes[last - 1]), NEVER)
    at = jnp.maximum(last - 1, 0)
    return _Limit(
        gain=jnp.where(found, lower[last], jnp.inf),
        omega=jnp.where(code >= FLUTTER, omega[at], jnp.nan),
        code=code.astype(jnp.float64),
    )


@_first_limit.defjvp
def _(primals, tangents):
    """The implicit function theorem, with dL = (db - y dD) x + y de, x = D⁻¹e, y = D⁻ᵀb, written out.

    Every entry of the change of the loop appears once and linearly, so a gradient in all of them costs one evaluation.
    """
    (loop,), (change,) = primals, tangents
    limit = _first_limit(loop)
    flutter, coalescence = limit.code == FLUTTER, limit.code == COALESCENCE
    s = jax.lax.complex(jnp.zeros_like(limit.omega), jnp.where(flutter | coalescence, limit.omega, 0.0))

    matrix, matrix_slope = loop.matrix(s), loop.matrix_slope(s)
    row, row_slope = loop.row(s), loop.row_slope(s)
    x, y = solve(matrix, loop.column.astype(complex)), solve(matrix.T, row)
    value_change = change.row(s) @ x - y @ (change.matrix(s) @ x) + y @ change.column
    # The same along s: x', y', L', L'' and the change of L'.
    x_slope, y_slope = -solve(matrix, matrix_slope @ x), solve(matrix.T, row_slope - matrix_slope.T @ y)
    slope = row_slope @ x - y @ (matrix_slope @ x)
    bend = 2 * loop.row_mass @ x + row_slope @ x_slope - y_slope @ (matrix_slope @ x)
    bend = bend - y @ (2 * loop.mass @ x + matrix_slope @ x_slope)
    slope_change = change.row_slope(s) @ x + change.row(s) @ x_slope - y_slope @ (change.matrix(s) @ x)
    slope_change = slope_change - y @ (change.matrix_slope(s) @ x + change.matrix(s) @ x_slope)
    slope_change = slope_change + y_slope @ change.column
    # Im L = 0 along a flutter boundary, Im L' = 0 along a coalescence.
    omega_change = jnp.where(
        flutter,
        -value_change.imag / jnp.where(flutter, slope.real, 1.0),
        jnp.where(coalescence, -slope_change.imag / jnp.where(coalescence, bend.real, 1.0), 0.0),
    )
    inverse_gain_change = value_change.real - slope.imag * omega_change
    # An impulse instead: s is infinite.
    x, y = solve(loop.mass, loop.column), solve(loop.mass.T, loop.row_mass)
    impulsive_change = change.row_mass @ x - y @ (change.mass @ x) + y @ change.column
    inverse_gain_change = jnp.where(limit.code == PAINLEVE, impulsive_change, inverse_gain_change)
    tangent = _Limit(-(limit.gain**2) * inverse_gain_change, omega_change, jnp.zeros_like(limit.code))
    return limit, tangent


def _zeros(matrix: Float[Array, "n n"], column: Float[Array, " n"], row: Float[Array, " n"]) -> Complex[Array, " n"]:
    """The zeros x of row (x - matrix)⁻¹ column: n - 1 of them or fewer; the others come out infinite."""
    # Shifted and inverted, the zeros are the eigenvalues of the matrix seen through the projector that leaves out the
    # column. The shift must not be a zero or an eigenvalue; of three the best is taken.
    n = matrix.shape[0]
    shifts = np.array([0.3719, 1.7133, 5.2917])

    def seen_from(shift):
        inverted = inverse(matrix - shift * np.eye(n))
        seen = row @ inverted
        through = seen @ column
        quality = jnp.abs(through) / (jnp.linalg.norm(seen) * jnp.linalg.norm(column))
        projected = inverted - jnp.outer(column, seen @ inverted) / through
        return projected, jnp.where(jnp.all(jnp.isfinite(projected)), quality, 0.0)

    projected, quality = jax.vmap(seen_from)(shifts)
    # The first of the best. All are useless for a loop that is zero or undamped, and then so is the result.
    chosen = (quality > 0) & (quality == jnp.max(quality))
    chosen = chosen & (jnp.cumsum(chosen) == 1)
    best = jnp.sum(jnp.where(chosen[:, None, None], projected, 0.0), axis=0)
    return jnp.sum(jnp.where(chosen, shifts, 0.0)) + 1 / jnp.linalg.eigvals(best)


def significant_growth(matrix: Float[Array, "n n"]) -> Float[Array, ""]:
    """The largest real part of the eigenvalues, less what rounding may have put there: an undamped mode does not grow.

    The matrix is in units where displacements, velocities and frequencies are of order one. Differentiable.
    """
    usable = jnp.all(jnp.isfinite(matrix))
    matrix = jnp.where(usable, matrix, 0.0)
    _, left, right = jax.lax.linalg.eig(jax.lax.stop_gradient(matrix), compute_left_eigenvectors=True)
    left = left.conj().T
    left = left / jnp.sum(left * right.T, axis=1, keepdims=True)
    # The derivative of an eigenvalue is that of left A right with its vectors held fixed.
    real_parts = jnp.sum(left * (matrix @ right).T, axis=1).real
    # An error of the matrix moves an eigenvalue by its size times the eigenvalue's condition number, which is large
    # at a double eigenvalue that is none (an undamped mode met by another, but not coupled to it).
    condition = jnp.linalg.norm(left, axis=1) * jnp.linalg.norm(right, axis=0)
    error = 3e-15 * jax.lax.stop_gradient(jnp.linalg.norm(matrix)) * condition
    growth = jnp.max(jnp.where(jnp.isfinite(error), real_parts - error, -1e-12))
    return jnp.where(usable, growth, -1e-12)


def with_own_gradient(function: Callable, exists: Callable = jnp.isfinite) -> Callable:
    """A scalar function whose derivative is formed at once, in double precision, and only applied later.

    The derivative is NaN where `exists` says of the value that there is none.

    In a process that has not turned on double precision JAX carries out the backward pass after the public function has
    returned, in single precision, and stumbles. Here the backward pass is left with a sum of products.
    """
    own = jax.custom_jvp(function)

    @own.defjvp
    @in_double_precision
    def rule(primals, tangents):
        value, gradients = jax.value_and_grad(function, argnums=tuple(range(len(primals))))(*primals)
        flag = jnp.where(exists(value), 1.0, jnp.nan)
        products = jax.tree.map(lambda g, t: jnp.sum(flag * g * t), gradients, tangents)
        return value, sum(jax.tree.leaves(products))

    return own


def _is_a_limit(value):
    # Infinite stands for "never unstable" and zero for "always unstable".
    return jnp.isfinite(value) & (value != 0)


def _friction_limit(structure, direction):
    return _first_limit(friction_loop(structure, direction)[0]).gain


_critical_friction = compiled(with_own_gradient(_friction_limit, _is_a_limit))


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

    **Arguments:** `structure`; `direction`, +1 for a belt that moves along the tangential coordinate, -1 against it.
    """
    arguments.instance("structure", structure, Structure, "a Structure, such as belt_oscillator()")
    check_direction(direction)
    return _critical_friction(_bare(structure), jnp.asarray(float(direction)))


@compiled
def _stability_limit(structure, direction):
    loop, scale = friction_loop(structure, direction)
    limit = _first_limit(loop)
    return StabilityLimit(mu=limit.gain, frequency=limit.omega * scale / (2 * jnp.pi), code=limit.code)


@returning_numpy
def stability_limit(structure: Structure, *, direction: int = 1) -> StabilityLimit:
    """Critical friction with its frequency, and by name whether there is one and how stability is lost there.

        limit = fj.cea.stability_limit(structure)
        limit.mu, limit.frequency, limit.outcome, limit.mechanism

    Arguments and method as in `critical_friction`.
    """
    arguments.instance("structure", structure, Structure, "a Structure, such as belt_oscillator()")
    check_direction(direction)
    return _stability_limit(_bare(structure), jnp.asarray(float(direction)))


# Damping is brought in by this many steps, with as many Newton iterations at each.
HOMOTOPY_STEPS, NEWTON_STEPS = 20, 4


@compiled
def _coalescence(structure, direction):
    undamped = eqx.tree_at(lambda s: s.damping, structure, jnp.zeros_like(structure.damping))
    loop, scale = friction_loop(undamped, direction)
    limit = _first_limit(loop)
    full, _ = friction_loop(structure, direction)

    def step(i, s):
        share = (i // NEWTON_STEPS + 1) / HOMOTOPY_STEPS
        partly = eqx.tree_at(
            lambda x: (x.damping, x.row_damping), full, (share * full.damping, share * full.row_damping)
        )
        slope, curvature = jax.jvp(partly.slope, (s,), (jnp.ones_like(s),))
        return s - slope / curvature

    start = jax.lax.complex(jnp.zeros_like(limit.omega), limit.omega)
    s = jax.lax.fori_loop(0, HOMOTOPY_STEPS * NEWTON_STEPS, step, start)
    found = limit.code == COALESCENCE
    kept = found & jnp.isfinite(s) & (jnp.abs(s - start) < 0.5 * jnp.abs(start))
    return limit.gain, limit.omega * scale, 1 / full(s), s * scale, found, kept


@in_double_precision
def coalescence(structure: Structure, *, damped: bool = False, direction: int = 1) -> Coalescence:
    r"""Where the two modes that become unstable together meet.

    - `damped=False`: with the dampers left out (two frequencies become one, $dL/dω = 0$). This is what is usually
      called coalescence, and what the paper's 0.22 is.
    - `damped=True`: with them. The eigenvalues then meet exactly only at a complex friction: $L'(s) = 0$ for complex
      $s$, $\mu + i\mu' = 1/L(s)$, followed from the undamped point as the damping is brought in. On the real axis they
      pass closest at `mu` (to second order in `imperfection`).

    **Returns:** a `Coalescence`. Where no two undamped modes meet its outcome is "never unstable" and its numbers are
    NaN; where the damped point is lost on the way (heavy damping) it is "undecided".
    """
    arguments.instance("structure", structure, Structure, "a Structure, such as belt_oscillator()")
    arguments.instance("damped", damped, bool, "True or False")
    check_direction(direction)
    mu, omega, damped_mu, s, found, kept = jax.tree.map(
        np.asarray, _coalescence(_bare(structure), jnp.asarray(float(direction)))
    )
    if not found or (damped and not kept):
        outcome = Outcome.UNDECIDED if found else Outcome.NEVER_UNSTABLE
        return Coalescence(np.nan, np.nan, np.nan, np.nan, damped=damped, outcome=outcome)
    if damped:
        values = (damped_mu.real, abs(s.imag) / (2 * np.pi), s.real, abs(damped_mu.imag))
    else:
        values = (mu, omega / (2 * np.pi), 0.0, 0.0)
    return Coalescence(*map(float, values), damped=damped, outcome=Outcome.FOUND)


def _slope_limit(scene):
    mu = scene.friction(jnp.abs(scene.belt_speed))
    loop, _ = slope_loop(scene.structure, mu, jnp.sign(scene.belt_speed))
    _, normal_force = steady_sliding(scene, scene.load.final)
    return -_first_limit(loop).gain / normal_force


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
    """
    scene = as_scene(_a_scene(scene), None, 1)
    return _critical_slope(scene)


@returning_numpy
def friction_slope(scene: Scene) -> Float[Array, ""]:
    """The slope dμ/dv of the scene's friction law at its belt speed, in s/m."""
    scene = as_scene(_a_scene(scene), None, 1)
    return jax.grad(lambda speed: scene.friction(speed))(jnp.abs(scene.belt_speed))


def _a_scene(scene):
    arguments.instance("scene", scene, Scene, "a Scene")
    return scene
