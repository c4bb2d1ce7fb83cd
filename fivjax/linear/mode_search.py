r"""Complex modes of small and large systems: dense, or by shift and invert in a band of frequencies.

$(λ^2 M + λ C + K)\, x = 0$ is a linear problem in $(x, λx/ω)$. Its eigenvalues near a shift $s$ are the largest ones of an
operator that needs one sparse factorisation of $s^2 M + s C + K$, of the size of the structure. Shifts along the imaginary
axis are added until the discs in which all eigenvalues were found cover the band.
"""

import dataclasses
from typing import TYPE_CHECKING

import numpy as np

from ..foundation import arguments
from ..model.sparse_structure import SparseStructure
from ..model.structure import Structure
from .pencil import Pencil, sliding_motions, sliding_pencil

if TYPE_CHECKING:
    import xarray as xr

# Up to this number of coordinates all eigenvalues are computed at once, from dense matrices of twice the size.
DENSE = 300
# Number of eigenvalues per shift: for more than some two dozen the basis costs more than another factorisation.
AT_ONCE = 24
MOST_SHIFTS = 40
# Half the width of the strip of growth rates that is searched, as a share of a disc's radius.
STRIP = 0.5


@dataclasses.dataclass(frozen=True, repr=False)
class ComplexModes:
    """Modes sorted by frequency, one of each conjugate pair.

    - `eigenvalues`: `(k,)`, in 1/s.
    - `shapes`: `(n, k)`, displacements of the structure, the largest entry 1.
    - `residuals`: `(k,)`, the error with which each satisfies its equation, relative to the size of the terms.
    - `strip`: in 1/s. All modes of the band with growth rates between minus this and this are there; infinite where all modes
      were computed.
    - `pencil`: the pencil that they are modes of.
    """

    eigenvalues: np.ndarray
    shapes: np.ndarray
    residuals: np.ndarray
    strip: float
    pencil: Pencil

    @property
    def frequencies(self) -> np.ndarray:
        """In Hz."""
        return self.eigenvalues.imag / (2 * np.pi)

    @property
    def growth_rates(self) -> np.ndarray:
        """In 1/s; positive where the mode is unstable."""
        return self.eigenvalues.real

    @property
    def damping_ratios(self) -> np.ndarray:
        """The share of critical damping, negative where the mode is unstable."""
        return -self.eigenvalues.real / np.abs(self.eigenvalues)

    @property
    def unstable(self) -> np.ndarray:
        """Indices of the unstable modes, the fastest growing one first."""
        growing = np.flatnonzero(self.eigenvalues.real > 1e-9 * np.abs(self.eigenvalues))
        return growing[np.argsort(-self.eigenvalues.real[growing])]

    def to_dataset(self) -> "xr.Dataset":
        """Frequencies, growth rates, damping ratios and residuals over `mode`, for tables and files."""
        import xarray as xr

        return xr.Dataset(
            {
                "frequency": ("mode", self.frequencies, {"long_name": "frequency", "units": "Hz"}),
                "growth_rate": ("mode", self.growth_rates, {"long_name": "growth rate", "units": "1/s"}),
                "damping_ratio": ("mode", self.damping_ratios, {"long_name": "damping ratio", "units": "1"}),
                "residual": ("mode", self.residuals, {"long_name": "relative residual", "units": "1"}),
            },
            attrs={"strip": self.strip, "coordinates": self.pencil.size},
        )

    def __repr__(self) -> str:
        rows = zip(self.frequencies, self.growth_rates, self.damping_ratios, strict=True)
        lines = [f"  {f:12.6g} Hz {g:12.5g} 1/s {100 * z:10.4f} %" for f, g, z in rows]
        for place in self.unstable:
            lines[place] += "  unstable"
        head = f"{len(lines)} modes, {len(self.unstable)} unstable (frequency, growth rate, damping ratio)"
        return "\n".join([head, *lines])


def complex_modes(
    system: Pencil | Structure | SparseStructure, mu=None, *, up_to: float | None = None, direction=1
) -> ComplexModes:
    """Complex modes of any pencil, or of steady sliding of a structure with any number of contacts.

        fj.cea.complex_modes(fj.cea.Pencil(M, C, K), up_to=3000.0)
        fj.cea.complex_modes(structure, mu=0.4, up_to=3000.0).unstable

    Up to 300 coordinates all modes are computed, and those up to `up_to` are returned. Larger systems are searched by shift and
    invert; modes far from the imaginary axis (beyond `strip`) may then be missing.

    **Arguments:**

    - `system`: a `Pencil`, or a structure, all of whose contacts slide under constant friction `mu`.
    - `mu`, `direction`: as for `sliding_pencil`; not for a `Pencil`.
    - `up_to`: highest frequency in Hz; must be given for more than 300 coordinates.

    **Raises:** `ValueError` for friction given with a pencil or not given with a structure, for a large system without `up_to`,
    and where a search does not cover the band.
    """
    arguments.instance("system", system, (Pencil, Structure, SparseStructure), "a Pencil, Structure or SparseStructure")
    if isinstance(system, Pencil):
        if mu is not None:
            raise ValueError("Argument `mu` must not be given with a pencil: its matrices hold the friction.")
        pencil, motions = system, None
    else:
        if mu is None:
            raise ValueError("Argument `mu` must be given with a structure.")
        pencil, motions = sliding_pencil(system, mu, direction=direction), sliding_motions(system)
    if up_to is not None:
        arguments.real_number("up_to", up_to, above=0)
    if pencil.size <= DENSE:
        values, shapes, strip = _all(pencil, np.inf if up_to is None else 2 * np.pi * up_to)
    elif up_to is None:
        raise ValueError(
            f"Argument `up_to` must be given for {pencil.size} coordinates: the highest frequency of interest in Hz."
        )
    else:
        values, shapes, strip = _in_band(pencil, 2 * np.pi * up_to)
    residuals = _residuals(pencil, values, shapes)
    shapes = shapes if motions is None else motions @ shapes
    largest = shapes[np.argmax(np.abs(shapes), axis=0), np.arange(values.size)]
    return ComplexModes(values, shapes / largest, residuals, strip, pencil)


def _residuals(pencil: Pencil, values, shapes) -> np.ndarray:
    found = []
    for value, shape in zip(values, shapes.T, strict=True):
        terms = [value**2 * (pencil.mass @ shape), value * (pencil.damping @ shape), pencil.stiffness @ shape]
        size = sum(np.linalg.norm(term) for term in terms)
        found.append(np.linalg.norm(sum(terms)) / size if size else 0.0)
    return np.array(found)


def _all(pencil: Pencil, band: float):
    from scipy.linalg import eig

    mass, damping, stiffness = (matrix.toarray() for matrix in (pencil.mass, pencil.damping, pencil.stiffness))
    n, eye = pencil.size, np.eye(pencil.size)
    unit = _unit(mass, stiffness)
    # In units of a typical frequency, so that both halves of a state are of similar size.
    state = np.block([[np.zeros((n, n)), eye], [-stiffness / unit**2, -damping / unit]])
    inertia = np.block([[eye, np.zeros((n, n))], [np.zeros((n, n)), mass]])
    (top, bottom), vectors = eig(state, inertia, homogeneous_eigvals=True)  # pyright: ignore[reportAssignmentType]
    finite = np.abs(bottom) > 1e-14 * np.abs(top)
    values, shapes = unit * top[finite] / bottom[finite], vectors[:n, finite]
    # Rounding may give a real eigenvalue a small imaginary part of either sign.
    values = np.where(np.abs(values.imag) < 1e-12 * np.abs(values), values.real, values)
    chosen = np.flatnonzero((values.imag >= 0) & (values.imag <= band))
    chosen = chosen[np.lexsort((values.real[chosen], values.imag[chosen]))]
    return values[chosen], shapes[:, chosen], np.inf


def _unit(mass: np.ndarray, stiffness: np.ndarray) -> float:
    sizes = [np.linalg.norm(matrix) for matrix in (stiffness, mass)]
    return float(np.sqrt(sizes[0] / sizes[1])) if min(sizes) > 0 else 1.0


def _in_band(pencil: Pencil, band: float):
    found, gaps, strip, shifts = [], [(0.0, band)], np.inf, 0
    while gaps:
        low, high = gaps.pop()
        shifts += 1
        if shifts > MOST_SHIFTS:
            raise ValueError(
                f"There are too many modes up to {band / (2 * np.pi):g} Hz to find them all. Lower `up_to`, or reduce the "
                f"structure by `craig_bampton`."
            )
        middle, half = (low + high) / 2, (high - low) / 2
        # Not on the imaginary axis, where an undamped mode may lie, but on the side of the unstable modes.
        shift = complex(0.01 * half, middle)
        values, shapes = near(pencil, shift, AT_ONCE)
        radius = np.max(np.abs(values - shift)) if values.size < 2 * pencil.size else np.inf
        reach = np.sqrt(1 - STRIP**2) * radius
        strip = min(strip, STRIP * radius)
        if reach < half:
            gaps += [(low, middle - reach), (middle + reach, high)]
            low, high = middle - reach, middle + reach
        # A little beyond both ends: a mode that rounding puts on the wrong side of a border is found twice, not missed.
        margin = 1e-6 * band
        inside = (values.imag >= max(low - margin, 0.0)) & (values.imag <= high + margin)
        found += [(value, shape, shifts) for value, shape in zip(values[inside], shapes[:, inside].T, strict=True)]
    found.sort(key=lambda mode: (mode[0].imag, mode[0].real))
    single = [mode for k, mode in enumerate(found) if not any(_same(mode, other) for other in found[max(k - 3, 0) : k])]
    single = [mode for mode in single if mode[0].imag <= band]
    shapes = np.stack([mode[1] for mode in single], axis=1) if single else np.zeros((pencil.size, 0), complex)
    return np.array([mode[0] for mode in single]), shapes, strip


def _same(a, b) -> bool:
    """Whether two modes found from different shifts are the same."""
    (value, shape, shift), (other, other_shape, other_shift) = a, b
    if shift == other_shift or abs(value - other) > 1e-6 * abs(value):
        return False
    alike = abs(np.vdot(shape, other_shape)) / (np.linalg.norm(shape) * np.linalg.norm(other_shape))
    return alike > 0.999


def near(pencil: Pencil, shift: complex, count: int) -> tuple[np.ndarray, np.ndarray]:
    """The eigenvalues nearest to a shift and their shapes (columns), by shift and invert."""
    from scipy.sparse.linalg import LinearOperator, eigs, splu

    n, unit = pencil.size, abs(shift)
    # An ordering for the matrix plus its transpose: a third less fill-in than one for columns alone.
    factors = splu(pencil.at(shift), permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.1)
    relative, mass, damping = shift / unit, unit**2 * pencil.mass, unit * pencil.damping

    def inverted(state):
        # With y = λx/ω, σ = s/ω: (A - σB)⁻¹B of (a, b) solves y - σx = a and -Kx - (ωC + σω²M) y = ω²M b.
        a, b = state[:n], state[n:]
        x = factors.solve(-(mass @ (b + relative * a) + damping @ a))
        return np.concatenate([x, a + relative * x])

    operator = LinearOperator((2 * n, 2 * n), matvec=inverted, dtype=complex)  # pyright: ignore[reportCallIssue]
    start = np.random.default_rng(0).standard_normal(2 * n) + 0j
    values, vectors = eigs(operator, k=min(count, 2 * n - 2), v0=start)  # pyright: ignore[reportAssignmentType]
    return shift + unit / values, vectors[:n]
