"""The systems of units of finite-element models, and the conversion to SI."""

import numpy as np
from scipy import sparse

# The units of length in m, of mass in kg and of time in s; force and pressure (in the comments) follow.
SYSTEMS = {
    "SI": (1.0, 1.0, 1.0),  # N
    "mm-t-s": (1e-3, 1e3, 1.0),  # N, MPa
    "mm-kg-ms": (1e-3, 1.0, 1e-3),  # kN, GPa
    "mm-g-ms": (1e-3, 1e-3, 1e-3),  # N, MPa
    "mm-kg-s": (1e-3, 1.0, 1.0),  # mN, kPa
    "in-lbf-s": (0.0254, 175.12683524647636, 1.0),  # lbf, psi; mass in lbf·s²/in
}


def in_si(matrices: dict[str, sparse.csr_array], directions: np.ndarray, units: str) -> dict[str, sparse.csr_array]:
    """Mass, damping and stiffness in SI units: displacements in directions 1 to 3 in metres, all others unchanged."""
    length, mass, time = SYSTEMS[units]
    # A quadratic form of displacements is an energy; a displacement in m is that in the file's units times their length.
    energy = mass * (length / time) ** 2
    scale = sparse.diags_array(np.where((directions >= 1) & (directions <= 3), 1 / length, 1.0))
    powers = {"stiffness": 0, "damping": 1, "mass": 2}
    return {
        name: (energy * time ** powers[name] * (scale @ matrix @ scale)).tocsr() for name, matrix in matrices.items()
    }
