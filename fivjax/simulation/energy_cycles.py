"""The ledger of a trajectory by cycle and by contact event, exact for any distance of its rows.

A cycle lasts from one instant at which the tangential velocity rises through zero to the next; these are turning points of the
motion. From the row before such an instant the trajectory is stepped again up to it, so times, energies and durations are those
of the instant itself. The same is done for contact events.

With several contacts, the velocity that rises is the weighted sum of `steppers.section`, and events at one instant are one
row (or two, where rounding puts one of them behind the other).
"""

from typing import TYPE_CHECKING, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..contact import Contact, Mechanics, State
from ..foundation import arguments
from ..foundation.carried import depending_on
from ..foundation.compiling import power_of_4
from ..foundation.precision import in_double_precision, is_known
from ..io.datasets import labelled
from ..kernels.functions import KernelFunction
from ..model.load import load_from, next_jump
from ..model.scene import Scene, refuse_vector_contacts
from ..model.sliding import contact_coordinates
from ..steppers.core import Segment, follow
from ..steppers.event_exact import EventExact
from ..steppers.kernel_scope import has_kernel
from ..steppers.section import section_weights
from . import energy as accounts
from .energy import Energy, EnergyData, Ledger
from .rows import after_jump
from .trajectory import Trajectory

if TYPE_CHECKING:
    import xarray as xr


class _Instant(NamedTuple):
    """A state of a trajectory, with its ledger."""

    t: Float[Array, ""]
    y: State
    contact: Contact
    ledger: Ledger


@in_double_precision
def energy_per_cycle(run: Trajectory) -> "xr.Dataset":
    """The ledger of each whole cycle of a trajectory: the black curves of Figs. 13, 15 and 16.

    **Arguments:** `run`, from `simulate(..., energy=True)`.

    **Returns:** a dataset over `cycle`, empty if there is no whole one. Energies in J, over the cycle: `contact_work`
    (the sum of `stick_work` and `slide_work`), `interface_work`, `damping_work` (also by damper where the structure names
    them), `load_work`, `impact_loss`, `impact_dissipated`, and `energy_gain`, the growth of mechanical energy. Durations in s:
    `stick_time`, `slide_time`, `detach_time`. At the start of the cycle: `mechanical_energy`, and the tangential displacement
    `turning_point` in m. With several contacts, durations and turning points also have an axis `contact`, and works at the
    contacts are also given one by one (`stick_work_0`, …). Coordinates `cycle_start` and `cycle_end` in s. Exact for
    `EventExact`; for other methods, the ends of cycles have the error of the method.

    **Raises:** `TypeError` for anything but a trajectory, `ValueError` for one without a ledger, or whose contacts are
    directions that are no coordinates.

    **Example:**

        >>> cycles = fj.energy_per_cycle(run)
        >>> cycles.sizes["cycle"]
        25
    """
    _check(run)
    found = _with_ends(run, _marks(run, "crossings")[0])
    energy = _mechanical(run.scene, found)
    work = {**found.ledger.work.lines("work"), "contact_work": found.ledger.work.contact}
    lines = {
        **work,
        "impact_loss": found.ledger.impact,
        "impact_dissipated": found.ledger.impact_dissipated,
        "energy_gain": energy,
    }
    several = len(run.scene.structure.contacts) > 1
    t, times = found.t[:, None] if several else found.t, found.ledger.by_contact if several else vars(found.ledger)
    stick, detach = times["stick_time"], times["detach_time"]
    lasted = {"stick_time": stick, "slide_time": t - stick - detach, "detach_time": detach}
    of_each = ("cycle", "contact") if several else "cycle"
    over = {name: ("cycle", np.diff(line)) for name, line in lines.items() if name != "kick_work"}
    over |= {name: (of_each, np.diff(line, axis=0)) for name, line in lasted.items()}
    count = max(len(found.t) - 1, 0)
    at = {
        "mechanical_energy": ("cycle", energy[:count]),
        "turning_point": (of_each, found.y[:count, contact_coordinates(run.scene.structure)[0]]),
    }
    coords = {
        "cycle": np.arange(count),
        "cycle_start": ("cycle", found.t[:count]),
        "cycle_end": ("cycle", found.t[1 : count + 1]),
    }
    import xarray as xr

    return labelled(xr.Dataset(over | at, coords), run.scene)


@in_double_precision
def energy_per_event(run: Trajectory) -> "xr.Dataset":
    """The ledger of each contact event of a trajectory: its time, the status before and after, and the loss in an impact.

    **Arguments:** `run`, from `simulate(..., energy=True)`.

    **Returns:** a dataset over `event`: `event_time` in s; `status_before` and `status_after` (equal for a rebound, and where
    slip reverses without sticking), over several contacts with an axis `contact`; `impact_loss` and `impact_dissipated` in J,
    zero except for re-contacts; and `mechanical_energy` just after the event, in J. Exact for `EventExact`; for other methods,
    times have the error of the method.

    **Raises:** `TypeError` for anything but a trajectory, `ValueError` for one without a ledger, or whose contacts are
    directions that are no coordinates.

    **Example:**

        >>> events = fj.energy_per_event(run)
        >>> round(float(events["event_time"][0]), 4), int(events["status_after"][0])
        (0.2491, 2)
    """
    _check(run)
    found, before = _marks(run, "events")
    several = len(run.scene.structure.contacts) > 1
    of_each = ("event", "contact") if several else "event"
    status = {
        "status_before": (of_each, before.astype(np.int8)),
        "status_after": (of_each, found.contact.status.astype(np.int8)),
    }
    variables = {
        "impact_loss": np.diff(found.ledger.impact, prepend=0.0),
        "impact_dissipated": np.diff(found.ledger.impact_dissipated, prepend=0.0),
        "mechanical_energy": _mechanical(run.scene, found),
    }
    coords = {"event": np.arange(len(found.t)), "event_time": ("event", found.t)}
    import xarray as xr

    return labelled(xr.Dataset(status | {name: ("event", x) for name, x in variables.items()}, coords), run.scene)


def _check(run) -> None:
    arguments.instance("run", run, Trajectory, "a trajectory, such as `simulate` returns")
    run.refuse_batch("A table of cycles or events")
    refuse_vector_contacts(run.scene.structure, "A table of cycles or events")
    if run.energy is None:
        raise ValueError(
            "Argument `run` must come with its ledger, but has none; ask for it: `simulate(..., energy=True)`."
        )
    if not is_known(run.t):
        raise ValueError(
            "Argument `run` must hold known values: tables of cycles and events cannot be made inside `jit`."
        )


def _marks(run: Trajectory, counted: str) -> tuple[_Instant, np.ndarray]:
    """All instants at which a count of the ledger rises, one per row; and the status that ended there."""
    scene = run.scene
    rows = jax.tree.map(np.asarray, _row_instants(run))
    finite = np.isfinite(rows.y).all(axis=1)
    rising = np.diff(getattr(rows.ledger, counted)) * finite[1:]
    chosen = np.flatnonzero(rising)
    by_kernel, most, size = has_kernel(scene, EventExact()), int(rising.max(initial=1)), max(len(chosen), 1)
    if not by_kernel:
        # One of few shapes, so that not every trajectory compiles anew.
        most = power_of_4(max(most, 4))
        size = power_of_4(max(size, 4096 // most, 64))
    # Surplus rows repeat the first row and are dropped.
    padded = np.concatenate([chosen, np.zeros(size - len(chosen), int)])
    starts = jax.tree.map(lambda leaf: leaf[padded], rows)
    own, numbers = (starts, rows.t[padded + 1]), np.arange(1.0, most + 1.0)
    _, (found, before) = _to_marks((scene, np.asarray(counted == "events")), numbers, own=own, by_kernel=by_kernel)
    wanted = np.zeros((len(padded), most), bool)
    wanted[: len(chosen)] = np.arange(most) < rising[chosen][:, None]
    # Events of several contacts at one instant are one row.
    begun, reached = (np.asarray(getattr(ledger, counted)) for ledger in (starts.ledger, found.ledger))
    wanted &= np.diff(reached, axis=1, prepend=begun[:, None]) > 0
    return jax.tree.map(lambda leaf: leaf[wanted], found), before[wanted]


def _with_ends(run: Trajectory, found: _Instant) -> _Instant:
    """With the ends of a motion under a constant load that begins and ends on the section, as a limit cycle's own trajectory
    does: its start is no rise through zero, and whether its end has become one is a matter of rounding.
    """
    scene = run.scene
    weights = section_weights(len(scene.structure.contacts))
    tangential = np.atleast_1d(contact_coordinates(scene.structure)[0])
    speed, rise = (np.asarray(of)[[0, -1]][:, tangential] @ weights for of in (run.velocity, run.acceleration))
    on_section = np.all(np.abs(speed) <= 1e-9 * np.max(np.abs(scene.belt_speed)))
    # A motion that fades ends on the section, too, where it rises no more.
    rises = np.all(rise > 1e-3 * np.max(np.abs(rise)))
    jumps = np.asarray(scene.load.jumps)
    if not (on_section and rises) or np.any((jumps >= run.t[0]) & (jumps <= run.t[-1])):
        return found
    rows = _row_instants(run)
    near = 1e-6 * (run.t[[1, -1]] - run.t[[0, -2]])
    inside = (found.t > run.t[0] + near[0]) & (found.t < run.t[-1] - near[1])
    first, last = (jax.tree.map(lambda leaf, at=at: np.asarray(leaf)[[at]], rows) for at in (0, -1))
    between = jax.tree.map(lambda leaf: leaf[inside], found)
    return jax.tree.map(lambda *parts: np.concatenate(parts), first, between, last)


def _find(args, numbers: Float[Array, " most"]):
    """The instants after a start, and before an end, at which the count of events, or of crossings, has risen by each of these
    numbers.
    """
    scene, of_events, begin, end = args
    mechanics, energy_data, method = Mechanics(scene), EnergyData(scene), EventExact()

    def count(ledger: Ledger) -> Array:
        return jnp.where(of_events, ledger.events, ledger.crossings)

    def stretch(now: _Instant) -> tuple[_Instant, Array, Array]:
        """The motion to the next such instant, the next jump of the load or the end, whichever comes first."""
        stop = jnp.minimum(end, next_jump(scene.load, now.t))

        def enter(total, segment: Segment):
            return accounts.enter(energy_data, method, mechanics, total[0], segment), segment.contact.status

        found = follow(
            method,
            mechanics,
            now.contact,
            scene.load(0.5 * (now.t + stop)),
            now.y,
            stop - now.t,
            total=(now.ledger, now.contact.status),
            observe=enter,
            until=lambda total: count(total[0]) > count(now.ledger),
            # Cycles end where the tangential velocity rises through zero, so segments have to end there.
            at_section=True,
            kind="lax",
        )
        t = jnp.where(found.left <= 0, stop, stop - found.left)
        ledger, before = found.total
        return _Instant(t, found.y, found.contact, ledger), before, ~found.enough

    def to_next(start: _Instant, number):
        def going(carry):
            now, _, failed = carry
            return (count(now.ledger) < count(begin.ledger) + number) & (now.t < end) & ~failed

        nothing_yet = start, start.contact.status, jnp.zeros((), bool)
        found, before, _ = jax.lax.while_loop(going, lambda carry: stretch(carry[0]), nothing_yet)
        # A row at a jump of the load has counted the event that it demands at once.
        now = of_events & (count(found.ledger) < count(begin.ledger) + number) & jnp.any(found.t == scene.load.jumps)
        after, ledger = after_jump(mechanics, found.contact, found.ledger, load_from(scene.load, found.t), found.y, now)
        before = jnp.where(count(ledger) > count(found.ledger), found.contact.status, before)
        found = found._replace(contact=after, ledger=ledger)
        return found, (found, before)

    _, rows = jax.lax.scan(to_next, depending_on((scene, begin, end), begin), numbers)
    return (), rows


_to_marks = KernelFunction(_find)


def _row_instants(run: Trajectory) -> _Instant:
    energy = run.energy
    assert isinstance(energy, Energy)
    slip, force = np.asarray(run.slip_velocity), np.asarray(run.friction_force)
    # Friction acts against the slip; where there is no slip yet, the sign of the friction force is its direction.
    direction = np.where(slip != 0, -np.sign(slip), np.where(force != 0, np.sign(force), 1.0))
    return _Instant(
        t=run.t,
        y=np.concatenate([run.displacement, run.velocity], axis=1),
        contact=Contact(np.asarray(run.status).astype(np.int32), direction),
        ledger=energy.ledger,
    )


def _mechanical(scene: Scene, found: _Instant) -> np.ndarray:
    # By NumPy: there are more instants or fewer in each run, and XLA would compile for each number of them.
    displacement, velocity = np.split(np.asarray(found.y), 2, axis=1)
    mass, stiffness = np.asarray(scene.structure.mass), np.asarray(scene.structure.stiffness)
    return 0.5 * np.sum((velocity @ mass) * velocity + (displacement @ stiffness) * displacement, axis=1)
