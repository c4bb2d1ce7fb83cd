r"""Complex modes of small and large systems: dense, or by shift and invert in a band of frequencies.

$(λ^2 M + λ C + K)\, x = 0$ is a linear problem in $(x, λx/ω)$. Its eigenvalues near a shift $s$ are the largest ones of an
operator that needs one sparse factorisation of $s^2 M + s C + K$, of the size of the structure. Shifts along the imaginary
axis are added until the discs in which all eigenvalues were found cover the band.

The matrices are real, so eigenvalues are real or come in conjugate pairs. Which of the two is decided in real arithmetic, never
by the sign of an imaginary part that may be rounding.
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
# What is left of a sum of terms by rounding, as a share of the largest.
ROUNDING = 64 * np.finfo(float).eps


@dataclasses.dataclass(frozen=True, repr=False, eq=False)
class ComplexModes:
    """Modes sorted by frequency, one of each conjugate pair.

    - `eigenvalues`: `(k,)`, in 1/s; real ones (overdamped motions, divergence) are all there, with an imaginary part of exactly
      zero. Zero where rounding leaves nothing else, as for rigid-body motions.
    - `shapes`: `(n, k)`, displacements of the structure, the largest entry 1.
    - `residuals`: `(k,)`, the error with which each satisfies its equation, relative to the size of the terms.
    - `rounding`: `(k,)`, about how far rounding of the matrices moves each eigenvalue, in 1/s.
    - `strip`: in 1/s. All modes of the band with growth rates between minus this and this are there; infinite where all modes
      were computed.
    - `pencil`: the pencil that they are modes of.
    """

    eigenvalues: np.ndarray
    shapes: np.ndarray
    residuals: np.ndarray
    rounding: np.ndarray
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
        size = np.abs(self.eigenvalues)
        return -self.eigenvalues.real / np.where(size > 0, size, 1.0)

    @property
    def unstable(self) -> np.ndarray:
        """Indices of the modes that grow faster than rounding explains, the fastest growing one first."""
        growing = np.flatnonzero(self.eigenvalues.real > np.maximum(1e-9 * np.abs(self.eigenvalues), self.rounding))
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
        searched = [f"  searched: growth rates between -{self.strip:.5g} and {self.strip:.5g} 1/s"]
        return "\n".join([head, *lines, *(searched if np.isfinite(self.strip) else [])])


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
        if direction != 1:
            raise ValueError(
                "Argument `direction` must not be given with a pencil: its matrices hold the belt's direction."
            )
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
    residuals, rounding = _residuals(pencil, values, shapes), _rounding(pencil, values, shapes)
    shapes = shapes if motions is None else motions @ shapes
    largest = shapes[np.argmax(np.abs(shapes), axis=0), np.arange(values.size)]
    return ComplexModes(values, shapes / largest, residuals, rounding, strip, pencil)


def _terms(pencil: Pencil, s):
    """The powers of `s` in the pencil, each with its matrix."""
    return (s**2, pencil.mass), (s, pencil.damping), (1.0, pencil.stiffness)


def _residuals(pencil: Pencil, values, shapes) -> np.ndarray:
    found = []
    for value, shape in zip(values, shapes.T, strict=True):
        terms = _terms(pencil, value)
        missed = np.linalg.norm(sum(power * (matrix @ shape) for power, matrix in terms))
        # Of a rigid-body motion each term is a difference of large numbers.
        size = sum(abs(power) * np.linalg.norm(abs(matrix) @ np.abs(shape)) for power, matrix in terms)
        found.append(missed / size if size else 0.0)
    return np.array(found)


def _rounding(pencil: Pencil, values, shapes) -> np.ndarray:
    """About how far each eigenvalue moves when every entry of the matrices changes by some rounding errors."""
    sizes = np.abs(shapes)
    terms = sum(
        power * np.sum(sizes * (abs(matrix) @ sizes), axis=0) for power, matrix in _terms(pencil, np.abs(values))
    )
    moved = pencil.mass @ shapes
    slope = np.sum(sizes * np.abs(2 * values * moved + pencil.damping @ shapes), axis=0)
    bend = np.sum(sizes * np.abs(moved), axis=0)
    # Where the slope vanishes, as at critical damping and at rest, two eigenvalues meet and move like the root of an error.
    root = np.sqrt(slope**2 + 4 * bend * ROUNDING * terms)
    return 2 * ROUNDING * terms / np.maximum(slope + root, np.finfo(float).tiny)


def _round_off(pencil: Pencil, values, shapes) -> np.ndarray:
    """The eigenvalues, those that cannot be told from zero or from real ones made exactly so.

    Of two equal real eigenvalues rounding makes a pair, one of which would be left out.
    """
    error = _rounding(pencil, values, shapes)
    values = np.where(np.abs(values.imag) <= error, values.real, values)
    return np.where(np.abs(values) <= error, 0.0, values)


def _all(pencil: Pencil, band: float):
    from scipy.linalg import eig

    mass, damping, stiffness = (matrix.toarray() for matrix in (pencil.mass, pencil.damping, pencil.stiffness))
    n, none = pencil.size, np.zeros((pencil.size, pencil.size))
    frequencies, sizes = _natural_units(mass, stiffness)
    mass, damping, stiffness = (sizes[:, None] * matrix * sizes for matrix in (mass, damping, stiffness))
    # Displacements times frequencies, so that both halves of a state are of similar size; time in units of a typical one.
    unit = np.exp(np.mean(np.log(frequencies)))
    state = np.block([[none, np.diag(frequencies)], [-stiffness / frequencies, -damping]]) / unit
    inertia = np.block([[np.eye(n), none], [none, mass]])
    (top, bottom), vectors = eig(state, inertia, homogeneous_eigvals=True)
    if np.any(np.abs(top) + np.abs(bottom) < 1e-14 * (np.abs(top) + np.abs(bottom)).max(initial=0.0)):
        raise _singular()
    finite = np.abs(bottom) > 1e-14 * np.abs(top)
    values, shapes = unit * top[finite] / bottom[finite], (sizes / frequencies)[:, None] * vectors[:n, finite]
    # LAPACK's routine for real matrices gives exactly real eigenvalues, and exact pairs.
    values = _round_off(pencil, values, shapes)
    chosen = np.flatnonzero((values.imag >= 0) & (values.imag <= band))
    chosen = chosen[np.lexsort((values.real[chosen], values.imag[chosen]))]
    return values[chosen], shapes[:, chosen], np.inf


def _natural_units(mass: np.ndarray, stiffness: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A frequency (rad/s) and a size of displacement for each coordinate, with which its mass is one.

    What has no mass or no spring has the frequency of the others.
    """
    mass, stiffness = np.abs(np.diag(mass)), np.abs(np.diag(stiffness))
    both = (mass > 0) & (stiffness > 0)
    squares = np.divide(stiffness, mass, out=np.ones_like(mass), where=both)
    usual = np.exp(np.mean(np.log(squares[both]))) if np.any(both) else 1.0
    squares = np.where(both, squares, usual)
    inertia = np.where(mass > 0, mass, stiffness / usual)
    return np.sqrt(squares), 1 / np.sqrt(np.where(inertia > 0, inertia, 1.0))


def _in_band(pencil: Pencil, band: float):
    found, gaps, strip, shifts = [], [(0.0, band)], np.inf, 0
    # How far a shift lies off the imaginary axis, as a share of half the part of the band that it is for.
    off_the_axis = 1e-3
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
        beside = off_the_axis * half
        shift = complex(beside, middle)
        values, shapes = near(pencil, shift, AT_ONCE)
        radius = np.max(np.abs(values - shift)) if values.size < 2 * pencil.size else np.inf
        reach = np.sqrt(1 - STRIP**2) * radius
        strip = min(strip, STRIP * radius - beside)
        if reach < half:
            gaps += [(low, middle - reach), (middle + reach, high)]
            low, high = middle - reach, middle + reach
        # A little beyond both ends: a mode that rounding puts on the wrong side of a border is found twice, not missed.
        margin = 1e-6 * band
        inside = (values.imag >= max(low - margin, 0.0)) & (values.imag <= high + margin)
        found += [(value, shape, shifts) for value, shape in zip(values[inside], shapes[:, inside].T, strict=True)]
    found.sort(key=lambda mode: (mode[0].imag, mode[0].real))
    single = [mode for k, mode in enumerate(found) if not _is_duplicate(mode, found[:k])]
    single = [mode for mode in single if mode[0].imag <= band]
    shapes = np.stack([mode[1] for mode in single], axis=1) if single else np.zeros((pencil.size, 0), complex)
    return np.array([mode[0] for mode in single]), shapes, strip


def _is_duplicate(mode, others) -> bool:
    """Whether a mode is one of those that another shift gave: with their eigenvalue, and a shape in the space of theirs."""
    value, shape, shift = mode
    alike = [other for other in others if other[2] != shift and abs(value - other[0]) <= 1e-6 * abs(value)]
    if not alike:
        return False
    space, _ = np.linalg.qr(np.stack([other[1] for other in alike], axis=1))
    return bool(np.linalg.norm(space.conj().T @ shape) > 0.999 * np.linalg.norm(shape))


def near(pencil: Pencil, shift: complex, count: int) -> tuple[np.ndarray, np.ndarray]:
    """The eigenvalues nearest to a shift and their shapes (columns), by shift and invert."""
    from scipy.sparse.linalg import LinearOperator, eigs, splu

    n, unit = pencil.size, abs(shift)
    # An ordering for the matrix plus its transpose: a third less fill-in than one for columns alone.
    try:
        factors = splu(pencil.at(shift), permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.1)
    except RuntimeError:
        raise _singular() from None
    relative, mass, damping = shift / unit, unit**2 * pencil.mass, unit * pencil.damping

    def shift_inverse(state):
        # With y = λx/ω, σ = s/ω: (A - σB)⁻¹B of (a, b) solves y - σx = a and -Kx - (ωC + σω²M) y = ω²M b.
        a, b = state[:n], state[n:]
        x = factors.solve(-(mass @ (b + relative * a) + damping @ a))
        return np.concatenate([x, a + relative * x])

    shape = 2 * n, 2 * n
    # pyrefly: ignore[missing-argument, unexpected-keyword, bad-keyword-argument]
    operator = LinearOperator(shape, matvec=shift_inverse, dtype=complex)
    start = np.random.default_rng(0).standard_normal(2 * n) + 0j
    values, states = eigs(operator, k=min(count, 2 * n - 2), v0=start)
    values = shift + unit / values
    # Eigenvalues this near to the real axis, relative to the shift, are found again in real arithmetic; rounding moves even
    # double ones by less.
    near_real = 1e-4
    close = np.abs(values.imag) <= near_real * unit
    if np.any(close):
        again, anew = _near_the_real_axis(shift_inverse, shift, states[:, close])
        again = _round_off(pencil, again, anew[:n])
        values, states = np.append(values[~close], again), np.hstack([states[:, ~close], anew])
    return values, states[:n]


def _singular() -> ValueError:
    return ValueError(
        "The pencil is singular, so its modes cannot be computed: some coordinate has neither mass nor stiffness. Hold it, or "
        "give it some."
    )


def _near_the_real_axis(shift_inverse, shift: complex, states: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The eigenvalues of these states, exactly real or in exact pairs, and the states that go with them.

    Complex arithmetic puts a real eigenvalue on either side of the real axis. Real and imaginary parts of the states span a
    space that the operator maps into itself, and in a real basis of it the problem is a small one with a real matrix.
    """
    columns, sizes, _ = np.linalg.svd(np.hstack([states.real, states.imag]), full_matrices=False)
    # Real and imaginary parts of states that depend on each other up to this share are one; the rest is rounding.
    dependent = 1e-9
    basis = columns[:, sizes > dependent * sizes[0]]
    images = np.stack([shift_inverse(column) for column in basis.T], axis=1)
    small = basis.T @ images  # ω(L - s)⁻¹ of the real matrix L that is sought
    found, shapes = np.linalg.eig((shift * np.eye(len(small)) + abs(shift) * np.linalg.inv(small)).real)
    # A direction of rounding alone is no state of the space.
    expected = abs(shift) / (found - shift)
    error = np.linalg.norm(images @ shapes - basis @ shapes * expected, axis=0)
    kept = error <= 1e-6 * np.abs(expected)
    return found[kept], (basis @ shapes)[:, kept]
