"""What can be checked of matrices that came from somewhere else: symmetry, definiteness, rigid-body modes, mass."""

import dataclasses

import numpy as np

# Rounding in a file that prints some ten digits; an error is larger by far.
ROUNDING = 1e-6
# Eigenvalues below this share of the largest of the lowest ones computed are rigid-body modes.
RIGID = 1e-6
# How many of the lowest modes are computed: six rigid-body modes and a few elastic ones.
LOWEST = 10


@dataclasses.dataclass(frozen=True)
class StructureChecks:
    """What was found about a structure's matrices; `print` it for sentences.

    - `asymmetry`: by matrix, the largest difference across the diagonal over the largest entry.
    - `negative_masses`, `negative_springs`: how many eigenvalues of the mass and of the stiffness matrix are negative; None
      where this could not be found, because the matrix is not symmetric.
    - `massless`: how many degrees of freedom have no mass.
    - `rigid_body_modes`, `lowest_frequencies` (Hz): of the structure without damping and contact; None as above.
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

    @property
    def symmetric(self) -> bool:
        """Whether all matrices are symmetric, up to what a printed file rounds."""
        return all(value <= ROUNDING for value in self.asymmetry.values())

    @property
    def definite(self) -> bool:
        """Whether no eigenvalue of the mass or stiffness matrix is negative, and every degree of freedom has mass."""
        return self.negative_masses == 0 and self.negative_springs == 0 and self.massless == 0

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
        for name, count in {"mass": self.negative_masses, "stiffness": self.negative_springs}.items():
            if count:
                found.append(f"The {name} matrix has {_of(count, 'negative eigenvalue')}.")
        if self.negative_masses == 0 and self.negative_springs == 0:
            found.append("Mass and stiffness have no negative eigenvalues.")
        if self.massless:
            found.append(f"{_of(self.massless, 'degree of freedom', 'degrees of freedom')} without mass.".capitalize())
        if self.lowest_frequencies is not None:
            elastic = self.lowest_frequencies[self.rigid_body_modes or 0 :]
            first = f"; the first elastic one is at {elastic[0]:.6g} Hz" if elastic else ""
            found.append(f"{_of(self.rigid_body_modes or 0, 'rigid-body mode')}{first}.")
        if self.total_mass is None:
            found.append("The total mass is not known: nothing says which rows are translations along which direction.")
        else:
            along = ", ".join(f"{mass:.6g} kg along {axis}" for mass, axis in zip(self.total_mass, "xyz", strict=True))
            found.append(f"Total mass: {along}.")
        if self.fixed:
            found.append(f"{_of(self.fixed, 'held degree of freedom', 'held degrees of freedom')} left out.")
        return [*found, *self.remarks]


def _of(count: int, one: str, many: str = "") -> str:
    return f"{count} {one if count == 1 else many or one + 's'}"


def check_matrices(mass, damping, stiffness, directions, *, fixed: int = 0, remarks=()) -> StructureChecks:
    """The checks of sparse matrices. `directions`: one for each row, 1 to 3 for translations along x, y, z; or None."""
    matrices = {"mass": mass, "damping": damping, "stiffness": stiffness}
    asymmetry = {name: _asymmetry(matrix) for name, matrix in matrices.items()}
    massless = int(np.sum(np.diff(mass.tocsr().indptr) == 0))
    both = max(asymmetry["mass"], asymmetry["stiffness"]) <= ROUNDING
    frequencies = rigid = None
    if both:
        values = lowest_eigenvalues(stiffness, mass, LOWEST)
        rigid = int(np.sum(np.abs(values) <= RIGID * np.abs(values).max(initial=0.0)))
        frequencies = tuple(float(f) for f in np.sqrt(np.maximum(values, 0.0)) / (2 * np.pi))
    total = None
    if directions is not None:
        along = [(np.asarray(directions) == axis).astype(float) for axis in (1, 2, 3)]
        total = tuple(float(ones @ (mass @ ones)) for ones in along)
    return StructureChecks(
        asymmetry=asymmetry,
        negative_masses=negative_eigenvalues(mass) if asymmetry["mass"] <= ROUNDING else None,
        negative_springs=negative_eigenvalues(stiffness) if asymmetry["stiffness"] <= ROUNDING else None,
        massless=massless,
        rigid_body_modes=rigid,
        lowest_frequencies=frequencies,
        total_mass=total,
        fixed=fixed,
        remarks=tuple(remarks),
    )


def _asymmetry(matrix) -> float:
    largest = abs(matrix).max() if matrix.nnz else 0.0
    return float(abs(matrix - matrix.T).max() / largest) if largest else 0.0


def negative_eigenvalues(matrix) -> int | None:
    """How many eigenvalues of a symmetric sparse matrix are negative beyond rounding; None where this cannot be found.

    By Sylvester's law of inertia there are as many as negative pivots in a symmetric elimination.
    """
    from scipy import sparse
    from scipy.sparse.linalg import splu

    if matrix.nnz == 0:
        return 0
    # With the diagonal scaled to one, rounding is the same in every row.
    diagonal = np.abs(matrix.diagonal())
    scale = sparse.diags_array(1 / np.sqrt(np.where(diagonal > 0, diagonal, 1.0)))
    shifted = (scale @ matrix @ scale + 1e-9 * sparse.eye_array(matrix.shape[0])).tocsc()
    if matrix.shape[0] <= 400:
        return int(np.sum(np.linalg.eigvalsh(shifted.toarray()) < 0))
    try:
        # Pivots on the diagonal, in an order that keeps symmetry: then it is L D Lᵀ.
        factors = splu(shifted, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True})
    except RuntimeError:
        return None
    if not np.array_equal(factors.perm_r, factors.perm_c):
        return None
    return int(np.sum(factors.U.diagonal() < 0))


def lowest_eigenvalues(stiffness, mass, count: int) -> np.ndarray:
    """The lowest eigenvalues ω² of K v = ω² M v, sorted; both symmetric. Fewer than asked for in small structures."""
    return lowest_modes(stiffness, mass, count)[0]


def lowest_modes(stiffness, mass, count: int) -> tuple[np.ndarray, np.ndarray]:
    """The lowest eigenvalues ω² of K v = ω² M v and their mass-normalised modes (columns), sorted."""
    from scipy.linalg import eigh
    from scipy.sparse.linalg import eigsh

    n = stiffness.shape[0]
    # Stiffness over mass of each degree of freedom, as a measure of ω².
    with np.errstate(divide="ignore", invalid="ignore"):
        squares = stiffness.diagonal() / mass.diagonal()
    squares = squares[np.isfinite(squares) & (squares > 0)]
    if not squares.size:
        return np.zeros(0), np.zeros((n, 0))
    if n <= 400:
        small = 1e-3 * squares.min()
        # ν = 1/(ω² + σ) is finite where mass is not: massless degrees of freedom have ν = 0.
        shifted = stiffness.toarray() + small * mass.toarray()
        try:
            values, modes = eigh(mass.toarray(), shifted)
        except np.linalg.LinAlgError:
            return np.zeros(0), np.zeros((n, 0))
        real = values > 1e-14 * values.max()
        squares, modes = 1 / values[real] - small, modes[:, real] / np.sqrt(values[real])
        order = np.argsort(squares)[:count]
        return squares[order], modes[:, order]
    # A negative shift keeps K + σM definite where rigid-body modes make K singular.
    shift = -1e-3 * squares.min()
    start = np.random.default_rng(0).standard_normal(n)
    values, modes = eigsh(stiffness.tocsc(), min(count, n - 1), mass.tocsc(), sigma=shift, which="LM", v0=start)
    order = np.argsort(values)
    return values[order], modes[:, order]
