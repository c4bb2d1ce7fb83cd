r"""The contact forces of a mode, as a linear function of the accelerations that the contacts would have without them.

For one contact the forces are written out. For several, the demands of all contacts are one linear
system: with the Delassus matrix G and the contact forces λ, the row of a contact's T says $(G λ)_t = -a_t$ (stick),
$T - σ μ N = 0$ (slide) or $T = 0$ (detach); that of its N says $(G λ)_n = -a_n$ (stick, slide) or $N = 0$ (detach). Its inverse
is worked out once for the whole time that a mode lasts.
"""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from ..foundation.linear_solve import inverse
from .mechanics import Mechanics
from .mode import Contact, Status

# One value, or with several contacts one for each.
Each = Float[Array, "*contacts"]


class ModeForces(eqx.Module):
    """How the contact forces of one mode follow from the free accelerations."""

    contact: Contact
    signed_friction: Float[Array, "*contacts"]  # σμ
    of_one: "_OneContact | None"
    # Of the linear system of several contacts: from its right-hand sides to (T, N).
    inverse: Float[Array, "k k"] | None

    def __init__(self, mechanics: Mechanics, contact: Contact, mu: Float[Array, "*contacts"]):
        self.contact = contact
        self.signed_friction = contact.direction * mu
        self.of_one = self.inverse = None
        if mechanics.several:
            sticking, closed = contact.status == Status.STICK, contact.status != Status.DETACH
            self.inverse = inverse(mode_matrix(mechanics.compliance, sticking, closed, self.signed_friction))
        else:
            self.of_one = _OneContact(mechanics, contact, mu)

    def added(
        self, mechanics: Mechanics, free: Float[Array, " n"], other_friction: Each | None = None
    ) -> tuple[Each, Each]:
        """(T, N) in N that the mode adds to those at `mechanics.rest`.

        `other_friction` is a part of the friction force of a sliding contact besides σμN, in N.
        """
        if mechanics.rest is not None:
            # The change of friction at the normal force of rest: exactly zero where friction is constant.
            more = (self.signed_friction - mechanics.rest.friction) * mechanics.rest.normal_force
            other_friction = more if other_friction is None else other_friction + more
        if self.inverse is not None:
            return self._of_several(self.inverse, mechanics, free, other_friction)
        assert self.of_one is not None
        status = self.contact.status
        tangential_force, normal_force = self.of_one.forces(
            mechanics, free, None if other_friction is None else jnp.where(status == Status.SLIDE, other_friction, 0.0)
        )
        if mechanics.rest is None:
            return tangential_force, normal_force
        return (
            jnp.where(status == Status.DETACH, -mechanics.rest.tangential_force, tangential_force),
            jnp.where(status == Status.DETACH, -mechanics.rest.normal_force, normal_force),
        )

    def _of_several(
        self, inverse_matrix, mechanics: Mechanics, free, other_friction
    ) -> tuple[Float[Array, " c"], Float[Array, " c"]]:
        status, rest = self.contact.status, mechanics.rest
        open_t, open_n = (0.0, 0.0) if rest is None else (-rest.tangential_force, -rest.normal_force)
        slides = jnp.zeros_like(self.signed_friction) if other_friction is None else other_friction
        right_t = by_status(self.contact, stick=-free[mechanics.tangential], slide=slides, detach=open_t)
        right_n = jnp.where(status == Status.DETACH, open_n, -free[mechanics.normal])
        forces = inverse_matrix @ jnp.concatenate([right_t, right_n])
        return forces[: len(status)], forces[len(status) :]


def mode_matrix(
    compliance: tuple[Float[Array, "c c"], ...],
    sticking: Bool[Array, " c"],
    closed: Bool[Array, " c"],
    signed_friction: Float[Array, " c"],
) -> Float[Array, "k k"]:
    """The matrix of the system for the forces of several contacts; rows and columns are all T, then all N."""
    g_tt, g_tn, g_nn = compliance
    one = jnp.eye(sticking.shape[0], dtype=g_tt.dtype)
    slides = jnp.where(closed & ~sticking, -signed_friction, 0.0)
    stuck, touching = sticking[:, None], closed[:, None]
    return jnp.concatenate(
        [
            jnp.concatenate([jnp.where(stuck, g_tt, one), jnp.where(stuck, g_tn, one * slides)], axis=1),
            jnp.concatenate([jnp.where(touching, g_tn.T, 0.0), jnp.where(touching, g_nn, one)], axis=1),
        ]
    )


class _OneContact(eqx.Module):
    """How the forces of a single contact follow from its free accelerations $a_t$ and $a_n$: $N$ is a sum over both, and $T$
    one over both and $N$. Divisions by compliances are done once.
    """

    normal: tuple[Float[Array, ""], Float[Array, ""]]  # kg
    tangential: tuple[Float[Array, ""], Float[Array, ""]]  # kg
    signed_friction: Float[Array, ""]  # σμ while it slides

    def __init__(self, mechanics: Mechanics, contact: Contact, mu: Float[Array, ""]):
        g_tt, g_tn, g_nn = mechanics.compliance
        sticks, slides, none = contact.status == Status.STICK, contact.status == Status.SLIDE, jnp.zeros_like(mu)
        stick = jnp.where(sticks, 1.0 / (g_tt * g_nn - g_tn**2), 0.0)
        slide = jnp.where(slides, 1.0 / mechanics.normal_compliance(contact.direction, mu), 0.0)
        self.normal = g_tn * stick, -g_tt * stick - slide
        self.tangential = -g_nn * stick, g_tn * stick
        self.signed_friction = jnp.where(slides, contact.direction * mu, none)

    def forces(self, mechanics: Mechanics, free: Float[Array, " n"], other_friction: Float[Array, ""] | None):
        free_t, free_n = free[mechanics.tangential], free[mechanics.normal]
        if other_friction is not None:
            _, g_tn, _ = mechanics.compliance
            free_n = free_n + g_tn * other_friction
        normal_force = self.normal[0] * free_t + self.normal[1] * free_n
        tangential_force = (
            self.tangential[0] * free_t + self.tangential[1] * free_n + self.signed_friction * normal_force
        )
        return (tangential_force if other_friction is None else tangential_force + other_friction), normal_force


def sticking_forces(mechanics: Mechanics, free: Float[Array, " n"]) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """(T, N) in N, added to those at rest, that make a single contact stick."""
    return holding_forces(mechanics, free[mechanics.tangential], free[mechanics.normal])


def holding_forces(mechanics: Mechanics, along, apart) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """(T, N) that make up for these accelerations of a single contact; or the impulses, for changes of its velocity."""
    g_tt, g_tn, g_nn = mechanics.compliance
    determinant = g_tt * g_nn - g_tn**2
    return (g_tn * apart - g_nn * along) / determinant, (g_tn * along - g_tt * apart) / determinant


def by_status(contact: Contact, *, stick, slide, detach):
    """The one of three values that belongs to the contact's status; the values may have one axis more than the status."""
    status = contact.status
    if max(jnp.ndim(value) for value in (stick, slide, detach)) > status.ndim:
        status = status[..., None]
    return jnp.where(status == Status.STICK, stick, jnp.where(status == Status.SLIDE, slide, detach))
