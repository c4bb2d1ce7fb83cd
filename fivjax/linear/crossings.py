r"""All gains at which a feedback loop may lose its stability, and the first at which it does.

Sliding can lose stability only where $1/γ = L(iω)$ for some real ω (see `feedback`), that is where $L(iω)$ is real. These
frequencies are eigenvalues of one small matrix: **all** crossings are found at once, and no narrow interval of instability is
missed. Between two crossings stability does not change, so the eigenvalues at one gain in between decide it. An undamped loop
is real for all ω; it loses stability where two modes meet, $dL/dω = 0$, and those points come from another such matrix.

The crossing is a solution of $L(iω; \text{parameters}) = 1/γ$, so it is differentiable by the implicit function theorem,
even where the eigenvalues are not.

Eigenvalues of general matrices (`jax.numpy.linalg.eig`) are computed on the CPU and, in recent versions of JAX, on some GPUs;
`routh_hurwitz` does without them.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float

from ..foundation.linear_solve import inverse, solve
from ..foundation.matrix_routines import eigenvalues
from .feedback import Loop
from .gradients import in_natural_units, significant_growth
from .outcomes import ALWAYS, COALESCENCE, DIVERGENCE, FLUTTER, NEVER, PAINLEVE


class Limit(NamedTuple):
    gain: Float[Array, ""]
    omega: Float[Array, ""]
    code: Float[Array, ""]  # index into CODES


class _StateSpace(NamedTuple):
    """A loop as a first-order system of displacements and velocities, with its mass divided out."""

    stiffness: Float[Array, "m m"]
    damping: Float[Array, "m m"]
    column: Float[Array, " m"]
    # Of displacements and velocities, in what the loop feeds back.
    row_position: Float[Array, " m"]
    row_velocity: Float[Array, " m"]

    @classmethod
    def of(cls, loop: Loop) -> "_StateSpace":
        m = loop.mass.shape[0]
        solved = solve(loop.mass, jnp.concatenate([loop.stiffness, loop.damping, loop.column[:, None]], axis=1))
        stiffness, damping, column = solved[:, :m], solved[:, m : 2 * m], solved[:, 2 * m]
        row_position = loop.row_stiffness - loop.row_mass @ stiffness
        row_velocity = loop.row_damping - loop.row_mass @ damping
        return cls(stiffness, damping, column, row_position, row_velocity)

    @property
    def matrix(self) -> Float[Array, "2m 2m"]:
        """Of the open loop."""
        eye, none = np.eye(len(self.column)), np.zeros(self.damping.shape)
        return jnp.block([[none, eye], [-self.stiffness, -self.damping]])

    @property
    def input(self) -> Float[Array, " 2m"]:
        return jnp.concatenate([jnp.zeros(len(self.column)), self.column])

    @property
    def row(self) -> Float[Array, " 2m"]:
        return jnp.concatenate([self.row_position, self.row_velocity])


@jax.custom_jvp
def first_limit(loop: Loop) -> Limit:
    """The smallest gain just above which the loop is unstable, found by checking every crossing."""
    system, (static, impulsive) = _StateSpace.of(loop), loop.limits
    state, input_, row = system.matrix, system.input, system.row
    inverse_gain, omega, codes = _crossings(loop, system)
    inverse_gain = jnp.concatenate([inverse_gain, jnp.stack([static, impulsive])])
    omega = jnp.concatenate([omega, jnp.array([0.0, jnp.inf])])
    codes = jnp.array([*codes, DIVERGENCE, PAINLEVE], jnp.int32)
    typical = 1 / (jnp.abs(impulsive) + jnp.linalg.norm(row) * jnp.linalg.norm(system.column))
    typical = jnp.where(jnp.isfinite(typical), typical, 1.0)
    usable = jnp.isfinite(inverse_gain) & (inverse_gain > 0)
    # A mode without damping lies on the imaginary axis already at gain zero, which is no crossing.
    values = eigenvalues(in_natural_units(state, 1.0))
    marginal = jnp.any(values.real > -1e-11 * jnp.abs(values))
    usable = usable & ~(marginal & (codes == FLUTTER) & (inverse_gain * typical > 1e5))
    # With damping, undamped modes that meet say nothing; but they may do so at the very gain of a crossing: where it is equal.
    usable = usable & (marginal | (codes != COALESCENCE))
    gains = jnp.where(usable, 1 / jnp.where(usable, inverse_gain, 1.0), jnp.inf)
    gains, omega, codes = jax.lax.sort((gains, omega, codes), num_keys=1)

    # Between two neighbouring crossings stability does not change, so any gain in between will do. One of ordinary size is
    # taken, because the next crossing may be very far off, or may be a rounding error.
    lower = jnp.concatenate([jnp.zeros(1), gains])
    upper = jnp.concatenate([gains, jnp.array([jnp.inf])])
    between = jnp.minimum(0.5 * (lower + upper), jnp.maximum(2 * lower, typical))
    empty = ~jnp.isfinite(lower) | (upper <= lower * (1 + 1e-11))

    def unstable(gain):
        closed = state + jnp.outer(input_, row) * gain / (1 - gain * impulsive)
        return significant_growth(in_natural_units(closed, 1.0)) > 0

    def not_found(carry):
        i, found = carry
        return (i < lower.size) & ~found

    def step(carry):
        i, _ = carry
        return i + 1, ~empty[i] & unstable(between[i])

    i, found = jax.lax.while_loop(not_found, step, (jnp.zeros((), jnp.int32), jnp.array(False)))
    last = i - 1
    code = jnp.where(found, jnp.where(last == 0, ALWAYS, codes[last - 1]), NEVER)
    at = jnp.maximum(last - 1, 0)
    return Limit(
        gain=jnp.where(found, lower[last], jnp.inf),
        omega=jnp.where(code >= FLUTTER, omega[at], jnp.nan),
        code=code.astype(jnp.float64),
    )


@first_limit.defjvp
def _(primals, tangents):
    """The implicit function theorem, with dL = (db - y dD) x + y de, x = D⁻¹e, y = D⁻ᵀb.

    It is linear in the change of each entry of the loop, so a gradient in all entries costs one evaluation.
    """
    (loop,), (change,) = primals, tangents
    limit = first_limit(loop)
    flutter, coalescence = limit.code == FLUTTER, limit.code == COALESCENCE
    s = jax.lax.complex(jnp.zeros_like(limit.omega), jnp.where(flutter | coalescence, limit.omega, 0.0))

    matrix, matrix_slope = jnp.where(limit.code == DIVERGENCE, loop.held, loop.matrix(s)), loop.matrix_slope(s)
    row, row_slope = loop.row(s), loop.row_slope(s)
    x, y = solve(matrix, loop.column.astype(complex)), solve(matrix.T, row)
    value_change = change.row(s) @ x - y @ (change.matrix(s) @ x) + y @ change.column
    # The derivatives by s: x', y', L', L'', and the change of L'.
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
    # Painlevé's paradox: s is infinite.
    x, y = solve(loop.mass, loop.column), solve(loop.mass.T, loop.row_mass)
    impulsive_change = change.row_mass @ x - y @ (change.mass @ x) + y @ change.column
    inverse_gain_change = jnp.where(limit.code == PAINLEVE, impulsive_change, inverse_gain_change)
    tangent = Limit(-(limit.gain**2) * inverse_gain_change, omega_change, jnp.zeros_like(limit.code))
    return limit, tangent


def _crossings(loop: Loop, system: _StateSpace) -> tuple[Float[Array, " k"], Float[Array, " k"], list[int]]:
    """The inverse of the gain, the frequency and the kind of all crossings between zero and infinity; the inverse is zero where
    there is none.
    """
    m = len(system.column)
    eye, none = np.eye(m), np.zeros((m, m))
    stiffness, damping = system.stiffness, system.damping
    # L(s) - L(-s) = 2s c (s² - A²)⁻¹ b with the loop's state matrix A. In units of the damping, so that light damping does not
    # lose digits.
    unit = jnp.max(jnp.abs(damping)) + jnp.max(jnp.abs(system.row_velocity))
    unit = jnp.where(unit > 0, unit, 1.0)
    squared = jnp.block([[-stiffness, -damping / unit], [unit * damping @ stiffness, damping @ damping - stiffness]])
    output = jnp.concatenate([system.row_position, system.row_velocity / unit])
    # Coalescence of an undamped loop: dL/ds² = -c (s² + M⁻¹K)⁻² b.
    chained = jnp.block([[-stiffness, eye], [none, -stiffness]])
    chained_output = jnp.concatenate([system.row_position, jnp.zeros(m)])
    squares = jax.vmap(_zeros, in_axes=(0, None, 0, None))(
        jnp.stack([squared, chained]), system.input, jnp.stack([output, chained_output]), _scales(stiffness)
    ).ravel()
    omega = jnp.sqrt(jnp.maximum(-squares.real, 0.0))
    inverse_gain = jax.vmap(lambda w: loop(1j * w).real)(omega)
    real_frequency = (squares.real < 0) & (jnp.abs(squares.imag) < 1e-6 * jnp.abs(squares))
    inverse_gain = jnp.where(real_frequency, inverse_gain, 0.0)
    each = squares.size // 2
    return inverse_gain, omega, [FLUTTER] * each + [COALESCENCE] * each


def _scales(stiffness: Float[Array, "m m"]) -> Float[Array, " 3"]:
    """Typical squares of frequencies: of the slowest coordinate, the middle, and of the fastest."""
    squares = jnp.abs(jnp.diagonal(stiffness))
    moving = squares > 0
    logarithms = jnp.log(jnp.where(moving, squares, 1.0))
    middle = jnp.sum(logarithms) / jnp.maximum(jnp.sum(moving), 1)
    ends = [jnp.min(jnp.where(moving, logarithms, jnp.inf)), middle, jnp.max(jnp.where(moving, logarithms, -jnp.inf))]
    return jnp.exp(jnp.where(jnp.any(moving), jnp.stack(ends), 0.0))


def _zeros(
    matrix: Float[Array, "n n"], column: Float[Array, " n"], row: Float[Array, " n"], scales: Float[Array, " k"]
) -> Complex[Array, "k n"]:
    """The zeros x of row (x - matrix)⁻¹ column, at most n - 1, as they are found about each scale; others come out infinite.

    About a scale those of its size come out with all their digits, and those that are far smaller with none.
    """
    # After shift and inversion, the zeros are eigenvalues of the matrix times the projector that removes the column. The shift
    # must not be a zero or an eigenvalue; the best of three is taken.
    n = matrix.shape[0]

    def projected_about(shift):
        inverted = inverse(matrix - shift * np.eye(n))
        seen = row @ inverted
        through = seen @ column
        quality = jnp.abs(through) / (jnp.linalg.norm(seen) * jnp.linalg.norm(column))
        projected = shift * (inverted - jnp.outer(column, seen @ inverted) / through)
        return projected, jnp.where(jnp.all(jnp.isfinite(projected)), quality, 0.0)

    def zeros_about(scale):
        shifts = scale * np.array([0.3719, 1.7133, 5.2917])
        projected, quality = jax.vmap(projected_about)(shifts)
        # The first of the best. For a loop that is zero or undamped none is usable, and the result is not finite.
        chosen = (quality > 0) & (quality == jnp.max(quality))
        chosen = chosen & (jnp.cumsum(chosen) == 1)
        best = jnp.sum(jnp.where(chosen[:, None, None], projected, 0.0), axis=0)
        return jnp.sum(jnp.where(chosen, shifts, 0.0)) * (1 + 1 / eigenvalues(best))

    return jax.vmap(zeros_about)(scales)
