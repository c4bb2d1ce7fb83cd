"""An independent route to the linear results: Eq. 3 of the paper typed out, NumPy's eigenvalues, SciPy's `brentq`.

Nothing of fivjax is imported here.
"""

import numpy as np
from scipy.optimize import brentq

TABLE_1 = {"m1": 0.53, "m2": 0.045, "c1": 1.0, "c2": 1.0, "k1": 100e3, "k2": 101e3, "theta": 0.01}


def sliding(mu, m1, m2, c1, c2, k1, k2, theta):
    """M, C, K of Eq. 3."""
    sin, cos = np.sin(theta), np.cos(theta)
    mass = np.array([[m2 + m1 * cos**2 + mu * m1 * cos * sin, 0.0], [0.0, m1]])
    damping = np.array(
        [
            [c2 * sin**2 + c1 * cos**2 + mu * (c1 - c2) * cos * sin, -c2 * sin + mu * c2 * cos],
            [-c2 * sin, c2],
        ]
    )
    stiffness = np.array(
        [
            [k2 * sin**2 + k1 * cos**2 + mu / 2 * (k1 - k2) * np.sin(2 * theta), -k2 * sin + mu * k2 * cos],
            [-k2 * sin, k2],
        ]
    )
    return mass, damping, stiffness


def normal_force(mu, force, k1, k2, theta, **_):
    """N of steady sliding, from the equilibrium of Eq. 3 and the third row of Eq. 5."""
    _, _, stiffness = sliding(mu, 1.0, 1.0, 0.0, 0.0, k1, k2, theta)
    x2, y1 = np.linalg.solve(stiffness, [0.0, -force])
    return (k2 - k1) * np.sin(theta) * np.cos(theta) * x2 - k2 * np.cos(theta) * y1


def state_matrix(mass, damping, stiffness):
    m = len(mass)
    return np.block(
        [[np.zeros((m, m)), np.eye(m)], [-np.linalg.solve(mass, stiffness), -np.linalg.solve(mass, damping)]]
    )


def eigenvalues(mu, **parameters):
    return np.linalg.eigvals(state_matrix(*sliding(mu, **{**TABLE_1, **parameters})))


def growth(mu, **parameters):
    return eigenvalues(mu, **parameters).real.max()


def critical_friction(low=0.2275, high=0.24, **parameters):
    """Between a stable and an unstable friction."""
    return brentq(growth_of(parameters), low, high, xtol=1e-16, rtol=1e-15)


def growth_of(parameters):
    return lambda mu: growth(mu, **parameters)


def general_state_matrix(mu, mass, damping, stiffness, tangential, normal):
    """The same for any symmetric matrices: rows and columns struck out one by one."""
    keep = [i for i in range(len(mass)) if i != normal]
    reduced = []
    for matrix in (mass, damping, stiffness):
        matrix = np.array(matrix, dtype=float)
        matrix[tangential] = matrix[tangential] - mu * matrix[normal]
        reduced.append(matrix[np.ix_(keep, keep)])
    return state_matrix(*reduced)


def general_critical_friction(top, points, **structure):
    """The first sign change of the growth rate on a grid from 0 to `top`, then `brentq`; infinite if there is none."""

    def growth(mu):
        return np.linalg.eigvals(general_state_matrix(mu, **structure)).real.max()

    grid = np.linspace(0.0, top, points)
    unstable = np.flatnonzero([growth(mu) > 0 for mu in grid])
    if not unstable.size:
        return np.inf
    first = unstable[0]
    return brentq(growth, grid[first - 1], grid[first], xtol=1e-15, rtol=1e-14)


def difference(function, x, step):
    """First derivative by central differences of fourth order."""
    return (8 * (function(x + step) - function(x - step)) - (function(x + 2 * step) - function(x - 2 * step))) / (
        12 * step
    )
