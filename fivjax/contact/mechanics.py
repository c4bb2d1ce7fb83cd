"""A scene in the form that accelerations need, as totals or as deviations from steady sliding."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..model.friction import AbstractFriction
from ..model.scene import Scene
from ..model.springs import Springs
from ..model.structure import Structure


class Rest(eqx.Module):
    """A state of steady sliding, as the forces that hold it; displacements and loads may be measured from there."""

    load: Float[Array, ""]  # N
    tangential_force: Float[Array, ""]  # N
    normal_force: Float[Array, ""]  # N
    friction: Float[Array, ""]  # σμ, the ratio of the two

    def __init__(self, scene: Scene, load: Float[Array, ""], normal_force: Float[Array, ""]):
        """Of a scene that presses with `normal_force` under `load`, see `scene.steady_sliding`."""
        self.load = load
        self.friction = jnp.sign(scene.belt_speed) * scene.friction(jnp.abs(scene.belt_speed))
        self.tangential_force = self.friction * normal_force
        self.normal_force = normal_force


class Mechanics(eqx.Module):
    """A scene in the form that accelerations need: everything divided by the mass matrix, once."""

    free_position: Float[Array, "n n"]  # -M⁻¹K, 1/s²
    free_velocity: Float[Array, "n n"]  # -M⁻¹C, 1/s
    free_load: Float[Array, " n"]  # M⁻¹f, 1/kg
    from_tangential: Float[Array, " n"]  # M⁻¹e_t, 1/kg
    from_normal: Float[Array, " n"]  # M⁻¹e_n, 1/kg
    friction: AbstractFriction
    belt_speed: Float[Array, ""]
    restitution: Float[Array, ""]
    impact_law: str = eqx.field(static=True)
    tangential: int = eqx.field(static=True)
    normal: int = eqx.field(static=True)
    # See `about`; none: states are totals.
    rest: Rest | None = None
    springs: Springs | None = None
    from_springs: Float[Array, "n n"] | None = None  # -M⁻¹Bᵀk, 1/s²

    def __init__(self, scene: Scene):
        structure, matrices = scene.structure, scene.structure.matrices
        n = structure.size
        forces = jnp.zeros((n, 2), matrices.mass.dtype)
        forces = forces.at[structure.tangential, 0].set(1.0).at[structure.normal, 1].set(1.0)
        right = jnp.concatenate(
            [-matrices.stiffness, -matrices.damping, matrices.load_direction[:, None], forces], axis=1
        )
        solved = jnp.linalg.solve(matrices.mass, right)
        self.free_position = solved[:, :n]
        self.free_velocity = solved[:, n : 2 * n]
        self.free_load = solved[:, 2 * n]
        self.from_tangential = solved[:, 2 * n + 1]
        self.from_normal = solved[:, 2 * n + 2]
        self.friction = scene.friction
        self.belt_speed = scene.belt_speed
        self.restitution = scene.restitution
        self.impact_law = scene.impact_law
        self.tangential = structure.tangential
        self.normal = structure.normal
        self.rest = self.springs = self.from_springs = None

    def about(self, rest: Rest, structure: Structure) -> "Mechanics":
        """The same mechanics for displacements and loads measured from a rest; velocities stay what they are.

        Forces are then as exact as a small deviation can tell them, those of the springs included: of a rigid motion,
        however far it goes, there are none.
        """
        matrices = structure.matrices
        springs = Springs(matrices.stiffness)
        from_springs = -jnp.linalg.solve(matrices.mass, springs.stretch.T * springs.rates)
        return self._with_reference(rest, springs, from_springs)

    @property
    def of_totals(self) -> "Mechanics":
        """The same mechanics for displacements and loads as they are, whatever they were measured from."""
        return self._with_reference(None, None, None)

    @property
    def homogeneous(self) -> "Mechanics":
        """Without what does not change in time, belt and rest: under no load, the physics of derivatives."""
        still = eqx.tree_at(lambda m: m.belt_speed, self, jnp.zeros_like(self.belt_speed))
        return still._with_reference(None, self.springs, self.from_springs)

    def _with_reference(self, *changed) -> "Mechanics":
        return eqx.tree_at(
            lambda m: (m.rest, m.springs, m.from_springs), self, changed, is_leaf=lambda leaf: leaf is None
        )

    @property
    def compliance(self) -> tuple[Float[Array, ""], Float[Array, ""], Float[Array, ""]]:
        """G_tt, G_tn and G_nn, in 1/kg."""
        return (
            self.from_tangential[self.tangential],
            self.from_tangential[self.normal],
            self.from_normal[self.normal],
        )

    def normal_compliance(self, direction: Float[Array, ""], mu: Float[Array, ""]) -> Float[Array, ""]:
        """G_nn + σμ G_nt: how the gap accelerates under a normal force that drags friction along, in 1/kg.

        Where it is not positive the contact problem has no unique solution (Painlevé's paradox).
        """
        _, g_tn, g_nn = self.compliance
        return g_nn + direction * mu * g_tn
