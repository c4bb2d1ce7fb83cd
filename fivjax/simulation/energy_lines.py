"""The lines of an energy ledger: flows, their sums along a trajectory, and the ledger of a whole trajectory.

Signs and equations are those of `energy`.
"""

import equinox as eqx
import numpy as np
from jaxtyping import Array, Float, Int

from ..foundation.precision import is_known


class Flows(eqx.Module):
    """Energy flows, as powers in W or as work in J; signs as in the table of `energy`. Scalars, or one row per instant."""

    stick: Float[Array, "..."]
    slide: Float[Array, "..."]
    interface: Float[Array, "..."]
    damping: Float[Array, "..."]
    dampers: dict[str, Float[Array, "..."]]  # the parts of `damping`, by damper; empty where the structure names none
    load: Float[Array, "..."]
    kick: Float[Array, "..."]  # the part of `load` above the load's final value
    # `stick`, `slide` and `interface` by contact, with a last axis over several contacts; empty with one contact.
    by_contact: dict[str, Float[Array, "... contacts"]] = eqx.field(default_factory=dict)

    @property
    def contact(self) -> Float[Array, "..."]:
        """The power or work of the belt on the structure, $P_c$ of Eq. 11."""
        return self.stick + self.slide

    @property
    def mechanical(self) -> Float[Array, "..."]:
        """The growth of mechanical energy between impacts: the right-hand side of Eq. 13."""
        return self.contact - self.damping + self.load

    def lines(self, kind: str) -> dict[str, Float[Array, "..."]]:
        """The flows by their names in a dataset, which end in `kind` ("power" or "work")."""
        return {
            f"stick_{kind}": self.stick,
            f"slide_{kind}": self.slide,
            f"interface_{kind}": self.interface,
            f"damping_{kind}": self.damping,
            **{f"damping_{kind}_{name}": part for name, part in self.dampers.items()},
            f"load_{kind}": self.load,
            f"kick_{kind}": self.kick,
            **_by_contact(f"{{}}_{kind}", self.by_contact),
        }


def _by_contact(name: str, lines: dict[str, Array]) -> dict[str, Array]:
    """Lines of several contacts; the name of each contact's line ends in its number."""
    return {
        f"{name.format(line)}_{i}": values[..., i] for line, values in lines.items() for i in range(values.shape[-1])
    }


class Ledger(eqx.Module):
    """The sums along one trajectory; scalars, or one row per instant."""

    work: Flows  # J
    impact: Float[
        Array, "..."
    ]  # mechanical energy lost in re-contacts, J; negative if the belt gave more than was lost
    impact_dissipated: Float[Array, "..."]  # the same plus the work of the belt: dissipated between the two, J
    stick_time: Float[Array, "..."]  # time spent sticking, s; with several contacts, while all of them do
    detach_time: Float[Array, "..."]  # time spent detached, s; with several contacts, while all of them are
    events: Int[Array, "..."]  # status changes, rebounds and reversals of slip
    crossings: Int[Array, "..."]  # upward zero crossings of the tangential velocity; see `steppers.section`
    beyond_rest: Float[Array, "..."]  # work of all forces but impacts beyond those at rest, J; see `energy`
    start: Float[Array, "..."]  # mechanical energy at the start, of displacements from rest, J
    worst: Float[Array, "..."]  # largest size of the residual so far, J
    # `impact`, `stick_time` and `detach_time` by contact, with a last axis over several contacts; empty with one contact.
    by_contact: dict[str, Float[Array, "... contacts"]] = eqx.field(default_factory=dict)


class Energy(eqx.Module):
    """The ledger of a trajectory; arrays over its `T` instants, powers in W, everything else in J or s.

    Work starts from zero at t = 0 and is exact at each row, for any distance of the rows.
    """

    kinetic: Float[Array, " T"]  # J
    elastic: Float[Array, " T"]  # J
    power: Flows  # W, at the row's instant and in its status
    ledger: Ledger  # the sums up to the row
    residual: Float[Array, " T"]  # growth of mechanical energy that no line accounts for, J

    def __repr__(self) -> str:
        if not (is_known(self.residual) and np.ndim(self.residual) == 1):
            return "Energy(<traced or batched>)"
        ends = {name: line[-1] for name, line in self.work.lines("work").items()} | {"impact_loss": self.impact[-1]}
        lines = ", ".join(f"{name} {float(value):.4g}" for name, value in ends.items())
        return f"energy ledger of {len(self.residual)} rows; at the end, in J: {lines}; residual {float(self.residual[-1]):.2g}"

    @property
    def mechanical(self) -> Float[Array, " T"]:
        """Kinetic and elastic energy, $E_m$, in J."""
        return self.kinetic + self.elastic

    @property
    def work(self) -> Flows:
        """The work since t = 0 by line, in J."""
        return self.ledger.work

    @property
    def impact(self) -> Float[Array, " T"]:
        """Mechanical energy lost in re-contacts since t = 0, in J."""
        return self.ledger.impact

    @property
    def exchanged(self) -> Float[Array, " T"]:
        """The sum of the sizes of the lines of the balance, in J: the measure for a residual."""
        return exchanged(self.ledger)

    def variables(self) -> dict[str, Float[Array, " T"]]:
        """The lines of the ledger by their names in a dataset."""
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
            **_by_contact("{}", self.ledger.by_contact),
        }


def exchanged(ledger: Ledger) -> Float[Array, "..."]:
    """The sum of the sizes of the lines of the balance, in J: the measure for a residual.

    Each line counts net, so energy that a vibration takes up and gives back within a cycle does not count.
    """
    work = ledger.work
    return abs(work.stick) + abs(work.slide) + work.damping + abs(work.load) + abs(ledger.impact)
