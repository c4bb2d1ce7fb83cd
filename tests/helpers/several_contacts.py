"""Structures with several contacts: uncoupled copies of one, each with a law and a belt speed of its own."""

import numpy as np

import fivjax as fj

EACH = 3  # coordinates of one oscillator


def copies(count, structure=None, shares=None):
    """Uncoupled copies of a structure in one, each with its own share of the load."""
    mass, damping, stiffness, load = map(
        np.asarray, (fj.belt_oscillator() if structure is None else structure).matrices
    )
    shares = np.ones(count) if shares is None else shares
    contacts = [fj.ContactPoint(EACH * i, EACH * i + 2) for i in range(count)]
    return fj.Structure(
        *(np.kron(np.eye(count), matrix) for matrix in (mass, damping, stiffness)),
        np.kron(shares, load),
        contacts=contacts,
    )


def coupled(count: int) -> fj.Structure:
    """Copies of the paper's oscillator under different shares of the load, neighbours held together firmly along the belt."""
    structure = copies(count, shares=1 + 0.1 * np.arange(count))
    mass, damping, stiffness, load = (np.array(matrix) for matrix in structure.matrices)
    for k in range(count - 1):
        for matrix, value in ((stiffness, 1e6), (damping, 200.0)):
            matrix[np.ix_([3 * k, 3 * k + 3], [3 * k, 3 * k + 3])] += value * np.array([[1.0, -1.0], [-1.0, 1.0]])
    return fj.Structure(mass, damping, stiffness, load, contacts=structure.contacts)


def scene_of(structure, *, mu=0.2, mu_static=None, belt=3.0, force=100.0, p=1.0, restitution=0.0):
    count = len(structure.contacts)
    mu, mu_static, belt = (
        np.broadcast_to(value, count) for value in (mu, mu if mu_static is None else mu_static, belt)
    )
    laws = [fj.Coulomb(float(m), float(s)) for m, s in zip(mu, mu_static, strict=True)]
    restitution = np.broadcast_to(float(restitution), count)
    return fj.Scene(structure, laws, np.array(belt), fj.Pulse(force, p), restitution)
