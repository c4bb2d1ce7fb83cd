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
| `damping` | $\dot q^T C \dot q$ | never negative; `dampers` has it apart by damper |
| `load` | $F f \cdot \dot q$ | $-F \dot y_1$ in the paper's model: Eq. 12 has the other sign, which does not close |
| `interface` | $-T v_{rel}$ | Eq. 8: dissipated between belt and structure, never negative |
| `kick` | $(F - F_{final}) f \cdot \dot q$ | the part of `load` that the kick puts in |

The belt's drive pays for what the interface dissipates, so that is no part of $\dot E_m$.
Eq. 13 has no term for impacts. A re-contact changes energy at one instant, which is a line of its own (`impact`): it takes
energy, or where the moving belt drags the landing structure along, may give some. What is left after all lines is the
`residual`: the error of the computation, and a meter for it.

The residual speaks of the vibration. A small one under a high load moves far less energy than the springs store at rest, and
in a balance of totals it would be lost in the rounding of what is stored. With displacements $z = q - q_0$ measured from
a sliding equilibrium (`contact.Rest`) the forces that hold it do no net work on the vibration, and the same balance reads

$$\tfrac12 \dot z^T M \dot z + \tfrac12 z^T K z = \int (T - T_0)\, \dot z_t + (N - N_0)\, \dot z_n + (F - F_0) f \cdot \dot z
  - \dot z^T C \dot z \; dt - \text{impacts}$$

in which nothing large cancels. The lines of the table are its terms with the work of $T_0$ and $F_0$ added. Maps keep
their books so; states of `simulate` are totals ($q_0 = 0$), with which both balances are the same. Either way a line that
is wrong by some joules shows in the residual with as many.

Work is integrated along each advance with the method's own states and to its own order: Gauss quadrature of the Taylor
series for `EventExact`, the stages and weights of the Runge–Kutta step for `WhereSwitched`.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from .. import contact as physics
from ..contact import Contact, Mechanics, State, Status
from ..foundation.precision import returning_numpy
from ..model.scene import Scene
from ..model.springs import Springs
from ..model.structure import Structure
from ..steppers.base import AbstractStepper, Within
from ..steppers.core import Segment


class Flows(eqx.Module):
    """Energy flows, as powers in W or cumulated in J; signs as in the module's table. Scalars, or one row per instant."""

    stick: Float[Array, "..."]
    slide: Float[Array, "..."]
    interface: Float[Array, "..."]
    damping: Float[Array, "..."]
    dampers: dict[str, Float[Array, "..."]]  # the parts of `damping`, by damper; empty where the structure names none
    load: Float[Array, "..."]
    kick: Float[Array, "..."]  # the part of `load` above the load's final value

    @property
    def contact(self) -> Float[Array, "..."]:
        """What the belt gives to the structure, $P_c$ of Eq. 11."""
        return self.stick + self.slide

    @property
    def mechanical(self) -> Float[Array, "..."]:
        """What mechanical energy grows by between impacts: the right-hand side of Eq. 13."""
        return self.contact - self.damping + self.load

    def lines(self, kind: str) -> dict[str, Float[Array, "..."]]:
        """The flows under the names that they have in a dataset, ending in `kind` ("power" or "work")."""
        return {
            f"stick_{kind}": self.stick,
            f"slide_{kind}": self.slide,
            f"interface_{kind}": self.interface,
            f"damping_{kind}": self.damping,
            **{f"damping_{kind}_{name}": part for name, part in self.dampers.items()},
            f"load_{kind}": self.load,
            f"kick_{kind}": self.kick,
        }


class Ledger(eqx.Module):
    """What is added up along one trajectory; scalars, or one row per instant."""

    work: Flows  # J
    impact: Float[
        Array, "..."
    ]  # mechanical energy lost in re-contacts, J; negative where the belt gave more than was lost
    impact_dissipated: Float[Array, "..."]  # the same with what the belt gave: dissipated between the two, J
    stick_time: Float[Array, "..."]  # time spent sticking, s
    detach_time: Float[Array, "..."]  # time spent detached, s
    events: Int[Array, "..."]  # status changes, rebounds and reversals of slip
    crossings: Int[Array, "..."]  # upward zero crossings of the tangential velocity
    beyond_rest: Float[Array, "..."]  # work of all forces but impacts beyond those at rest, J; see the module's text
    start: Float[Array, "..."]  # mechanical energy at the start, of displacements from rest, J
    worst: Float[Array, "..."]  # largest size of the residual so far, J


class Energy(eqx.Module):
    """The ledger of a trajectory; arrays over its `T` instants, powers in W, everything else in J or s.

    Cumulated lines start from zero at t = 0 and hold up to their row exactly, however far apart rows are.
    """

    kinetic: Float[Array, " T"]  # J
    elastic: Float[Array, " T"]  # J
    power: Flows  # W, at the row's instant and in its status
    ledger: Ledger  # what had been entered by then
    residual: Float[Array, " T"]  # growth of mechanical energy that no line accounts for, J

    @property
    def mechanical(self) -> Float[Array, " T"]:
        """Kinetic and elastic energy, $E_m$, in J."""
        return self.kinetic + self.elastic

    @property
    def work(self) -> Flows:
        """The flows cumulated since t = 0, in J."""
        return self.ledger.work

    @property
    def impact(self) -> Float[Array, " T"]:
        """Mechanical energy lost in re-contacts since t = 0, in J."""
        return self.ledger.impact

    @property
    def exchanged(self) -> Float[Array, " T"]:
        """How much the lines of the balance hold together, in J: what a residual is to be measured against."""
        return exchanged(self.ledger)

    def variables(self) -> dict[str, Float[Array, " T"]]:
        """The ledger's lines under the names that they have in a dataset."""
        return {
            "kinetic_energy": self.kinetic,
            "elastic_energy": self.elastic,
            "mechanical_energy": self.mechanical,
            **self.power.lines("power"),
            **self.work.lines("work"),
            "impact_loss": self.impact,
            "impact_dissipated": self.ledger.impact_dissipated,
            "energy_residual": self.residual,
            "stick_time": self.ledger.stick_time,
            "detach_time": self.ledger.detach_time,
        }


class Books(eqx.Module):
    """What a scene's ledger needs of it, worked out once."""

    structure: Structure
    springs: Springs
    dampers: dict[str, Float[Array, "n n"]]
    final_load: Float[Array, ""]

    def __init__(self, scene: Scene):
        # Read in every step: worked out once.
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
    """Kinetic energy, and elastic energy of the displacement from an equilibrium, in J: zero where nothing vibrates.

    What a kick has done is to be read off this one. The load's own share of it, `kick`, is small and may be negative:
    at the paper's parameters nearly all of the vibration is fed by the contact while the kick lasts.
    """
    y = jnp.asarray(y)
    displaced = jnp.concatenate([y[: structure.size] - equilibrium, y[structure.size :]])
    return mechanical_energy(structure, displaced)


def powers(books: Books, mechanics: Mechanics, contact: Contact, load: Float[Array, ""], y: State) -> Flows:
    """The flows at one instant, in W; where `mechanics` has a rest, of the forces beyond it, but for all of `interface`."""
    structure, rest = books.structure, mechanics.rest
    velocity = y[structure.size :]
    force, _ = physics.added_forces(mechanics, contact, load, y)
    total_force, _ = physics.contact_forces(mechanics, contact, load, y)
    final_load = books.final_load if rest is None else books.final_load - rest.load
    from_belt = force * velocity[structure.tangential]
    none = jnp.zeros_like(from_belt)
    sliding = contact.status == Status.SLIDE
    along_load = jnp.sum(structure.load_direction * velocity)
    return Flows(
        stick=jnp.where(contact.status == Status.STICK, from_belt, none),
        slide=jnp.where(sliding, from_belt, none),
        interface=jnp.where(sliding, -total_force * physics.relative_velocity(mechanics, y), none),
        damping=_form(structure.damping, velocity),
        dampers={name: _form(part, velocity) for name, part in books.dampers.items()},
        load=load * along_load,
        kick=(load - final_load) * along_load,
    )


def _work(
    books: Books, mechanics: Mechanics, contact: Contact, load: Float[Array, ""], within: Within
) -> tuple[Flows, Float[Array, ""]]:
    """The flows of one advance, cumulated, and what all forces together did beyond those at rest, in J."""
    rest = mechanics.rest
    along = jax.vmap(lambda y: powers(books, mechanics, contact, load, y))(within.states)
    beyond = jax.tree.map(lambda power: jnp.sum(within.weights * power), along)
    if rest is None:
        return beyond, beyond.mechanical
    moved = within.weights @ within.states[:, books.structure.size :]
    by_contact = rest.tangential_force * moved[mechanics.tangential]
    by_load = rest.load * jnp.sum(books.structure.load_direction * moved)
    total = eqx.tree_at(
        lambda flows: (flows.stick, flows.slide, flows.load),
        beyond,
        (
            beyond.stick + jnp.where(contact.status == Status.STICK, by_contact, 0.0),
            beyond.slide + jnp.where(contact.status == Status.SLIDE, by_contact, 0.0),
            beyond.load + by_load,
        ),
    )
    # Of an open contact the forces at rest are missing, which no line of the table says.
    missing = by_contact + rest.normal_force * moved[mechanics.normal]
    return total, beyond.mechanical - jnp.where(contact.status == Status.DETACH, missing, 0.0)


def open_ledger(books: Books, y: State) -> Ledger:
    """A ledger in which nothing has been entered yet."""
    none, no = jnp.zeros((), y.dtype), jnp.zeros((), jnp.int32)
    return Ledger(
        work=Flows(none, none, none, none, dict.fromkeys(books.dampers, none), none, none),
        impact=none,
        impact_dissipated=none,
        stick_time=none,
        detach_time=none,
        events=no,
        crossings=no,
        beyond_rest=none,
        start=_stored(books, y),
        worst=none,
    )


def residual(books: Books, ledger: Ledger, y: State) -> Float[Array, ""]:
    """Growth of mechanical energy that no line accounts for, in J: the error of the computation.

    `y` is the state as the mechanics measure it with which the ledger was entered: a total, or a deviation from rest.
    """
    grown = _stored(books, y) - ledger.start
    return grown - (ledger.beyond_rest - ledger.impact)


def _stored(books: Books, y: State) -> Float[Array, ""]:
    """Mechanical energy, free of cancellation where the structure has moved far as a whole."""
    return kinetic_energy(books.structure, y) + books.springs.energy(y[: books.structure.size])


def exchanged(ledger: Ledger) -> Float[Array, "..."]:
    """How much the lines of the balance hold together, in J: what a residual is to be measured against.

    Each line counts net, so what a vibration takes up and gives back within a cycle does not.
    """
    work = ledger.work
    return abs(work.stick) + abs(work.slide) + work.damping + abs(work.load) + abs(ledger.impact)


def enter(
    books: Books,
    method: AbstractStepper,
    mechanics: Mechanics,
    ledger: Ledger,
    segment: Segment,
) -> Ledger:
    """The ledger with one segment entered.

    The scene's "reset" impact law is no impulse of the contact; there, `impact_dissipated` is only the loss with the work that
    the belt would do if it were.

    What a transition merely tidies up (a gap put at zero, slip that has run out) is no line: it goes into the residual.
    """
    structure = books.structure
    n, normal, tangential = structure.size, structure.normal, structure.tangential
    contact, load, y, after = segment.contact, segment.load, segment.y, segment.after
    within = method.within(mechanics, contact, load, y, after.h)
    work, beyond_rest = _work(books, mechanics, contact, load, within)
    # While detached, velocities jump at re-contact and at nothing else. The difference of squares, free of cancellation.
    before, behind = within.end[n:], after.y[n:]
    impulses = jnp.sum(structure.mass * (behind - before), axis=-1)
    loss = -0.5 * jnp.sum(impulses * (before + behind))
    by_belt = impulses[tangential] * mechanics.belt_speed
    detached = contact.status == Status.DETACH
    landed = detached & (after.y[normal] == 0)
    loss, dissipated = jnp.where(landed, loss, 0.0), jnp.where(landed, loss + by_belt, 0.0)
    bounced = landed & (after.contact.status == Status.DETACH) & (after.h > 0)
    reversed_ = (contact.status == after.contact.status) & (contact.direction != after.contact.direction)
    reversed_ = reversed_ & (contact.status == Status.SLIDE)
    entered = Ledger(
        work=jax.tree.map(jnp.add, ledger.work, work),
        impact=ledger.impact + loss,
        impact_dissipated=ledger.impact_dissipated + dissipated,
        stick_time=ledger.stick_time + jnp.where(contact.status == Status.STICK, after.h, 0.0),
        detach_time=ledger.detach_time + jnp.where(detached, after.h, 0.0),
        events=ledger.events + ((after.contact.status != contact.status) | bounced | reversed_),
        crossings=ledger.crossings + ((y[n + tangential] < 0) & (after.y[n + tangential] >= 0)),
        beyond_rest=ledger.beyond_rest + beyond_rest,
        start=ledger.start,
        worst=ledger.worst,
    )
    open_ = jax.lax.stop_gradient(jnp.abs(residual(books, entered, after.y)))
    return eqx.tree_at(lambda ledger: ledger.worst, entered, jnp.maximum(ledger.worst, open_))


def along_rows(
    books: Books,
    mechanics: Mechanics,
    contacts: Contact,
    loads: Float[Array, " T"],
    ys: Float[Array, "T state"],
    rows: Ledger,
) -> Energy:
    """The ledger of a trajectory from its rows and what had been entered up to each of them."""
    structure = books.structure
    return Energy(
        kinetic=jax.vmap(lambda y: kinetic_energy(structure, y))(ys),
        elastic=jax.vmap(lambda y: elastic_energy(structure, y))(ys),
        power=jax.vmap(lambda c, f, y: powers(books, mechanics, c, f, y))(contacts, loads, ys),
        ledger=rows,
        residual=jax.vmap(lambda ledger, y: residual(books, ledger, y))(rows, ys),
    )


def _form(matrix: Float[Array, "n n"], x: Float[Array, " n"]) -> Float[Array, ""]:
    # A sum rather than two matrix products: in a batch this becomes one fused loop over trajectories.
    return jnp.sum(matrix * (x[:, None] * x[None, :]))
