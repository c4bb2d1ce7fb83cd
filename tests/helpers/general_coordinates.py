"""Structures with one contact in coordinates of which none is a direction of the contact."""

import numpy as np

import fivjax as fj

# Displacements at coordinates are these products with general ones.
TURN = np.array([[1.0, 0.3, -0.2], [0.1, 1.2, 0.4], [-0.3, 0.2, 0.9]])


def in_general_coordinates(structure: fj.Structure, turn: np.ndarray = TURN) -> fj.Structure:
    """A structure with three coordinates, of which the first is tangential and the last normal, with its contact by vectors."""
    matrices = (turn.T @ np.asarray(matrix) @ turn for matrix in structure.matrices[:3])
    load, contact = turn.T @ np.asarray(structure.load_direction), fj.ContactPoint(turn[0], turn[2])
    return fj.Structure(*(0.5 * (one + one.T) for one in matrices), load, contacts=[contact])
