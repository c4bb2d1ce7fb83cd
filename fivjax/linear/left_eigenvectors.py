r"""Derivatives of eigenvalues by left and right eigenvectors, and a common basis for the modes of several operating points.

$\frac{dλ}{dp} = -\frac{y^H (λ^2 M' + λ C' + K')\, x}{y^H (2λ M + C)\, x}$ with $P(λ)x = 0$ and $y^H P(λ) = 0$, for any real
matrices, at the cost of one sparse factorisation for each mode.
"""

from collections.abc import Mapping

import numpy as np

from ..foundation import arguments
from .mode_search import ComplexModes
from .pencil import Pencil


def eigenvalue_derivatives(modes: ComplexModes, changes: Mapping[str, Pencil], which=None) -> dict[str, np.ndarray]:
    """dλ/dp of modes by each parameter, from the derivatives of the matrices.

        change = {"speed": fj.cea.Pencil(0 * M, dC, dK)}
        slopes = fj.cea.eigenvalue_derivatives(modes, change, which=modes.unstable)
        slopes["speed"].real        # of the growth rates, in 1/s per unit of the parameter

    **Arguments:**

    - `modes`: from `complex_modes`.
    - `changes`: by parameter, the derivatives of M, C and K as a `Pencil`; `friction_derivative` gives it for the friction of a
      structure whose contacts slide.
    - `which`: indices of the modes; all unless given.

    **Returns:** by parameter, an array with one complex number for each mode, in 1/s per unit of the parameter. NaN for modes
    with equal eigenvalues, which have no derivative of their own.

    **Raises:** `ValueError` for changes of another size than the pencil's, and for indices that are not those of modes.
    """
    arguments.instance("modes", modes, ComplexModes, "ComplexModes, as fj.cea.complex_modes gives them")
    arguments.instance("changes", changes, Mapping, 'a dictionary of pencils, such as {"mu": friction_derivative(...)}')
    for name, change in changes.items():
        arguments.instance(f"changes[{name!r}]", change, Pencil, "a Pencil of the derivatives of M, C and K")
        if change.size != modes.pencil.size:
            raise ValueError(
                f"Argument `changes[{name!r}]` must have {modes.pencil.size} rows to go with the modes, but has {change.size}."
            )
    count = modes.eigenvalues.size
    which = np.arange(count) if which is None else np.atleast_1d(arguments.numeric_array("which", which))
    if not np.all(np.isin(which, np.arange(-count, count))):
        raise ValueError(f"Argument `which` must hold indices of the {count} modes, but is {which.tolist()}.")
    which = which.astype(int)
    found = {name: np.full(which.size, complex(np.nan, np.nan)) for name in changes}
    # Eigenvalues this near to each other are equal, up to rounding. So are those whose left and right eigenvectors are this
    # nearly orthogonal.
    nearly = 1e-6
    for k, place in enumerate(which):
        value = modes.eigenvalues[place]
        if np.any(np.abs(np.delete(modes.eigenvalues, place) - value) <= nearly * _size_of(modes.pencil, value)):
            continue
        right, left = eigenvectors(modes.pencil, value)
        slope = left.conj() @ (modes.pencil.slope(value) @ right)
        size = np.linalg.norm(left) * np.linalg.norm(modes.pencil.slope(value) @ right)
        if abs(slope) <= nearly * size:
            continue
        for name, change in changes.items():
            found[name][k] = -(left.conj() @ (change.at(value) @ right)) / slope
    return found


def eigenvectors(pencil: Pencil, value: complex) -> tuple[np.ndarray, np.ndarray]:
    """Right and left eigenvector of the eigenvalue nearest to a value, by inverse iteration with one factorisation."""
    from scipy.sparse.linalg import splu

    size = _size_of(pencil, value)
    # The matrix is factorised at this relative distance from the eigenvalue: near enough for convergence in two steps, far
    # enough not to be singular.
    apart = 1e-8
    factors = splu(pencil.at(value + apart * size), permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.1)
    found = []
    for transposition in ("N", "H"):
        vector = np.random.default_rng(0).standard_normal(pencil.size) + 0j
        for _ in range(3):
            vector = factors.solve(vector / np.linalg.norm(vector), trans=transposition)
        found.append(vector / np.linalg.norm(vector))
    return found[0], found[1]


def _size_of(pencil: Pencil, value: complex) -> float:
    # Rigid-body motions, at zero but for rounding, have no size of their own; that of the other eigenvalues is a measure.
    return max(abs(value), 1e-6 * np.sqrt(abs(pencil.stiffness).sum() / abs(pencil.mass).sum()))


def shape_basis(pencil: Pencil, *modes: ComplexModes, coordinates: int = 60) -> np.ndarray:
    """A real basis of few columns that contains the mode shapes of several operating points, for `pencil.projected`.

        points = [fj.cea.complex_modes(brake(speed), up_to=3000.0) for speed in (6.0, 20.0, 60.0)]
        basis = fj.cea.shape_basis(brake(6.0), *points)
        fj.cea.complex_modes(brake(12.0).projected(basis))      # at any speed between, in no time

    The leading left singular vectors of all real and imaginary parts, with about equal kinetic energy for each mode: by the
    masses on the diagonal.

    **Arguments:** `pencil`, whose mass matrix gives the kinetic energy; `modes`, of pencils with the same coordinates;
    `coordinates`, the largest number of columns.

    **Returns:** `(n, m)`, with m at most `coordinates`.
    """
    arguments.instance("pencil", pencil, Pencil, "a Pencil, such as `cea.sliding_pencil` returns")
    coordinates = arguments.whole_number("coordinates", coordinates, minimum=1)
    for k, found in enumerate(modes):
        arguments.instance(f"modes[{k}]", found, ComplexModes, "modes, such as `cea.complex_modes` returns")
    if not modes or any(found.shapes.shape[0] != pencil.size for found in modes):
        raise ValueError(f"Argument `modes` must hold modes of pencils with {pencil.size} coordinates, at least one.")
    weight = np.sqrt(np.abs(pencil.mass.diagonal()))
    weight = np.where(weight > 0, weight, np.max(weight) * 1e-8)[:, None]
    shapes = np.hstack([found.shapes for found in modes]) * weight
    shapes = shapes / np.linalg.norm(shapes, axis=0)
    columns, sizes, _ = np.linalg.svd(np.hstack([shapes.real, shapes.imag]), full_matrices=False)
    return (columns / weight)[:, : min(coordinates, int(np.sum(sizes > 1e-12 * sizes[0])))]
