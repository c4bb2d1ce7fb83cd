"""The rows of a trajectory: states, contact modes, forces and energies at saved instants.

With known values they are computed in parts of one length, so that one program serves all runs of a scene, however long they
are and however often they save.
"""

from collections.abc import Iterator

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from .. import contact as physics
from ..contact import Contact, Mechanics, State
from ..foundation.compiling import compiled
from ..foundation.precision import known_to_numpy
from ..foundation.progress import stage, tick
from ..model.load import load_from
from ..model.scene import Scene
from ..model.sliding import contact_coordinates
from ..steppers.base import AbstractStepper
from ..steppers.core import Segment
from . import energy as accounts
from .ending import UNBOUNDED_FROM
from .energy import EnergyData, Ledger
from .jump_instants import StartOfRun, load_before, moment, start_of_run
from .stretches import Begin, go_on

# Intervals between saved instants in a part.
IN_A_PART = 1024


def with_step_as_array(method: AbstractStepper) -> AbstractStepper:
    """A method with a fixed step, with that step as an array: as a number, each value would be compiled anew."""
    if method.chooses_its_steps:
        return method
    return eqx.tree_at(lambda method: method.dt, method, np.asarray(method.dt))


class Reached(eqx.Module):
    """Where a run is at the end of a part."""

    y: State
    contact: Contact
    ledger: Ledger | None
    highest: Float[Array, ""]  # the largest load so far, N
    ended: Bool[Array, ""]  # whether it has no finite rows any more


def rows_in_parts(
    scene: Scene, method: AbstractStepper, y0: State, saved: Float[np.ndarray, " T"], most: int, energy: bool
) -> dict:
    """`rows_at` for known values, as NumPy arrays."""
    parts = list(_parts(scene, method, y0, saved, most, energy))
    return jax.tree.map(lambda *leaves: np.concatenate(leaves), *parts)


def _parts(scene, method, y0, saved, most, energy) -> Iterator[dict]:
    bound, begin = np.asarray(most, np.int32), None
    stage("compiling")
    for first in range(0, max(len(saved) - 1, 1), IN_A_PART):
        own = saved[first : first + IN_A_PART + 1]
        padded = np.pad(own, (0, IN_A_PART + 1 - len(own)), mode="edge")
        begin = _at_start(scene, y0, padded, energy) if begin is None else begin
        found, begin = _part(scene, method, y0, begin, padded, bound, energy)
        stage("stepping")
        tick(len(own) - 1)
        # A part begins where the one before it ended. Cut as NumPy arrays: JAX would compile a slice for each number of rows.
        kept = slice(min(first, 1), len(own))
        yield jax.tree.map(lambda leaf, kept=kept: known_to_numpy(leaf)[kept], found)


@compiled
def _at_start(scene: Scene, y0: State, saved: Float[Array, " T"], energy: bool) -> Reached:
    contact, ledger = mode_and_ledger_at_start(scene, y0, saved, EnergyData(scene) if energy else None)
    return Reached(y0, contact, ledger, jnp.zeros((), y0.dtype), jnp.asarray(False))


@compiled
def _part(
    scene: Scene,
    method: AbstractStepper,
    start: State,
    begin: Reached,
    saved: Float[Array, " T"],
    most: Array,
    energy: bool,
) -> tuple[dict, Reached]:
    energy_data, at_start = EnergyData(scene) if energy else None, (begin.contact, begin.ledger)
    states = states_at(scene, method, begin.y, saved, most, energy_data, at_start=at_start)
    found = _rows(scene, start, saved, states, energy_data, begin.highest, begin.ended)
    y, contact, ledger = jax.tree.map(lambda leaf: leaf[-1], states)
    highest = jnp.maximum(begin.highest, jnp.max(jnp.abs(found["load"])))
    return found, Reached(y, contact, ledger, highest, ~jnp.all(jnp.isfinite(found["velocity"][-1])))


@compiled
def rows_at(
    scene: Scene,
    method: AbstractStepper,
    y0: State,
    saved: Float[Array, " T"],
    most: int,
    energy: bool,
    derivatives: str | None,
) -> dict:
    """What a `Trajectory` has at its saved instants, by name; and from where on it has `grown` without bound."""
    energy_data = EnergyData(scene) if energy else None
    return _rows(scene, y0, saved, states_at(scene, method, y0, saved, most, energy_data, derivatives), energy_data)


def _rows(scene: Scene, start: State, saved, states, energy_data, highest=0.0, ended=False) -> dict:
    """The rows of a run from what `states_at` gives; `highest` is the largest load (N) before them, and it may have `ended`
    before.
    """
    mechanics, (y, contacts, ledgers) = Mechanics(scene), states
    acting = jax.vmap(lambda t: load_from(scene.load, t))
    load = acting(saved)
    # Rows after one that is not finite are not finite either, even where contact would set a value to zero.
    finite = jnp.logical_not(ended) & (jnp.cumprod(jnp.all(jnp.isfinite(y), axis=-1)) > 0)
    highest = jnp.maximum(highest, jnp.max(jnp.abs(load)))
    # The load may have been higher between two rows.
    jumps = scene.load.jumps
    between = jnp.where(jumps <= saved[-1], jnp.abs(acting(jumps)), 0.0)
    highest = jnp.maximum(highest, jnp.max(between, initial=0.0))
    beyond = jax.vmap(lambda t, y: grown(scene, start, t, highest, y))(saved, y)
    unbounded = finite & (jnp.cumsum(beyond) > 0)
    kept = finite & ~unbounded

    y = jnp.where(kept[:, None], y, jnp.nan)
    # A row at a jump of the load shows the load and the contact just after it.
    on_jump = jnp.any(saved[:, None] == scene.load.jumps, axis=-1) & (jnp.arange(len(saved)) > 0)
    contacts, ledgers = jax.vmap(lambda *own: after_jump(mechanics, *own))(contacts, ledgers, load, y, on_jump)
    rows = jax.vmap(lambda *own: row_of(mechanics, energy_data, *own))(contacts, load, y, ledgers, ~kept)
    return {"t": saved, **rows, "status": rows["status"].astype(jnp.int8), "grown": unbounded}


def row_of(
    mechanics: Mechanics,
    energy_data: EnergyData | None,
    contact: Contact,
    load: Float[Array, ""],
    y: State,
    ledger: Ledger | None,
    lost: Bool[Array, ""],
) -> dict:
    """What a `Trajectory` has at one instant, by name; NaN where the motion has been `lost` before."""
    n = y.shape[0] // 2
    friction_force, normal_force = physics.contact_forces(mechanics, contact, load, y)

    def known(value):
        return jnp.where(lost, jnp.nan, value)

    return {
        "displacement": y[:n],
        "velocity": y[n:],
        # What a contact mode forbids is zero whatever the state.
        "acceleration": known(physics.acceleration(mechanics, contact, load, y)),
        "status": contact.status.astype(jnp.int32),
        "normal_force": known(normal_force),
        "friction_force": known(friction_force),
        "load": load,
        "energy": None
        if energy_data is None or ledger is None
        else accounts.energy_of(energy_data, mechanics, contact, load, y, ledger),
    }


def grown(scene: Scene, start: State, t: Float[Array, ""], highest: Float[Array, ""], y: State) -> Bool[Array, ""]:
    """Whether a state is `UNBOUNDED_FROM` times larger than the start, the belt's motion and the effect of the highest load."""
    structure = scene.structure
    weights, n = structure.weights, structure.size
    tangential, _ = contact_coordinates(structure)
    belt = jnp.max(weights[n + tangential] * jnp.abs(scene.belt_speed))
    # A free structure is accelerated by a load for as long as it lasts.
    pushed = jnp.max(jnp.abs(structure.load_direction) / weights[n:]) * highest * t
    expected = jnp.max(jnp.abs(weights * start)) + belt + pushed
    return jnp.max(jnp.abs(weights * y)) > UNBOUNDED_FROM * expected


def after_jump(
    mechanics: Mechanics, contact: Contact, ledger: Ledger | None, load: Float[Array, ""], y: State, now
) -> tuple[Contact, Ledger | None]:
    """The contact mode after a jump of the load, if there is a jump `now`, and the ledger with that event."""

    def after() -> Contact:
        ended = physics.guards(mechanics, contact, load, y) < 0
        return physics.transition(mechanics, contact, load, y, ended, jnp.zeros_like(load))[0]

    following = jax.lax.cond(now, after, lambda: contact)
    return following, None if ledger is None else accounts.at_transition(mechanics, ledger, contact, following)


def states_at(
    scene: Scene,
    method: AbstractStepper,
    y0: State,
    instants: Float[Array, " T"],
    most: int | Array,
    energy_data: EnergyData | None = None,
    derivatives: str | None = None,
    at_start: tuple[Contact, Ledger | None] | None = None,
) -> tuple[Float[Array, "T state"], Contact, Ledger | None]:
    """States, contacts and, with `energy_data`, ledgers at given instants (s, in non-decreasing order, the first is the
    start); NaN from where `most` advances between two of them were not enough.

    `derivatives`: differentiable (also by the instants and the load's jumps) in "both" modes, or faster in only "forward" or
    "reverse" mode; None, not at all. In "reverse" mode only the states at the instants are kept; the rest is computed again.
    `at_start` are the contact mode and the ledger at the start, unless the run begins there (`mode_and_ledger_at_start`).
    """
    mechanics = Mechanics(scene)
    ends = _ends(scene, instants)

    def enter(ledger, segment: Segment):
        return accounts.entered(energy_data, method, mechanics, ledger, segment)

    def to_next(carry, end):
        t, y, contact, ledger = carry
        h = end - t
        load = scene.load(0.5 * (t + end))
        # If a jump coincides with an instant, the motion between them is under the load just before the jump.
        still = moment(mechanics, contact, load_before(scene, end), y, h - jax.lax.stop_gradient(h))
        begin = Begin(mechanics, contact, load, y, h, ledger, energy_data)
        moved, following, entered, reached = go_on(begin, method, most, derivatives)
        if derivatives is not None and energy_data is not None:
            entered = jax.lax.cond(h > 0, lambda: entered, lambda: enter(ledger, still))
        # States that were not reached are NaN; counts are kept.
        moved, ledger = jax.tree.map(
            lambda leaf: jnp.where(reached, leaf, jnp.nan) if eqx.is_inexact_array(leaf) else leaf, (moved, entered)
        )
        y = jnp.where(h > 0, moved, still.after.y)
        return (end, y, following, ledger), (y, following, ledger)

    contact0, ledger0 = mode_and_ledger_at_start(scene, y0, instants, energy_data) if at_start is None else at_start
    # Inside a scan common subexpressions are not merged across the checkpoint anyway.
    step = jax.checkpoint(to_next, prevent_cse=False) if derivatives == "both" else to_next
    if derivatives is None:
        start = StartOfRun(instants[0], physics.stuck(mechanics, contact0, jnp.asarray(y0)), ledger0)
    else:
        start = start_of_run(scene, mechanics, contact0, y0, instants[0], ledger0, enter)
    _, after = jax.lax.scan(step, (start.t, start.y, contact0, start.total), ends)
    rows = jnp.searchsorted(ends, instants[1:], side="right") - 1

    def with_start(first, rest):
        return jnp.concatenate([first[None], rest[rows]])

    return jax.tree.map(with_start, (y0, contact0, ledger0), after)


def mode_and_ledger_at_start(
    scene: Scene, y0: State, instants: Float[Array, " T"], energy_data: EnergyData | None
) -> tuple[Contact, Ledger | None]:
    """The contact mode and the ledger of a run that begins at the first of these instants."""
    contact = physics.status_from_forces(Mechanics(scene), load_from(scene.load, instants[0]), y0)
    return contact, None if energy_data is None else accounts.open_ledger(energy_data, y0)


def _ends(scene: Scene, instants: Float[Array, " T"]) -> Float[Array, " ends"]:
    """Where stretches end: at the instants and at the load's jumps."""
    jumps = scene.load.jumps
    inside = (jumps >= instants[0]) & (jumps <= instants[-1])
    # A jump outside does not contribute to the derivative; one exactly at an end contributes fully, where `clip` would halve
    # it.
    jumps = jnp.where(inside, jumps, jax.lax.stop_gradient(jnp.clip(jumps, instants[0], instants[-1])))
    return jnp.sort(jnp.concatenate([instants[1:], jumps]))
