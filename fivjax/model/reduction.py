r"""Craig–Bampton reduction: a structure of many thousand degrees of freedom, described by its contacts and a few modes.

The displacements are written as $q = T z$. The columns of $T$ are the static shape for a unit displacement of each coordinate
at a contact while the others are held, the modes up to a frequency with all of these coordinates held, and the static response
to the load (Craig and Bampton, AIAA Journal 6, 1968). Static displacements are exact; the error of frequencies is reported.
"""

import dataclasses
from collections.abc import Sequence

import numpy as np

from ..foundation import arguments
from .contact_coordinates import transformation
from .contact_point import ContactPoint
from .sparse_structure import AXES, SparseStructure
from .structure import Structure
from .structure_checks import lowest_modes


@dataclasses.dataclass(frozen=True, repr=False, eq=False)
class Reduction:
    """A reduced structure, the way back to the full one, and how well its frequencies are kept.

    - `structure`: the reduced `fj.Structure`; its contacts are at coordinates of their own.
    - `basis`: `(n, m)`, displacements of the full structure for each reduced coordinate: `q = basis @ z`.
    - `frequencies`: of the full structure, without contact and damping, up to the frequency asked for, in Hz.
    - `reduced_frequencies`: the same frequencies of the reduced structure, in Hz.

    **Example:** see `fj.craig_bampton`.
    """

    structure: Structure
    basis: np.ndarray
    frequencies: np.ndarray
    reduced_frequencies: np.ndarray

    @property
    def errors(self) -> np.ndarray:
        """How much higher each kept frequency is, relative to the full structure's; 0 for rigid-body modes."""
        rigid = self.frequencies <= 1e-3 * np.max(self.frequencies, initial=0.0)
        return np.where(rigid, 0.0, self.reduced_frequencies / np.where(rigid, 1.0, self.frequencies) - 1.0)

    def __repr__(self) -> str:
        n, m = self.basis.shape
        lines = [f"Reduction from {n} to {m} coordinates; {self.frequencies.size} frequencies kept:"]
        rows = zip(self.frequencies, self.reduced_frequencies, self.errors, strict=True)
        lines += [f"  {full:12.6g} Hz   reduced {less:12.6g} Hz   {error:9.1e}" for full, less, error in rows]
        return "\n".join(lines)


def craig_bampton(
    structure: SparseStructure,
    up_to: float,
    *,
    keep: Sequence[tuple[int, int | str] | int] = (),
    damping_ratio: float = 0.0,
) -> Reduction:
    """A structure reduced onto its contacts, its load and its modes up to a frequency.

        reduction = fj.craig_bampton(big, up_to=6000.0)
        print(reduction)
        scene = fj.Scene(reduction.structure, fj.Coulomb(0.4), belt_speed=2.0)

    Twice the highest frequency of interest is a common choice for `up_to`. The frequencies of the full structure are computed,
    too, and compared.

    **Arguments:**

    - `structure`: as `fj.read_structure` gives it, with at least one contact.
    - `up_to`: the frequency in Hz up to which modes with held contacts are kept.
    - `keep`: further coordinates to keep, by node and direction, such as (7, "z") (or by index where there are no labels).
    - `damping_ratio`: damping to add, the same share of critical damping in each mode of the reduced structure without contact.

    **Returns:** a `Reduction`.

    **Raises:** `ValueError` for a structure that has no contacts, is not symmetric or not definite, or has a part that moves
    freely although the contacts are held.

    **Example:**

        >>> np.savez("model.npz", K=np.diag([2e4, 3e4, 5e4]), M=np.eye(3))
        >>> contact = fj.NodeContact(1, tangential="x", normal="z")
        >>> names = {"stiffness": "K", "mass": "M"}
        >>> labels = [(1, 1), (1, 3), (2, 1)]
        >>> big = fj.read_structure(
        ...     "model.npz", units="SI", names=names, labels=labels, contacts=[contact], load={(1, "z"): -1.0}
        ... )
        >>> reduction = fj.craig_bampton(big, up_to=100.0)
    """
    from scipy.sparse.linalg import splu

    arguments.instance("structure", structure, SparseStructure, "a SparseStructure, as fj.read_structure gives it")
    arguments.real_number("up_to", up_to, above=0)
    arguments.real_number("damping_ratio", damping_ratio, minimum=0)
    if not structure.normal_directions.shape[1]:
        raise ValueError("The structure has no contacts to reduce it onto. Give `contacts` to `read_structure`.")
    if not structure.checks.symmetric:
        worst = max(structure.checks.asymmetry, key=lambda name: structure.checks.asymmetry[name])
        raise ValueError(
            f"The {worst} matrix is not symmetric, and a structure in contact must be. Give the matrices without friction "
            f"or gyroscopic terms; `fj.cea.Pencil` takes the others."
        )
    for name, count in structure.checks.unexplained.items():
        if count > 0:
            raise ValueError(
                f"The {name} matrix has negative eigenvalues ({count}), and a structure in contact must have none. Look at the "
                f"signs and units in the {name} matrix; negative springs are not modelled."
            )
    if not arguments.is_listed(keep):
        raise TypeError(
            f"Argument `keep` must be a list of coordinates, such as `[(7, 'z')]`, but is {arguments.describe(keep)}."
        )
    directions = np.hstack([structure.tangential_directions, structure.normal_directions])
    kept = np.any(directions != 0, axis=1)
    kept[[_index(structure, place) for place in keep]] = True
    inner, outer = np.flatnonzero(~kept), np.flatnonzero(kept)
    stiffness, mass = structure.stiffness, structure.mass
    held = stiffness[inner][:, inner].tocsc()
    columns = [np.eye(structure.size)[:, outer]]
    squares = np.zeros(0)
    # A static shape of which the modes leave less than this share would add only rounding.
    new_shape = 1e-6
    if inner.size:
        try:
            squares, modes = _modes_up_to(held, mass[inner][:, inner], up_to)
            factors = splu(held)
        except (RuntimeError, np.linalg.LinAlgError):
            factors = None
        if factors is None or np.any(squares < 1e-9 * np.max(squares, initial=0.0)):
            tied = ", or a Lagrange multiplier ties nothing but them" if structure.checks.multipliers else ""
            raise ValueError(
                f"With its contacts held, the structure still has a part that moves freely{tied}, so that static shapes do not "
                f"exist. Hold it in the finite-element model, or name nodes of that part with `keep`."
            )
        columns[0][inner] = -factors.solve(stiffness[inner][:, outer].toarray())
        shape = factors.solve(structure.load_direction[inner])
        if np.any(shape):
            # The part of it that the modes do not represent (they are orthonormal in the mass matrix).
            # pyrefly: ignore[unbound-name]
            rest = shape - modes @ (modes.T @ (mass[inner][:, inner] @ shape))
            if rest @ held @ rest > new_shape**2 * (shape @ held @ shape):
                norm = np.sqrt(rest @ mass[inner][:, inner] @ rest)
                modes = np.column_stack([modes, rest / norm])
        # pyrefly: ignore[unbound-name]
        columns.append(np.zeros((structure.size, modes.shape[1])))
        columns[1][inner] = modes
    basis = np.hstack(columns)
    reduced, basis = _structure(structure, basis, outer, len(squares))
    return _compare(structure, _with_modal_damping(reduced, damping_ratio), basis, up_to)


def _modes_up_to(stiffness, mass, frequency: float) -> tuple[np.ndarray, np.ndarray]:
    # Modes are computed in growing numbers, until one lies above the frequency; first so many.
    first_lot = 20
    limit, count = (2 * np.pi * frequency) ** 2, first_lot
    while True:
        squares, modes = lowest_modes(stiffness, mass, count)
        if squares.size < count or squares[-1] > limit:
            return squares[squares <= limit], modes[:, squares <= limit]
        count *= 2


def _structure(full: SparseStructure, basis: np.ndarray, outer: np.ndarray, modes: int) -> tuple[Structure, np.ndarray]:
    names = [full.coordinates[place] for place in outer]
    names += [f"mode {number + 1}" for number in range(modes)]
    names += ["load"] * (basis.shape[1] - len(names))

    def project(basis: np.ndarray, contacts: list[ContactPoint]) -> Structure:
        turned = [basis.T @ (matrix @ basis) for matrix in (full.mass, full.damping, full.stiffness)]
        mass, damping, stiffness = (0.5 * (matrix + matrix.T) for matrix in turned)
        load = basis.T @ full.load_direction
        return Structure(mass, damping, stiffness, load, contacts=contacts, coordinates=names)

    count = full.normal_directions.shape[1]
    tangential, normal = basis.T @ full.tangential_directions, basis.T @ full.normal_directions
    raw = project(basis, [ContactPoint(tangential[:, i], normal[:, i]) for i in range(count)])
    # Contacts get coordinates of their own, because other functions need them there.
    turn, places = transformation(raw)
    basis = basis @ turn
    for i in range(count):
        suffix = f" {i}" if count > 1 else ""
        names[places[i]], names[places[count + i]] = f"tangential{suffix}", f"normal{suffix}"
    contacts = [ContactPoint(places[i], places[count + i]) for i in range(count)]
    return project(basis, contacts), basis


def _with_modal_damping(structure: Structure, ratio: float) -> Structure:
    if ratio == 0:
        return structure
    from scipy.linalg import eigh

    mass, damping, stiffness = (np.asarray(matrix) for matrix in structure.matrices[:3])
    squares, modes = eigh(stiffness, mass)
    shapes = mass @ modes
    added = (shapes * (2 * ratio * np.sqrt(np.maximum(squares, 0.0)))) @ shapes.T
    return Structure(
        mass,
        damping + 0.5 * (added + added.T),
        stiffness,
        structure.load_direction,
        contacts=structure.contacts,
        coordinates=structure.coordinates,
    )


def _compare(full: SparseStructure, reduced: Structure, basis: np.ndarray, up_to: float) -> Reduction:
    from scipy.linalg import eigh

    squares, _ = _modes_up_to(full.stiffness, full.mass, up_to)
    less = eigh(np.asarray(reduced.stiffness), np.asarray(reduced.mass), eigvals_only=True)[: len(squares)]
    squares = squares[: len(less)]
    return Reduction(
        structure=reduced,
        basis=basis,
        frequencies=np.sqrt(np.maximum(squares, 0.0)) / (2 * np.pi),
        reduced_frequencies=np.sqrt(np.maximum(less, 0.0)) / (2 * np.pi),
    )


def _index(structure: SparseStructure, place) -> int:
    if arguments.is_whole(place):
        if not 0 <= place < structure.size:
            raise ValueError(f"Argument `keep` must hold indices below {structure.size}, but holds {place}.")
        return int(place)
    if structure.labels is not None and arguments.is_listed(place) and len(place) == 2:
        node, direction = place
        label = node, AXES.get(direction, direction) if isinstance(direction, str) else direction
        if label in structure.labels:
            return structure.labels.index(label)
    raise ValueError(
        f"Argument `keep` must hold coordinates of the structure by node and direction, but holds {place!r}."
    )
