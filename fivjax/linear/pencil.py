r"""Quadratic pencils $λ^2 M + λ C + K$ of any real matrices, and those of sliding structures with any number of contacts."""

import dataclasses
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from ..foundation import arguments
from ..model.sparse_structure import SparseStructure
from ..model.structure import Structure

if TYPE_CHECKING:
    from scipy import sparse


@dataclasses.dataclass(frozen=True, repr=False, init=False, eq=False)
class Pencil:
    r"""Small motions $M \ddot q + C \dot q + K q = 0$ whose matrices need not be symmetric.

    For systems that are no `Structure`: gyroscopic terms in C, circulatory ones in K, friction terms of a finite-element code.

        pencil = fj.cea.Pencil(mass, damping, stiffness)
        modes = fj.cea.complex_modes(pencil, up_to=3000.0)

    **Arguments:** `mass`, `damping`, `stiffness`: real `(n, n)` matrices in kg, N·s/m and N/m, dense or sparse.

    **Raises:** `ValueError` for matrices that are not square, of one size, real and finite.
    """

    mass: "sparse.csc_array"
    damping: "sparse.csc_array"
    stiffness: "sparse.csc_array"

    def __init__(self, mass, damping, stiffness):
        from scipy import sparse

        given = {"mass": mass, "damping": damping, "stiffness": stiffness}
        for name, matrix in given.items():
            if not sparse.issparse(matrix):
                matrix = arguments.numeric_array(name, matrix)
            shape = np.shape(matrix)
            if len(shape) != 2 or shape[0] != shape[1] or shape != np.shape(mass):
                raise ValueError(
                    f"Argument `{name}` must be a square matrix of the size of the mass matrix, but has shape {shape}."
                )
            if np.issubdtype(matrix.dtype, np.complexfloating):
                raise ValueError(f"Argument `{name}` must be real. Give structural damping as viscous damping.")
            found = sparse.csc_array(matrix, dtype=np.float64)
            if not np.all(np.isfinite(found.data)):
                raise ValueError(
                    f"Argument `{name}` must be finite, but holds {found.data[~np.isfinite(found.data)][0]}."
                )
            object.__setattr__(self, name, found)

    @property
    def size(self) -> int:
        """Number of coordinates; there are twice as many eigenvalues."""
        return self.mass.indptr.size - 1

    def at(self, value: complex) -> "sparse.csc_array":
        """λ²M + λC + K at this λ."""
        return (value**2 * self.mass + value * self.damping + self.stiffness).tocsc()

    def slope(self, value: complex) -> "sparse.csc_array":
        """The derivative by λ, 2λM + C."""
        return (2 * value * self.mass + self.damping).tocsc()

    def projected(self, right: np.ndarray, left: np.ndarray | None = None) -> "Pencil":
        """The pencil of motions q = right @ z, projected onto the columns of `left` (of `right` unless given)."""
        left = right if left is None else left
        return Pencil(*(left.T @ (matrix @ right) for matrix in (self.mass, self.damping, self.stiffness)))

    def __repr__(self) -> str:
        return f"Pencil with {self.size} coordinates"


def sliding_pencil(system: Structure | SparseStructure, mu, *, direction=1) -> Pencil:
    r"""The pencil of steady sliding with all contacts closed and slipping, under constant friction.

    With $N$ and $T = σμN$ of all contacts, $M \ddot q + C \dot q + K q = B N$, $B = W_n + W_t \,\mathrm{diag}(σμ)$, and
    $W_n^T q = 0$. Motions are $q = Z x$ with $W_n^T Z = 0$, and the equations are projected onto $Y$ with $B^T Y = 0$, so that
    the contact forces vanish: $Y^T (λ^2 M + λ C + K) Z$. For one contact that is Eq. 3 of the paper.

    **Arguments:** `mu` and `direction` (+1 for a belt that moves along the tangential direction, -1 against it): one number,
    or one for each contact.

    **Raises:** `ValueError` for negative or infinite friction, or a number of values that is neither one nor that of the
    contacts.
    """
    bases = _Bases.of(system)
    left = bases.left(signed_friction(system, mu, direction))
    return Pencil(*(left.T @ (matrix @ bases.right) for matrix in _sparse_matrices(system)))


def friction_derivative(system: Structure | SparseStructure, mu, *, direction=1) -> Pencil:
    """The derivative of the sliding pencil at `mu`, by what is added to the friction coefficients of all contacts."""
    bases = _Bases.of(system)
    signs = signed_friction(system, np.ones_like(arguments.numeric_array("mu", mu)), direction)
    slope = bases.left_slope(signed_friction(system, mu, direction), signs)
    return Pencil(*(slope.T @ (matrix @ bases.right) for matrix in _sparse_matrices(system)))


def sliding_motions(system: Structure | SparseStructure) -> "sparse.csc_array":
    """Z: displacements of the structure for each coordinate of the sliding pencil."""
    return _Bases.of(system).right


def signed_friction(system: Structure | SparseStructure, mu, direction) -> np.ndarray:
    """σμ of each contact."""
    count = system.normal_directions.shape[1]
    values = {}
    for name, value in {"mu": mu, "direction": direction}.items():
        array = arguments.numeric_array(name, value).astype(np.float64)
        if array.shape not in ((), (count,)):
            raise ValueError(
                f"Argument `{name}` must be one number or hold one for each of the {count} contacts, but has shape "
                f"{array.shape}."
            )
        values[name] = np.broadcast_to(array, (count,))
    if not np.all(np.isfinite(values["mu"]) & (values["mu"] >= 0)):
        raise ValueError(f"Argument `mu` must be non-negative and finite, but is {mu}.")
    if not np.all(np.abs(values["direction"]) == 1):
        raise ValueError(f"Argument `direction` must be 1 or -1, but is {direction}.")
    return values["mu"] * values["direction"]


def _sparse_matrices(system):
    from scipy import sparse

    if isinstance(system, SparseStructure):
        return [system.mass, system.damping, system.stiffness]
    return [sparse.csr_array(np.asarray(matrix)) for matrix in system.matrices[:3]]


class _Bases(NamedTuple):
    """Z of the sliding motions, and what Y, onto which they are projected, is made of: Y = Z - dual A, A = G Wₜᵀ Z.

    By B' Y = 0, G = (1 + diag(σμ) Wₜᵀ dual)⁻¹ diag(σμ).
    """

    right: "sparse.csc_array"  # Z
    dual: "sparse.csc_array"  # Wₙᵀ dual = 1
    against: "sparse.csc_array"  # Wₜᵀ Z
    mixed: np.ndarray  # Wₜᵀ dual: not zero where a tangential direction is not at right angles to the normal ones

    @classmethod
    def of(cls, system: Structure | SparseStructure) -> "_Bases":
        from scipy import sparse
        from scipy.linalg import null_space

        arguments.instance(
            "system", system, Structure | SparseStructure, "a Structure, or what `read_structure` returns"
        )
        arguments.known("system", system)
        normal, tangential = system.normal_directions, system.tangential_directions
        if not normal.shape[1]:
            raise ValueError("The structure has no contacts. Give `contacts` to `read_structure`, or use `cea.Pencil`.")
        # Only coordinates in which a normal direction has an entry are replaced; all others stay, so the matrices stay sparse.
        touched = np.flatnonzero(np.any(normal != 0, axis=1))
        others = np.setdiff1d(np.arange(system.size), touched)
        # In units in which all masses are one: coordinates may be metres and micrometres.
        mass = _sparse_matrices(system)[0].diagonal()[touched]
        size = 1 / np.sqrt(np.where(mass > 0, mass, mass.max(initial=0.0) or 1.0))[:, None]
        kernel = size * null_space((size * normal[touched]).T)
        if kernel.shape[1] != len(touched) - normal.shape[1]:
            raise ValueError(
                "The normal directions of the contacts must be linearly independent, but some follow from others."
            )
        inner = sparse.coo_array(kernel)
        right = sparse.csc_array(
            (
                np.append(inner.data, np.ones(len(others))),
                (
                    np.append(touched[inner.row], others),
                    np.append(inner.col, kernel.shape[1] + np.arange(len(others))),
                ),
            ),
            shape=(system.size, kernel.shape[1] + len(others)),
        )
        dual = np.zeros(normal.shape)
        dual[touched] = size * np.linalg.pinv(size * normal[touched]).T
        against = sparse.csc_array(sparse.csc_array(tangential.T) @ right)
        return cls(right, sparse.csc_array(dual), against, tangential.T @ dual)

    def left(self, friction: np.ndarray) -> "sparse.csc_array":
        """Y at these σμ of the contacts."""
        return (self.right - self._of_contacts(self._shares(friction, friction))).tocsc()

    def left_slope(self, friction: np.ndarray, change: np.ndarray) -> "sparse.csc_array":
        """The change of Y with σμ: that of G is (1 + diag(σμ) Wₜᵀ dual)⁻¹ diag(change) (1 - Wₜᵀ dual G)."""
        seen = np.eye(len(friction)) - self.mixed @ self._shares(friction, friction)
        return -self._of_contacts(self._shares(friction, change) @ seen)

    def _shares(self, friction: np.ndarray, factors: np.ndarray) -> np.ndarray:
        return np.linalg.solve(np.eye(len(friction)) + friction[:, None] * self.mixed, np.diag(factors))

    def _of_contacts(self, shares: np.ndarray) -> "sparse.csc_array":
        from scipy import sparse

        return (self.dual @ sparse.csc_array(shares) @ self.against).tocsc()
