r"""Derivatives of a functional of a trajectory, and whether they exist.

Derivatives through contact events are exact: event times are differentiated implicitly, and the derivative of the state jumps
at events as it must (`EventExact`). But they do not exist everywhere. Where a contact only just touches, lifts off or slips,
the smallest change of a parameter changes the sequence of events; there the state has no derivative, or only a one-sided one.
So `derivatives` also follows the guards of the trajectory and says how close it comes to that (`event_distance` has the
measures).
"""

import dataclasses
from collections.abc import Callable, Iterable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from ..foundation import arguments
from ..foundation.compiling import compiled
from ..foundation.precision import in_double_precision, known_to_numpy
from ..foundation.progress import reported
from ..model.scene import Scene, refuse_painleve, scene_in_contact_coordinates
from ..model.sliding import contact_coordinates
from ..steppers.base import AbstractStepper
from ..steppers.event_exact import EventExact
from .event_distance import ClosestCall, closest_call
from .start import checked_start, start_in_contact_coordinates, start_state
from .trajectory import Trajectory, simulate

# What has a derivative that is not worked out.
JUMPS_AT_ONCE = "two jumps of the load at one instant, which a parameter moves apart"
LANDINGS_OF_SEVERAL = "a landing of several contacts with hardly any restitution, under this impact law"
HELD_BY_STATIC_FRICTION = (
    "a landing after which static friction alone holds the contact, and the least rebound makes it slide"
)
ENERGY_OF_A_HELD_START = "the work of the impulse that holds a given start on the belt"
ENERGY_OF_RESTITUTION = "the share of a landing and of what follows in the ledger, by a restitution of 0"
NOT_WORKED_OUT = (
    JUMPS_AT_ONCE,
    LANDINGS_OF_SEVERAL,
    HELD_BY_STATIC_FRICTION,
    ENERGY_OF_A_HELD_START,
    ENERGY_OF_RESTITUTION,
)
# By the restitution, how far rebounds are from vanishing.
NO_REBOUND = "a landing without a rebound, at restitution 0,"
# With less restitution, rebounds end in no time. What follows is worked out for one contact, and for impacts with friction.
LITTLE = 1e-3


class Derivatives(eqx.Module):
    """The value of a functional of a trajectory, its derivatives, and how far they are from not existing."""

    value: Array
    by_name: dict[str, Array]  # of the functional's shape, per unit of the parameter
    events: int  # contact events on the trajectory
    closest: float  # smallest relative distance from another sequence of events; infinite without any
    closest_at: float  # its time, s
    closest_event: str = eqx.field(static=True)
    exist: bool = eqx.field(static=True)

    def __getitem__(self, name: str) -> Array:
        if name not in self.by_name:
            raise KeyError(
                f"There is no derivative by {name!r}, but by {', '.join(self.by_name)}; ask for it by `wrt`."
            )
        return self.by_name[name]

    def __repr__(self) -> str:
        def one(value):
            return f"{float(np.squeeze(value)):.8g}" if np.size(value) == 1 else f"array of shape {np.shape(value)}"

        def text(value):
            each = list(map(one, jax.tree.leaves(value)))
            return each[0] if len(each) == 1 else f"({', '.join(each)})"

        slopes = ", ".join(f"d/d {name} = {text(slope)}" for name, slope in self.by_name.items())
        return f"value {text(self.value)}; {slopes}; {self.events} contact events\n{self.reason}"

    @property
    def reason(self) -> str:
        """Why the derivatives exist or do not, as a sentence."""
        if not _finite(self.value):
            return (
                "No derivative can be relied on: the value itself is not finite. Where the run ends early, "
                "`fj.simulate(...).meaning` says why; more saved rows, a smaller `dt_save`, allow more steps."
            )
        if not np.isfinite(self.closest):
            return "The derivatives exist: no contact event comes anywhere near."
        where = f"{self.closest_event} at t = {self.closest_at:.6g} s"
        if self.closest_event in NOT_WORKED_OUT:
            return f"No derivative can be relied on: it is not worked out for {where}."
        call = f"The closest call is {where}, {self.closest:.1e} of its range away from changing."
        if self.exist:
            return f"The derivatives exist. {call}"
        return f"No derivative can be relied on, because the sequence of events is about to be another. {call}"


@reported("derivatives")
@in_double_precision
def derivatives(
    functional: Callable[[Trajectory], Array],
    scene: Scene,
    wrt: Iterable[str],
    t1: float = 2.0,
    dt_save: float = 1e-4,
    *,
    y0=None,
    energy: bool = False,
    mode: str = "forward",
    method: AbstractStepper | None = None,
    margin: float = 1e-6,
    progress: bool | None = None,
) -> Derivatives:
    """Derivatives of a functional of a trajectory in parameters of the scene, and whether they exist.

        d = fj.derivatives(lambda run: run.velocity[-1, 0], scene, ["mu", "k1"], t1=0.5)
        d["mu"], d.exist, d.reason

    **Arguments:**

    - `functional`: a smooth function of a `Trajectory`, written with `jax.numpy`: a peak, an energy, a line of the spectrum.
      Sums of *accelerations* over saved instants have no derivative where these jump; use differences of velocities.
      By the instant of a load's jump, a velocity saved at that very instant has one-sided derivatives only: the one towards
      later jumps is given.
    - `wrt`: names of parameters, any of `scene.parameters`. For `start` = 0 the derivative is that towards later times, for
      `restitution` = 0 that towards larger values. By `duration` = 0 none is worked out: give a short one, such as 1e-9 s.
    - `scene`, `t1`, `dt_save`, `y0`, `method`, `progress`: as in `simulate`. With `WhereSwitched` the derivatives are those of
      its steps, which are wrong after contact events.
    - `energy`: whether the trajectory has its ledger, `run.energy`, for a functional of energies.
    - `mode`: "forward" (faster up to some ten parameters) or "reverse" (keeps only the saved states in memory).
    - `margin`: the relative distance from another sequence of events below which derivatives are said not to exist.

    **Returns:** `Derivatives`.

    **Raises:** `ValueError` or `TypeError`, as a sentence, for an unknown name, and for anything that `simulate` refuses.

    **Example:**

        >>> found = fj.derivatives(lambda run: run.displacement[-1, 0], scene, ["mu", "k1"], t1=0.4)  # doctest: +SLOW
    """
    arguments.instance("scene", scene, Scene, "a Scene")
    arguments.known("scene", scene)
    if not callable(functional):
        raise TypeError(
            f"Argument `functional` must be a function of a Trajectory, but is {arguments.describe(functional)}."
        )
    if isinstance(wrt, str):
        raise TypeError(f'Argument `wrt` must be a list of names, such as ["{wrt}"], but is {str(wrt)!r} (str).')
    names = arguments.listed_names("wrt", wrt, "mu")
    arguments.names_of_parameters("wrt", names, scene.parameters)
    arguments.one_of("mode", mode, ("forward", "reverse"))
    arguments.real_number("margin", margin, minimum=0)
    arguments.truth("energy", energy)
    arguments.real_number("t1", t1, above=0)
    arguments.real_number("dt_save", dt_save, above=0)
    method = EventExact() if method is None else method
    arguments.instance("method", method, AbstractStepper, "a stepper, such as EventExact()")
    refuse_painleve(scene)
    # The equilibrium depends on the parameters, a given start does not. As an array, a start with other numbers is not compiled
    # anew.
    inner, given = scene_in_contact_coordinates(scene), None
    begin = start_state(inner, None if y0 is None else start_in_contact_coordinates(scene, y0))
    if y0 is not None:
        given = begin if inner is scene else checked_start(scene.structure.size, y0)
    value, by_name, moved = _differentiated(
        functional, scene, names, float(t1), float(dt_save), given, bool(energy), mode, method
    )
    # A parameter may have several numbers: one for each contact.
    moved = {
        what: np.concatenate([np.reshape(found[name], (-1, np.size(scene.parameters[name]))).T for name in names])
        for what, found in moved.items()
    }
    slips_move = np.any(moved["belt_speed"] != 0, axis=0) & (y0 is not None)
    calls = closest_call(inner, method, begin, float(t1), slips_move)
    n, (tangential, _) = inner.structure.size, contact_coordinates(inner.structure)
    held = np.any(slips_move & (np.asarray(begin)[n + tangential] == np.asarray(inner.belt_speed)))
    calls = _missing(scene, float(t1), moved, calls, bool(energy), bool(held)) or calls
    value = jax.tree.map(known_to_numpy, value)
    return Derivatives(
        value=value,
        # Rows that were not reached depend on nothing for JAX; their derivative is not zero but undefined.
        by_name={name: jax.tree.map(_where_finite, value, found) for name, found in by_name.items()},
        events=calls.events,
        closest=calls.closest,
        closest_at=calls.at,
        closest_event=calls.event,
        exist=bool(calls.closest > margin) and _finite(value),
    )


@compiled
def _differentiated(functional, scene, names, t1, dt_save, y0, energy, mode, method):
    def of(values):
        run = simulate(scene.replace(**values), t1, dt_save, method, y0=y0, energy=energy, derivatives=mode)
        try:
            value = functional(run)
        except arguments.NEEDS_NUMBERS as error:
            raise TypeError(
                "Argument `functional` must be a JAX function, but asks for a value while it is traced. Use `jax.numpy` in "
                "place of NumPy, and no `float` or `if`."
            ) from error
        except AttributeError as error:
            if energy or "NoneType" not in str(error):
                raise
            raise TypeError("Argument `functional` asks for energies: give `energy=True`.") from error
        leaves = jax.tree.leaves(value)
        if not leaves or not all(jnp.issubdtype(jnp.result_type(leaf), jnp.floating) for leaf in leaves):
            raise TypeError(
                f"Argument `functional` must return real numbers, but returns {value!r}: whole numbers, such as `status`, have "
                "no derivatives."
            )
        return value, value

    jacobian = jax.jacfwd if mode == "forward" else jax.jacrev

    def of_scene(values):
        changed = scene.replace(**values)
        return {"belt_speed": changed.belt_speed, "jumps": changed.load.jumps, "restitution": changed.restitution}

    values = {name: scene.parameters[name] for name in names}
    found, value = jacobian(of, has_aux=True)(values)
    # For a functional of several numbers, the parameters are the last axis.
    by_name = {name: jax.tree.map(lambda _, slopes, name=name: slopes[name], value, found) for name in names}
    return value, by_name, jax.jacfwd(of_scene)(values)


def _missing(
    scene: Scene, t1: float, moved: dict[str, np.ndarray], calls: ClosestCall, energy: bool, held: bool
) -> ClosestCall | None:
    """Something whose derivative is not worked out, or rebounds that nearly vanish; `moved`: the derivatives of parts of the
    scene, a row each; `held` is whether a given start sticks to a belt whose speed moves.
    """
    if energy and held:
        return dataclasses.replace(calls, closest=0.0, at=0.0, event=ENERGY_OF_A_HELD_START)
    jumps, apart = np.asarray(scene.load.jumps), np.any(np.diff(moved["jumps"], axis=-1) != 0, axis=0)
    # The load between two jumps at one instant is not known.
    at_once = jumps[1:][(np.diff(jumps) == 0) & apart & (jumps[1:] >= 0) & (jumps[1:] < t1)]
    if len(at_once):
        return dataclasses.replace(calls, closest=0.0, at=float(at_once[0]), event=JUMPS_AT_ONCE)
    restitution, landed = np.atleast_1d(scene.restitution), np.isfinite(calls.landed_at)
    moves = np.any(moved["restitution"] != 0, axis=0)
    if energy and landed and np.any(moves & (restitution == 0)):
        return dataclasses.replace(calls, closest=0.0, at=calls.landed_at, event=ENERGY_OF_RESTITUTION)
    several = len(scene.structure.places) > 1 and scene.impact_law != "coulomb"
    if several and landed and np.any(moves & (restitution < LITTLE)):
        return dataclasses.replace(calls, closest=0.0, at=calls.landed_at, event=LANDINGS_OF_SEVERAL)
    if calls.held < 0 and np.any(moves & (restitution == 0)):
        return dataclasses.replace(calls, closest=0.0, at=calls.landed_at, event=HELD_BY_STATIC_FRICTION)
    least = float(np.min(restitution, where=moves & (restitution > 0), initial=np.inf))
    if landed and least < calls.closest:
        return dataclasses.replace(calls, closest=least, at=calls.landed_at, event=NO_REBOUND)
    return None


def _finite(value) -> bool:
    return all(bool(np.all(np.isfinite(leaf))) for leaf in jax.tree.leaves(value))


def _where_finite(value, slope):
    """A derivative, whose last axis may be over a parameter's numbers; NaN where the value is no number."""
    slope = known_to_numpy(slope)
    return np.where(np.expand_dims(np.isfinite(value), tuple(range(np.ndim(value), np.ndim(slope)))), slope, np.nan)
