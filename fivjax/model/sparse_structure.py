"""A structure as a finite-element code knows it: large sparse matrices, with nodes and directions for coordinates."""

import dataclasses
from typing import TYPE_CHECKING, Any

import numpy as np

from .structure_checks import StructureChecks

if TYPE_CHECKING:
    from scipy import sparse

# The numbers of the directions that have letters.
AXES = {"x": 1, "y": 2, "z": 3}


@dataclasses.dataclass(frozen=True, repr=False, eq=False)
class SparseStructure:
    r"""A linear structure with frictional contacts and very many degrees of freedom, as `fj.read_structure` gives it.

    $M \ddot q + C \dot q + K q = f F(t) + W_t T + W_n N$, with a column of $W_t$ and $W_n$ for each contact.

    - `mass`, `damping`, `stiffness`: sparse `(n, n)` arrays in kg, N·s/m and N/m (rotations in rad).
    - `load_direction`: `(n,)`, the coordinates' share of a positive load, without unit.
    - `tangential_directions`, `normal_directions`: `(n, contacts)`, $W_t$ and $W_n$: along the belt, and away from it.
    - `labels`: node and direction of each coordinate; None where the files do not say.
    - `checks`: what was found about the matrices; print it.

    `fj.craig_bampton` reduces it for simulations and maps; `fj.cea.complex_modes` takes it as it is.

    **Example:**

        >>> np.savez("model.npz", K=np.diag([2e4, 3e4]), M=np.eye(2))
        >>> contact = fj.NodeContact(1, tangential="x", normal="z")
        >>> names = {"stiffness": "K", "mass": "M"}
        >>> big = fj.read_structure("model.npz", units="SI", names=names, labels=[(1, 1), (1, 3)], contacts=[contact])
        >>> big.size
        2
    """

    mass: "sparse.csr_array"
    damping: "sparse.csr_array"
    stiffness: "sparse.csr_array"
    load_direction: np.ndarray
    tangential_directions: np.ndarray
    normal_directions: np.ndarray
    labels: tuple[Any, ...] | None
    checks: StructureChecks

    @property
    def size(self) -> int:
        """Number of degrees of freedom."""
        return self.mass.indptr.size - 1

    @property
    def coordinates(self) -> tuple[str, ...]:
        """Names of the coordinates: node and direction, "17:3", or "q0", "q1", …"""
        if self.labels is None:
            return tuple(f"q{i}" for i in range(self.size))
        return tuple(f"{node}:{direction}" for node, direction in self.labels)

    def __repr__(self) -> str:
        count = self.normal_directions.shape[1]
        contacts = f"{count} contact" + ("" if count == 1 else "s")
        head = f"SparseStructure with {self.size} degrees of freedom and {contacts}"
        return "\n".join([head, *(f"  {line}" for line in self.checks.sentences)])
