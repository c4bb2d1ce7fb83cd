"""The vibrating structure: symmetric matrices, where the load acts, and which coordinates touch the belt.

A structure knows nothing of contact or friction. Sliding and sticking are projections of its matrices, done in
`contact`; nothing outside `belt_oscillator` knows a spring or an angle by name.
"""

from collections.abc import Callable

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..foundation import arguments
from ..foundation.precision import in_double_precision, is_known, real
from .printing import as_call


class Springs(eqx.Module):
    r"""A stiffness matrix as so many springs, $K = B^T \mathrm{diag}(k) B$ with a triangular $B$.

    Structures may be free to move as a whole. In $Kq$ the stiff springs cancel then only to rounding, which pulls a soft
    structure back that has come far; the stretches $Bq$ of such a motion are zero, and so are the forces.
    """

    stretch: Float[Array, "n n"]  # B, how displacements stretch the springs
    rates: Float[Array, " n"]  # k, N/m; exactly zero where the structure is free

    def __init__(self, stiffness: Float[Array, "n n"]):
        n, left, columns, rates = stiffness.shape[0], stiffness, [], []
        eps = float(jnp.finfo(stiffness.dtype).eps)
        for k in range(n):
            rate = left[k, k]
            # What elimination leaves of a stiffness that is no larger than its rounding is none.
            rate = jnp.where(rate > 16 * n * eps * stiffness[k, k], rate, 0.0)
            column = jnp.where(jnp.arange(n) > k, left[:, k] / jnp.where(rate > 0, rate, 1.0), 0.0)
            column = jnp.where(rate > 0, column, 0.0).at[k].set(1.0)
            left = left - rate * column[:, None] * column[None, :]
            columns.append(column)
            rates.append(rate)
        self.stretch, self.rates = jnp.stack(columns), jnp.stack(rates)

    def stretches(self, displacement: Float[Array, " n"]) -> Float[Array, " n"]:
        """How far each spring is stretched, in m."""
        return jnp.sum(self.stretch * displacement, axis=-1)

    def energy(self, displacement: Float[Array, " n"]) -> Float[Array, ""]:
        """The energy stored in them, in J."""
        return 0.5 * jnp.sum(self.rates * self.stretches(displacement) ** 2)


class Structure(eqx.Module):
    r"""A linear structure with one frictional contact:
    $M \ddot q + C \dot q + K q = f F(t) + e_t T + e_n N$ (Eqs. 4–5 of the paper, with the contact forces on the right).

    **Arguments:**

    - `mass`, `damping`, `stiffness`: symmetric `(n, n)` matrices in kg, N·s/m and N/m. The mass matrix is positive
      definite, the other two positive semi-definite.
    - `load_direction`: `(n,)`, the coordinates' share $f$ of a positive load, without unit.
    - `tangential`, `normal`: indices of the coordinate along the belt and of the gap (positive away from the belt).

    **Raises:** `ValueError` or `TypeError`, as a sentence, for a wrong shape, a non-finite entry, an unsymmetric or
    indefinite matrix, or an index out of range.
    """

    mass: Float[Array, "n n"]
    damping: Float[Array, "n n"]
    stiffness: Float[Array, "n n"]
    load_direction: Float[Array, " n"]
    tangential: int = eqx.field(static=True)
    normal: int = eqx.field(static=True)
    # How the matrices came about, where a builder such as `belt_oscillator` made them: its arguments by name, and itself.
    parameters: dict[str, Float[Array, ""]]
    builder: Callable[..., "Structure"] | None = eqx.field(static=True)
    # Which of these parameters are dampers: the damping matrix is a sum of parts, each proportional to one of them.
    dampers: tuple[str, ...] = eqx.field(static=True)

    @in_double_precision
    def __init__(
        self,
        mass,
        damping,
        stiffness,
        load_direction,
        tangential: int = 0,
        normal: int = 2,
        *,
        parameters: dict | None = None,
        builder: Callable[..., "Structure"] | None = None,
        dampers: tuple[str, ...] = (),
    ):
        matrices = {"mass": mass, "damping": damping, "stiffness": stiffness}
        for name, matrix in matrices.items():
            _check_matrix(name, matrix, definite=name == "mass")
        self.mass, self.damping, self.stiffness = map(real, matrices.values())
        if is_known(load_direction):
            arguments.numeric_array("load_direction", load_direction)
        self.load_direction = real(load_direction)
        n = self.mass.shape[0]
        _check_shapes(n, damping=self.damping, stiffness=self.stiffness)
        if self.load_direction.shape != (n,):
            raise ValueError(
                f"Argument `load_direction` must have shape ({n},) to go with the mass matrix, but has shape "
                f"{self.load_direction.shape}."
            )
        if is_known(load_direction) and not np.all(np.isfinite(np.asarray(load_direction))):
            raise ValueError("Argument `load_direction` must be finite.")
        self.tangential = _checked_index("tangential", tangential, n)
        self.normal = _checked_index("normal", normal, n)
        if self.tangential == self.normal:
            raise ValueError(
                f"Arguments `tangential` and `normal` must name two different coordinates, but both are {self.normal}."
            )
        self.parameters = {name: real(value) for name, value in (parameters or {}).items()}
        self.builder = builder
        self.dampers = tuple(dampers)

    @property
    @in_double_precision
    def damping_parts(self) -> dict[str, Float[Array, "n n"]]:
        """The damping matrix apart by damper, in N·s/m; empty where the structure was given as matrices."""
        if self.builder is None:
            return {}
        # The matrix is linear in the dampers, so a part is what is left of it without the others.
        return {
            name: self.replace(
                **{other: jnp.zeros_like(self.parameters[other]) for other in self.dampers if other != name}
            ).damping
            for name in self.dampers
        }

    @property
    def size(self) -> int:
        """Number of degrees of freedom of the free structure."""
        return self.mass.shape[0]

    @property
    def weights(self) -> Float[Array, " 2n"]:
        """What makes the squares of displacements and velocities comparable energies: the square roots of the diagonals."""
        return jnp.sqrt(jnp.concatenate([jnp.diag(self.stiffness), jnp.diag(self.mass)]))

    def __repr__(self) -> str:
        if self.builder is not None:
            return as_call(getattr(self.builder, "__name__", "Structure"), self.parameters)
        shown = ("mass", "damping", "stiffness", "load_direction", "tangential", "normal")
        return as_call("Structure", {name: getattr(self, name) for name in shown})

    def replace(self, **changes) -> "Structure":
        """The structure rebuilt with other values of the parameters that made it: `structure.replace(k1=90e3)`.

        **Raises:** `ValueError` for a name that is not among `structure.parameters`.
        """
        if not changes:
            return self
        unknown = sorted(set(changes) - set(self.parameters))
        if unknown or self.builder is None:
            known = ", ".join(self.parameters) or "none (it was given as matrices)"
            raise ValueError(f"Structure has no parameter `{(unknown or list(changes))[0]}`; it has: {known}.")
        return self.builder(**{**self.parameters, **changes})


@in_double_precision
def belt_oscillator(m1=0.53, m2=0.045, c1=1.0, c2=1.0, k1=100e3, k2=101e3, theta=0.01) -> Structure:
    """The paper's mass on a moving belt, with the values of its Table 1 (matrices of Eq. 5).

    Coordinates `(x2, y1, y2)`: along the belt, vertical displacement of mass 1, normal to the belt. Mass 1 shares the
    horizontal motion of mass 2, so its position is `(x2 cosθ − y2 sinθ, y1)`; spring 1 ties that horizontal motion to
    the frame, and spring 2 acts on the difference of `y1` and the height `x2 sinθ + y2 cosθ` of mass 2.

    **Arguments:** masses `m1`, `m2` in kg; dampers `c1`, `c2` in N·s/m; springs `k1`, `k2` in N/m; belt inclination
    `theta` in rad.

    **Raises:** `ValueError` for masses that are not positive, negative dampers or springs, or a non-finite value.
    """
    arguments.real_number("m1", m1, above=0)
    arguments.real_number("m2", m2, above=0)
    for name, value in {"c1": c1, "c2": c2, "k1": k1, "k2": k2}.items():
        arguments.real_number(name, value, minimum=0)
    arguments.real_number("theta", theta)
    parameters = {
        name: real(value)
        for name, value in {"m1": m1, "m2": m2, "c1": c1, "c2": c2, "k1": k1, "k2": k2, "theta": theta}.items()
    }
    m1, m2, c1, c2, k1, k2, theta = parameters.values()
    sin, cos = jnp.sin(theta), jnp.cos(theta)
    zero, one = jnp.zeros_like(sin), jnp.ones_like(sin)
    horizontal = jnp.stack([cos, zero, -sin])  # of both masses
    height_1 = jnp.stack([zero, one, zero])  # of mass 1
    height_2 = jnp.stack([sin, zero, cos])  # of mass 2

    def quadratic_form(weights_and_rows):
        return sum(weight * jnp.outer(row, row) for weight, row in weights_and_rows)

    return Structure(
        mass=quadratic_form([(m1 + m2, horizontal), (m1, height_1), (m2, height_2)]),
        damping=quadratic_form([(c1, horizontal), (c2, height_1 - height_2)]),
        stiffness=quadratic_form([(k1, horizontal), (k2, height_1 - height_2)]),
        load_direction=-height_1,
        tangential=0,
        normal=2,
        parameters=parameters,
        builder=belt_oscillator,
        dampers=("c1", "c2"),
    )


def _check_matrix(name: str, matrix, *, definite: bool) -> None:
    if not is_known(matrix):
        return
    array = arguments.numeric_array(name, matrix).astype(np.float64)
    if array.ndim != 2 or array.shape[0] != array.shape[1]:
        raise ValueError(f"Argument `{name}` must be a square matrix, but has shape {array.shape}.")
    if array.shape[0] < 2:
        raise ValueError(
            f"Argument `{name}` must have at least two rows (a tangential and a normal coordinate), but has "
            f"{array.shape[0]}."
        )
    if not np.all(np.isfinite(array)):
        raise ValueError(f"Argument `{name}` must be finite, but holds {array[~np.isfinite(array)][0]}.")
    # Rounding in sums of a few products; a matrix entered by hand is either symmetric or wrong by far more.
    asymmetry = np.abs(array - array.T)
    if np.any(asymmetry > 1e-9 * np.abs(array).max()):
        i, j = np.unravel_index(np.argmax(asymmetry), array.shape)
        raise ValueError(
            f"Argument `{name}` must be symmetric, but entry ({i}, {j}) is {array[i, j]:g} and entry ({j}, {i}) is "
            f"{array[j, i]:g}. Friction does not belong here: give the symmetric matrix of the free structure."
        )
    # Judged after scaling the diagonal to one, so that masses of very different size do not look indefinite.
    diagonal = np.diag(array)
    scale = 1.0 / np.sqrt(np.where(diagonal > 0, diagonal, 1.0))
    # One side after the other: of the smallest numbers there are, the product of two such scales is infinite.
    lowest = np.linalg.eigvalsh(array * scale * scale[:, None])[0]
    if definite and lowest <= 0:
        raise ValueError(
            f"Argument `{name}` must be positive definite, but its smallest eigenvalue (diagonal scaled to one) is "
            f"{lowest:.3g}. Every coordinate needs a positive mass."
        )
    if lowest < -1e-9:
        raise ValueError(
            f"Argument `{name}` must be positive semi-definite, but its smallest eigenvalue (diagonal scaled to one) "
            f"is {lowest:.3g}. Negative springs or dampers are not modelled."
        )


def _check_shapes(n: int, **matrices) -> None:
    for name, matrix in matrices.items():
        if matrix.shape != (n, n):
            raise ValueError(
                f"Argument `{name}` must have shape ({n}, {n}) to go with the mass matrix, but has shape {matrix.shape}."
            )


def _checked_index(name: str, index, n: int) -> int:
    if isinstance(index, bool) or not isinstance(index, int | np.integer):
        raise TypeError(f"Argument `{name}` must be the index of a coordinate, but is {arguments.describe(index)}.")
    if not 0 <= index < n:
        raise ValueError(f"Argument `{name}` must be between 0 and {n - 1}, but is {index}.")
    return int(index)
