r"""A structure in coordinates that contain the displacements of its contacts. Contact is computed in these.

Contact needs exact zeros: of a closed gap, and of the slip velocity while sticking. They exist only where gap and tangential
displacement are coordinates. For contacts given by vectors, $q = X z$ replaces as many coordinates by $w^T q$ as there are
directions; the others stay. Energies, forces and eigenvalues do not change.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..foundation import arguments
from ..foundation.precision import Returned, in_double_precision
from .contact_point import ContactPoint, directions, pivots
from .structure import FromParameters, Matrices, Structure


def check_structure(structure) -> None:
    """Refuse what is no structure, and several in one."""
    arguments.instance("structure", structure, Structure, "a Structure, such as belt_oscillator()")
    if np.ndim(structure.mass) != 2:
        raise ValueError(
            f"This is not one structure but several, as `jax.vmap` returns them: its mass matrix has shape "
            f"{np.shape(structure.mass)}. Take them one by one, by `jax.vmap` of the function that you called."
        )


def transformation(structure: Structure) -> tuple[np.ndarray, list[int]]:
    """X of q = X z, without unit, and the places in z of the tangential directions and then the normal ones."""
    n = structure.size
    columns = np.concatenate(directions(structure.contacts, n), axis=1)
    places = pivots(columns)
    # z at these places is Wᵀ q; the other coordinates stay.
    inverse = np.eye(n)
    inverse[places] = columns.T
    return np.linalg.inv(inverse), places


@in_double_precision
def in_contact_coordinates(structure: Structure) -> Structure:
    """The same structure with the directions of all contacts as coordinates; itself, where they are coordinates already.

    New coordinates are called "tangential" and "normal", with several contacts "tangential_0", "normal_0", …; the others keep
    their names.

    **Raises:** `ValueError` for several structures in one, as `jax.vmap` returns them.

    **Example:**

        >>> fj.in_contact_coordinates(structure) is structure
        True
    """
    check_structure(structure)
    if structure.contacts_at_coordinates:
        return structure
    x, places = transformation(structure)
    count = len(structure.contacts)
    suffixes = [""] if count == 1 else [f"_{i}" for i in range(count)]
    names = list(structure.coordinates)
    # Of the coordinates that the contacts' directions become.
    kinds = ("tangential", "normal")
    for place, name in zip(places, [kind + suffix for kind in kinds for suffix in suffixes], strict=True):
        # Nor may its velocity have the name of another coordinate.
        while name in names or f"d{name}" in names:
            name += " of the contact"
        names[place] = name
    contacts = [ContactPoint(places[i], places[count + i]) for i in range(count)]
    source = structure.source
    if not isinstance(source, FromParameters):
        return Structure(*_transform(x, source), contacts=contacts, coordinates=names)
    return Structure.from_parameters(
        TurnedMatrices(source.matrices_of, tuple(map(tuple, x.tolist()))),
        source.parameters,
        contacts=contacts,
        coordinates=names,
        dampers=source.dampers,
        builder=None if source.builder is None else TurnedStructure(source.builder),
    )


@dataclass(frozen=True)
class TurnedMatrices:
    """The matrices of a structure in contact coordinates, from its parameters."""

    matrices_of: Callable[..., tuple]
    x: tuple[tuple[float, ...], ...]

    def __call__(self, **parameters) -> Matrices:
        return _transform(np.array(self.x), self.matrices_of(**parameters))


@dataclass(frozen=True)
class TurnedStructure:
    """A structure in contact coordinates, from its parameters."""

    builder: Callable[..., Structure]

    def __call__(self, **parameters) -> Structure:
        return in_contact_coordinates(self.builder(**parameters))


def _transform(x: np.ndarray, matrices: tuple) -> Matrices:
    """Matrices and load in the coordinates z of q = X z."""
    mass, damping, stiffness, load = map(jnp.asarray, matrices)

    def congruence(matrix: Float[Array, "n n"]) -> Float[Array, "n n"]:
        turned = jnp.asarray(x.T) @ matrix @ x
        return 0.5 * (turned + turned.T)

    return Matrices(congruence(mass), congruence(damping), congruence(stiffness), jnp.asarray(x.T) @ load)


def to_contact_coordinates(structure: Structure, y: Float[Returned, "*k state"]) -> Float[Returned, "*k state"]:
    """States z, with the directions of all contacts as coordinates, of states of a structure."""
    return _halves(y, np.linalg.inv(transformation(structure)[0]))


def from_contact_coordinates(structure: Structure, z: Float[Returned, "*k state"]) -> Float[Returned, "*k state"]:
    """States in a structure's own coordinates of states z in contact coordinates."""
    return _halves(z, transformation(structure)[0])


def _halves(y, matrix: np.ndarray) -> Any:
    """Displacements and velocities, each times a matrix; NumPy's arrays stay NumPy's."""
    n = len(matrix)
    join = np.concatenate if isinstance(y, np.ndarray) else jnp.concatenate
    return join([y[..., :n] @ matrix.T, y[..., n:] @ matrix.T], axis=-1)
