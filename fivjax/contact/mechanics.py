"""A scene in the form that accelerations need, for total displacements or for deviations from steady sliding."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..foundation.linear_solve import solve
from ..model.friction import AbstractFriction
from ..model.friction_per_contact import FrictionPerContact
from ..model.scene import Scene, refuse_vector_contacts, sliding_friction
from ..model.springs import Springs
from ..model.structure import Structure


class Rest(eqx.Module):
    """The forces of a state of steady sliding, from which displacements and loads may be measured."""

    load: Float[Array, ""]  # N
    tangential_force: Float[Array, "*contacts"]  # N
    normal_force: Float[Array, "*contacts"]  # N
    friction: Float[Array, "*contacts"]  # σμ, the ratio of the two

    def __init__(self, scene: Scene, load: Float[Array, ""], normal_force: Float[Array, "*contacts"]):
        """The rest of a scene whose contacts press with `normal_force` (N) under `load` (N), from `steady_sliding`."""
        self.load = load
        self.friction = sliding_friction(scene)
        self.tangential_force = self.friction * normal_force
        self.normal_force = normal_force


class Mechanics(eqx.Module):
    """A scene in the form that accelerations need: everything divided by the mass matrix, once.

    With one contact, each of its quantities is a number. With several it is an array with a last axis over the contacts, and
    the compliances are matrices. `tangential` and `normal` index arrays over the coordinates in both cases.
    """

    free_position: Float[Array, "n n"]  # -M⁻¹K, 1/s²
    free_velocity: Float[Array, "n n"]  # -M⁻¹C, 1/s
    free_load: Float[Array, " n"]  # M⁻¹f, 1/kg
    from_tangential: Float[Array, "n *contacts"]  # M⁻¹W_t, 1/kg
    from_normal: Float[Array, "n *contacts"]  # M⁻¹W_n, 1/kg
    friction: AbstractFriction
    belt_speed: Float[Array, "*contacts"]
    restitution: Float[Array, "*contacts"]
    impact_law: str = eqx.field(static=True)
    places: tuple[tuple[int, int], ...] = eqx.field(static=True)  # of the contacts: tangential and normal coordinates
    # Set by `about`; without it, displacements and loads are totals.
    rest: Rest | None = None
    springs: Springs | None = None
    from_springs: Float[Array, "n n"] | None = None  # -M⁻¹Bᵀk, 1/s²

    def __init__(self, scene: Scene):
        structure, matrices = scene.structure, scene.structure.matrices
        n = structure.size
        refuse_vector_contacts(structure, "This")
        self.places = structure.places  # pyrefly: ignore[bad-assignment]
        columns = jnp.eye(n, dtype=matrices.mass.dtype)[
            :, np.array(self.places).T.ravel()
        ]  # tangential directions, then normal ones
        right = jnp.concatenate(
            [-matrices.stiffness, -matrices.damping, matrices.load_direction[:, None], columns], axis=1
        )
        solved = solve(matrices.mass, right)
        count = len(self.places)
        self.free_position = solved[:, :n]
        self.free_velocity = solved[:, n : 2 * n]
        self.free_load = solved[:, 2 * n]
        forces = solved[:, 2 * n + 1 :]
        if count == 1:
            self.from_tangential, self.from_normal = forces[:, 0], forces[:, 1]
            self.friction, self.belt_speed, self.restitution = scene.friction, scene.belt_speed, scene.restitution
        else:
            self.from_tangential, self.from_normal = forces[:, :count], forces[:, count:]
            law = scene.friction
            self.friction = law if isinstance(law, FrictionPerContact) else FrictionPerContact([law] * count)
            self.belt_speed = jnp.broadcast_to(scene.belt_speed, count)
            self.restitution = jnp.broadcast_to(scene.restitution, count)
        self.impact_law = scene.impact_law
        self.rest = self.springs = self.from_springs = None

    @property
    def several(self) -> bool:
        """Whether there are several contacts."""
        return len(self.places) > 1

    @property
    def tangential(self) -> int | np.ndarray:
        """The coordinate along the belt; with several contacts, an array of them."""
        return self._coordinates(0)

    @property
    def normal(self) -> int | np.ndarray:
        """The coordinate of the gap; with several contacts, an array of them."""
        return self._coordinates(1)

    def _coordinates(self, kind: int) -> int | np.ndarray:
        return np.array([place[kind] for place in self.places]) if self.several else self.places[0][kind]

    def about(self, rest: Rest, structure: Structure) -> "Mechanics":
        """The same mechanics for displacements and loads measured from a rest; velocities stay totals.

        Forces then have the relative precision of the deviation. The springs' forces do as well: they are zero in a rigid
        motion, however far it goes.
        """
        matrices = structure.matrices
        springs = Springs(matrices.stiffness)
        from_springs = -solve(matrices.mass, springs.stretch.T * springs.rates)
        return self._with_reference(rest, springs, from_springs)

    @property
    def of_totals(self) -> "Mechanics":
        """The same mechanics for total displacements and loads."""
        return self._with_reference(None, None, None)

    @property
    def homogeneous(self) -> "Mechanics":
        """The same mechanics without belt speed and rest, the terms that are constant in time; without load, derivatives with
        respect to the state obey it.
        """
        still = eqx.tree_at(lambda m: m.belt_speed, self, jnp.zeros_like(self.belt_speed))
        return still._with_reference(None, self.springs, self.from_springs)

    def _with_reference(self, *changed) -> "Mechanics":
        return eqx.tree_at(
            lambda m: (m.rest, m.springs, m.from_springs), self, changed, is_leaf=lambda leaf: leaf is None
        )

    @property
    def compliance(self) -> tuple[Float[Array, "*c"], Float[Array, "*c"], Float[Array, "*c"]]:
        """G_tt, G_tn and G_nn, in 1/kg: the blocks of the Delassus matrix."""
        return (
            self.from_tangential[self.tangential],
            self.from_normal[self.tangential] if self.several else self.from_tangential[self.normal],
            self.from_normal[self.normal],
        )

    def normal_compliance(self, direction: Float[Array, ""], mu: Float[Array, ""]) -> Float[Array, ""]:
        """G_nn + σμ G_nt of one contact, in 1/kg: acceleration of the gap by a unit normal force with the friction it causes.

        Where it is not positive the contact problem has no unique solution (Painlevé's paradox).
        """
        _, g_tn, g_nn = self.compliance
        return g_nn + direction * mu * g_tn
