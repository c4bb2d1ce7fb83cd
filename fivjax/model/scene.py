"""A scene: a structure pressed onto a moving belt, with a friction law and a load."""

import dataclasses
import itertools
from collections.abc import Mapping, Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..foundation import arguments
from ..foundation.digits import apart
from ..foundation.linear_solve import solve
from ..foundation.numpy_evaluation import by_numpy
from ..foundation.precision import (
    in_double_precision,
    is_known,
    real,
    real_if_real,
    returning_numpy,
    state_for_pickle,
    state_from_pickle,
)
from . import description
from .contact_coordinates import in_contact_coordinates, transformation
from .delassus_matrix import delassus, has_one_solution
from .friction import AbstractFriction, numeric_fields, rebuilt
from .friction_per_contact import FrictionPerContact
from .load import AbstractLoad, ConstantLoad
from .printing import as_call
from .sliding import contact_coordinates, sliding_coordinates, sliding_load, sliding_matrices
from .structure import Structure

IMPACT_LAWS = ("coulomb", "frictionless", "reset")


class Scene(eqx.Module):
    """What is simulated.

    **Arguments:**

    - `structure`: a `Structure`, for instance from `belt_oscillator()`.
    - `friction`: `Coulomb`, `ExponentialDecay` or a law of your own; for several contacts, one law for all or a list of laws.
    - `belt_speed`: in m/s; sliding equilibrium needs one that is not zero. One number, or one for each contact.
    - `load`: `ConstantLoad`, `Pulse` or a load of your own; `ConstantLoad()` unless given.
    - `restitution`: Newton's coefficient for the closing gap, 0 (inelastic) to 1. One number, or one for each contact.
    - `impact_law`: what happens where the gap closes: "coulomb" (an impulse with Coulomb friction), "frictionless" (an impulse
      along the normal alone) or "reset" (of the velocities in `in_contact_coordinates`, the gap's alone changes: it
      reverses, times `restitution`).

    **Raises:** `TypeError` or `ValueError`, as a sentence, for parts of the wrong kind or values out of range.

    **Example:**

        >>> scene = fj.Scene(fj.belt_oscillator(), fj.Coulomb(mu=0.227), belt_speed=3.0, load=fj.Pulse(force=100.0, p=1.2))
        >>> float(scene.replace(mu=0.2, k1=98e3).parameters["mu"])
        0.2
    """

    __getstate__, __setstate__ = state_for_pickle, state_from_pickle

    structure: Structure
    friction: AbstractFriction
    belt_speed: Float[Array, "*contacts"]
    load: AbstractLoad
    restitution: Float[Array, "*contacts"]
    impact_law: str = eqx.field(static=True)

    @in_double_precision
    def __init__(
        self,
        structure: Structure,
        friction: AbstractFriction | Sequence[AbstractFriction],
        belt_speed=3.0,
        load: AbstractLoad | None = None,
        restitution=0.0,
        impact_law: str = "coulomb",
    ):
        load = ConstantLoad() if load is None else load
        arguments.instance("structure", structure, Structure, "a Structure, such as belt_oscillator()")
        count = len(structure.contacts)
        if isinstance(friction, list | tuple):
            friction = FrictionPerContact(friction)
        arguments.instance("friction", friction, AbstractFriction, "a friction law, such as Coulomb(mu=0.2)")
        if isinstance(friction, FrictionPerContact) and len(friction.laws) != count:
            raise ValueError(
                f"Argument `friction` must be one law, or one for each of the {count} contacts, but holds {len(friction.laws)}."
            )
        if isinstance(friction, FrictionPerContact) and count == 1:
            (friction,) = friction.laws
        arguments.instance("load", load, AbstractLoad, "a load, such as Pulse(force=100.0, p=1.2)")
        belt_speed = arguments.each_number("belt_speed", belt_speed, count)
        restitution = arguments.each_number("restitution", restitution, count, minimum=0, maximum=1)
        arguments.one_of("impact_law", impact_law, IMPACT_LAWS)
        _refuse_other_than_numbers("friction law", friction)
        _refuse_other_than_numbers("load", load)
        # Numbers of a law or a load of the user's own may have come in single precision, or as Python's.
        friction = jax.tree.map(real_if_real, friction)
        own_load: AbstractLoad = jax.tree.map(real_if_real, load)
        friction.check(belt_speed)
        if count > 1 and not isinstance(friction, FrictionPerContact):
            friction.check_for_several(count)
        own_load.check()
        self.structure = structure
        self.friction = friction
        self.belt_speed = real(belt_speed)
        self.load = own_load
        self.restitution = real(restitution)
        self.impact_law = str(impact_law)  # NumPy's text, too
        whose: dict[str, str] = {}
        for part, parameters in self._parameters_of_parts().items():
            for name in parameters:
                if name in whose:
                    raise ValueError(
                        f"Parameter `{name}` of the {part} has the name of one of the {whose[name]}, so `replace` and the axes "
                        f"of maps could not tell them apart. Give it another name."
                    )
                whose[name] = part

    @property
    def parameters(self) -> dict[str, Array]:
        """Every numeric parameter by the name that `replace` and the axes of a map know it by."""
        return {name: value for own in self._parameters_of_parts().values() for name, value in own.items()}

    def parameters_of(self, part: str) -> dict[str, Array]:
        """Those of a part: "scene", "friction law", "load" or "structure"."""
        arguments.one_of("part", part, parts := self._parameters_of_parts())
        return parts[part]

    def _parameters_of_parts(self) -> dict[str, dict[str, Array]]:
        friction, load = map(numeric_fields, (self.friction, self.load))
        if isinstance(self.friction, FrictionPerContact):
            friction = {**self.friction.parameters, **friction}
        own = {"belt_speed": self.belt_speed, "restitution": self.restitution}
        return {"scene": own, "friction law": friction, "load": load, "structure": self.structure.parameters}

    @in_double_precision
    def replace(self, **changes) -> "Scene":
        """The scene with other values of some parameters: `scene.replace(mu=0.2, p=1.3, k1=90e3)`.

        **Raises:** `ValueError` for a name that is not among `scene.parameters`, and whatever the part's own
        constructor refuses.
        """
        unknown = [name for name in changes if name not in self.parameters]
        if unknown:
            hint = arguments.did_you_mean(unknown[0], self.parameters)
            if unknown[0] in ("structure", "friction", "load", "impact_law"):
                hint = f" For another `{unknown[0]}` make a new `fj.Scene` from the parts of this one."
            raise ValueError(
                f"Scene has no parameter `{unknown[0]}`; it has: {', '.join(sorted(self.parameters))}.{hint}"
            )

        def rebuild(part):
            if isinstance(part, FrictionPerContact):
                return part.replace(**changes)
            return rebuilt(part, changes) if numeric_fields(part).keys() & changes.keys() else part

        of_structure = {name: changes[name] for name in self.structure.parameters if name in changes}
        return Scene(
            structure=self.structure.replace(**of_structure) if of_structure else self.structure,
            friction=rebuild(self.friction),
            belt_speed=changes.get("belt_speed", self.belt_speed),
            load=rebuild(self.load),
            restitution=changes.get("restitution", self.restitution),
            impact_law=self.impact_law,
        )

    @classmethod
    def from_dataset(cls, dataset) -> "Scene":
        """The scene that a dataset of fivjax's came from: a map, a saved trajectory, modes, …

            scene = fj.Scene.from_dataset(fj.open("map.nc"))

        Friction laws and loads of your own must be defined or imported first. A structure that a function of your own made
        comes back with its parameters where that function has made one in this process before; else as its matrices.

        **Raises:** `ValueError` for a dataset without a scene in its attributes, with a damaged one, or with parts of unknown
        classes.
        """
        found = description.description_in(dataset)
        try:
            return cls(**description.arguments_of_scene(found))
        except ValueError:
            raise
        except Exception as error:  # of many kinds: anything can stand in the attributes of a file of others
            said = f"{type(error).__name__}: {str(error)[:200]}".rstrip(".: ")
            raise ValueError(
                f"The scene in the attributes of argument `dataset` is damaged ({said}). Save it again."
            ) from None

    def __repr__(self) -> str:
        return as_call("Scene", {field.name: getattr(self, field.name) for field in dataclasses.fields(self)})

    def _repr_html_(self) -> str:
        return description.as_table(self)


def check_corners(scene: Scene, axes: Mapping[str, np.ndarray]) -> None:
    """Check that a scene may have all values of these rising axes of parameters.

    Rules on parameters are bounds, or an order between two of them, so they hold in the grid where they hold at all corners;
    those that a structure of one's own has besides are looked at there only.

    **Raises:** whatever `Scene.replace` refuses.
    """
    for corner in itertools.product(*((values[0], values[-1]) for values in axes.values())):
        scene.replace(**dict(zip(axes, corner, strict=True)))


def scene_in_contact_coordinates(scene: Scene) -> Scene:
    """The same scene with the directions of all contacts as coordinates; itself, where they are coordinates already."""
    structure = in_contact_coordinates(scene.structure)
    return scene if structure is scene.structure else dataclasses.replace(scene, structure=structure)


def _refuse_other_than_numbers(what: str, part: eqx.Module) -> None:
    """Numbers are parameters, which JAX transforms; all else must be fixed."""
    for leaf in jax.tree.leaves(part):
        if not isinstance(leaf, bool | int | float | complex) and not hasattr(leaf, "dtype"):
            raise TypeError(
                f"The {what} `{type(part).__name__}` must have numbers in its fields, but has a {type(leaf).__name__}. Fix "
                "that field by `eqx.field(static=True)`; of a network, take numbers and functions apart by `eqx.partition(net, "
                "eqx.is_array)`."
            )


@returning_numpy
def sliding_equilibrium(scene: Scene) -> Float[Array, " n"]:
    r"""Displacements of steady sliding, $K^{-1}F$ of Eq. 3, under the load before any jump, in m.

    **Raises:** `ValueError` where there is no such state: a belt at rest, a singular sliding stiffness, or a normal
    force that would have to pull.

    **Example:**

        >>> fj.sliding_equilibrium(scene).round(6)  # x2, y1 and y2, which is closed
        array([ 0.000217, -0.000988,  0.      ])
    """
    arguments.instance("scene", scene, Scene, "a Scene")
    refuse_belt_at_rest(scene)
    q, normal_force = _steady_sliding(scene, scene.load.force)
    if is_known(q):
        normal_force = np.asarray(normal_force)
        if not np.all(np.isfinite(np.asarray(q))):
            raise ValueError(
                "There is no sliding equilibrium: the sliding stiffness matrix is singular at this friction. Change "
                "the friction or the springs, or give `y0` to start elsewhere."
            )
        if np.any(normal_force < 0):
            raise ValueError(
                f"There is no sliding equilibrium: the belt would have to pull with {-float(np.min(normal_force)):.3g} N. "
                f"Change the load, its direction or the friction."
            )
    return q


def refuse_belt_at_rest(scene: Scene) -> None:
    """Refuse a belt that is known to be at rest."""
    if is_known(scene.belt_speed) and np.any(np.asarray(scene.belt_speed) == 0):
        raise ValueError(
            "Argument `belt_speed` must not be zero for steady sliding. Let the belt move, or give an initial state `y0` to "
            "`simulate`."
        )


def steady_sliding(scene: Scene, force: Float[Array, ""]) -> tuple[Float[Array, " n"], Float[Array, "*contacts"]]:
    """Displacements (m) and normal force (N) of steady sliding under a load (N), unchecked: not finite where there is no such
    state.
    """
    if not scene.structure.contacts_at_coordinates:
        z, normal_force = steady_sliding(scene_in_contact_coordinates(scene), force)
        return jnp.asarray(transformation(scene.structure)[0]) @ z, normal_force
    structure = scene.structure
    friction = sliding_friction(scene)
    _, _, stiffness = sliding_matrices(structure, friction)
    load = sliding_load(structure, friction)
    reduced = solve(stiffness, load * force)
    # Where the stiffness is singular but for rounding, the displacements are so large that their rounding outweighs the load.
    rounding = jnp.finfo(reduced.dtype).eps * jnp.max(jnp.abs(stiffness) @ jnp.abs(reduced))
    reduced = jnp.where(rounding > 1e-3 * jnp.max(jnp.abs(load * force)), jnp.nan, reduced)
    _, normal = contact_coordinates(structure)
    if isinstance(normal, np.ndarray):
        q = jnp.zeros(structure.size, reduced.dtype).at[sliding_coordinates(structure.size, normal)].set(reduced)
    else:
        q = jnp.concatenate([reduced[:normal], jnp.zeros(1, reduced.dtype), reduced[normal:]])
    matrices = structure.matrices
    normal_force = matrices.stiffness[normal] @ q
    normal_force = normal_force - matrices.load_direction[normal] * force
    return q, normal_force


def steady_slip_speeds(scene: Scene) -> Float[Array, "*contacts"]:
    """The slip speed of steady sliding, in m/s; one for each of several contacts."""
    speed, count = jnp.abs(scene.belt_speed), len(scene.structure.contacts)
    return speed if count == 1 else jnp.broadcast_to(speed, count)


def sliding_friction(scene: Scene) -> Float[Array, "*contacts"]:
    """σμ of steady sliding: the coefficient with the sign of the belt's direction; one for each of several contacts."""
    return jnp.sign(scene.belt_speed) * scene.friction(steady_slip_speeds(scene))


@by_numpy
def _steady_sliding(scene: Scene, force: Float[Array, ""]) -> tuple[Float[Array, " n"], Float[Array, "*contacts"]]:
    return steady_sliding(scene, force)


@by_numpy
def _largest_friction(scene: Scene) -> Float[Array, "*contacts"]:
    """The largest friction at slip speeds up to that of steady sliding."""
    return scene.friction.largest(steady_slip_speeds(scene))


@returning_numpy
def painleve_friction(structure: Structure) -> Float[Array, ""]:
    r"""The friction beyond which the contact problem has no unique solution, $G_{nn} / |G_{nt}|$, without unit.

    For the belt oscillator this is $(m_2 + m_1 \cos^2θ)/(m_1 \sinθ \cosθ)$: 108.49 at θ = 0.01. Infinite where the
    mass matrix does not couple the two contact coordinates.

    **Raises:** `ValueError` for several contacts.

    **Example:**

        >>> round(float(fj.painleve_friction(structure)), 2)
        108.49
    """
    return _painleve_friction(in_contact_coordinates(structure))


@by_numpy
def _painleve_friction(structure: Structure):
    columns = jnp.eye(structure.size)[:, jnp.array([structure.tangential, structure.normal])]
    compliance = columns.T @ solve(structure.mass, columns)
    coupling = jnp.abs(compliance[0, 1])
    # A change of coordinates leaves rounding.
    least = 64 * jnp.finfo(coupling.dtype).eps * jnp.sqrt(compliance[0, 0] * compliance[1, 1])
    return jnp.where(coupling <= least, jnp.inf, compliance[1, 1] / jnp.where(coupling <= least, 1.0, coupling))


def refuse_several_contacts(structure: Structure, who: str, instead: str) -> None:
    """Refuse anything but one contact at two coordinates; `who`, the function that needs this, is named in the error, and what
    there is `instead`.
    """
    if len(structure.contacts) > 1:
        raise ValueError(
            f"{who} takes structures with one contact, but this one has {len(structure.contacts)}. {instead}"
        )
    refuse_vector_contacts(structure, who)


def refuse_vector_contacts(structure: Structure, who: str) -> None:
    """Refuse contacts that are not at coordinates; `who`, the function that needs this, is named in the error."""
    if not structure.contacts_at_coordinates:
        raise ValueError(
            f"{who} takes contacts whose directions are coordinates, but some of these are vectors. Give the structure as "
            f"`fivjax.in_contact_coordinates(structure)`."
        )


def refuse_painleve(scene: Scene) -> None:
    """Refuse friction at which the contact problem has no unique solution, where its value is known."""
    # Every motion that slides or comes to rest passes through these slip speeds.
    largest = _largest_friction(scene)
    if is_known(largest) and len(scene.structure.contacts) > 1:
        g = delassus(scene.structure)
        coefficients = np.broadcast_to(np.asarray(largest), len(scene.structure.contacts))
        if all(map(is_known, g)) and not has_one_solution(g, coefficients):
            raise ValueError(
                f"The contact problem has no unique solution at friction {np.asarray(largest).tolist()}: the normal forces of "
                f"sliding contacts follow from a matrix that is not a P-matrix (Painlevé's paradox). Lower the friction or "
                f"the coupling in the mass matrix."
            )
        return
    if is_known(largest):
        limit = painleve_friction(scene.structure)
        if is_known(limit) and float(largest) >= limit:
            friction, limit = apart(largest, limit, digits=4)
            raise ValueError(
                f"The contact problem has no unique solution at friction {friction}: Painlevé's limit of this "
                f"structure is {limit}. Lower the friction or the coupling in the mass matrix."
            )
