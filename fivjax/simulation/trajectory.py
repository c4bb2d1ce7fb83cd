"""One trajectory: `simulate` and its result."""

import contextlib
import dataclasses
import functools
import json
import math
from collections.abc import Callable
from typing import TYPE_CHECKING

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from .. import contact as physics
from ..contact import Mechanics, State, Status
from ..foundation import arguments
from ..foundation.compiling import compiled
from ..foundation.digits import apart
from ..foundation.precision import (
    Returned,
    in_double_precision,
    is_known,
    known_to_numpy,
    real,
    refusing_reverse_in_single_precision,
)
from ..foundation.progress import following, tick
from ..foundation.stopping import interruptible
from ..io.datasets import labelled
from ..model.contact_coordinates import transformation
from ..model.scene import Scene, refuse_painleve, scene_in_contact_coordinates
from ..steppers.base import MOST_ADVANCES, AbstractStepper, describe_method
from ..steppers.event_exact import EventExact
from ..steppers.kernel_scope import has_kernel
from .ending import ENDING, Ending
from .energy import Energy
from .motion import rows_by_kernel
from .rows import rows_at, rows_in_parts, with_step_as_array
from .start import refuse_without_equilibrium, start_in_contact_coordinates, start_state
from .stretches import MODES

if TYPE_CHECKING:
    import xarray as xr

# What a trajectory has in each row for all coordinates, and for each contact.
OF_COORDINATES = ("displacement", "velocity", "acceleration")
OF_CONTACTS = ("status", "normal_force", "friction_force")


class Trajectory(eqx.Module):
    """A response in time. Rows are saved instants: the first is t = 0, the last exactly `t1`; `n` is the structure's size.

    **Example:**

        >>> float(run.t[-1]), run.velocity.shape
        (0.4, (401, 3))
        >>> sorted(set(run.status.tolist()))  # it has slid and detached
        [1, 2]
    """

    t: Float[Returned, " T"]  # s
    displacement: Float[Returned, "T n"]  # m
    velocity: Float[Returned, "T n"]  # m/s
    acceleration: Float[Returned, "T n"]  # m/s²
    status: Int[Returned, "T *contacts"]  # 0 stick, 1 slide, 2 detach; with several contacts, one column for each
    normal_force: Float[Returned, "T *contacts"]  # N
    friction_force: Float[Returned, "T *contacts"]  # N
    load: Float[Returned, " T"]  # N
    scene: Scene
    energy: Energy | None = None  # the ledger, if asked for
    outcome: Int[Returned | np.generic, ""] = eqx.field(default_factory=lambda: np.int8(Ending.FINISHED))  # an `Ending`
    # How it was computed, as pairs of name and value: method, dt, dt_save, t1, start.
    settings: tuple[tuple[str, str | float], ...] = eqx.field(static=True, default=())

    def __repr__(self) -> str:
        if not is_known((self.t, self.status, self.velocity, self.outcome)):
            return f"Trajectory (traced) of {np.shape(self.t)[-1]} rows"
        if np.ndim(self.t) != 1:
            return f"Trajectory: a batch of shape {np.shape(self.t)[:-1]}, each of {np.shape(self.t)[-1]} rows"
        t, status = np.asarray(self.t), np.asarray(self.status)
        shares = ", ".join(f"{one.name.lower()} {100 * np.mean(status == one):.3g} %" for one in Status)
        along = _at_contacts(np.asarray(self.velocity), self.scene.structure.tangential_directions)
        ledger = "" if self.energy is None else "; with its energy ledger"
        return (
            f"Trajectory: {len(t)} rows from 0 to {t[-1]:g} s of {self.scene.structure.size} coordinates "
            f"({', '.join(self.scene.structure.coordinates[:6])}{', …' if self.scene.structure.size > 6 else ''})\n"
            f"  contact: {shares} of the rows; peak tangential speed {np.nanmax(np.abs(along), initial=0.0):.6g} m/s{ledger}\n"
            f"  {self.meaning}"
        )

    def refuse_batch(self, what: str) -> None:
        """Refuse several trajectories in one, as `jax.vmap` makes them."""
        if np.ndim(self.t) != 1:
            raise ValueError(
                f"{what} is that of one trajectory, but here is a batch of shape {np.shape(self.t)[:-1]}. Take one of them, "
                "`jax.tree.map(lambda x: x[0], runs)`, or go through all by `jax.vmap`."
            )

    @property
    def meaning(self) -> str:
        """How the trajectory ended, in a sentence."""
        self.refuse_batch("`meaning`")
        return ENDING[Ending(int(self.outcome))]

    @property
    def slip_velocity(self) -> Float[Returned, "T *contacts"]:
        """Tangential velocity relative to the belt, in m/s; negative in steady sliding on a belt that moves forward."""
        self.refuse_batch("`slip_velocity`")
        along = _at_contacts(self.velocity, self.scene.structure.tangential_directions)
        return along - known_to_numpy(self.scene.belt_speed)

    @property
    def gap(self) -> Float[Returned, "T *contacts"]:
        """Distance from the belt, in m."""
        self.refuse_batch("`gap`")
        return _at_contacts(self.displacement, self.scene.structure.normal_directions)

    @classmethod
    def from_dataset(cls, dataset: "xr.Dataset") -> "Trajectory":
        """A trajectory from its dataset, such as `fj.open("run.nc")`; without its energy ledger.

        **Raises:** `ValueError` for a dataset without a scene in its attributes, or one that is not a whole trajectory.
        """
        scene = Scene.from_dataset(dataset)
        rows = ("t", *OF_COORDINATES, *OF_CONTACTS, "load")
        try:
            settings = tuple(json.loads(dataset.attrs.get("settings", "{}")).items())
            outcome = np.int8(Ending[dataset.attrs["outcome"].upper()])
            values = {name: dataset[name].values for name in rows}
        except (AttributeError, KeyError, TypeError, ValueError, RecursionError):
            raise ValueError(
                f"Argument `dataset` must be a saved trajectory: variables {', '.join(rows)} and attributes `settings` and "
                f"`outcome`, but some are missing or damaged. Save the trajectory again."
            ) from None
        count, size = values["t"].size, len(scene.structure.coordinates)
        for name, value in values.items():
            wide = name in OF_COORDINATES
            if value.dtype.kind not in "biuf" or value.shape[:1] != (count,) or (wide and value.shape != (count, size)):
                raise ValueError(
                    f"Argument `dataset` must be a saved trajectory of {count} instants and {size} coordinates, but `{name}` "
                    f"has shape {value.shape} and type {value.dtype}. Save the trajectory again."
                )
        return cls(**values, scene=scene, outcome=outcome, settings=settings)

    def to_dataset(self) -> "xr.Dataset":
        """The trajectory with names, units and the scene it came from."""
        import xarray as xr

        self.refuse_batch("A dataset")
        along = ("t", "coordinate")
        each = ("t",) if np.ndim(self.status) == 1 else ("t", "contact")
        axes = {**dict.fromkeys(OF_COORDINATES, along), **dict.fromkeys(OF_CONTACTS, each), "load": "t"}
        dataset = xr.Dataset(
            {name: (own, np.asarray(getattr(self, name))) for name, own in axes.items()},
            coords={"t": np.asarray(self.t), "coordinate": list(self.scene.structure.coordinates)},
        )
        if self.energy is not None:
            dataset = dataset.assign({name: ("t", np.asarray(x)) for name, x in self.energy.variables().items()})
        return labelled(dataset, self.scene, **dict(self.settings)).assign_attrs(
            outcome=Ending(int(self.outcome)).name.lower(), meaning=self.meaning
        )


@refusing_reverse_in_single_precision
@in_double_precision
def simulate(
    scene: Scene,
    t1: float = 2.0,
    dt_save: float = 1e-4,
    method: AbstractStepper | None = None,
    *,
    y0=None,
    energy: bool = False,
    derivatives: str = "both",
    progress: bool | None = None,
) -> Trajectory:
    """The response of a scene from t = 0 to `t1`.

    **Arguments:**

    - `scene`: what is simulated.
    - `t1`: the end, in s.
    - `dt_save`: time between saved instants, in s; the steps in between are chosen by the method.
    - `method`: how to step, `EventExact()` unless given.
    - `y0`: displacements and velocities at t = 0, as a pair of `(n,)` arrays or one of `(2n,)`, in m and m/s; the sliding
      equilibrium at rest unless given.
    - `energy`: whether to keep the energy ledger, `run.energy` (an `energy.Energy`). It costs time only if asked for.
    - `derivatives`: the modes in which JAX may differentiate the run, "both", "forward", "reverse" or "none". Kernels have
      both and need not be told. Where XLA follows a run inside a JAX transformation, one mode is faster than both (`jax.grad`
      about ten times), and "none" up to twice as fast again, because derivatives need shorter steps.
    - `progress`: whether to show how far a run of more than a second is; unless given, in terminals and notebooks.

    **Returns:** a `Trajectory` of NumPy arrays (of JAX arrays inside `jit`, `grad` or `vmap`). Where the motion is no longer
    finite, grows without bound, or has contact events without end, the rows from there on are NaN; `run.outcome`
    (an `Ending`) and `run.meaning` (a sentence) say which.

    Outside of JAX's transformations one compiled program serves all runs of scenes of one kind, however long they are and
    however often they save. Works inside `jax.jit`, `jax.vmap` and `jax.jacfwd` even if double precision is off; `jax.grad`
    needs it on.

    **Raises:** `ValueError` for times that are not positive, a `dt_save` below the fixed step of `WhereSwitched`, a start below
    the belt or of the wrong shape, a scene without sliding equilibrium to start from, or friction beyond Painlevé's limit;
    `TypeError` under reverse-mode derivatives without double precision.

    **Example:**

        >>> run = fj.simulate(scene.replace(p=1.5), t1=0.4, dt_save=1e-3, energy=True)
        >>> run.displacement.shape, run.meaning
        ((401, 3), 'reached its end')
    """
    method = EventExact() if method is None else method
    arguments.instance("scene", scene, Scene, "a Scene")
    arguments.instance("method", method, AbstractStepper, "a stepper, such as EventExact()")
    # They say how many rows there are.
    arguments.known("t1", t1)
    arguments.known("dt_save", dt_save)
    arguments.real_number("t1", t1, above=0)
    arguments.real_number("dt_save", dt_save, above=0)
    arguments.truth("energy", energy)
    arguments.one_of("derivatives", derivatives, MODES)
    refuse_painleve(scene)
    if not scene.structure.contacts_at_coordinates:
        return _in_contact_coordinates(
            scene, t1, dt_save, method, y0=y0, energy=energy, derivatives=derivatives, progress=progress
        )
    saved, steps = _saved_instants(method, t1, dt_save)
    start, given = ("sliding equilibrium", None) if y0 is None else ("given by y0", start_state(scene, y0))
    # Events shorten advances, so more may be needed than the interval divided by `dt`.
    most = steps + MOST_ADVANCES
    # What is traced is not followed yet.
    known = is_known(jax.tree.leaves((scene, given)))
    work = following("simulate", shown=progress, total=len(saved) - 1, unit=" rows")
    with work if known else contextlib.nullcontext():
        if has_kernel(scene, method):
            ending, found = _by_kernel(scene, method, given, saved, most, bool(energy), known)
        else:
            traced = functools.partial(rows_at, derivatives=None if derivatives == "none" else derivatives)
            # Runs with known values are not differentiated.
            rows = rows_in_parts if known else traced
            ending, found = _by_xla(scene, method, given, saved, most, bool(energy), rows)
    if not is_known(found["velocity"]):
        found = _without_derivatives_unless_begun(found)
    settings = (
        ("method", describe_method(method)),
        ("dt", float(method.dt)),
        ("dt_save", float(dt_save)),
        ("t1", float(t1)),
        ("start", start),
    )
    return Trajectory(**found, scene=scene, outcome=ending.astype(np.int8), settings=settings)


def _saved_instants(method: AbstractStepper, t1: float, dt_save: float) -> tuple[Float[np.ndarray, " T"], int]:
    """The saved instants (s), and how many steps of `dt` there are between two of them.

    **Raises:** `ValueError` for more of either than is possible.
    """
    # The most rows that a trajectory may have: some 20 GB. And the most steps between two of them.
    most_rows, most_steps = 10**8, 10**9
    if not method.chooses_its_steps and dt_save < method.dt * (1 - 1e-9):
        saved, step = apart(dt_save, method.dt)
        raise ValueError(
            f"Argument `dt_save` must be at least the method's step, but is {saved} s and `dt` is {step} s. Steps "
            f"end on saved instants, so no step would be as long as `dt`. Save less often, or lower `dt`."
        )
    with np.errstate(over="ignore"):
        rows = float(np.float64(t1) / np.float64(dt_save))
        steps = float(np.float64(min(dt_save, t1)) / np.float64(method.dt))
    if rows > most_rows:
        raise ValueError(
            f"Argument `dt_save` asks for {rows:.3g} rows up to t1 = {t1:g} s, which no memory holds; the most is "
            f"{most_rows:.0e}. Save less often, or stop earlier."
        )
    if steps > most_steps:
        raise ValueError(
            f"Argument `method` has steps of {method.dt:g} s, of which {steps:.3g} lie between two saved rows; the most is "
            f"{most_steps:.0e}. Give it a larger `dt`, or lower `dt_save`."
        )
    # The quotient is rounded: by that alone there is no row more.
    whole = max(math.ceil(rows * (1 - 1e-12) - 1e-9), 1)
    # By NumPy, because JAX would compile a small program for each operation.
    saved = np.append(np.minimum(float(dt_save) * np.arange(whole), float(t1)), float(t1))
    return saved, math.ceil(steps - 1e-9)


def _by_kernel(
    scene: Scene, method, given: State | None, saved, most: int, energy: bool, known: bool
) -> tuple[Array | np.int8, dict]:
    """How the motion ended, and its rows; from the equilibrium unless a start is `given`."""
    if given is None:
        refuse_without_equilibrium(scene)

    def follow():
        return rows_by_kernel(scene, method, given, saved, most, energy)

    # It takes some milliseconds and more.
    long = len(saved) * max(most - MOST_ADVANCES, 1) > 2e4
    followed = interruptible(follow) if long and known else follow()
    tick(len(saved) - 1)
    return followed


def _by_xla(
    scene: Scene, method, given: State | None, saved, most: int, energy: bool, rows: Callable[..., dict]
) -> tuple[Array | np.int8, dict]:
    """The same without a kernel, by `rows_in_parts` or `rows_at`."""
    stepper, y0 = with_step_as_array(method), start_state(scene, None) if given is None else given
    found = rows(scene, stepper, y0, saved, most, energy)
    return _ending(scene, stepper, found, found.pop("grown"), most, given is None), found


def _without_derivatives_unless_begun(rows: dict) -> dict:
    """The rows; where already the first is no number, their derivatives are none either. They would be zero, which an optimiser
    takes for a minimum.
    """
    share = jnp.where(jnp.all(jnp.isfinite(rows["velocity"][0])), 1.0, jnp.nan)
    return jax.tree.map(lambda leaf: leaf * share if eqx.is_inexact_array(leaf) else leaf, rows)


def _in_contact_coordinates(scene: Scene, *how, y0, **options) -> Trajectory:
    """`simulate` for a structure with contacts given by vectors: in contact coordinates, and transformed back."""
    structure = scene.structure
    inner, (x, _) = scene_in_contact_coordinates(scene), transformation(structure)
    if y0 is not None:
        y0 = start_in_contact_coordinates(scene, y0)
    run = simulate(inner, *how, y0=y0, **options)
    rows = {name: getattr(run, name) @ x.T for name in OF_COORDINATES}
    return dataclasses.replace(run, **rows, scene=scene)


def _at_contacts(rows: Float[Returned, "T n"], directions: np.ndarray) -> Float[Returned, "T *contacts"]:
    """A motion along the contacts' directions; with one contact, without an axis over contacts."""
    unit = np.count_nonzero(directions, axis=0) == 1
    # A column is selected, not multiplied by zeros, because another column may not be finite.
    along = (
        rows[:, np.argmax(directions, axis=0)]
        if np.all(unit & (np.max(directions, axis=0) == 1))
        else rows @ directions
    )
    return along[:, 0] if directions.shape[1] == 1 else along


def _ending(
    scene: Scene, method: AbstractStepper, rows: dict, grown, most: int, from_equilibrium: bool
) -> Array | np.int8:
    """How the rows end: an `Ending`. Under a transformation, where values are unknown, other failures count as not finite."""
    if not is_known(rows["velocity"]):
        finite = jnp.all(jnp.isfinite(rows["velocity"]), axis=-1)
        failure = jnp.where(jnp.any(grown), Ending.UNBOUNDED, Ending.NOT_FINITE)
        outcome = jnp.where(jnp.all(finite), Ending.FINISHED, failure)
        if from_equilibrium:
            outcome = jnp.where(finite[0], outcome, Ending.NO_EQUILIBRIUM)
        return jnp.where(physics.slides_uniquely(Mechanics(scene)), outcome, Ending.PAINLEVE).astype(jnp.int8)
    finite = np.all(np.isfinite(rows["velocity"]), axis=-1)
    if np.all(finite):
        return np.int8(Ending.FINISHED)
    if np.any(grown):
        return np.int8(Ending.UNBOUNDED)
    first = int(np.argmin(finite))
    if first == 0:
        return np.int8(Ending.NOT_FINITE)
    start = jnp.concatenate([rows["displacement"][first - 1], rows["velocity"][first - 1]])
    events, reached = _events_from(scene, method, real(rows["t"][first - 1]), start, np.asarray(most))
    if not np.all(np.isfinite(reached)):
        return np.int8(Ending.NOT_FINITE)
    return np.int8(Ending.TOO_MANY_EVENTS if 2 * int(events) > most else Ending.STEP_FAILURE)


@compiled
def _events_from(scene: Scene, method: AbstractStepper, t: Float[Array, ""], y: State, most: Int[Array, ""]):
    """How many of the next `most` advances end in an event, and the state after them."""
    mechanics = Mechanics(scene)

    def body(_, carry):
        y, contact, events = carry
        after = method.advance(mechanics, contact, scene.load(t), y, jnp.asarray(method.dt, y.dtype))
        # A rebound keeps its status but has touched the belt.
        landed = (contact.status == Status.DETACH) & (physics.gap(mechanics, after.y) == 0)
        return after.y, after.contact, events + jnp.any(landed | (after.contact.status != contact.status))

    contact = physics.status_from_forces(mechanics, scene.load(t), y)
    y, _, events = jax.lax.fori_loop(0, most, body, (y, contact, jnp.zeros((), jnp.int32)))
    return events, y
