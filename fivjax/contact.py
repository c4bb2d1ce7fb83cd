r"""The one physics: accelerations, contact forces, what ends a status, and what follows.

A contact sticks (0), slides (1) or is detached (2). With the free acceleration $a^f = M^{-1}(fF - C\dot q - Kq)$ and the
contact's compliance $G = E^T M^{-1} E$, $E = [e_t, e_n]$, every status is the free structure plus contact forces
$a = a^f + M^{-1}(e_t T + e_n N)$ that keep what the status demands:

| status | demands | forces |
|---|---|---|
| stick | $a_t = a_n = 0$ | $(T, N) = -G^{-1} (a^f_t, a^f_n)$ |
| slide | $a_n = 0$, $T = \sigma \mu N$ | $N = -a^f_n / (G_{nn} + \sigma \mu G_{nt})$ |
| detach | | $T = N = 0$ |

with $\sigma = -\mathrm{sign}(\dot q_t - v_{belt})$. These are Eqs. 3, 6 and 5 of the paper, for any structure: the
projection of the symmetric free matrices replaces typing each set in.

A status lasts while its *guards* are positive: the two edges of the friction cone while sticking, N and the slip speed
while sliding, the gap while detached. When one is used up, `transition` puts the state on its constraint, applies the
impact law where the gap closed, and chooses the next status from the forces, never from which guard it was.

Where a high load stores much more energy than a small vibration moves, states as totals cannot hold the vibration: its
digits are lost in the rounding of what is at rest. `Mechanics.about` makes mechanics for displacements and loads that are
deviations from a `Rest` instead. The free acceleration is then that under the contact forces at rest, and
`sticking_forces`, `sliding_forces` and `forces_by_status` are what is *added* to those; `guards` and `contact_forces` are of
the total forces either way.

Everything here is about one contact at one instant; batches come from `jax.vmap`.
"""

import enum

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from .friction import AbstractFriction
from .scene import Scene
from .structure import Springs, Structure


class Status(enum.IntEnum):
    """The paper's codes."""

    STICK = 0
    SLIDE = 1
    DETACH = 2


class Contact(eqx.Module):
    """The discrete state of the contact: a `Status`, and the direction σ of the friction force while it slides."""

    status: Int[Array, ""]
    direction: Float[Array, ""]


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
        structure = scene.structure
        n = structure.size
        forces = jnp.zeros((n, 2), structure.mass.dtype)
        forces = forces.at[structure.tangential, 0].set(1.0).at[structure.normal, 1].set(1.0)
        right = jnp.concatenate(
            [-structure.stiffness, -structure.damping, structure.load_direction[:, None], forces], axis=1
        )
        solved = jnp.linalg.solve(structure.mass, right)
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
        springs = Springs(structure.stiffness)
        from_springs = -jnp.linalg.solve(structure.mass, springs.stretch.T * springs.rates)
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


State = Float[Array, " 2n"]  # displacements, then velocities


def relative_velocity(mechanics: Mechanics, y: State) -> Float[Array, ""]:
    """Tangential velocity of the structure relative to the belt, in m/s."""
    return y[_n(y) + mechanics.tangential] - mechanics.belt_speed


def slip_speed(mechanics: Mechanics, contact: Contact, y: State) -> Float[Array, ""]:
    """Slip against the friction force, in m/s; positive while the contact slides in the direction of its status."""
    return -contact.direction * relative_velocity(mechanics, y)


def gap(mechanics: Mechanics, y: State) -> Float[Array, ""]:
    """Distance from the belt, in m."""
    return y[mechanics.normal]


def free_acceleration(mechanics: Mechanics, load: Float[Array, ""], y: State) -> Float[Array, " n"]:
    """Accelerations without contact forces, or with those at `mechanics.rest`, in m/s²."""
    n = _n(y)
    # Sums over columns rather than matrix products: in a batch these become one fused loop over lanes.
    acceleration = mechanics.free_load * load
    position, displacement = mechanics.free_position, y[:n]
    if mechanics.springs is not None and mechanics.from_springs is not None:
        position, displacement = mechanics.from_springs, mechanics.springs.stretches(displacement)
    for j in range(n):
        acceleration = acceleration + position[:, j] * displacement[j] + mechanics.free_velocity[:, j] * y[n + j]
    return acceleration


def sticking_forces(mechanics: Mechanics, free: Float[Array, " n"]) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """(T, N) in N that hold the contact still, added to those at rest."""
    g_tt, g_tn, g_nn = mechanics.compliance
    free_t, free_n = free[mechanics.tangential], free[mechanics.normal]
    determinant = g_tt * g_nn - g_tn**2
    return (g_tn * free_n - g_nn * free_t) / determinant, (g_tn * free_t - g_tt * free_n) / determinant


def sliding_forces(
    mechanics: Mechanics, free: Float[Array, " n"], direction: Float[Array, ""], slip: Float[Array, ""]
) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """(T, N) in N while sliding, the friction force pointing in `direction`; added to those at rest."""
    mu = mechanics.friction(slip)
    if mechanics.rest is None:
        normal_force = -free[mechanics.normal] / mechanics.normal_compliance(direction, mu)
        return direction * mu * normal_force, normal_force
    _, g_tn, _ = mechanics.compliance
    # What friction pulls otherwise than at rest under the same pressing force: exactly zero where friction is constant.
    otherwise = (direction * mu - mechanics.rest.friction) * mechanics.rest.normal_force
    added = -(free[mechanics.normal] + g_tn * otherwise) / mechanics.normal_compliance(direction, mu)
    return direction * mu * added + otherwise, added


def total_forces(
    mechanics: Mechanics, tangential_force: Float[Array, ""], normal_force: Float[Array, ""]
) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """(T, N) in N from what is added to those at rest."""
    if mechanics.rest is None:
        return tangential_force, normal_force
    return tangential_force + mechanics.rest.tangential_force, normal_force + mechanics.rest.normal_force


def contact_forces(
    mechanics: Mechanics, contact: Contact, load: Float[Array, ""], y: State
) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """(T, N) in N in the given status; N is negative beyond the instant where contact is lost."""
    return total_forces(mechanics, *added_forces(mechanics, contact, load, y))


def added_forces(
    mechanics: Mechanics, contact: Contact, load: Float[Array, ""], y: State
) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """(T, N) in N in the given status, what is added to those at rest."""
    free = free_acceleration(mechanics, load, y)
    sliding = sliding_forces(mechanics, free, contact.direction, slip_speed(mechanics, contact, y))
    return forces_by_status(mechanics, contact, free, sliding)


def forces_by_status(
    mechanics: Mechanics,
    contact: Contact,
    free: Float[Array, " n"],
    sliding: tuple[Float[Array, ""], Float[Array, ""]],
) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """(T, N) in the given status from the free accelerations and the forces of sliding; added to those at rest."""
    stick_t, stick_n = sticking_forces(mechanics, free)
    slide_t, slide_n = sliding
    open_t = open_n = jnp.zeros_like(slide_n)
    if mechanics.rest is not None:
        open_t, open_n = -mechanics.rest.tangential_force, -mechanics.rest.normal_force
    return (
        _by_status(contact, stick=stick_t, slide=slide_t, detach=open_t),
        _by_status(contact, stick=stick_n, slide=slide_n, detach=open_n),
    )


def acceleration(mechanics: Mechanics, contact: Contact, load: Float[Array, ""], y: State) -> Float[Array, " n"]:
    """Accelerations in the given status, in m/s²; those that the status forbids are exactly zero."""
    free = free_acceleration(mechanics, load, y)
    return acceleration_under(mechanics, contact, free, *added_forces(mechanics, contact, load, y))


def acceleration_under(
    mechanics: Mechanics,
    contact: Contact,
    free: Float[Array, " n"],
    tangential_force: Float[Array, ""],
    normal_force: Float[Array, ""],
) -> Float[Array, " n"]:
    """Accelerations from the free ones and the contact forces added to those at rest, in m/s²."""
    total = free + mechanics.from_tangential * tangential_force + mechanics.from_normal * normal_force
    index = jnp.arange(free.shape[0])
    held = (index == mechanics.normal) & (contact.status != Status.DETACH)
    held = held | ((index == mechanics.tangential) & (contact.status == Status.STICK))
    return jnp.where(held, 0.0, total)


def guards(mechanics: Mechanics, contact: Contact, load: Float[Array, ""], y: State) -> Float[Array, "2"]:
    """What must stay positive for the status to last; N, or m/s and m where that is what counts.

    stick: distances of T from both edges of the friction cone; slide: N and the slip speed; detach: the gap, twice.
    """
    forces = added_forces(mechanics, contact, load, y)
    return guards_under(mechanics, contact, *forces, slip_speed(mechanics, contact, y), gap(mechanics, y))


def guards_under(
    mechanics: Mechanics,
    contact: Contact,
    tangential_force: Float[Array, ""],
    normal_force: Float[Array, ""],
    slip: Float[Array, ""],
    height: Float[Array, ""],
) -> Float[Array, "2"]:
    """`guards` from the contact forces added to those at rest, the slip speed and the gap; linear in all of them."""
    _, pressing = total_forces(mechanics, tangential_force, normal_force)
    return _by_status(
        contact,
        stick=cone_margins(mechanics, tangential_force, normal_force),
        slide=jnp.stack([pressing, slip]),
        detach=jnp.stack([height, height]),
    )


def cone_margins(
    mechanics: Mechanics, tangential_force: Float[Array, ""], normal_force: Float[Array, ""]
) -> Float[Array, "2"]:
    """Distances of T from both edges of the friction cone, in N, from the contact forces added to those at rest."""
    static = mechanics.friction.static
    edge = static * normal_force
    margins = jnp.stack([edge - tangential_force, edge + tangential_force])
    if mechanics.rest is None:
        return margins
    # Apart from what is added, and not as a difference of forces that are rounded: at rest one of them is exactly zero
    # unless static friction is larger.
    friction = mechanics.rest.friction
    return margins + jnp.stack([static - friction, static + friction]) * mechanics.rest.normal_force


def exactly_zero(contact: Contact) -> Bool[Array, "2"]:
    """Which guards are put at zero exactly where their status begins: slip and gap.

    If these are small, they are small, and not zero but for rounding: a slow belt under a high load has a slip that the
    motion outgrows a billionfold before it is used up.
    """
    sliding, detached = contact.status == Status.SLIDE, contact.status == Status.DETACH
    return jnp.stack([detached, sliding | detached])


def magnitudes(
    mechanics: Mechanics, contact: Contact, load: Float[Array, ""], y: State
) -> tuple[Float[Array, "2"], State]:
    """Sizes of the largest terms that the guards and the rates are sums of: their rounding is that share of these.

    `y` holds sizes, too. Where a stiff structure presses hard, forces are small differences of huge terms; whether one
    is zero is a question that only these sizes answer.
    """
    n = _n(y)
    free = jnp.abs(mechanics.free_load) * jnp.abs(load)
    for j in range(n):
        free = free + jnp.abs(mechanics.free_position[:, j]) * y[j] + jnp.abs(mechanics.free_velocity[:, j]) * y[n + j]
    g_tt, g_tn, g_nn = map(jnp.abs, mechanics.compliance)
    _, tn, _ = mechanics.compliance
    free_t, free_n = free[mechanics.tangential], free[mechanics.normal]
    determinant = g_tt * g_nn - tn**2
    static = mechanics.friction.static
    compliance = jnp.abs(mechanics.normal_compliance(contact.direction, static))
    sliding_n = free_n / jnp.where(compliance > 0, compliance, 1.0)
    none = jnp.zeros_like(free_n)
    stick_t, stick_n = (g_tn * free_n + g_nn * free_t) / determinant, (g_tn * free_t + g_tt * free_n) / determinant
    tangential_force = _by_status(contact, stick=stick_t, slide=static * sliding_n, detach=none)
    normal_force = _by_status(contact, stick=stick_n, slide=sliding_n, detach=none)
    pressing, margins, onset = normal_force, jnp.zeros(2, normal_force.dtype), none
    if mechanics.rest is not None:
        at_rest, rest_t, rest_n = mechanics.rest, mechanics.rest.tangential_force, mechanics.rest.normal_force
        # What is added to the forces at rest is all that is rounded in the rates, but for forces that are not those.
        dragging = contact.direction * mechanics.friction(jnp.zeros_like(static))
        otherwise = jnp.abs(dragging - at_rest.friction) if mechanics.friction.constant else 2 * static
        tangential_force = tangential_force + _by_status(
            contact, stick=none, slide=otherwise * jnp.abs(rest_n), detach=jnp.abs(rest_t)
        )
        normal_force = normal_force + _by_status(
            contact, stick=none, slide=g_tn * otherwise * jnp.abs(rest_n) / compliance, detach=jnp.abs(rest_n)
        )
        pressing = normal_force + jnp.abs(rest_n)
        margins = jnp.abs(cone_margins(mechanics, none, none))
        # Slip sets out with the acceleration that rounding leaves of the margin at which sticking ended; were that taken for
        # more than nothing, the two would hand over to each other for ever.
        edge = static * stick_n + stick_t
        onset = jnp.where(contact.status == Status.SLIDE, edge * jnp.abs(determinant) / compliance, 0.0)
    slip = y[n + mechanics.tangential] + jnp.abs(mechanics.belt_speed)
    edge = static * normal_force + tangential_force
    guards = _by_status(
        contact,
        stick=edge + margins,
        slide=jnp.stack([pressing, slip]),
        detach=jnp.stack([y[mechanics.normal]] * 2),
    )
    acceleration = (
        free + jnp.abs(mechanics.from_tangential) * tangential_force + jnp.abs(mechanics.from_normal) * normal_force
    )
    acceleration = acceleration + jnp.where(jnp.arange(n) == mechanics.tangential, onset, 0.0)
    return guards, on_constraint_rates(mechanics, contact, jnp.concatenate([y[n:], acceleration]))


def on_constraint_rates(mechanics: Mechanics, contact: Contact, rates: State) -> State:
    """Rates with what the status forbids set to exactly zero: those of the gap, and creep while sticking."""
    n = _n(rates)
    touching, sticking = contact.status != Status.DETACH, contact.status == Status.STICK
    index = jnp.arange(2 * n)
    held = touching & ((index == mechanics.normal) | (index == n + mechanics.normal))
    return jnp.where(held | (sticking & (index == n + mechanics.tangential)), 0.0, rates)


def on_constraint(mechanics: Mechanics, contact: Contact, y: State) -> State:
    """The state with what the status forbids set to exactly zero: gap and its rate, and creep while sticking."""
    touching = contact.status != Status.DETACH
    sticking = contact.status == Status.STICK
    return _with_contact_coordinates(
        mechanics,
        y,
        gap=jnp.where(touching, 0.0, gap(mechanics, y)),
        gap_rate=jnp.where(touching, 0.0, y[_n(y) + mechanics.normal]),
        tangential_velocity=jnp.where(sticking, mechanics.belt_speed, y[_n(y) + mechanics.tangential]),
    )


def transition(
    mechanics: Mechanics,
    contact: Contact,
    load: Float[Array, ""],
    y: State,
    ended: Bool[Array, "2"],
    resolution: Float[Array, ""],
) -> tuple[Contact, State]:
    """What follows where the guards in `ended` are used up: the next status, and the state on its constraint.

    Where none is, nothing changes. A rebound that would be back on the belt within the time `resolution` (s) is taken
    to have come to rest: with restitution, bounces get shorter without end, and a stepper can follow only so many.
    """
    n = _n(y)
    detached = contact.status == Status.DETACH
    sliding = contact.status == Status.SLIDE
    lifted = sliding & ended[0]
    touched = detached & ended[0]
    # Slip that has run out is put at exactly zero; sticking has none to begin with.
    stopped = (sliding & ended[1]) | (contact.status == Status.STICK)
    stopped_velocity = jnp.where(stopped, mechanics.belt_speed, y[n + mechanics.tangential])
    y_stopped = _with_contact_coordinates(
        mechanics,
        y,
        gap=jnp.where(touched, 0.0, gap(mechanics, y)),
        gap_rate=y[n + mechanics.normal],
        tangential_velocity=stopped_velocity,
    )
    y_next = jnp.where(touched, _resting(mechanics, load, impact(mechanics, y_stopped), resolution), y_stopped)
    # At the edge of the friction cone, or where N has just reached zero, rounding alone would decide whether the status
    # that has ended goes on. It does not.
    following = status_from_forces(mechanics, load, y_next, may_stick=contact.status != Status.STICK)
    following = Contact(
        status=jnp.where(lifted, Status.DETACH, following.status).astype(following.status.dtype),
        direction=following.direction,
    )
    y_next = on_constraint(mechanics, following, y_next)
    any_ended = jnp.any(ended)
    return (
        Contact(
            status=jnp.where(any_ended, following.status, contact.status),
            direction=jnp.where(any_ended, following.direction, contact.direction),
        ),
        jnp.where(any_ended, y_next, y),
    )


def status_from_forces(
    mechanics: Mechanics, load: Float[Array, ""], y: State, may_stick: Bool[Array, ""] | bool = True
) -> Contact:
    """The status that a state on its constraints is in, found from the forces that each status would need.

    Open or opening: detached. Slipping: sliding if pressed, else detached. At rest on the belt: sticking if the holding
    force lies in the friction cone, else sliding the way it is pushed, else detached.
    """
    free = free_acceleration(mechanics, load, y)
    slip = relative_velocity(mechanics, y)
    open_ = (gap(mechanics, y) > 0) | (y[_n(y) + mechanics.normal] > 0)
    holds = sticking_forces(mechanics, free)
    held = jnp.all(cone_margins(mechanics, *holds) >= 0)
    holding, pressing = total_forces(mechanics, *holds)
    sticks = may_stick & (slip == 0) & (pressing > 0) & held
    pushed = jnp.where(slip == 0, jnp.sign(holding), -jnp.sign(slip))
    direction = jnp.where(pushed == 0, 1.0, pushed).astype(y.dtype)
    _, sliding_normal_force = total_forces(mechanics, *sliding_forces(mechanics, free, direction, jnp.abs(slip)))
    status = jnp.where(
        open_,
        Status.DETACH,
        jnp.where(sticks, Status.STICK, jnp.where(sliding_normal_force > 0, Status.SLIDE, Status.DETACH)),
    )
    return Contact(status=status.astype(jnp.int32), direction=direction)


def impact(mechanics: Mechanics, y: State) -> State:
    """Velocities after the gap has closed: Newton's restitution normally, and the scene's impact law tangentially.

    - "coulomb" (default): the tangential impulse obeys Coulomb's law; the one that ends slip is taken if the friction
      cone at the approaching slip speed holds it.
    - "frictionless": no tangential impulse; the normal one moves whatever the mass matrix couples to it.
    - "reset": the normal velocity alone is changed, as a code does that resets one number. Not consistent with momentum.

    Newton's restitution above zero together with friction can create energy where the normal impulse turns the slip round
    (Kane's paradox); that takes a strong coupling of the two coordinates in the mass matrix. Restitution 0 never does.

    The paper does not state its law; its Table 2 comes out the same with all three.
    """
    n = _n(y)
    g_tt, g_tn, g_nn = mechanics.compliance
    approach = y[n + mechanics.normal]
    slip = relative_velocity(mechanics, y)
    jump = -(1.0 + mechanics.restitution) * approach
    if mechanics.impact_law == "reset":
        return y.at[n + mechanics.normal].add(jump)
    if mechanics.impact_law == "frictionless":
        tangential_impulse, normal_impulse = jnp.zeros_like(jump), jump / g_nn
    else:
        mu = mechanics.friction(jnp.abs(slip))
        determinant = g_tt * g_nn - g_tn**2
        ending = (-g_nn * slip - g_tn * jump) / determinant
        ending_normal = (g_tn * slip + g_tt * jump) / determinant
        direction = jnp.sign(ending)
        dragging_normal = jump / mechanics.normal_compliance(direction, mu)
        ends_slip = jnp.abs(ending) <= mu * ending_normal
        tangential_impulse = jnp.where(ends_slip, ending, direction * mu * dragging_normal)
        normal_impulse = jnp.where(ends_slip, ending_normal, dragging_normal)
    kick = mechanics.from_tangential * tangential_impulse + mechanics.from_normal * normal_impulse
    y = y.at[n:].add(kick)
    # What the law demands exactly, free of rounding: a mass that comes to rest on the belt rests.
    tangential_velocity = y[n + mechanics.tangential]
    if mechanics.impact_law == "coulomb":
        tangential_velocity = jnp.where(ends_slip, mechanics.belt_speed, tangential_velocity)
    return _with_contact_coordinates(
        mechanics,
        y,
        gap=gap(mechanics, y),
        gap_rate=-mechanics.restitution * approach,
        tangential_velocity=tangential_velocity,
    )


def _resting(mechanics: Mechanics, load: Float[Array, ""], y: State, resolution: Float[Array, ""]) -> State:
    rate = y[_n(y) + mechanics.normal]
    free_n = free_acceleration(mechanics, load, y)[mechanics.normal]
    if mechanics.rest is not None:
        _, g_tn, g_nn = mechanics.compliance
        free_n = free_n - g_tn * mechanics.rest.tangential_force - g_nn * mechanics.rest.normal_force
    rests = rate + 0.5 * free_n * resolution <= 0
    return jnp.where(jnp.arange(y.shape[0]) == _n(y) + mechanics.normal, jnp.where(rests, 0.0, rate), y)


def _by_status(contact: Contact, *, stick, slide, detach):
    return jnp.where(contact.status == Status.STICK, stick, jnp.where(contact.status == Status.SLIDE, slide, detach))


def _with_contact_coordinates(mechanics: Mechanics, y: State, *, gap, gap_rate, tangential_velocity) -> State:
    n = _n(y)
    index = jnp.arange(2 * n)
    y = jnp.where(index == mechanics.normal, gap, y)
    y = jnp.where(index == n + mechanics.normal, gap_rate, y)
    return jnp.where(index == n + mechanics.tangential, tangential_velocity, y)


def _n(y: State) -> int:
    return y.shape[0] // 2
