"""The finite-element brake: unstable modes by `complex_modes` against a reference by another route, whole and reduced.

Its matrices are those of BrakeSqueal 0.1 (Gräbner, Mehrmann, Quraishi, Schröder, von Wagner, ZAMM 96, 2016), in the folder `brake`
of the one that FIVJAX_DATA names, or else of `../shared/data`.

The reference: the undamped modes of the elastic springs alone give first guesses, by a dense solution in the space that they span;
Newton's method on (λ²M + λC + K) x = 0 with the length of x fixed then solves each to rounding. It shares neither the linear problem,
nor the operator, nor the iteration with the function that is measured.
"""

import os
import time
from pathlib import Path

import numpy as np
from scipy import linalg, sparse
from scipy.sparse.linalg import eigsh, splu

import fivjax as fj

DATA = Path(os.environ.get("FIVJAX_DATA", Path(__file__).parents[3] / "shared" / "data"))
FOLDER = DATA / "brake"
SPEED = 4 * np.pi  # rad/s
NAMES = {
    "M": "BMLL",
    "D1": "BDLL",
    "DG": "BYLL",
    "DR": "BDIWLL",
    "D4": "BHLL",
    "K1": "BKLL",
    "KR": "BKQLL",
    "KGEO": "BWLL",
}


def parts(folder: Path) -> dict[str, sparse.csr_array]:
    """The eight matrices of the brake."""
    return {name: fj.read_matrices(folder / f"{file}00.mat")[file].matrix for name, file in NAMES.items()}


def brake(p: dict, speed: float) -> fj.cea.Pencil:
    """Its pencil at a speed of the disc in rad/s, with 1 rad/s and 1600 Hz as references."""
    damping = p["D1"] + speed * p["DG"] + (1 / speed - 1) * p["DR"] + p["D4"] / (2 * np.pi * 1600)
    return fj.cea.Pencil(p["M"], damping, p["K1"] + p["KR"] + (speed**2 - 1) * p["KGEO"])


def speed_derivative(p: dict, speed: float) -> fj.cea.Pencil:
    """The derivative of the pencil by the speed."""
    return fj.cea.Pencil(0 * p["M"], p["DG"] - p["DR"] / speed**2, 2 * speed * p["KGEO"])


def reference(pencil: fj.cea.Pencil, elastic, frequencies, modes: int = 40) -> tuple[np.ndarray, np.ndarray]:
    """Eigenvalues near these frequencies (Hz) and their residuals, by Newton's method from modes of elastic springs."""
    _, basis = eigsh(elastic.tocsc(), modes, pencil.mass, sigma=0.0)
    small = [basis.T @ (matrix @ basis) for matrix in (pencil.mass, pencil.damping, pencil.stiffness)]
    n = modes
    state = np.block(
        [[np.zeros((n, n)), np.eye(n)], [-np.linalg.solve(small[0], small[2]), -np.linalg.solve(small[0], small[1])]]
    )
    guesses, vectors = linalg.eig(state)
    found, residuals = [], []
    for frequency in frequencies:
        # Two modes may be near one another: each is followed to its end, and the one that grows is taken.
        near = np.flatnonzero(np.abs(guesses.imag / (2 * np.pi) - frequency) < 0.05 * frequency)
        ends = [newton(pencil, guesses[place], basis @ vectors[:n, place]) for place in near]
        value, residual = max(ends, key=lambda end: end[0].real)
        found.append(value)
        residuals.append(residual)
    return np.array(found), np.array(residuals)


def newton(pencil: fj.cea.Pencil, value: complex, shape: np.ndarray) -> tuple[complex, float]:
    """The eigenvalue that Newton's method reaches from a guess, and its residual relative to the size of the terms."""
    for _ in range(12):
        # (λ²M + λC + K) dx + (2λM + C) x dλ = -(λ²M + λC + K) x, and x keeps its length.
        factors = splu(pencil.at(value), permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.1)
        along = factors.solve(pencil.slope(value) @ shape)
        step = np.vdot(shape, shape) / np.vdot(shape, along)
        shape, value = along / np.linalg.norm(along), value - step
        if abs(step) < 1e-12 * abs(value):
            break
    terms = [value**2 * (pencil.mass @ shape), value * (pencil.damping @ shape), pencil.stiffness @ shape]
    return value, float(np.linalg.norm(sum(terms)) / sum(map(np.linalg.norm, terms)))


def measure(folder: Path) -> dict:
    """Time, errors of the two unstable modes, whole and reduced, and their derivatives by the speed."""
    p = parts(folder)
    pencil = brake(p, SPEED)
    begun = time.perf_counter()
    modes = fj.cea.complex_modes(pencil, up_to=3000.0)
    seconds = time.perf_counter() - begun
    wanted, residuals = reference(pencil, p["K1"], (785.0, 2769.0))
    places = [int(np.argmin(np.abs(modes.eigenvalues - value))) for value in wanted]
    # The basis is from three other speeds; none of it is from this one.
    points = [fj.cea.complex_modes(brake(p, speed), up_to=3000.0) for speed in (2 * np.pi, 6 * np.pi, 20 * np.pi)]
    basis = fj.cea.shape_basis(pencil, *points, coordinates=60)
    small = fj.cea.complex_modes(pencil.projected(basis), up_to=3500.0).eigenvalues
    reduced = np.array([small[np.argmin(np.abs(small - value))] for value in wanted])
    slopes = fj.cea.eigenvalue_derivatives(modes, {"speed": speed_derivative(p, SPEED)}, which=places)["speed"]
    step = 1e-3 * SPEED
    ends = [
        np.array([newton(brake(p, SPEED + sign * step), modes.eigenvalues[k], modes.shapes[:, k])[0] for k in places])
        for sign in (1, -1)
    ]
    return {
        "seconds": seconds,
        "modes": modes,
        "reference": wanted,
        "reference residual": residuals,
        "relative error": np.abs(modes.eigenvalues[places] - wanted) / np.abs(wanted),
        "coordinates": basis.shape[1],
        "reduced error": np.abs(reduced - wanted) / np.abs(wanted),
        "reduced growth error": np.abs(reduced.real / wanted.real - 1),
        "slope error": np.abs(slopes - (ends[0] - ends[1]) / (2 * step)) / np.abs(slopes),
    }
