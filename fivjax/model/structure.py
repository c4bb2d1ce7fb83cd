"""The vibrating structure: symmetric matrices, the direction of the load, and the directions of its contacts.

A structure has no contact forces and no friction. Sliding and sticking are projections of its matrices (`sliding`, `contact`);
nothing outside `belt_oscillator` depends on the names of springs or angles. A structure holds either its matrices, or the
parameters from which they are worked out each time, never both: so the two cannot disagree.
"""

import contextlib
import functools
from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..foundation import arguments
from ..foundation.numpy_evaluation import by_numpy
from ..foundation.precision import in_double_precision, is_known, real, state_for_pickle, state_from_pickle
from ..foundation.same_functions import first_like
from .contact_point import ContactPoint, directions, resolve_contacts
from .matrix_checks import check_matrix, check_names, check_shapes
from .own_structures import check_name, remember
from .printing import as_call


class Matrices(NamedTuple):
    """The four arrays of a structure that computations need."""

    mass: Float[Array, "n n"]  # kg
    damping: Float[Array, "n n"]  # N·s/m
    stiffness: Float[Array, "n n"]  # N/m
    load_direction: Float[Array, " n"]  # share of a positive load, without unit


class FromParameters(eqx.Module):
    """Parameters by name, and the function from them to the matrices."""

    __getstate__, __setstate__ = state_for_pickle, state_from_pickle

    values: dict[str, Float[Array, "..."]]
    names: tuple[str, ...] = eqx.field(static=True)  # in the order that they were given in, which JAX does not keep
    matrices_of: Callable[..., tuple] = eqx.field(static=True)
    # Which parameters are dampers: the damping matrix is a sum of parts, each proportional to one of them.
    dampers: tuple[str, ...] = eqx.field(static=True)
    # The function that made the structure from parameters and checks them: `replace` calls it again.
    builder: "Callable[..., Structure] | None" = eqx.field(static=True)

    @property
    def matrices(self) -> Matrices:
        """Worked out anew each time."""
        return self._at(self.values)

    @property
    def parameters(self) -> dict[str, Float[Array, "..."]]:
        """The values by name."""
        return {name: self.values[name] for name in self.names}

    @property
    def damping_parts(self) -> dict[str, Float[Array, "n n"]]:
        """The part of the damping matrix of each damper, in N·s/m."""
        # The matrix is linear in the dampers, so a part is the matrix with the other dampers at zero.
        return {
            name: self._at(
                {
                    other: jnp.zeros_like(value) if other in self.dampers and other != name else value
                    for other, value in self.values.items()
                }
            ).damping
            for name in self.dampers
        }

    @in_double_precision
    def _at(self, parameters: dict[str, Array]) -> Matrices:
        if not all(hasattr(value, "dtype") for value in parameters.values()):
            raise TypeError(
                "The matrices of this structure follow from its parameters. Change these with `replace`, or take "
                "`structure.as_matrices()` to change a matrix itself."
            )
        # Under `jit`, too, known parameters make known matrices, which NumPy takes.
        known = is_known(list(parameters.values()))
        with jax.ensure_compile_time_eval() if known else contextlib.nullcontext():
            return jax.tree.map(jnp.asarray, _matrices(self.matrices_of, parameters))


# Always rounded alike: the same parameters make the same matrices.
@functools.partial(by_numpy, always=True)
def _matrices(matrices_of: Callable[..., tuple], parameters: dict[str, Float[Array, "..."]]) -> Matrices:
    def matrices(parameters):
        found = matrices_of(**parameters)
        if not isinstance(found, tuple | list) or len(found) != len(Matrices._fields):
            raise TypeError(
                f"Argument `matrices_of` must return (mass, damping, stiffness, load direction), but returns "
                f"{arguments.describe(found)}."
            )
        return Matrices(*map(jnp.asarray, found))

    # Parameters that come out of `vmap` have leading axes; so have the matrices made from them.
    names, values = list(parameters), jnp.broadcast_arrays(*parameters.values())
    for _ in range(values[0].ndim):
        matrices = jax.vmap(matrices)
    return matrices(dict(zip(names, values, strict=True)))


Place = int | tuple[float, ...]


def _place(direction) -> Place:
    return tuple(direction.tolist()) if isinstance(direction, np.ndarray) else int(direction)


class Structure(eqx.Module):
    r"""A linear structure with frictional contacts:
    $M \ddot q + C \dot q + K q = f F(t) + W_t T + W_n N$ (Eqs. 4–5 of the paper, with the contact forces on the right).

    **Arguments:**

    - `mass`, `damping`, `stiffness`: symmetric `(n, n)` matrices in kg, N·s/m and N/m. The mass matrix is positive
      definite, the other two positive semi-definite.
    - `load_direction`: `(n,)`, the coordinates' share $f$ of a positive load, without unit.
    - `tangential`, `normal`: the coordinate along the belt and the gap (positive away from the belt) of a structure with one
      contact, by index or name.
    - `contacts`: instead of these, a `ContactPoint` for each contact; their directions may be coordinates or vectors.
    - `coordinates`: the coordinates' names, ("q0", "q1", …) unless given.

    `Structure.from_parameters` makes one whose matrices follow from named parameters, as `belt_oscillator` does.

    **Raises:** `ValueError` or `TypeError`, as a sentence, for a wrong shape, a non-finite entry, an unsymmetric or
    indefinite matrix, an index out of range, directions that are linearly dependent, or a number of names that is not that of
    the coordinates.

    **Example:**

        >>> block = fj.Structure(np.eye(2), np.zeros((2, 2)), np.eye(2), [0.0, -1.0], tangential=0, normal=1)
        >>> block.size
        2
    """

    __getstate__, __setstate__ = state_for_pickle, state_from_pickle

    # The matrices, or the parameters that they follow from. Everything else is read from here.
    source: "Matrices | FromParameters"
    coordinates: tuple[str, ...] = eqx.field(static=True)
    # The contacts' directions: indices, or vectors as tuples.
    places: tuple[tuple[Place, Place], ...] = eqx.field(static=True)

    @in_double_precision
    def __init__(
        self,
        mass,
        damping,
        stiffness,
        load_direction,
        tangential: int | str = 0,
        normal: int | str = 2,
        *,
        contacts: Sequence[ContactPoint] | None = None,
        coordinates: Sequence[str] | None = None,
    ):
        matrices = {"mass": mass, "damping": damping, "stiffness": stiffness}
        for name, matrix in matrices.items():
            check_matrix(name, matrix, definite=name == "mass")
        if is_known(load_direction):
            arguments.numeric_array("load_direction", load_direction)
        given = Matrices(real(mass), real(damping), real(stiffness), real(load_direction))
        n = given.mass.shape[0]
        check_shapes(n, damping=given.damping, stiffness=given.stiffness)
        if given.load_direction.shape != (n,):
            raise ValueError(
                f"Argument `load_direction` must have shape ({n},) to go with the mass matrix, but has shape "
                f"{given.load_direction.shape}."
            )
        if is_known(load_direction) and not np.all(np.isfinite(np.asarray(load_direction))):
            raise ValueError("Argument `load_direction` must be finite.")
        self.coordinates = check_names(coordinates, n)
        if contacts is None:
            contacts = [ContactPoint(tangential, normal)]
        elif np.ndim(tangential) or np.ndim(normal) or (tangential, normal) != (0, 2):
            raise ValueError("Give either `contacts`, or `tangential` and `normal` for a single contact, but not both.")
        self.places = tuple(
            (_place(contact.tangential), _place(contact.normal))
            for contact in resolve_contacts(contacts, self.coordinates)
        )
        self.source = given

    @classmethod
    @in_double_precision
    def from_parameters(
        cls,
        matrices_of: Callable[..., tuple],
        parameters: Mapping[str, float],
        *,
        tangential: int | str = 0,
        normal: int | str = 2,
        contacts: Sequence[ContactPoint] | None = None,
        coordinates: Sequence[str] | None = None,
        dampers: Sequence[str] = (),
        builder: "Callable[..., Structure] | None" = None,
    ) -> "Structure":
        """A structure whose matrices are worked out from parameters, which `replace`, maps and derivatives know by name.

        **Arguments:**

        - `matrices_of`: a function of the parameters by name that returns (mass, damping, stiffness, load direction),
          written with `jax.numpy`.
        - `parameters`: their values by name.
        - `tangential`, `normal`, `contacts`, `coordinates`: as for `Structure`.
        - `dampers`: names of the dampers: the damping matrix is a sum of parts, each proportional to one of these parameters.
          The energy ledger then has a line for each.
        - `builder`: the function of the parameters by name that calls this one. `replace` calls it again, with its own checks.

        **Raises:** `TypeError` for a function that needs its parameters' numbers, and what `Structure` raises for the matrices
        at these values.
        """
        if not callable(matrices_of):
            raise TypeError(
                f"Argument `matrices_of` must be a function of the parameters, but is {arguments.describe(matrices_of)}."
            )
        arguments.instance("parameters", parameters, Mapping, 'a dictionary of numbers, such as {"k1": 1e5}')
        if not parameters:
            raise ValueError("Argument `parameters` must hold at least one. Give matrices without any to `Structure`.")
        for name, value in parameters.items():
            check_name(name)
            arguments.real_number(name, value)
        numbers = {name: real(value) for name, value in parameters.items()}
        dampers = arguments.listed_names("dampers", dampers, "c1")
        unknown = [name for name in dampers if name not in numbers]
        if unknown:
            raise ValueError(
                f"Argument `dampers` must name parameters, but has {unknown[0]!r}.{arguments.did_you_mean(unknown[0], numbers)}"
            )
        source = FromParameters(numbers, tuple(numbers), first_like(matrices_of), dampers, builder)
        try:
            matrices = source.matrices
        except arguments.NEEDS_NUMBERS as error:
            raise TypeError(
                "Argument `matrices_of` must work out by `jax.numpy` what depends on its parameters, as maps and derivatives "
                "over them demand. NumPy, `math` and `if` need the numbers; `jnp.array`, `jnp.sqrt` and `jnp.where` do not."
            ) from error
        checked = cls(*matrices, tangential, normal, contacts=contacts, coordinates=coordinates)
        if builder is not None:
            remember(builder, None, builder)
        else:
            settings = {"contacts": checked.contacts, "coordinates": checked.coordinates, "dampers": dampers}
            maker = functools.partial(cls.from_parameters, matrices_of, **settings)
            remember(matrices_of, (checked.places, checked.coordinates, dampers), lambda **values: maker(values))
        return eqx.tree_at(lambda s: s.source, checked, source)

    @property
    def contacts(self) -> tuple[ContactPoint, ...]:
        """The contacts, in order."""

        def direction(place: Place) -> int | np.ndarray:
            return np.array(place) if isinstance(place, tuple) else place

        return tuple(ContactPoint(direction(tangential), direction(normal)) for tangential, normal in self.places)

    @property
    def contacts_at_coordinates(self) -> bool:
        """Whether all contacts' directions are coordinates."""
        return all(isinstance(place, int) for pair in self.places for place in pair)

    @property
    def tangential_directions(self) -> Float[np.ndarray, "n c"]:
        """$W_t$: the tangential directions of the contacts as columns, without unit."""
        return directions(self.contacts, self.size)[0]

    @property
    def normal_directions(self) -> Float[np.ndarray, "n c"]:
        """$W_n$: the normal directions of the contacts as columns, without unit."""
        return directions(self.contacts, self.size)[1]

    @property
    def tangential(self) -> int:
        """Index of the coordinate along the belt, of a structure with one contact.

        **Raises:** `ValueError` for several contacts, or for one whose directions are no coordinates.
        """
        return self._only_contact()[0]

    @property
    def normal(self) -> int:
        """Index of the gap, of a structure with one contact.

        **Raises:** `ValueError` for several contacts, or for one whose directions are no coordinates.
        """
        return self._only_contact()[1]

    def _only_contact(self) -> tuple[int, int]:
        if len(self.places) != 1:
            raise ValueError(
                f"This needs a structure with one contact, but this one has {len(self.places)}. Several contacts are taken "
                f"by `simulate` and by what is said to take them."
            )
        tangential, normal = self.places[0]
        if not isinstance(tangential, int) or not isinstance(normal, int):
            raise ValueError(
                "This needs a contact whose directions are coordinates, but this one's are vectors. Give the structure as "
                "`fivjax.in_contact_coordinates(structure)`."
            )
        return tangential, normal

    @property
    def matrices(self) -> Matrices:
        """Mass, damping, stiffness and load direction at once, worked out together."""
        return self.source.matrices if isinstance(self.source, FromParameters) else self.source

    @property
    def parameters(self) -> dict[str, Float[Array, "..."]]:
        """The parameters that the matrices follow from, by name; none where they were given."""
        return self.source.parameters if isinstance(self.source, FromParameters) else {}

    @property
    def builder(self) -> "Callable[..., Structure] | None":
        """The function that made the structure from its parameters, if `from_parameters` was given one."""
        return self.source.builder if isinstance(self.source, FromParameters) else None

    @property
    def mass(self) -> Float[Array, "n n"]:
        """In kg."""
        return self.matrices.mass

    @property
    def damping(self) -> Float[Array, "n n"]:
        """In N·s/m."""
        return self.matrices.damping

    @property
    def stiffness(self) -> Float[Array, "n n"]:
        """In N/m."""
        return self.matrices.stiffness

    @property
    def load_direction(self) -> Float[Array, " n"]:
        """The coordinates' share of a positive load, without unit."""
        return self.matrices.load_direction

    @property
    def damping_parts(self) -> dict[str, Float[Array, "n n"]]:
        """The part of the damping matrix of each damper, in N·s/m; empty where the structure was given as matrices."""
        return self.source.damping_parts if isinstance(self.source, FromParameters) else {}

    @property
    def size(self) -> int:
        """Number of degrees of freedom of the free structure."""
        return len(self.coordinates)

    @property
    @in_double_precision
    def weights(self) -> Float[Array, " state"]:
        """Factors that make squares of displacements and velocities comparable, as energies: square roots of the diagonals
        of stiffness and mass.
        """
        matrices = self.matrices
        return _weights(matrices.stiffness, matrices.mass)

    def __repr__(self) -> str:
        if self.builder is not None:
            return as_call(getattr(self.builder, "__name__", "Structure"), self.parameters)
        single = len(self.places) == 1 and self.contacts_at_coordinates
        places = {"tangential": self.tangential, "normal": self.normal} if single else {"contacts": list(self.contacts)}
        own = {**self.matrices._asdict(), **places}
        return as_call("Structure", own)

    def as_matrices(self) -> "Structure":
        """The same structure given as matrices: its parameters are forgotten, and its matrices are not worked out again.

        For code that reads them in a loop, or that changes one of them with `eqx.tree_at`.
        """
        return eqx.tree_at(lambda s: s.source, self, self.matrices)

    def replace(self, **changes) -> "Structure":
        """The structure rebuilt with other values of the parameters that made it: `structure.replace(k1=90e3)`.

        **Raises:** `ValueError` for a name that is not among `structure.parameters`, and what its builder refuses.
        """
        if not changes:
            return self
        unknown = sorted(set(changes) - set(self.parameters))
        if unknown:
            known = ", ".join(self.parameters) or "none (it was given as matrices)"
            near = arguments.did_you_mean(unknown[0], self.parameters)
            raise ValueError(f"Structure has no parameter `{unknown[0]}`; it has: {known}.{near}")
        parameters, source = {**self.parameters, **changes}, self.source
        if source.builder is not None:
            return source.builder(**parameters)
        return Structure.from_parameters(
            source.matrices_of,
            parameters,
            contacts=self.contacts,
            coordinates=self.coordinates,
            dampers=source.dampers,
        )


@by_numpy
def _weights(stiffness: Float[Array, "n n"], mass: Float[Array, "n n"]) -> Float[Array, " state"]:
    return jnp.sqrt(jnp.concatenate([jnp.diag(stiffness), jnp.diag(mass)]))
