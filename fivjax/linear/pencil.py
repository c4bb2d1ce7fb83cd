r"""Quadratic pencils $λ^2 M + λ C + K$ of any real matrices, and those of sliding structures with any number of contacts."""

import dataclasses
from typing import TYPE_CHECKING

import numpy as np

from ..foundation import arguments
from ..model.sparse_structure import SparseStructure
from ..model.structure import Structure

if TYPE_CHECKING:
    from scipy import sparse


@dataclasses.dataclass(frozen=True, repr=False, init=False)
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
    right, left, friction_part = _bases(system)
    friction = signed_friction(system, mu, direction)
    left = left - friction_part(friction)
    return Pencil(*(left.T @ (matrix @ right) for matrix in _sparse_matrices(system)))


def friction_derivative(system: Structure | SparseStructure, mu, *, direction=1) -> Pencil:
    """The derivative of the sliding pencil by a friction coefficient that all contacts share."""
    right, _, friction_part = _bases(system)
    change = friction_part(signed_friction(system, np.ones_like(np.asarray(mu, float)), direction))
    return Pencil(*(-change.T @ (matrix @ right) for matrix in _sparse_matrices(system)))


def sliding_motions(system: Structure | SparseStructure) -> "sparse.csc_array":
    """Z: displacements of the structure for each coordinate of the sliding pencil."""
    return _bases(system)[0]


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


def _bases(system: Structure | SparseStructure):
    """Z, Y without friction, and the part that friction takes from Y, as a function of σμ."""
    from scipy import sparse
    from scipy.linalg import null_space

    normal, tangential = system.normal_directions, system.tangential_directions
    if not normal.shape[1]:
        raise ValueError("The structure has no contacts. Give `contacts` to `read_structure`, or use `cea.Pencil`.")
    # Only coordinates in which a normal direction has an entry are replaced; all others stay, so the matrices stay sparse.
    touched = np.flatnonzero(np.any(normal != 0, axis=1))
    others = np.setdiff1d(np.arange(system.size), touched)
    kernel = null_space(normal[touched].T)
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
    dual = sparse.csc_array(np.linalg.pinv(normal).T)  # Wₙᵀ dual = 1, and Zᵀ dual = 0
    against = sparse.csc_array(tangential.T) @ right
    mixed = tangential.T @ dual.toarray()

    def friction_part(friction: np.ndarray) -> sparse.csc_array:
        # B' Y = 0 with Y = Z - dual A: (1 + diag(σμ) Wₜᵀ dual) A = diag(σμ) Wₜᵀ Z.
        inner = np.linalg.solve(np.eye(len(friction)) + friction[:, None] * mixed, np.diag(friction))
        return (dual @ sparse.csc_array(inner) @ against).tocsc()

    return right, right, friction_part
