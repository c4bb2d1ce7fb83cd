r"""A structure in coordinates that contain the displacements of its contacts. Contact is computed in these.

Contact needs exact zeros: of a closed gap, and of the slip velocity while sticking. They exist only where gap and tangential
displacement are coordinates. For contacts given by vectors, $q = X z$ replaces as many coordinates by $w^T q$ as there are
directions; the others stay. Energies, forces and eigenvalues do not change.
"""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..foundation.precision import in_double_precision
from .contact_point import ContactPoint, directions, pivots
from .structure import Structure


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

    **Example:**

        >>> fj.in_contact_coordinates(structure) is structure
        True
    """
    if structure.contacts_at_coordinates:
        return structure
    x, places = transformation(structure)
    count = len(structure.contacts)
    suffixes = [""] if count == 1 else [f"_{i}" for i in range(count)]
    names = list(structure.coordinates)
    for place, name in zip(
        places, [kind + suffix for kind in ("tangential", "normal") for suffix in suffixes], strict=True
    ):
        names[place] = name
    mass, damping, stiffness, load = structure.matrices

    def seen(matrix: Float[Array, "n n"]) -> Float[Array, "n n"]:
        turned = jnp.asarray(x.T) @ matrix @ x
        return 0.5 * (turned + turned.T)

    contacts = [ContactPoint(places[i], places[count + i]) for i in range(count)]
    return Structure(
        seen(mass), seen(damping), seen(stiffness), jnp.asarray(x.T) @ load, contacts=contacts, coordinates=names
    )
