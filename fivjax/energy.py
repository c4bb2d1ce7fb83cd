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

Work is integrated along each advance with the method's own states and to its own order: Gauss quadrature of the Taylor
series for `EventExact`, the stages and weights of the Runge–Kutta step for `WhereSwitched`.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from . import contact as physics
from .contact import Contact, Mechanics, State, Status
from .precision import returning_numpy
from .scene import Scene
from .steppers import AbstractStepper, Advance
from .structure import Structure


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
    start: Float[Array, "..."]  # mechanical energy at the start, J
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
    dampers: dict[str, Float[Array, "n n"]]
    final_load: Float[Array, ""]

    def __init__(self, scene: Scene):
        self.structure = scene.structure
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
    """The flows at one instant, in W."""
    structure = books.structure
    velocity = y[structure.size :]
    force, _ = physics.contact_forces(mechanics, contact, load, y)
    from_belt = force * velocity[structure.tangential]
    none = jnp.zeros_like(from_belt)
    sliding = contact.status == Status.SLIDE
    along_load = jnp.sum(structure.load_direction * velocity)
    return Flows(
        stick=jnp.where(contact.status == Status.STICK, from_belt, none),
        slide=jnp.where(sliding, from_belt, none),
        interface=jnp.where(sliding, -force * physics.relative_velocity(mechanics, y), none),
        damping=_form(structure.damping, velocity),
        dampers={name: _form(part, velocity) for name, part in books.dampers.items()},
        load=load * along_load,
        kick=(load - books.final_load) * along_load,
    )


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
        start=mechanical_energy(books.structure, y),
        worst=none,
    )


def residual(books: Books, ledger: Ledger, y: State) -> Float[Array, ""]:
    """Growth of mechanical energy that no line accounts for, in J: the error of the computation."""
    grown = mechanical_energy(books.structure, y) - ledger.start
    return grown - (ledger.work.mechanical - ledger.impact)


def exchanged(ledger: Ledger) -> Float[Array, "..."]:
    """How much the lines of the balance hold together, in J: what a residual is to be measured against."""
    work = ledger.work
    return abs(work.stick) + abs(work.slide) + work.damping + abs(work.load) + abs(ledger.impact)


def enter(
    books: Books,
    method: AbstractStepper,
    mechanics: Mechanics,
    load: Float[Array, ""],
    ledger: Ledger,
    contact: Contact,
    y: State,
    after: Advance,
) -> Ledger:
    """The ledger with one advance entered, from `contact` and `y` under `load` to what it reached.

    The scene's "reset" impact law is no impulse of the contact; there, `impact_dissipated` is only the loss with the work that
    the belt would do if it were.

    What a transition merely tidies up (a gap put at zero, slip that has run out) is no line: it goes into the residual.
    """
    structure = books.structure
    n, normal, tangential = structure.size, structure.normal, structure.tangential
    within = method.within(mechanics, contact, load, y, after.h)
    along = jax.vmap(lambda state: powers(books, mechanics, contact, load, state))(within.states)
    work = jax.tree.map(lambda line, power: line + jnp.sum(within.weights * power), ledger.work, along)
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
        work=work,
        impact=ledger.impact + loss,
        impact_dissipated=ledger.impact_dissipated + dissipated,
        stick_time=ledger.stick_time + jnp.where(contact.status == Status.STICK, after.h, 0.0),
        detach_time=ledger.detach_time + jnp.where(detached, after.h, 0.0),
        events=ledger.events + ((after.contact.status != contact.status) | bounced | reversed_),
        crossings=ledger.crossings + ((y[n + tangential] < 0) & (after.y[n + tangential] >= 0)),
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
    ys: Float[Array, "T 2n"],
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
    # A sum rather than two matrix products: in a batch this becomes one fused loop over lanes.
    return jnp.sum(matrix * (x[:, None] * x[None, :]))
