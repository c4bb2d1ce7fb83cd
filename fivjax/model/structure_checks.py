"""What can be checked of matrices that came from somewhere else: symmetry, definiteness, rigid-body modes, mass."""

import contextlib
import dataclasses
import warnings
from collections.abc import Sequence

import numpy as np

from ..foundation.digits import counted

# Rounding in a file that prints some ten digits; an error is larger by far.
ROUNDING = 1e-6
# Eigenvalues below this share of the largest of the lowest ones computed are rigid-body modes.
RIGID = 1e-6
# Up to this size matrices are dense.
DENSE = 400


@dataclasses.dataclass(frozen=True)
class StructureChecks:
    """What was found about a structure's matrices; `print` it for sentences.

    - `asymmetry`: by matrix, the largest difference across the diagonal over the largest entry.
    - `negative_masses`, `negative_springs`: how many eigenvalues of the mass and of the stiffness matrix are negative; None
      where this could not be found, because the matrix is not symmetric.
    - `massless`: how many degrees of freedom have no mass.
    - `multipliers`: the rows of Lagrange multipliers, by name: without mass, and without positive stiffness on the diagonal.
      Each makes one eigenvalue of the stiffness matrix negative.
    - `internal`: the rows of internal nodes, by name; files give them negative numbers.
    - `loose`: the rows, by name, in which neither mass nor stiffness has an entry.
    - `rigid_body_modes`, `lowest_frequencies` (Hz): of the structure without damping and contact; None as above, and where the
      stiffness is singular whatever mass is added.
    - `total_mass`: in kg along x, y and z; None where no labels say which rows belong to which direction.
    - `fixed`: how many degrees of freedom the file marks as held, which were left out.
    - `remarks`: what else is worth a look, one sentence each.
    """

    asymmetry: dict[str, float]
    negative_masses: int | None
    negative_springs: int | None
    massless: int
    rigid_body_modes: int | None
    lowest_frequencies: tuple[float, ...] | None
    total_mass: tuple[float, float, float] | None
    fixed: int = 0
    remarks: tuple[str, ...] = ()
    multipliers: tuple[str, ...] = ()
    internal: tuple[str, ...] = ()
    loose: tuple[str, ...] = ()

    @property
    def symmetric(self) -> bool:
        """Whether all matrices are symmetric, up to what a printed file rounds."""
        return all(value <= ROUNDING for value in self.asymmetry.values())

    @property
    def definite(self) -> bool:
        """Whether no eigenvalue of the mass or stiffness matrix is negative, and every degree of freedom has mass."""
        return self.negative_masses == 0 and self.negative_springs == 0 and self.massless == 0

    @property
    def unexplained(self) -> dict[str, int]:
        """How many eigenvalues of mass and stiffness are negative, by matrix, beside those that Lagrange multipliers make."""
        springs = (self.negative_springs or 0) - len(self.multipliers)
        return {"mass": self.negative_masses or 0, "stiffness": springs}

    def __repr__(self) -> str:
        return "\n".join(self.sentences)

    @property
    def sentences(self) -> list[str]:
        """The findings, one sentence each."""
        found = []
        for name, value in self.asymmetry.items():
            if value > ROUNDING:
                found.append(f"The {name} matrix is not symmetric: entries differ by {value:.2g} of the largest one.")
        found = found or ["The matrices are symmetric."]
        for name, count in self.unexplained.items():
            if count > 0:
                beside = ", beside one for each Lagrange multiplier" if name == "stiffness" and self.multipliers else ""
                found.append(f"The {name} matrix has {counted(count, 'negative eigenvalue')}{beside}.")
        if self.negative_masses == 0 and self.negative_springs == 0:
            found.append("Mass and stiffness have no negative eigenvalues.")
        found += self._about_rows
        massless = self.massless - len(self.multipliers) - len(self.loose)
        if massless > 0:
            found.append(f"{counted(massless, 'degree of freedom', 'degrees of freedom')} without mass.".capitalize())
        if self.lowest_frequencies is not None:
            elastic = [f for f in self.lowest_frequencies if f > np.sqrt(RIGID) * max(self.lowest_frequencies)]
            first = f"; the first elastic one is at {elastic[0]:.6g} Hz" if elastic else ""
            found.append(f"{counted(self.rigid_body_modes or 0, 'rigid-body mode')}{first}.")
        elif self.symmetric:
            why = "rows without entries" if self.loose else "constraints that follow from others, perhaps"
            found.append(f"Rigid-body modes and frequencies are not known: the stiffness is singular ({why}).")
        if self.total_mass is None:
            found.append("The total mass is not known: nothing says which rows are translations along which direction.")
        else:
            along = ", ".join(f"{mass:.6g} kg along {axis}" for mass, axis in zip(self.total_mass, "xyz", strict=True))
            found.append(f"Total mass: {along}.")
        if self.fixed:
            found.append(f"{counted(self.fixed, 'held degree of freedom', 'held degrees of freedom')} left out.")
        return [*found, *self.remarks]

    @property
    def _about_rows(self) -> list[str]:
        found = []
        if self.internal:
            rows = counted(len(self.internal), "row")
            found.append(
                f"{rows} of internal nodes, which have negative numbers ({_listing(self.internal)}): "
                f"unknowns that elements or constraints have of their own."
            )
        if self.multipliers:
            found.append(
                f"{counted(len(self.multipliers), 'Lagrange multiplier')} without mass and stiffness "
                f"({_listing(self.multipliers)}). Each holds a constraint, such as a tie or a contact, and makes one "
                f"eigenvalue of the stiffness negative, which is no instability. `fj.craig_bampton` and `fj.cea.complex_modes` "
                f"keep the constraints. For matrices without multipliers, export the model with penalty stiffness in their "
                f"place, or a substructure that retains the contact nodes."
            )
        if self.loose:
            found.append(
                f"{counted(len(self.loose), 'row')} with neither mass nor stiffness ({_listing(self.loose)}). Hold such "
                f"degrees of freedom in the finite-element model, or leave them out."
            )
        return found


def _listing(rows: tuple[str, ...]) -> str:
    # How many rows a sentence names.
    named = 5
    more = f" and {len(rows) - named} more" if len(rows) > named else ""
    return "; ".join(rows[:named]) + more


def check_matrices(
    mass, damping, stiffness, directions, *, numbers: Sequence[int] | None = None, fixed: int = 0, remarks=()
) -> StructureChecks:
    """The checks of sparse matrices.

    `directions`: one for each row, 1 to 3 for translations along x, y, z; or None. `numbers`: of the rows' nodes, or of the
    rows where directions are not known; negative for internal ones.
    """
    matrices = {"mass": mass, "damping": damping, "stiffness": stiffness}
    asymmetry = {name: _asymmetry(matrix) for name, matrix in matrices.items()}
    massless, empty = (abs(matrix).sum(axis=1) == 0 for matrix in (mass, stiffness))
    loose = massless & empty
    multipliers = massless & ~empty & (stiffness.diagonal() <= 0)
    both = max(asymmetry["mass"], asymmetry["stiffness"]) <= ROUNDING
    frequencies = rigid = None
    # How many of the lowest modes are computed: six rigid-body modes and a few elastic ones.
    lowest = 10
    if both and not np.any(loose):
        with contextlib.suppress(np.linalg.LinAlgError):
            values, _ = lowest_modes(stiffness, mass, lowest)
            rigid = int(np.sum(np.abs(values) <= RIGID * np.abs(values).max(initial=0.0)))
            frequencies = tuple(float(f) for f in np.sqrt(np.maximum(values, 0.0)) / (2 * np.pi))
    total = None
    if directions is not None:
        along = [(np.asarray(directions) == axis).astype(float) for axis in (1, 2, 3)]
        total = tuple(float(ones @ (mass @ ones)) for ones in along)
    own = np.arange(1, len(massless) + 1) if numbers is None else np.asarray(numbers)

    def names_of(which) -> tuple[str, ...]:
        kinds = np.full(len(own), -1) if directions is None else np.asarray(directions)
        words = {-1: "row {}", 0: "point {}"}
        return tuple(
            words.get(int(kinds[k]), f"node {{}}, direction {kinds[k]}").format(own[k]) for k in np.flatnonzero(which)
        )

    return StructureChecks(
        asymmetry=asymmetry,
        negative_masses=negative_eigenvalues(mass) if asymmetry["mass"] <= ROUNDING else None,
        negative_springs=negative_eigenvalues(stiffness, multipliers) if asymmetry["stiffness"] <= ROUNDING else None,
        massless=int(np.sum(massless)),
        rigid_body_modes=rigid,
        lowest_frequencies=frequencies,
        total_mass=total,
        fixed=fixed,
        remarks=tuple(remarks),
        multipliers=names_of(multipliers),
        internal=names_of(own < 0),
        loose=names_of(loose),
    )


def _asymmetry(matrix) -> float:
    largest = abs(matrix).max() if matrix.nnz else 0.0
    return float(abs(matrix - matrix.T).max() / largest) if largest else 0.0


def negative_eigenvalues(matrix, multipliers=None) -> int | None:
    """How many eigenvalues of a symmetric sparse matrix are negative beyond rounding; None where this cannot be found.

    By Sylvester's law of inertia there are as many as negative pivots in a symmetric elimination. `multipliers` marks the rows
    of Lagrange multipliers: each makes one, also where its constraint follows from others.
    """
    from scipy import sparse
    from scipy.sparse.linalg import splu

    if matrix.nnz == 0:
        return 0
    # With the diagonal scaled to one, rounding is the same in every row.
    diagonal = np.abs(matrix.diagonal())
    scale = sparse.diags_array(1 / np.sqrt(np.where(diagonal > 0, diagonal, 1.0)))
    # Shifted to the side where each kind of row belongs, it has pivots in any order (Vanderbei, SIAM J. Optim. 5, 1995).
    shift = 1e-9 * np.where(np.zeros(len(diagonal), bool) if multipliers is None else multipliers, -1.0, 1.0)
    shifted = (scale @ matrix @ scale + sparse.diags_array(shift)).tocsc()
    if matrix.shape[0] <= DENSE:
        return int(np.sum(np.linalg.eigvalsh(shifted.toarray()) < 0))
    try:
        # Pivots on the diagonal, in an order that keeps symmetry: then it is L D Lᵀ.
        factors = splu(shifted, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True})
    except RuntimeError:
        return None
    if not np.array_equal(factors.perm_r, factors.perm_c):
        return None
    return int(np.sum(factors.U.diagonal() < 0))


def lowest_modes(stiffness, mass, count: int) -> tuple[np.ndarray, np.ndarray]:
    """The lowest eigenvalues ω² of K v = ω² M v and their mass-normalised modes (columns), sorted.

    Fewer than asked for in small structures. Both matrices are symmetric; K may be indefinite, as Lagrange multipliers make it.

    **Raises:** `LinAlgError` where K + σM is singular for every σ, and where M has negative eigenvalues.
    """
    from scipy.sparse.linalg import eigsh, splu

    n = stiffness.shape[0]
    # Stiffness over mass of each degree of freedom, as a measure of ω².
    with np.errstate(divide="ignore", invalid="ignore"):
        squares = stiffness.diagonal() / mass.diagonal()
    squares = squares[np.isfinite(squares) & (squares > 0)]
    if not squares.size:
        return np.zeros(0), np.zeros((n, 0))
    # A shift keeps K + σM definite where rigid-body modes make K singular.
    small = 1e-3 * squares.min()
    if n <= DENSE or count >= n:
        return _of_dense(stiffness.toarray(), mass.toarray(), small, count)
    start = np.random.default_rng(0).standard_normal(n)
    try:
        values, modes = eigsh(stiffness.tocsc(), min(count, n - 1), mass.tocsc(), sigma=-small, which="LM", v0=start)
    except RuntimeError as error:
        raise np.linalg.LinAlgError(str(error)) from None
    order = np.argsort(values)
    values, modes = values[order], modes[:, order]
    if np.any(mass.diagonal() == 0):
        # A component without mass has no part in the iteration's scalar product; one step more makes it follow the others.
        modes = splu((stiffness + small * mass).tocsc()).solve(mass @ modes) * (values + small)
    return values, modes


def _of_dense(stiffness: np.ndarray, mass: np.ndarray, small: float, count: int) -> tuple[np.ndarray, np.ndarray]:
    from scipy.linalg import eigh

    # ν = 1/(ω² + σ) is finite where mass is not: massless degrees of freedom have ν = 0.
    shifted = stiffness + small * mass
    try:
        values, modes = eigh(mass, shifted)
        real = values > 1e-14 * values.max()
        modes = modes[:, real] / np.sqrt(values[real])
    except np.linalg.LinAlgError:
        values, modes = _of_indefinite(shifted, mass)
        real = np.abs(values) > 1e-12 * np.abs(values).max(initial=0.0)
        modes = modes[:, real]
    squares = 1 / values[real] - small
    order = np.argsort(squares)[:count]
    return squares[order], modes[:, order]


def _of_indefinite(shifted: np.ndarray, mass: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """ν and mass-normalised modes of M v = ν (K + σM) v, from the symmetric Lᵀ(K + σM)⁻¹L with M = L Lᵀ.

    **Raises:** `LinAlgError` where K + σM is singular, or M has negative eigenvalues.
    """
    from scipy.linalg import LinAlgWarning, eigh, solve

    diagonal = np.sqrt(np.maximum(mass.diagonal(), 0.0))
    unit = np.where(diagonal > 0, diagonal, 1.0)
    sizes, turn = eigh(mass / unit / unit[:, None])
    if sizes[0] < -1e-9:
        raise np.linalg.LinAlgError("The mass matrix has a negative eigenvalue.")
    # pyrefly: ignore[unsupported-operation]
    kept = sizes > 1e-12
    root = unit[:, None] * turn[:, kept] * np.sqrt(sizes[kept])
    with warnings.catch_warnings():
        warnings.simplefilter("error", LinAlgWarning)
        try:
            solved = solve(shifted, root, assume_a="sym")
        except LinAlgWarning as warning:
            raise np.linalg.LinAlgError(str(warning)) from None
    values, turn = eigh(0.5 * (root.T @ solved + solved.T @ root))
    with np.errstate(divide="ignore", invalid="ignore"):
        return values, solved @ turn / values  # pyrefly: ignore[bad-return]
