"""Structures of any number of coordinates and contacts."""

import numpy as np

import fivjax as fj


def chain(n: int, contacts: int) -> fj.Scene:
    stiffness = np.diag(np.linspace(1e4, 1e6, n)) + 1e3
    load = np.zeros(n)
    load[1 : 2 * contacts : 2] = -1.0
    places = [fj.ContactPoint(2 * i, 2 * i + 1) for i in range(contacts)]
    structure = fj.Structure(np.eye(n) + 0.01, 1e-5 * stiffness, stiffness, load, contacts=places)
    return fj.Scene(structure, fj.Coulomb(mu=0.3), belt_speed=1.0, load=fj.Pulse(force=10.0, p=2.0))
