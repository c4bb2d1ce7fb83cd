r"""The energy ledger: where every joule of a trajectory comes from and goes to.

The structure's mechanical energy is kinetic plus elastic, with its symmetric matrices (Eq. 7; the matrices of Eq. 3
contain friction, and with them no balance closes):

$$E_m = \tfrac12 \dot q^T M \dot q + \tfrac12 q^T K q$$

and between impacts it changes by (Eq. 13)

$$\dot E_m = P_{st} + P_{sl} - P_{dm} + P_F$$

Signs, for all of fivjax: **contact and load power are positive into the structure; what is dissipated is positive.**

| line | power | |
|---|---|---|
| `stick` | $T v_{belt}$ | Eq. 9: from the belt that carries the structure along |
| `slide` | $T \dot q_t$ | Eq. 10: from the belt that slides under it; zero while detached |
| `damping` | $\dot q^T C \dot q$ | never negative; `dampers` has the part of each damper |
| `load` | $F f \cdot \dot q$ | $-F \dot y_1$ in the paper's model: Eq. 12 has the other sign, which does not close |
| `interface` | $-T v_{rel}$ | Eq. 8: dissipated between belt and structure, never negative |
| `kick` | $(F - F_{final}) f \cdot \dot q$ | the part of `load` that the kick puts in |

The energy that the interface dissipates comes from the drive of the belt, so it is no part of $\dot E_m$.
Eq. 13 has no term for impacts. A re-contact changes the energy at one instant, which is a line of its own (`impact`): it takes
energy, or may give some where the moving belt drags the landing structure along. The part of the balance that no line explains
is the `residual`: it measures the error of the computation.

A small vibration under a high load exchanges far less energy than the springs store at rest, and in a balance of totals it
would be lost in the rounding of the stored energy. With displacements $z = q - q_0$ measured from a sliding equilibrium
(`contact.Rest`) the forces at rest cancel, and the same balance reads

$$\tfrac12 \dot z^T M \dot z + \tfrac12 z^T K z = \int (T - T_0)\, \dot z_t + (N - N_0)\, \dot z_n + (F - F_0) f \cdot \dot z
  - \dot z^T C \dot z \; dt - \text{impacts}$$

without cancellation of large terms. The lines of the table are its terms with the work of $T_0$ and $F_0$ added. Maps keep
their ledger so; states of `simulate` are totals ($q_0 = 0$), for which both balances are the same. In both cases a line that
is wrong by some joules changes the residual by as much.

Work is integrated along each advance with the method's own states and to its own order: Gauss quadrature of the Taylor
series for `EventExact`, the stages and weights of the Runge–Kutta step for `WhereSwitched`.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from .. import contact as physics
from ..contact import Contact, Mechanics, State, Status, same_mode
from ..foundation.precision import returning_numpy
from ..model.scene import Scene
from ..model.springs import Springs
from ..model.structure import Structure
from ..steppers.base import AbstractStepper, Within
from ..steppers.core import Segment
from ..steppers.section import rise_between, well_before_section
from .energy_lines import Energy as Energy
from .energy_lines import Flows as Flows
from .energy_lines import Ledger as Ledger
from .energy_lines import exchanged as exchanged


class EnergyData(eqx.Module):
    """The data of a scene that its ledger needs, worked out once."""

    structure: Structure
    springs: Springs
    dampers: dict[str, Float[Array, "n n"]]
    final_load: Float[Array, ""]

    def __init__(self, scene: Scene):
        # As matrices, because they are read in every step.
        self.structure = scene.structure.as_matrices()
        self.springs = Springs(self.structure.stiffness)
        self.dampers = scene.structure.damping_parts
        self.final_load = scene.load.final


def kinetic_energy(structure: Structure, y: State) -> Float[Array, ""]:
    """Kinetic energy of a state (Eq. 7, with the symmetric mass matrix), in J."""
    return 0.5 * _form(structure.mass, y[structure.size :])


def elastic_energy(structure: Structure, y: State) -> Float[Array, ""]:
    """Elastic energy of a state (Eq. 7, with the symmetric stiffness matrix), in J."""
    return 0.5 * _form(structure.stiffness, y[: structure.size])


def mechanical_energy(structure: Structure, y: State) -> Float[Array, ""]:
    """Kinetic and elastic energy of a state, in J."""
    return kinetic_energy(structure, y) + elastic_energy(structure, y)


@returning_numpy
def vibration_energy(structure: Structure, equilibrium: Float[Array, " n"], y: State) -> Float[Array, ""]:
    """Kinetic energy plus elastic energy of the displacement from an equilibrium, in J: zero without vibration.

    It measures the effect of a kick. The work of the load, `kick`, is only a small part of it and may be negative: with the
    paper's parameters nearly all of the energy of the vibration comes from the contact while the kick lasts.
    """
    y = jnp.asarray(y)
    displaced = jnp.concatenate([y[: structure.size] - equilibrium, y[structure.size :]])
    return mechanical_energy(structure, displaced)


def powers(energy_data: EnergyData, mechanics: Mechanics, contact: Contact, load: Float[Array, ""], y: State) -> Flows:
    """The flows at one instant, in W. If `mechanics` has a rest, only of forces beyond those at rest, except for
    `interface`.
    """
    structure, rest = energy_data.structure, mechanics.rest
    velocity = y[structure.size :]
    force, _ = physics.added_forces(mechanics, contact, load, y)
    total_force, _ = physics.contact_forces(mechanics, contact, load, y)
    final_load = energy_data.final_load if rest is None else energy_data.final_load - rest.load
    from_belt = force * velocity[mechanics.tangential]
    none = jnp.zeros_like(from_belt)
    sliding = contact.status == Status.SLIDE
    along_load = jnp.sum(structure.load_direction * velocity)
    stick = jnp.where(contact.status == Status.STICK, from_belt, none)
    slide = jnp.where(sliding, from_belt, none)
    interface = jnp.where(sliding, -total_force * physics.relative_velocity(mechanics, y), none)
    return Flows(
        stick=_sum(mechanics, stick),
        slide=_sum(mechanics, slide),
        interface=_sum(mechanics, interface),
        damping=_form(structure.damping, velocity),
        dampers={name: _form(part, velocity) for name, part in energy_data.dampers.items()},
        load=load * along_load,
        kick=(load - final_load) * along_load,
        by_contact={"stick": stick, "slide": slide, "interface": interface} if mechanics.several else {},
    )


def _sum(mechanics: Mechanics, each: Float[Array, "*contacts"]) -> Float[Array, ""]:
    """The sum over the contacts, if there are several."""
    return jnp.sum(each) if mechanics.several else each


def _work(
    energy_data: EnergyData, mechanics: Mechanics, contact: Contact, load: Float[Array, ""], within: Within
) -> tuple[Flows, Float[Array, ""]]:
    """The work of one advance by line, and the work of all forces beyond those at rest, in J."""
    rest = mechanics.rest
    along = jax.vmap(lambda y: powers(energy_data, mechanics, contact, load, y))(within.states)
    weights = within.weights
    beyond = jax.tree.map(
        lambda power: jnp.sum((weights if power.ndim == 1 else weights[:, None]) * power, axis=0), along
    )
    if rest is None:
        return beyond, beyond.mechanical
    moved = within.weights @ within.states[:, energy_data.structure.size :]
    at_rest = rest.tangential_force * moved[mechanics.tangential]
    by_load = rest.load * jnp.sum(energy_data.structure.load_direction * moved)
    stick = jnp.where(contact.status == Status.STICK, at_rest, 0.0)
    slide = jnp.where(contact.status == Status.SLIDE, at_rest, 0.0)
    by_contact = beyond.by_contact
    if by_contact:
        by_contact = {**by_contact, "stick": by_contact["stick"] + stick, "slide": by_contact["slide"] + slide}
    total = eqx.tree_at(
        lambda flows: (flows.stick, flows.slide, flows.load, flows.by_contact),
        beyond,
        (
            beyond.stick + _sum(mechanics, stick),
            beyond.slide + _sum(mechanics, slide),
            beyond.load + by_load,
            by_contact,
        ),
    )
    # While a contact is open, the forces at rest are missing, which is in no line of the table.
    missing = at_rest + rest.normal_force * moved[mechanics.normal]
    missing = _sum(mechanics, jnp.where(contact.status == Status.DETACH, missing, 0.0))
    return total, beyond.mechanical - missing


def open_ledger(energy_data: EnergyData, y: State) -> Ledger:
    """An empty ledger."""
    none, no = jnp.zeros((), y.dtype), jnp.zeros((), jnp.int32)
    count = len(energy_data.structure.places)
    each, several = jnp.zeros(count, y.dtype), count > 1
    flows = dict.fromkeys(("stick", "slide", "interface"), each) if several else {}
    return Ledger(
        work=Flows(none, none, none, none, dict.fromkeys(energy_data.dampers, none), none, none, flows),
        impact=none,
        impact_dissipated=none,
        stick_time=none,
        detach_time=none,
        events=no,
        crossings=no,
        beyond_rest=none,
        start=_stored(energy_data, y),
        worst=none,
        by_contact=dict.fromkeys(("impact", "stick_time", "detach_time"), each) if several else {},
    )


def residual(energy_data: EnergyData, ledger: Ledger, y: State) -> Float[Array, ""]:
    """Growth of mechanical energy that no line accounts for, in J: the error of the computation.

    `y` is a total state or a deviation from rest, as in the mechanics with which the ledger was kept.
    """
    grown = _stored(energy_data, y) - ledger.start
    return grown - (ledger.beyond_rest - ledger.impact)


def _stored(energy_data: EnergyData, y: State) -> Float[Array, ""]:
    """Mechanical energy in J, without cancellation after a large rigid motion."""
    return kinetic_energy(energy_data.structure, y) + energy_data.springs.energy(y[: energy_data.structure.size])


def enter(
    energy_data: EnergyData,
    method: AbstractStepper,
    mechanics: Mechanics,
    ledger: Ledger,
    segment: Segment,
) -> Ledger:
    """The ledger with one more segment.

    The "reset" impact law is no impulse of the contact; with it, `impact_dissipated` is the loss plus the work that the belt
    would do if it were one.

    Corrections by rounding in a transition (a gap or a slip speed set to zero) have no line: they are in the residual.
    """
    structure = energy_data.structure
    n, tangential, normal = structure.size, mechanics.tangential, mechanics.normal
    contact, load, y, after = segment.contact, segment.load, segment.y, segment.after
    within = method.within(mechanics, contact, load, y, after.h)
    work, beyond_rest = _work(energy_data, mechanics, contact, load, within)
    # While detached, velocities jump only at re-contact. The difference of squares is written without cancellation.
    before, behind = within.end[n:], after.y[n:]
    impulses = jnp.sum(structure.mass * (behind - before), axis=-1)
    loss = -0.5 * jnp.sum(impulses * (before + behind))
    by_belt = impulses[tangential] * mechanics.belt_speed
    status, following = contact.status, after.contact.status
    detached, sticks = status == Status.DETACH, status == Status.STICK
    landed = detached & (physics.gap(mechanics, after.y) == 0)
    loss = jnp.where(jnp.any(landed), loss, 0.0)
    dissipated = jnp.where(jnp.any(landed), loss + _sum(mechanics, by_belt), 0.0)
    bounced = detached & after.ended[..., 0] & (following == Status.DETACH)
    by_contact = {}
    if mechanics.several:
        # Impulses act only at the contacts, so each contact has its own part of the loss.
        own = impulses * (before + behind)
        own = jnp.where(jnp.any(landed), -0.5 * (own[tangential] + own[normal]), 0.0)
        entries = {
            "impact": own,
            "stick_time": jnp.where(sticks, after.h, 0.0),
            "detach_time": jnp.where(detached, after.h, 0.0),
        }
        by_contact = {name: ledger.by_contact[name] + entry for name, entry in entries.items()}
    entered = Ledger(
        work=jax.tree.map(jnp.add, ledger.work, work),
        impact=ledger.impact + loss,
        impact_dissipated=ledger.impact_dissipated + dissipated,
        stick_time=ledger.stick_time + jnp.where(_all(mechanics, sticks), after.h, 0.0),
        detach_time=ledger.detach_time + jnp.where(_all(mechanics, detached), after.h, 0.0),
        events=ledger.events + _changes(mechanics, contact, after.contact, bounced),
        # Not of what is at rest but for rounding.
        crossings=ledger.crossings
        + (rise_between(mechanics, y, after.end, after.y).happened & _moves_back(mechanics, y, after.end)),
        beyond_rest=ledger.beyond_rest + beyond_rest,
        start=ledger.start,
        worst=ledger.worst,
        by_contact=by_contact,
    )
    open_ = jax.lax.stop_gradient(jnp.abs(residual(energy_data, entered, after.y)))
    return eqx.tree_at(lambda ledger: ledger.worst, entered, jnp.maximum(ledger.worst, open_))


def at_transition(mechanics: Mechanics, ledger: Ledger, before: Contact, after: Contact) -> Ledger:
    """The ledger after a change of the contact mode that a jump of the load demands at once: no work, but an event."""
    return eqx.tree_at(lambda ledger: ledger.events, ledger, ledger.events + _changes(mechanics, before, after, False))


def _changes(mechanics: Mechanics, before: Contact, after: Contact, bounced) -> Array:
    """How many contacts have an event between two modes."""
    happened = ~same_mode(before.status, before.direction, after.status, after.direction) | bounced
    return jnp.sum(happened, dtype=jnp.int32) if mechanics.several else happened


def _moves_back(mechanics: Mechanics, *states: State) -> Array:
    return jnp.any(jnp.stack([well_before_section(mechanics, y) for y in states]))


def entered(
    energy_data: EnergyData | None,
    method: AbstractStepper,
    mechanics: Mechanics,
    ledger: Ledger | None,
    segment: Segment,
) -> Ledger | None:
    """The same where there is a ledger."""
    if energy_data is None or ledger is None:
        return None
    return enter(energy_data, method, mechanics, ledger, segment)


def _all(mechanics: Mechanics, each: Bool[Array, "*contacts"]) -> Bool[Array, ""]:
    return jnp.all(each) if mechanics.several else each


def energy_of(
    energy_data: EnergyData, mechanics: Mechanics, contact: Contact, load: Float[Array, ""], y: State, ledger: Ledger
) -> Energy:
    """The energies at one instant, with the ledger up to it."""
    structure = energy_data.structure
    return Energy(
        kinetic=kinetic_energy(structure, y),
        elastic=elastic_energy(structure, y),
        power=powers(energy_data, mechanics, contact, load, y),
        ledger=ledger,
        residual=residual(energy_data, ledger, y),
    )


def _form(matrix: Float[Array, "n n"], x: Float[Array, " n"]) -> Float[Array, ""]:
    # A sum rather than two matrix products: in a batch this becomes one fused loop over trajectories.
    return jnp.sum(matrix * (x[:, None] * x[None, :]))
